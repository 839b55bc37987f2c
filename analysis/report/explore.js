/** Any number against any other, and parallel coordinates: an axis for each setting that differs, a line a run. */

const MOST_LINES = 300;
const MOST_AXES = 10;
const MOST_TICKS = 6;

let seenExplore = () => {};
const drawExplore = () => seenExplore();

async function drawExploreNow() {
  await plotly;
  const [x, y, key] = ["scatter-x", "scatter-y", "scatter-by"].map((id) => $(id).value);
  const known = (run) => value(x, run) !== null && typeof value(y, run) === "number";
  const runs = selection.runs.filter(known).slice(0, MOST_MARKS);
  const paint = colouring(key, runs);
  await Plotly.react("scatter", [{
    mode: "markers", x: runs.map((run) => value(x, run)), y: runs.map((run) => value(y, run)), customdata: runs,
    text: runs.map((run) => `${escaped(value("run_id", run))}<br>${key ? `${escaped(heading(key))}: ${escaped(text(value(key, run)) ?? "none")}` : ""}`),
    hovertemplate: `%{text}<br>${escaped(heading(y))} %{y:.4~g}<br>${escaped(heading(x))} %{x}<extra></extra>`,
    marker: { color: runs.map(paint.of), size: 7, opacity: 0.75 },
  }], plotLayout(heading(x), heading(y), {
    xaxis: { type: isNumeric(x) ? (pressed("scatter-logx") ? "log" : "linear") : "category" },
    yaxis: { type: pressed("scatter-logy") ? "log" : "linear" },
  }), plotSettings);
  listen("scatter");
  drawLegend($("scatter-legend"), key, paint.entries);
  const left = selection.runs.length - runs.length;
  $("scatter-status").textContent = `${counted(runs.length, "run")}${left ? `; ${left.toLocaleString("en")} selected runs lack one of both, or are too many` : ""}.`;
  await drawParallel();
}

function listen(id) {
  $(id).removeAllListeners("plotly_click");
  $(id).on("plotly_click", ({ points: [point] }) => openRun(point.customdata));
}

async function drawParallel() {
  const result = $("scatter-y").value;
  const runs = selection.runs.filter((run) => value(result, run) !== null).slice(0, MOST_LINES);
  const axes = [...varying(runs), result].map((name) => axisOf(name, runs));
  const paint = colouring(result, runs);
  const traces = runs.map((run) => ({
    mode: "lines", x: axes.map((_, place) => place), y: axes.map((axis) => axis.at(value(axis.name, run))),
    customdata: axes.map(() => run), line: { color: paint.of(run), width: 1.2 }, opacity: 0.6,
    text: axes.map((axis) => `${escaped(value("run_id", run))}<br>${escaped(heading(axis.name))}: ${escaped(shown(axis.name, text(value(axis.name, run))))}`),
    hovertemplate: "%{text}<extra></extra>",
  }));
  const layout = plotLayout("", "", {
    xaxis: { tickvals: axes.map((_, place) => place), ticktext: axes.map((axis) => escaped(middle(heading(axis.name), 18))), showgrid: true, range: [-0.3, axes.length - 0.5] },
    yaxis: { visible: false, range: [-0.06, 1.06] },
  });
  layout.annotations = axes.flatMap((axis, place) => axis.ticks.map(([name, y]) => (
    { x: place, y, text: escaped(name), showarrow: false, xanchor: "left", xshift: 4, font: { size: 10.5 }, bgcolor: colour("--paper") })));
  await Plotly.react("parallel", traces, { ...layout, showlegend: false }, plotSettings);
  listen("parallel");
  const left = selection.runs.length - runs.length;
  $("parallel-status").textContent = runs.length
    ? `${counted(runs.length, "run")}, coloured by ${heading(result)}${left ? `; ${left.toLocaleString("en")} selected runs are not drawn` : ""}. The axes are the settings that differ, at most ${MOST_AXES}.`
    : "No selected run has this result.";
}

/** Settings with several values among the runs, those with few values first. */
function varying(runs) {
  const label = ["scene_name", "field", "encoder", "density", "color"];
  const idle = /\.(path|fingerprint)$|^scene\.name$|^(density|color)\.(name|rates|initials)/;
  const levels = (name) => new Set(runs.map((run) => text(value(name, run)))).size;
  const counted = [...new Set([...label, ...DATA.settings])].filter((name) => columns.has(name) && !idle.test(name)).map((name) => [name, levels(name)]);
  return counted.filter(([, count]) => count > 1 && count <= Math.max(12, runs.length / 2)).slice(0, MOST_AXES).map(([name]) => name);
}

/** An axis from 0 to 1: {name, at: value -> place, ticks: [text, place]}. Other values than numbers are spread evenly. */
function axisOf(name, runs) {
  const values = [...new Set(runs.map((run) => text(value(name, run))))];
  const numbers = values.filter((v) => typeof v === "number").sort((a, b) => a - b);
  const [low, high] = [numbers[0], numbers.at(-1)];
  if (numbers.length === values.length && numbers.length > MOST_TICKS) {
    const at = (v) => (v - low) / (high - low || 1);
    return { name, at, ticks: [0, 0.25, 0.5, 0.75, 1].map((share) => [(low + share * (high - low)).toLocaleString("en", { maximumSignificantDigits: 3 }), share]) };
  }
  const sorted = values.sort((a, b) => String(a).localeCompare(String(b), "en", { numeric: true }));
  const place = new Map(sorted.map((v, number) => [v, sorted.length === 1 ? 0.5 : number / (sorted.length - 1)]));
  const every = Math.ceil(sorted.length / (2 * MOST_TICKS));
  return { name, at: (v) => place.get(text(v)), ticks: sorted.filter((_, n) => n % every === 0).map((v) => [middle(String(v ?? "none"), 14), place.get(v)]) };
}

function offerExplore() {
  const numbers = [...columns.keys()].filter(isNumeric).sort();
  const usual = ["psnr", "ssim", "params.heads", "params.total", "step_ms", "train_s"].filter((name) => numbers.includes(name));
  const named = (names) => [...new Set(names)].map((name) => [name, heading(name)]);
  options($("scatter-y"), named([...usual, ...numbers]), "psnr");
  options($("scatter-x"), named([...usual, ...telling(), ...numbers]), "params.heads");
  options($("scatter-by"), [["", "one colour"], ...named(telling())], "field");
}

function startExplore() {
  offerExplore();
  for (const id of ["scatter-x", "scatter-y", "scatter-by"]) $(id).addEventListener("change", drawExplore);
  for (const id of ["scatter-logx", "scatter-logy"]) $(id).addEventListener("click", () => { toggle($(id)); drawExplore(); });
  keep("scatter-x", "scatter-y", "scatter-by", "scatter-logx", "scatter-logy");
  seenExplore = whenSeen("explore-section", drawExploreNow);
  selection.listeners.push(drawExplore);
  drawExplore();
}
