/** The panel of one run; its address is #run=<id>, so that "back" closes it and a link opens it. */

function openRun(run) {
  location.hash = `run=${encodeURIComponent(value("run_id", run))}`;
}

function followHash() {
  const match = /^#run=(.*)$/.exec(location.hash);
  const run = match ? column("run_id").indexOf(decodeURIComponent(match[1])) : -1;
  if (run < 0) return $("detail").close();
  fillDetail(run);
  if (!$("detail").open) $("detail").showModal();
  $("detail").scrollTop = 0;
}

function fillDetail(run) {
  $("detail-title").textContent = value("run_id", run);
  const choose = ["a", "b"].map((side) =>
    element("button", { type: "button", onclick: () => { closeDetail(); compare(side, run); $("pictures-section").scrollIntoView(); } },
      `Compare as ${side.toUpperCase()}`));
  const results = [...columns.keys()].filter((name) => !DATA.settings.includes(name) && !HIDDEN.includes(name));
  $("detail-body").replaceChildren(
    element("div", { class: "controls" }, ...choose),
    pairs(["state", "error", "tags", "note", "version", "path"].filter((name) => value(name, run) !== null), run),
    element("h3", {}, "Results"), pairs(results.filter((name) => value(name, run) !== null), run),
    element("h3", {}, "Held-out views"), ...strips(run),
    element("h3", {}, "Configuration"), pairs(DATA.settings.filter((name) => value(name, run) !== null), run),
  );
}

const HIDDEN = ["run_id", "state", "error", "tags", "note", "version", "path", "configuration"];

function pairs(names, run) {
  const items = names.flatMap((name) => [element("dt", {}, heading(name)), element("dd", {}, shown(name, value(name, run)))]);
  return element("dl", {}, ...items);
}

/** Truth, render and depth of each view that is on the page. */
function strips(run) {
  const views = Object.entries(DATA.pictures.runs[run] ?? {});
  if (!views.length) return [element("p", { class: "absent" }, "No pictures of this run on this page.")];
  return views.map(([view, kinds]) =>
    element("div", { class: "strip" }, ...Object.entries(kinds).map(([kind, file]) => {
      const { uri, width } = DATA.pictures.files[file];
      const image = element("img", { src: uri, alt: `${kind}, view ${view}`, class: width < 400 ? "pixels" : "" });
      return element("figure", {}, image, element("figcaption", {}, `${kind}, ${view}`));
    })));
}

function closeDetail() {
  history.replaceState(null, "", location.pathname + location.search);
  $("detail").close();
}

function startDetail() {
  $("detail-close").addEventListener("click", closeDetail);
  $("detail").addEventListener("cancel", closeDetail);
  $("detail").addEventListener("click", (event) => { if (event.target === $("detail")) closeDetail(); });
  addEventListener("hashchange", followHash);
  followHash();
}
