/** Interactive plots of the selected runs: a mark a run, a larger one a configuration, and the Pareto front. */

const plotSettings = { responsive: true, displayModeBar: false };

/** Resolved when Plotly is there; everything but the plots is shown before. */
let plotly = Promise.resolve();

let seenPlots = () => {};
const drawPlots = () => seenPlots();

function plotLayout(x, y, more = {}) {
  const [ink, muted, line] = ["--ink", "--muted", "--line"].map(colour);
  const axis = { gridcolor: line, linecolor: muted, zeroline: false, ticks: "outside", tickcolor: muted, automargin: true };
  return {
    paper_bgcolor: "rgba(0,0,0,0)",
    plot_bgcolor: "rgba(0,0,0,0)",
    font: { color: ink, size: 12.5, family: getComputedStyle(document.body).fontFamily },
    margin: { l: 58, r: 12, t: 12, b: 48 },
    hoverlabel: { bgcolor: colour("--panel"), bordercolor: muted, font: { color: ink }, align: "left" },
    legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0 },
    hovermode: "closest",
    xaxis: { ...axis, title: { text: escaped(x), standoff: 8 }, ...more.xaxis },
    yaxis: { ...axis, title: { text: escaped(y), standoff: 8 }, ...more.yaxis },
  };
}

const MOST_MARKS = 3000;

/** Mean and standard deviation (n - 1; null for one value). */
function spread(values) {
  const mean = values.reduce((sum, v) => sum + v, 0) / values.length;
  if (values.length < 2) return { mean, std: null };
  return { mean, std: Math.sqrt(values.reduce((sum, v) => sum + (v - mean) ** 2, 0) / (values.length - 1)) };
}

/** Finished runs among the selected ones that have both numbers. */
function drawable(x, y, scene) {
  const usable = (v) => typeof v === "number";
  return selection.runs.filter(
    (run) =>
      value("state", run) === "finished" && value("scene_name", run) === scene &&
      usable(value(x, run)) && value(x, run) > 0 && usable(value(y, run)),
  );
}

/** One point a configuration: name, field, runs, and mean and spread of x and y. */
function configurations(runs, x, y) {
  const groups = Map.groupBy(runs, (run) => value("configuration", run));
  return [...groups].map(([name, members]) => ({
    name,
    field: value("field", members[0]),
    runs: members,
    x: spread(members.map((run) => value(x, run))),
    y: spread(members.map((run) => value(y, run))),
  }));
}

/** The points that no other beats: going right, each is better than all before it. */
function front(points, y) {
  const sign = DATA.metrics[y].sign;
  let best = -Infinity;
  return [...points]
    .sort((a, b) => a.x.mean - b.x.mean || sign * (b.y.mean - a.y.mean))
    .filter((point) => {
      const better = sign * point.y.mean > best;
      if (better) best = sign * point.y.mean;
      return better;
    });
}

function traces(x, y, scene) {
  const runs = drawable(x, y, scene);
  const points = configurations(runs, x, y);
  const best = DATA.unranked[x] ? [] : front(points, y);
  const drawn = [{
    name: "Pareto front", mode: "lines", hoverinfo: "skip",
    x: best.map((point) => point.x.mean), y: best.map((point) => point.y.mean),
    line: { color: colour("--muted"), width: 1.2, dash: "dot" },
  }];
  for (const [field, style] of Object.entries(DATA.fields)) {
    const marker = { color: style.colour, symbol: style.symbol };
    const single = runs.filter((run) => value("field", run) === field);
    const means = points.filter((point) => point.field === field);
    if (!single.length) continue;
    if (runs.length <= MOST_MARKS) drawn.push({
      name: `${field}, runs`, showlegend: false, legendgroup: field, mode: "markers",
      x: single.map((run) => value(x, run)), y: single.map((run) => value(y, run)), customdata: single,
      text: single.map((run) => `${escaped(value("run_id", run))}<br>seed ${value("seed", run)}`),
      hovertemplate: `%{text}<br>${heading(y)} %{y:.4~g}<br>${heading(x)} %{x:,.4~g}<extra></extra>`,
      marker: { ...marker, size: 5, opacity: 0.45 },
    });
    const bars = (axis) => ({
      type: "data", array: means.map((point) => point[axis].std), visible: means.some((point) => point[axis].std !== null),
      color: style.colour, thickness: 1.1, width: 3,
    });
    drawn.push({
      name: field, legendgroup: field, mode: "markers",
      x: means.map((point) => point.x.mean), y: means.map((point) => point.y.mean),
      error_x: x.startsWith("params.") ? { visible: false } : bars("x"), error_y: bars("y"),
      customdata: means.map((point) => bestOf(point.runs, y)), text: means.map((point) => hoverOf(point, y)),
      hovertemplate: `%{text}<br>${heading(x)} %{x:,.4~g}<extra></extra>`,
      marker: { ...marker, size: 11, line: { color: colour("--paper"), width: 1 } },
    });
  }
  return { drawn, best, runs, points };
}

/** Of the runs of a configuration, the one that a click on their mean opens. */
function bestOf(runs, y) {
  const sign = DATA.metrics[y].sign;
  return runs.reduce((a, b) => (sign * value(y, b) > sign * value(y, a) ? b : a));
}

function hoverOf(point, y) {
  const n = point.runs.length;
  const std = point.y.std === null ? "" : ` ± ${shown(y, point.y.std)}`;
  return `<b>${escaped(point.name)}</b><br>${escaped(heading(y))} ${shown(y, point.y.mean)}${std} (${n} seed${n > 1 ? "s" : ""})`;
}

/** Plotly reads a few tags in texts; names from outside must not be read as such. */
function escaped(text) {
  return String(text).replaceAll("&", "&amp;").replaceAll("<", "&lt;").replaceAll(">", "&gt;");
}

async function drawPlotsNow() {
  await plotly;
  const [scene, y] = [$("plot-scene").value, $("plot-y").value];
  const said = [];
  for (const id of ["capacity", "speed"]) {
    const x = $(`${id}-x`).value;
    if (!x || !y) continue;
    const { drawn, best, runs, points } = traces(x, y, scene);
    const layout = plotLayout(heading(x), heading(y), { xaxis: logarithmic(runs.map((run) => value(x, run)), $(id).clientWidth < 420 ? 5 : 7) });
    if (!runs.length) layout.annotations = [{ text: "no selected run has both", showarrow: false, xref: "paper", yref: "paper", x: 0.5, y: 0.5 }];
    await Plotly.react(id, drawn, layout, plotSettings);
    $(id).removeAllListeners("plotly_click");
    $(id).on("plotly_click", ({ points: [point] }) => openRun(point.customdata));
    if (id === "speed") {
      said.push(`${runs.length.toLocaleString("en")} finished runs of ${points.length.toLocaleString("en")} configurations`);
      if (DATA.unranked[x]) said.push(DATA.unranked[x]);
      if (best.length) said.push(`Pareto front of ${heading(y)} against ${heading(x)}: ${best.slice(0, 6).map((p) => p.name).join("; ")}`);
    }
  }
  if (selection.runs.length > MOST_MARKS) said.push("too many runs for a mark each: only means are drawn");
  $("plots-status").textContent = `${said.join(". ")}.`;
}

/** A logarithmic axis around positive values, with at most so many labels at round numbers. */
function logarithmic(values, most) {
  const low = values.reduce((a, b) => Math.min(a, b), Infinity) / 1.2;
  const high = values.reduce((a, b) => Math.max(a, b), 0) * 1.2;
  const decades = Array.from({ length: 16 }, (_, power) => 10 ** (power - 5));
  const inside = (digits) => decades.flatMap((ten) => digits.map((d) => d * ten)).filter((v) => v >= low && v <= high);
  const ticks = [[1, 1.5, 2, 3, 4, 5, 6, 7, 8, 9], [1, 1.5, 2, 3, 5, 7], [1, 2, 5], [1]].map(inside);
  const chosen = ticks.find((of) => of.length <= most) ?? ticks.at(-1);
  return {
    type: "log",
    range: values.length ? [Math.log10(low), Math.log10(high)] : [0, 1],
    tickangle: 0,
    tickvals: chosen,
    ticktext: chosen.map((v) => v.toLocaleString("en", { maximumSignificantDigits: 2 })),
  };
}

/** Fills the choices from the runs that there are. */
function offerPlots() {
  if (!$("capacity")) return;
  const measured = (kind) => DATA.kinds[kind].filter((name) => columns.has(name) && isNumeric(name)).map((name) => [name, heading(name)]);
  options($("capacity-x"), measured("size"));
  options($("speed-x"), measured("time"));
  options($("plot-y"), measured("image"));
  options($("plot-scene"), DATA.scenes.map((name) => [name, name]));
}

function startPlots() {
  offerPlots();
  if (!$("capacity")) return;
  for (const id of ["capacity-x", "speed-x", "plot-y", "plot-scene"]) $(id).addEventListener("change", drawPlots);
  keep("capacity-x", "speed-x", "plot-y", "plot-scene");
  seenPlots = whenSeen("plots-section", drawPlotsNow);
  selection.listeners.push(drawPlots);
  drawPlots();
}

/** Saves the plot that a button names, as PNG at twice its size on the screen. */
async function savePlot(id) {
  const { clientWidth: width, clientHeight: height } = $(id);
  const paper = colour("--paper");
  await Plotly.relayout(id, { paper_bgcolor: paper });
  const uri = await Plotly.toImage(id, { format: "png", width, height, scale: 2 });
  await Plotly.relayout(id, { paper_bgcolor: "rgba(0,0,0,0)" });
  const bytes = Uint8Array.from(atob(uri.split(",")[1]), (c) => c.charCodeAt(0));
  download(`${id}.png`, bytes, "image/png");
}
