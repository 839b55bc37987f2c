/** Logged values of the selected runs over steps or time. */

const MOST_CURVES = 40;

function drawCurves() {
  if (!$("curve-key")) return;
  const [key, by] = [$("curve-key").value, $("curve-x").value];
  const having = selection.runs.filter((run) => DATA.curves[run]?.[key]);
  const drawn = having.slice(0, MOST_CURVES).map((run) => curve(run, key, by));
  const logarithmic = $("curve-log").getAttribute("aria-pressed") === "true";
  const layout = plotLayout(by === "step" ? "step" : "time, s", DATA.curve_names[key], { yaxis: { type: logarithmic ? "log" : "linear" } });
  Plotly.react("curves-plot", drawn, { ...layout, showlegend: false }, plotSettings);
  const without = selection.runs.length - having.length;
  const parts = [`${drawn.length} runs, coloured by field`];
  if (having.length > drawn.length) parts.push(`the first ${MOST_CURVES} of ${having.length} in the table's order: filter or sort for others`);
  if (without) parts.push(`${without.toLocaleString("en")} selected runs have no such curve on this page`);
  $("curves-status").textContent = `${parts.join("; ")}.`;
}

function curve(run, key, by) {
  const { step, time, value: values } = DATA.curves[run][key];
  const style = DATA.fields[value("field", run)] ?? { colour: colour("--muted") };
  return {
    name: escaped(value("run_id", run)), mode: values.length < 12 ? "lines+markers" : "lines",
    x: by === "step" ? step : time, y: values, customdata: values.map(() => run),
    line: { color: style.colour, width: 1.3 }, marker: { symbol: style.symbol, size: 5 }, opacity: 0.9,
    hovertemplate: "%{fullData.name}<br>%{x:,.4~g}: %{y:.4~g}<extra></extra>",
  };
}

function startCurves() {
  if (!$("curve-key")) return;
  const keys = new Set(Object.values(DATA.curves).flatMap((of) => Object.keys(of)));
  options($("curve-key"), [...keys].map((key) => [key, DATA.curve_names[key]]));
  for (const id of ["curve-key", "curve-x"]) $(id).addEventListener("change", drawCurves);
  $("curve-log").addEventListener("click", () => { toggle($("curve-log")); drawCurves(); });
  selection.listeners.push(drawCurves);
  drawCurves();
  $("curves-plot").on("plotly_click", ({ points: [point] }) => openRun(point.customdata));
}

/** Turns a button that stays pressed on or off; says which. */
function toggle(button, on = button.getAttribute("aria-pressed") !== "true") {
  button.setAttribute("aria-pressed", String(on));
  return on;
}
