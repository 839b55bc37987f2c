/** The runs that are compared, as many as one likes: what differs between them, their views side by side, and any two
 * pictures of a view under a slider. */

const chosen = []; // in the order in which they were chosen
const MOST_VIEWS = 24;

const letter = (place) => (place < 26 ? String.fromCharCode(65 + place) : `R${place + 1}`);

function choose(run, on) {
  if (on && !chosen.includes(run)) chosen.push(run);
  if (!on && chosen.includes(run)) chosen.splice(chosen.indexOf(run), 1);
  remember("compare", chosen.map((one) => encodeURIComponent(value("run_id", one))).join(","));
  drawTable();
  drawCompared();
}

let seenCompared = () => {};
const drawCompared = () => seenCompared();
let comparing = 0;

async function drawComparison() {
  const number = ++comparing;
  const runs = chosen.slice();
  $("chosen").replaceChildren(...runs.map((run, place) => element("li", {},
    element("strong", {}, letter(place)), " ", element("a", { href: hashOf(run), title: value("run_id", run) }, middle(nameOf(run), 60)),
    element("button", { type: "button", "aria-label": `stop comparing ${value("run_id", run)}`, onclick: () => choose(run, false) }, "×"))));
  $("none-chosen").hidden = runs.length > 0;
  $("compared").hidden = !runs.length;
  drawDifferences(runs);
  const views = await Promise.all(runs.map((run) => source.views(run)));
  if (number === comparing) drawViews(runs, views);
}

function nameOf(run) {
  const state = value("state", run);
  const psnr = value("psnr", run) === null ? "" : ` (${shown("psnr", value("psnr", run))} dB)`;
  return value("run_id", run) + psnr + (state === "finished" ? "" : `, ${state}`);
}

function drawViews(runs, views) {
  const pictured = runs.map((run, place) => ({ run, place, views: views[place] })).filter((one) => Object.keys(one.views).length);
  const together = Object.keys(pictured[0]?.views ?? {}).filter((view) => pictured.every((one) => one.views[view]));
  $("comparison").hidden = !together.length;
  const without = runs.filter((_, place) => !Object.keys(views[place]).length).map((run) => letter(runs.indexOf(run)));
  const reasons = [];
  if (without.length && !DATA.pictures.none) reasons.push(`No pictures of ${without.join(", ")} here: the run has none yet, or the page had no room for them (--max-images, --filter).`);
  if (pictured.length && !together.length) reasons.push("These runs were rendered from different views: choose runs of one scene.");
  $("no-comparison").textContent = reasons.join(" ");
  $("no-comparison").hidden = !reasons.length;
  if (!together.length) return;
  options($("view"), together.map((view) => [view, view]));
  const panels = Object.keys(pictured[0].views[together[0]]).filter((panel) => panel !== "truth");
  const sides = [["truth", "truth"], ...pictured.flatMap(({ place }) => panels.map((panel) => [`${place}:${panel}`, `${letter(place)}, ${panel}`]))];
  options($("left"), sides, "truth");
  options($("right"), sides, `${pictured[0].place}:render`);
  options($("grid-panel"), panels.map((panel) => [panel, panel]), "render");
  drawn = { pictured, together };
  drawPictures();
  drawGrid();
}

/** The runs with pictures, and the views that all of them have. */
let drawn = { pictured: [], together: [] };

function pictureOf(choice, view) {
  const [place, panel] = choice === "truth" ? [drawn.pictured[0].place, "truth"] : choice.split(":");
  return drawn.pictured.find((one) => one.place === Number(place)).views[view][panel];
}

function show(image, choice, view, name) {
  const { uri, width, height } = pictureOf(choice, view);
  if (image.getAttribute("src") !== uri) image.src = uri;
  image.alt = `${name}, view ${view}`;
  image.classList.toggle("pixels", width < 400);
  return { width, height };
}

function drawPictures() {
  if (!drawn.together.length) return;
  for (const id of ["left", "right"]) {
    const name = $(id).selectedOptions[0].textContent;
    const { width, height } = show($(`${id}-image`), $(id).value, $("view").value, name);
    const factor = Math.max(1, Math.floor(Math.min(640 / width, 520 / height)));
    $("slider").style.width = $("sides").style.width = `${width * factor}px`;
    $(`${id}-name`).textContent = name;
  }
  moveSlider();
}

/** A row for the truth and for each run, a column for each view. */
function drawGrid() {
  const views = drawn.together.slice(0, MOST_VIEWS);
  const row = (name, choice) => element("tr", {}, element("th", { scope: "row" }, name), ...views.map((view) => {
    const image = element("img", { loading: "lazy" });
    const { width, height } = show(image, choice, view, name);
    image.width = Math.max(96, Math.min(width, 160));
    image.height = Math.round(image.width * height / width);
    return element("td", {}, image);
  }));
  const panel = $("grid-panel").value;
  $("grid").replaceChildren(
    element("thead", {}, element("tr", {}, element("th", {}), ...views.map((view) => element("th", { scope: "col" }, view)))),
    element("tbody", {}, row("truth", "truth"), ...drawn.pictured.map(({ place }) => row(letter(place), `${place}:${panel}`))));
  const more = drawn.together.length - views.length;
  $("grid-status").textContent = more > 0 ? `${more} more views are in the choice above.` : "";
}

function moveSlider() {
  const different = pressed("difference");
  $("slider").style.setProperty("--at", `${$("position").value}%`);
  $("slider").classList.toggle("bright", different);
  $("right-image").classList.toggle("difference", different);
  $("slider").querySelector(".bar").hidden = different;
  $("position").disabled = different;
}

function drawDifferences(runs) {
  const differ = (name) => new Set(runs.map((run) => JSON.stringify(value(name, run)))).size > 1;
  const settings = DATA.settings.filter(differ);
  const results = DATA.shown.filter((name) => isNumeric(name) && !DATA.settings.includes(name) && differ(name));
  const row = (name) => element("tr", {}, element("th", { scope: "row" }, heading(name)),
    ...runs.map((run) => element("td", { class: "wrap" }, shown(name, value(name, run)))));
  $("config-diff").replaceChildren(
    element("thead", {}, element("tr", {}, element("th", { scope: "col" }, "setting"), ...runs.map((_, place) => element("th", { scope: "col" }, letter(place))))),
    element("tbody", {}, ...settings.map(row), ...results.map(row)));
  const count = settings.length;
  $("diff-status").textContent = runs.length < 2 ? "Choose another run to see what differs."
    : `${count} of ${DATA.settings.length} settings differ${results.length ? "; then the results" : ""}.`;
}

/** The best run with pictures, and the best of another configuration on the same scene, with the same seed if there is one. */
function firstPair() {
  const pictured = (run) => DATA.pictures.none || DATA.pictures.runs[run];
  const finished = selection.runs.filter((run) => value("state", run) === "finished" && value("scene_name", run) === DATA.scenes[0] && pictured(run));
  const [best] = finished;
  const others = finished.filter((run) => value("configuration", run) !== value("configuration", best));
  return [best, others.find((run) => value("seed", run) === value("seed", best)) ?? others[0]].filter((run) => run !== undefined);
}

function startCompare() {
  const wanted = address.get("compare")?.split(",").map((id) => column("run_id").indexOf(decodeURIComponent(id)));
  chosen.push(...(wanted?.filter((run) => run >= 0) ?? firstPair()));
  for (const id of ["view", "left", "right"]) $(id).addEventListener("change", drawPictures);
  $("grid-panel").addEventListener("change", drawGrid);
  $("position").addEventListener("input", moveSlider);
  $("difference").addEventListener("click", () => { toggle($("difference")); moveSlider(); });
  keep("view", "left", "right", "grid-panel");
  seenCompared = whenSeen("compared-section", drawComparison);
  drawTable(); // with the ticks of what is compared
  drawCompared();
}
