/** Any number against any other. */

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
  $("scatter").removeAllListeners("plotly_click");
  $("scatter").on("plotly_click", ({ points: [point] }) => openRun(point.customdata));
  drawLegend($("scatter-legend"), key, paint.entries);
  const left = selection.runs.length - runs.length;
  $("scatter-status").textContent = `${counted(runs.length, "run")}${left ? `; ${left.toLocaleString("en")} selected runs lack one of both, or are too many` : ""}.`;
}

function offerExplore() {
  const numbers = [...columns.keys()].filter(isNumeric).sort();
  const usual = [DATA.metric, "ssim", "params.heads", "params.total", "step_ms", "train_s"].filter((name) => numbers.includes(name));
  const named = (names) => [...new Set(names)].map((name) => [name, heading(name)]);
  options($("scatter-y"), named([...usual, ...numbers]), DATA.metric);
  const across = ["params.heads", ...telling().filter((name) => name !== "configuration")].find((name) => numbers.includes(name) && name !== DATA.metric);
  options($("scatter-x"), named([...usual, ...telling(), ...numbers]), across);
  options($("scatter-by"), [["", "one colour"], ...named(telling())], groupKey());
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
