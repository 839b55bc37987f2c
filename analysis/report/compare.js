/** Two runs beside each other: their pictures under a slider, and what differs between their configurations. */

const compared = { a: null, b: null };
const MOST_CHOICES = 500;

function compare(side, run) {
  compared[side] = run;
  drawCompared();
  drawTable();
}

/** Runs to choose from: the selected ones, with pictures first, and those that are chosen. */
function drawChoices() {
  const withPictures = selection.runs.filter((run) => DATA.pictures.runs[run]);
  for (const side of ["a", "b"]) {
    const runs = new Set([compared[side], ...withPictures, ...selection.runs].filter((run) => run !== null).slice(0, MOST_CHOICES));
    options($(`run-${side}`), [...runs].map((run) => [run, nameOf(run)]));
    $(`run-${side}`).value = compared[side];
  }
}

function nameOf(run) {
  const psnr = value("psnr", run);
  const state = value("state", run);
  return value("run_id", run) + (psnr === null ? "" : ` (${shown("psnr", psnr)} dB)`) + (state === "finished" ? "" : `, ${state}`);
}

function drawCompared() {
  drawChoices();
  drawViews();
  drawDifferences();
}

const pictureOf = (run, view, kind) => DATA.pictures.runs[run]?.[view]?.[kind];

function drawViews() {
  const views = [compared.a, compared.b].map((run) => Object.keys(DATA.pictures.runs[run] ?? {}));
  const together = views[0].filter((view) => views[1].includes(view));
  $("comparison").hidden = !together.length;
  $("no-comparison").hidden = together.length > 0 || DATA.pictures.none;
  if (!together.length) {
    const without = ["a", "b"].filter((_, side) => !views[side].length).map((side) => side.toUpperCase());
    $("no-comparison").textContent = without.length
      ? `No pictures of ${without.join(" and ")} on this page: the run has none, or others came first (--max-images, --filter).`
      : "A and B were rendered from different views: choose two runs of one scene.";
    return;
  }
  options($("view"), together.map((view) => [view, view]));
  const items = Object.entries(SIDES).map(([choice, [name]]) => [choice, name]);
  for (const [id, standard] of [["left", "truth"], ["right", "a"]]) {
    const first = !$(id).options.length;
    options($(id), items);
    if (first) $(id).value = standard;
  }
  drawPictures();
}

/** What the two sides of the slider can show: name, run, kind of picture. */
const SIDES = {
  truth: ["truth", "a", "truth"],
  a: ["A, render", "a", "render"],
  b: ["B, render", "b", "render"],
  "a-depth": ["A, depth", "a", "depth"],
  "b-depth": ["B, depth", "b", "depth"],
};

function show(image, choice) {
  const [name, side, kind] = SIDES[choice];
  const { uri, width, height } = DATA.pictures.files[pictureOf(compared[side], $("view").value, kind)];
  image.src = uri;
  image.alt = `${name}, view ${$("view").value}`;
  image.classList.toggle("pixels", width < 400);
  return { name, width, height };
}

function drawPictures() {
  for (const id of ["left", "right"]) {
    const { name, width, height } = show($(`${id}-image`), $(id).value);
    const scale = Math.max(1, Math.floor(Math.min(640 / width, 520 / height)));
    $("slider").style.width = $("sides").style.width = `${width * scale}px`;
    $(`${id}-name`).textContent = name;
  }
  $("thumbs").replaceChildren(...Object.keys(SIDES).map((choice) => {
    const image = element("img");
    const { name } = show(image, choice);
    return element("figure", {}, image, element("figcaption", {}, name));
  }));
  moveSlider();
}

function moveSlider() {
  const different = $("difference").getAttribute("aria-pressed") === "true";
  $("slider").style.setProperty("--at", `${$("position").value}%`);
  $("slider").classList.toggle("bright", different);
  $("right-image").classList.toggle("difference", different);
  $("slider").querySelector(".bar").hidden = different;
  $("position").disabled = different;
}

function drawDifferences() {
  const { a, b } = compared;
  const same = (one, two) => JSON.stringify(one) === JSON.stringify(two);
  const different = DATA.settings.filter((name) => !same(value(name, a), value(name, b)));
  const results = DATA.shown.filter((name) => isNumeric(name) && !DATA.settings.includes(name) && !same(value(name, a), value(name, b)));
  const row = (name) =>
    element("tr", {}, element("th", { scope: "row" }, heading(name)),
      ...[a, b].map((run) => element("td", { class: "wrap" }, shown(name, value(name, run)))));
  $("config-diff").tBodies[0].replaceChildren(...different.map(row), ...results.map(row));
  const count = different.length;
  $("diff-status").textContent = `${count} of ${DATA.settings.length} settings differ${results.length ? "; then the results" : ""}.`;
}

function startCompare() {
  const common = selection.runs.filter((run) => value("scene_name", run) === DATA.scenes[0] && value("state", run) === "finished");
  const pictured = common.filter((run) => DATA.pictures.runs[run]);
  const candidates = [pictured, common, selection.runs].find((runs) => runs.length);
  compared.a = candidates[0];
  const scene = value("scene_name", compared.a);
  const [kind, seed] = ["field", "seed"].map((name) => value(name, compared.a));
  const others = candidates.filter((run) => value("scene_name", run) === scene && value("field", run) !== kind);
  compared.b = others.find((run) => value("seed", run) === seed) ?? others[0] ?? candidates[1] ?? compared.a;
  for (const side of ["a", "b"]) $(`run-${side}`).addEventListener("change", (event) => compare(side, Number(event.target.value)));
  for (const id of ["view", "left", "right"]) $(id).addEventListener("change", drawPictures);
  $("position").addEventListener("input", moveSlider);
  $("difference").addEventListener("click", () => { toggle($("difference")); moveSlider(); });
  selection.listeners.push(drawChoices);
  drawCompared();
}
