/** Logged values of the selected runs over steps or time: each run, or means and bands of groups. */

let seenCurves = () => {};
const drawCurves = () => seenCurves();
let drawing = 0;

async function drawCurvesNow() {
  const number = ++drawing;
  const runs = source.withCurves(selection.runs).slice(0, Number($("curve-most").value));
  const names = await source.keys(runs);
  if (number !== drawing) return;
  options($("curve-key"), [["", "the first four"], ...Object.entries(names)], "");
  const keys = $("curve-key").value ? [$("curve-key").value] : Object.keys(names).slice(0, 4);
  const logged = await Promise.all(keys.map((key) => source.curves(runs, key)));
  await plotly;
  if (number !== drawing) return;
  const having = runs.filter((run) => logged.some((own) => own.has(run)));
  const paint = colouring($("curve-by").value, having);
  const by = $("curve-x").value;
  const layout = plotLayout(by === "step" ? "step" : "time, s", names[keys[0]] ?? "", { yaxis: { type: pressed("curve-log") ? "log" : "linear" } });
  if (!having.length) layout.annotations = [{ text: "no selected run has logged this yet", showarrow: false, xref: "paper", yref: "paper", x: 0.5, y: 0.5 }];
  const across = keys.length > 1 && $("curves-plot").clientWidth > 600 ? 2 : 1;
  if (keys.length > 1) layout.grid = { columns: across, rows: Math.ceil(keys.length / across), pattern: "independent", ygap: 0.3 };
  $("curves-plot").style.height = keys.length > 1 ? `${17 * layout.grid.rows}rem` : "";
  const traces = keys.flatMap((key, place) => {
    const axis = place ? place + 1 : "";
    layout[`xaxis${axis}`] = layout.xaxis;
    layout[`yaxis${axis}`] = { ...layout.yaxis, title: { ...layout.yaxis.title, text: escaped(names[key]) } };
    const lines = runs.filter((run) => logged[place].has(run)).map((run) => {
      const { step, time, value: values } = logged[place].get(run);
      return { run, x: by === "step" ? step : time, y: values };
    });
    const drawn = pressed("curve-mean") ? bands(lines, paint) : lines.map((line) => single(line, paint));
    return drawn.map((trace) => ({ ...trace, xaxis: `x${axis}`, yaxis: `y${axis}` }));
  });
  await Plotly.react("curves-plot", traces, { ...layout, showlegend: false, uirevision: `${keys} ${by}` }, plotSettings);
  $("curves-plot").removeAllListeners("plotly_click");
  $("curves-plot").on("plotly_click", ({ points: [point] }) => { if (typeof point.customdata === "number") openRun(point.customdata); });
  drawLegend($("curves-legend"), $("curve-by").value, paint.entries);
  const left = selection.runs.length - having.length;
  const parts = [counted(having.length, "run")];
  if (pressed("curve-mean")) parts.push("line: mean of a group; band: ± standard deviation over its runs");
  if (left) parts.push(`${left.toLocaleString("en")} selected runs are not drawn: they follow in the table's order, or have no such curve here`);
  $("curves-status").textContent = `${parts.join("; ")}.`;
}

function single({ run, x, y }, paint) {
  return {
    name: escaped(value("run_id", run)), mode: y.length < 12 ? "lines+markers" : "lines", x, y, customdata: y.map(() => run),
    line: { color: paint.of(run), width: 1.3 }, marker: { symbol: DATA.fields[value("field", run)]?.symbol, size: 5 }, opacity: 0.9,
    hovertemplate: "%{fullData.name}<br>%{x:,.4~g}: %{y:.4~g}<extra></extra>",
  };
}

/** Mean and standard deviation (n - 1; null for one value). */
function spread(values) {
  const mean = values.reduce((sum, v) => sum + v, 0) / values.length;
  if (values.length < 2) return { mean, std: null };
  return { mean, std: Math.sqrt(values.reduce((sum, v) => sum + (v - mean) ** 2, 0) / (values.length - 1)) };
}

/** A line and a band for each group of runs of one colour key. */
function bands(lines, paint) {
  const key = $("curve-by").value;
  const groups = Map.groupBy(lines, (line) => (key ? text(value(key, line.run)) : "all"));
  return [...groups].flatMap(([name, members]) => {
    const css = paint.of(members[0].run);
    const points = meanAndStd(members);
    const several = points.filter((point) => point.std !== null);
    const least = members.every(({ y }) => y.every((v) => v === null || v >= 0)) ? 0 : -Infinity; // of a loss
    const band = {
      x: [...several.map((p) => p.x), ...several.map((p) => p.x).reverse()],
      y: [...several.map((p) => p.mean + p.std), ...several.map((p) => Math.max(least, p.mean - p.std)).reverse()],
      mode: "lines", line: { width: 0 }, fill: "toself", fillcolor: css, opacity: 0.2, hoverinfo: "skip",
    };
    const label = `${escaped(name ?? "none")} (${members.length})`;
    const line = {
      name: label, mode: points.length < 12 ? "lines+markers" : "lines", marker: { size: 5 }, x: points.map((p) => p.x), y: points.map((p) => p.mean), line: { color: css, width: 1.8 },
      text: points.map((p) => (p.std === null ? "" : ` ± ${p.std.toPrecision(3)}`)),
      hovertemplate: "%{fullData.name}<br>%{x:,.4~g}: %{y:.4~g}%{text}<extra></extra>",
    };
    return several.length ? [band, line] : [line];
  });
}

const MOST_POINTS = 400;

/** Mean and standard deviation over lines at their common places; between its points a line is straight. */
function meanAndStd(lines) {
  const all = [...new Set(lines.flatMap(({ x }) => x))].sort((a, b) => a - b);
  const every = Math.ceil(all.length / MOST_POINTS);
  return all.filter((_, place) => place % every === 0 || place === all.length - 1).flatMap((x) => {
    const values = lines.map((line) => interpolated(line, x)).filter((v) => v !== null);
    return values.length ? [{ x, ...spread(values) }] : [];
  });
}

/** The line's value at x; null outside of it, or where a point beside x has none. */
function interpolated({ x: places, y }, x) {
  let [low, high] = [0, places.length - 1];
  if (high < 0 || x < places[low] || x > places[high]) return null;
  while (high - low > 1) {
    const half = (low + high) >> 1;
    if (places[half] <= x) low = half;
    else high = half;
  }
  if (places[low] === x) return y[low];
  if (places[high] === x) return y[high];
  if (y[low] === null || y[high] === null) return null;
  return y[low] + ((x - places[low]) / (places[high] - places[low])) * (y[high] - y[low]);
}

function offerCurves() {
  options($("curve-by"), [["", "one colour"], ...telling().map((name) => [name, heading(name)])], groupKey());
}

function startCurves() {
  offerCurves();
  for (const id of ["curve-mean", "curve-log"]) $(id).addEventListener("click", () => { toggle($(id)); drawCurves(); });
  for (const id of ["curve-key", "curve-x", "curve-by", "curve-most"]) $(id).addEventListener("change", drawCurves);
  keep("curve-key", "curve-x", "curve-by", "curve-most", "curve-mean", "curve-log");
  seenCurves = whenSeen("curves-section", drawCurvesNow);
  selection.listeners.push(drawCurves);
  drawCurves();
}
