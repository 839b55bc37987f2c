/** Views and curves of a page that holds them itself. */

source = {
  /** The runs whose curves are on the page. */
  withCurves: (runs) => runs.filter((run) => DATA.curves[run]),
  keys: async () => DATA.curve_names,
  /** Run -> {step, time, value}. */
  curves: async (runs, key) => new Map(runs.filter((run) => DATA.curves[run]?.[key]).map((run) => [run, DATA.curves[run][key]])),
  /** View -> panel -> {uri, width, height}. */
  views: async (run) => Object.fromEntries(Object.entries(DATA.pictures.runs[run] ?? {}).map(([view, kinds]) =>
    [view, Object.fromEntries(Object.entries(kinds).map(([kind, file]) => [kind, DATA.pictures.files[file]]))])),
  /** Plotly is on the page compressed. */
  async plotly() {
    const bytes = Uint8Array.from(atob($("plotly").textContent), (c) => c.charCodeAt(0));
    const unpacked = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    const script = element("script", { nonce: document.querySelector("script[nonce]").nonce });
    script.textContent = await new Response(unpacked).text();
    document.head.append(script);
  },
};
