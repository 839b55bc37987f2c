/** The table of runs: sorted by a click on a heading, in pages so that ten thousand rows stay quick. */

const shownColumns = DATA.shown.slice();
let page = 0;

function drawHead() {
  const cells = shownColumns.map((name) => {
    const sorted = selection.key === name ? (selection.descending ? "descending" : "ascending") : "none";
    const button = element("button", { type: "button", "data-key": name, onclick: () => sortBy(name) }, heading(name));
    return element("th", { scope: "col", class: isNumeric(name) ? "number" : "", "aria-sort": sorted }, button);
  });
  const choose = ["A", "B"].map((side) => element("th", { scope: "col", title: `the run compared as ${side}` }, side));
  $("runs-head").replaceChildren(element("tr", {}, cells[0], ...choose, ...cells.slice(1)));
}

function sortBy(name) {
  if (selection.key === name) selection.descending = !selection.descending;
  else [selection.key, selection.descending] = [name, isNumeric(name)];
  sort();
  $("runs-head").querySelector(`[data-key="${CSS.escape(name)}"]`).focus();
}

function drawTable() {
  const rows = Number($("rows").value);
  const last = Math.max(0, Math.ceil(selection.runs.length / rows) - 1);
  page = Math.min(page, last);
  const from = page * rows;
  const visible = selection.runs.slice(from, from + rows);
  drawHead();
  $("runs-body").replaceChildren(...visible.map(rowOf));
  $("previous").disabled = page === 0;
  $("next").disabled = page === last;
  const count = selection.runs.length.toLocaleString("en");
  $("page-status").textContent = visible.length
    ? `${(from + 1).toLocaleString("en")}–${(from + visible.length).toLocaleString("en")} of ${count} selected`
    : `no run matches; there are ${DATA.total.toLocaleString("en")}`;
}

function rowOf(run) {
  const name = value("run_id", run);
  const choose = ["a", "b"].map((side) =>
    element("td", {}, element("input", {
      type: "radio", name: `side-${side}`, "aria-label": `compare ${name} as ${side.toUpperCase()}`,
      ...(compared[side] === run ? { checked: true } : {}), onchange: () => compare(side, run),
    })),
  );
  const cells = shownColumns.slice(1).map((key) => {
    const v = value(key, run);
    const kind = key === "state" ? `state-${v}` : isNumeric(key) ? "number" : "";
    return element("td", { class: kind }, shown(key, v));
  });
  const link = element("a", { href: `#run=${encodeURIComponent(name)}`, title: name }, name);
  return element("tr", {}, element("th", { scope: "row" }, link), ...choose, ...cells);
}

function startTable() {
  const others = [...columns.keys()].filter((name) => !shownColumns.includes(name)).sort();
  options($("more"), [["", "another column…"], ...others.map((name) => [name, heading(name)])]);
  $("more").addEventListener("change", () => {
    shownColumns.push($("more").value);
    $("more").selectedOptions[0].remove();
    $("more").value = "";
    drawTable();
  });
  $("rows").addEventListener("change", drawTable);
  $("previous").addEventListener("click", () => { page -= 1; drawTable(); });
  $("next").addEventListener("click", () => { page += 1; drawTable(); });
  selection.listeners.push(() => { page = 0; drawTable(); });
}
