/** The panel of one run; its address is #run=ID, so that "back" closes it and a link opens it. */

let opened = null; // the run in the panel

/** The address of the present view with this run open. */
function hashOf(run) {
  const view = new URLSearchParams(address);
  view.set("run", value("run_id", run));
  return `#${view}`;
}

function openRun(run) {
  location.hash = hashOf(run);
}

function followHash() {
  const id = readAddress().get("run");
  const run = id === null ? -1 : column("run_id").indexOf(id);
  opened = run < 0 ? null : run;
  if (opened === null) {
    address.delete("run");
    return $("detail").close();
  }
  address.set("run", id);
  fillDetail(run);
  if (!$("detail").open) $("detail").showModal();
  $("detail").scrollTop = 0;
}

async function fillDetail(run) {
  $("detail-title").textContent = value("run_id", run);
  const add = element("button", { type: "button", onclick: () => { closeDetail(); choose(run, true); $("compared-section").scrollIntoView(); } }, "Compare");
  const results = [...columns.keys()].filter((name) => !DATA.settings.includes(name) && !HIDDEN.includes(name));
  $("detail-body").replaceChildren(
    element("div", { class: "controls" }, add),
    pairs(["state", "error", "version", "path"].filter((name) => value(name, run) !== null), run),
    element("h3", {}, "Results"), pairs(results.filter((name) => value(name, run) !== null), run),
    element("h3", {}, "Held-out views"), element("div", { id: "detail-views" }),
    element("h3", {}, "Configuration"), pairs(DATA.settings.filter((name) => value(name, run) !== null), run),
  );
  const views = strips(await source.views(run));
  if (opened === run) $("detail-views").replaceChildren(...(source.preview ? source.preview(run) : []), ...views);
}

const HIDDEN = ["run_id", "state", "error", "version", "path", "configuration"];

function pairs(names, run) {
  const items = names.flatMap((name) => [element("dt", {}, heading(name)), element("dd", {}, shown(name, value(name, run)))]);
  return element("dl", {}, ...items);
}

/** The panels of each view. */
function strips(views) {
  const pictured = Object.entries(views);
  if (!pictured.length) return [element("p", { class: "absent" }, "No pictures of this run here.")];
  return pictured.map(([view, panels]) =>
    element("div", { class: "strip" }, ...Object.entries(panels).map(([panel, { uri, width }]) => {
      const image = element("img", { src: uri, alt: `${panel}, view ${view}`, loading: "lazy", class: width < 400 ? "pixels" : "" });
      return element("figure", {}, image, element("figcaption", {}, `${panel}, ${view}`));
    })));
}

function closeDetail() {
  opened = null;
  remember("run", "");
  $("detail").close();
}

function startDetail() {
  $("detail-close").addEventListener("click", closeDetail);
  $("detail").addEventListener("cancel", closeDetail);
  $("detail").addEventListener("click", (event) => { if (event.target === $("detail")) closeDetail(); });
  addEventListener("hashchange", followHash);
  followHash();
}
