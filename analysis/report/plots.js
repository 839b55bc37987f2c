/** What all plots of the page share: their layout and their texts. Their bar saves them as PNG. */

const plotSettings = { responsive: true, displaylogo: false, modeBarButtons: [["toImage"]], toImageButtonOptions: { scale: 2 } };

/** Resolved when Plotly is there; everything but the plots is shown before. */
let plotly = Promise.resolve();

function plotLayout(x, y, more = {}) {
  const [ink, muted, line] = ["--ink", "--muted", "--line"].map(colour);
  const axis = { gridcolor: line, linecolor: muted, zeroline: false, ticks: "outside", tickcolor: muted, automargin: true };
  return {
    paper_bgcolor: colour("--paper"),
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

/** Plotly reads a few tags in texts; names from outside must not be read as such. */
function escaped(text) {
  return String(text).replaceAll("&", "&amp;").replaceAll("<", "&lt;").replaceAll(">", "&gt;");
}
