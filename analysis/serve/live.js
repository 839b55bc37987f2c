/** A page that follows the store: it asks every second what has changed, and fetches views and curves when needed. */

const EVERY = 1000; // milliseconds between two questions
const HIDDEN_EVERY = 15000; // while nobody sees the page
let version = DATA.version;
const numberOf = new Map(); // run id -> its number on this page
const fetched = new Map(); // `run key` -> promise of a curve; dropped when the run's row changes
const fetchedViews = new Map();
const previews = new Map(); // run -> stamp of its preview

async function ask(path, query = {}, more = {}) {
  const pairs = Object.entries(query).flatMap(([name, v]) => (Array.isArray(v) ? v : [v]).map((one) => [name, one]));
  const answer = await fetch(`${path}?${new URLSearchParams(pairs)}`, more);
  if (!answer.ok) throw new Error(await answer.text());
  return answer;
}

const json = async (path, query) => (await ask(path, query)).json();
const idOf = (run) => value("run_id", run);

source = {
  withCurves: (runs) => runs,
  keys: (runs) => json("keys", { run: runs.slice(0, 20).map(idOf) }),
  async curves(runs, key) {
    const missing = runs.filter((run) => !fetched.has(`${run} ${key}`));
    if (missing.length) {
      const answer = json("curves", { key, run: missing.map(idOf) });
      for (const run of missing) fetched.set(`${run} ${key}`, answer.then((all) => all[idOf(run)]));
    }
    const found = await Promise.all(runs.map((run) => fetched.get(`${run} ${key}`)));
    return new Map(runs.map((run, place) => [run, found[place]]).filter(([, curve]) => curve));
  },
  async views(run) {
    if (!fetchedViews.has(run)) fetchedViews.set(run, json("views", { run: idOf(run) }));
    const { views, preview } = await fetchedViews.get(run);
    previews.set(run, preview);
    const uri = (view, panel) => `picture?${new URLSearchParams({ run: idOf(run), view, panel })}`;
    return Object.fromEntries(Object.entries(views).map(([view, panels]) =>
      [view, Object.fromEntries(Object.entries(panels).map(([panel, size]) => [panel, { ...size, uri: uri(view, panel) }]))]));
  },
  plotly: () => new Promise((resolve, reject) => {
    document.head.append(element("script", { src: "plotly.js", onload: resolve, onerror: reject }));
  }),
  preview(run) {
    const stamp = previews.get(run);
    return stamp && value("state", run) !== "finished" ? [previewOf(run, stamp)] : [];
  },
  editor,
  prepare() {
    for (const [run, id] of column("run_id").entries()) numberOf.set(id, run);
  },
  start() {
    startDifferences();
    drawTraining();
    follow();
  },
};

function previewOf(run, stamp) {
  const src = `picture?${new URLSearchParams({ run: idOf(run), view: stamp, panel: "preview" })}`;
  return element("figure", {}, element("img", { src, alt: `truth, render, error and depth of ${idOf(run)} in training`, class: "pixels" }),
    element("figcaption", {}, "truth, render, error, depth of one view"));
}

async function follow() {
  try {
    const news = await json("changes", { since: version });
    if (news.reload) return location.reload();
    version = news.version;
    if (Object.keys(news.rows).length || news.removed.length) apply(news);
    $("live-status").textContent = "";
  } catch {
    $("live-status").textContent = "The server does not answer: what is shown is no longer followed.";
    $("live-status").className = "stale";
  }
  setTimeout(follow, document.hidden ? HIDDEN_EVERY : EVERY);
  return null;
}

document.addEventListener("visibilitychange", () => { if (!document.hidden) drawTraining(); });

/** Takes over whole rows, and the runs that are gone. A reload names the configurations of new runs. */
function take({ rows, removed }) {
  const known = new Set(columns.keys());
  for (const [id, row] of Object.entries(rows)) {
    const run = numbered(id);
    for (const [name, values] of columns) if (name !== "configuration") values[run] = row[name] ?? null;
    set(run, Object.entries(row).filter(([name]) => !columns.has(name)));
    for (const key of fetched.keys()) if (key.startsWith(`${run} `)) fetched.delete(key);
    fetchedViews.delete(run);
  }
  for (const id of removed) if (numberOf.has(id)) gone.add(numberOf.get(id));
  forget();
  const fresh = [...columns.keys()].filter((name) => !known.has(name));
  DATA.settings.push(...fresh.filter(isSetting));
  if (fresh.some((name) => DATA.usual.includes(name))) {
    const wanted = [...DATA.shown, ...fresh];
    DATA.shown = DATA.usual.filter((name) => wanted.includes(name));
    if (!address.has("columns") && shownColumns.length) shownColumns.splice(0, shownColumns.length, ...DATA.shown);
  }
  DATA.scenes = [...new Set(DATA.scenes.concat(column("scene_name").filter((scene) => scene !== null)))];
}

function apply(news) {
  take(news);
  refresh(Object.keys(news.rows).map((id) => numberOf.get(id)));
}

const isSetting = (name) => name.includes(".") && !/^(params|time|run)\./.test(name);

function numbered(id) {
  if (!numberOf.has(id)) {
    numberOf.set(id, DATA.total);
    DATA.total += 1;
    for (const values of columns.values()) values.push(null);
  }
  gone.delete(numberOf.get(id));
  return numberOf.get(id);
}

function set(run, pairs) {
  for (const [name, v] of pairs) {
    if (!columns.has(name)) columns.set(name, new Array(DATA.total).fill(null));
    columns.get(name)[run] = v;
  }
}

function refresh(changed) {
  for (const offer of [offerSelection, offerExplore, offerCurves, offerDifferences]) offer();
  select(); // every listener draws
  drawTraining();
  if (chosen.some((run) => changed.includes(run))) drawCompared();
  if (opened !== null && changed.includes(opened) && !$("detail").contains(document.activeElement?.closest("form"))) fillDetail(opened);
}

/** Numbers of runs by state, and a card for each run that trains: how far it is, how good, and what it renders. */
async function drawTraining() {
  const here = [...Array(DATA.total).keys()].filter((run) => !gone.has(run));
  const states = Map.groupBy(here, (run) => value("state", run) ?? "unknown");
  $("counts").replaceChildren(...[...states].map(([state, runs]) =>
    element("li", {}, element("strong", { class: `state-${state}` }, runs.length.toLocaleString("en")), ` ${state}`)));
  const running = (states.get("running") ?? []).slice(-MOST_CARDS);
  $("training-section").hidden = !running.length;
  document.querySelector('nav [href="#training-section"]').parentElement.hidden = !running.length;
  if (document.hidden) return;
  await Promise.all(running.map(source.views));
  const logged = await source.curves(running, "eval/psnr");
  $("training").replaceChildren(...running.map((run) => card(run, logged.get(run))));
}

const MOST_CARDS = 6;

function card(run, curve) {
  const [step, steps] = [value("step", run) ?? 0, value("train.steps", run)];
  const bar = steps ? [element("progress", { max: steps, value: step, "aria-label": "steps done" })] : [];
  const last = curve?.value.at(-1) ?? null;
  const psnr = last === null ? "" : `, held-out PSNR ${last.toFixed(2)} dB at step ${curve.step.at(-1).toLocaleString("en")}`;
  const link = element("a", { href: hashOf(run), title: idOf(run) }, middle(idOf(run), 38));
  const stamp = previews.get(run);
  return element("li", {}, link, ...bar,
    element("div", { class: "note" }, `step ${step.toLocaleString("en")}${steps ? ` of ${steps.toLocaleString("en")}` : ""}${psnr}`),
    ...(stamp ? [previewOf(run, stamp)] : []));
}

/** Tags and note of a run, to be changed. */
function editor(run) {
  const tags = element("input", { type: "text", value: (value("tags", run) ?? []).join(" "), spellcheck: "false", autocomplete: "off" });
  const note = element("textarea", { rows: 3 });
  note.value = value("note", run) ?? "";
  const said = element("span", { class: "note", role: "status" });
  const save = async (event) => {
    event.preventDefault();
    const before = value("tags", run) ?? [];
    const after = tags.value.split(/[\s,]+/).filter(Boolean);
    const wanted = { add: after.filter((tag) => !before.includes(tag)), remove: before.filter((tag) => !after.includes(tag)), note: note.value };
    try {
      const headers = { "Content-Type": "application/json" };
      const answer = await ask("annotate", { run: idOf(run) }, { method: "POST", headers, body: JSON.stringify(wanted) });
      const written = await answer.json();
      set(run, [["tags", written.tags.length ? written.tags : null], ["note", written.note || null]]);
      forget();
      said.textContent = "saved";
      select();
    } catch (error) {
      said.textContent = error.message;
    }
  };
  return element("form", { class: "editor", onsubmit: save }, element("label", {}, "Tags", tags), element("label", {}, "Note", note),
    element("div", { class: "controls" }, element("button", { type: "submit" }, "Save"), said));
}
