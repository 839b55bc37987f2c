/** A page that follows the store: it asks every second what has changed, and fetches views and curves when needed. */

const EVERY = 1000; // milliseconds between two questions, or ten times what an answer takes
const HIDDEN_EVERY = 15000; // while nobody sees the page
let version = DATA.version;
const fetched = new Map(); // `id key` -> promise of a curve; dropped with the next news of a run that trains
const fetchedViews = new Map(); // id -> promise
const previews = new Map(); // run -> stamp of its preview

async function ask(path, query = {}) {
  const pairs = Object.entries(query).flatMap(([name, v]) => (Array.isArray(v) ? v : [v]).map((one) => [name, one]));
  const answer = await fetch(`${path}?${new URLSearchParams(pairs)}`);
  if (!answer.ok) throw new Error(await answer.text());
  return answer;
}

const json = async (path, query) => (await ask(path, query)).json();
const idOf = (run) => value("run_id", run);

source = {
  withCurves: (runs) => runs,
  keys: (runs) => json("keys", { run: runs.slice(0, 20).map(idOf) }),
  async curves(runs, key) {
    const missing = runs.map(idOf).filter((id) => !fetched.has(`${id} ${key}`));
    if (missing.length) {
      const answer = json("curves", { key, run: missing });
      for (const id of missing) fetched.set(`${id} ${key}`, answer.then((all) => all[id]));
    }
    const found = await Promise.all(runs.map((run) => fetched.get(`${idOf(run)} ${key}`)));
    return new Map(runs.map((run, place) => [run, found[place]]).filter(([, curve]) => curve));
  },
  async views(run) {
    const id = idOf(run);
    if (!fetchedViews.has(id)) fetchedViews.set(id, json("views", { run: id }));
    const { views, preview } = await fetchedViews.get(id);
    previews.set(id, preview);
    const uri = (view, panel) => `picture?${new URLSearchParams({ run: id, view, panel })}`;
    return Object.fromEntries(Object.entries(views).map(([view, panels]) =>
      [view, Object.fromEntries(Object.entries(panels).map(([panel, size]) => [panel, { ...size, uri: uri(view, panel) }]))]));
  },
  plotly: () => new Promise((resolve, reject) => {
    document.head.append(element("script", { src: "plotly.js", onload: resolve, onerror: reject }));
  }),
  preview(run) {
    const stamp = previews.get(idOf(run));
    return stamp && value("state", run) !== "finished" ? [previewOf(run, stamp)] : [];
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
  const begun = performance.now();
  try {
    const news = await json("changes", { since: version });
    if (news.reload) return location.reload();
    version = news.version;
    if (news.data) take(news.data);
    $("live-status").textContent = "";
  } catch {
    $("live-status").textContent = "The server does not answer: what is shown is no longer followed.";
    $("live-status").className = "stale";
  }
  setTimeout(follow, Math.max(document.hidden ? HIDDEN_EVERY : EVERY, 10 * (performance.now() - begun)));
  return null;
}

document.addEventListener("visibilitychange", () => { if (!document.hidden) drawTraining(); });

/** Takes over the table of runs as it is now. Runs have other numbers in it, so what is chosen is found by its id. */
function take(data) {
  const unfinished = () => [...Array(DATA.total).keys()].filter((run) => value("state", run) !== "finished").map(idOf);
  const [compared, shownRun, changing] = [chosen.map(idOf), opened === null ? null : idOf(opened), unfinished()];
  Object.assign(DATA, data);
  columns.clear();
  for (const [name, packed] of Object.entries(data.columns)) columns.set(name, unpack(packed));
  forget();
  const stale = new Set([...changing, ...unfinished()]);
  for (const key of fetched.keys()) if (stale.has(key.slice(0, key.lastIndexOf(" ")))) fetched.delete(key);
  for (const id of stale) fetchedViews.delete(id);
  const numbers = new Map(column("run_id").map((id, run) => [id, run]));
  chosen.splice(0, chosen.length, ...compared.map((id) => numbers.get(id)).filter((run) => run !== undefined));
  opened = numbers.get(shownRun) ?? null;
  const usual = address.has("columns") ? shownColumns.filter((name) => columns.has(name)) : DATA.shown;
  if (shownColumns.length) shownColumns.splice(0, shownColumns.length, ...usual);
  for (const offer of [offerSelection, offerExplore, offerCurves, offerDifferences]) offer();
  select(); // every listener draws
  drawTraining();
  if (compared.some((id) => stale.has(id))) drawCompared();
  if (stale.has(shownRun) && opened !== null) fillDetail(opened);
}

/** Numbers of runs by state, and a card for each run that trains: how far it is, how good, and what it renders. */
async function drawTraining() {
  const states = Map.groupBy([...Array(DATA.total).keys()], (run) => value("state", run) ?? "unknown");
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
  const stamp = previews.get(idOf(run));
  return element("li", {}, link, ...bar,
    element("div", { class: "note" }, `step ${step.toLocaleString("en")}${steps ? ` of ${steps.toLocaleString("en")}` : ""}${psnr}`),
    ...(stamp ? [previewOf(run, stamp)] : []));
}
