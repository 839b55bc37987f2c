/** The table of runs: sorted by a click on a heading, in pages so that ten thousand rows stay quick. */

const shownColumns = [];
let page = 0;

function drawHead() {
  const cells = shownColumns.map((name) => {
    const sorted = selection.key === name ? (selection.descending ? "descending" : "ascending") : "none";
    const button = element("button", { type: "button", "data-key": name, onclick: () => sortBy(name) }, heading(name));
    return element("th", { scope: "col", class: isNumeric(name) ? "number" : "", "aria-sort": sorted }, button);
  });
  const choose = element("th", { scope: "col", title: "runs that are compared below" }, "✓");
  const row = element("tr", {}, choose, ...cells);
  if (!$("runs-head").firstChild?.isEqualNode(row)) $("runs-head").replaceChildren(row); // a heading keeps the focus
}

function sortBy(name) {
  if (selection.key === name) selection.descending = !selection.descending;
  else [selection.key, selection.descending] = [name, isNumeric(name)];
  remember("sort", `${name} ${selection.descending ? "down" : "up"}`);
  sort();
  $("runs-head").querySelector(`[data-key="${CSS.escape(name)}"]`)?.focus();
}

function drawTable() {
  const rows = Number($("rows").value);
  const last = Math.max(0, Math.ceil(selection.runs.length / rows) - 1);
  page = Math.min(page, last);
  const from = page * rows;
  const visible = selection.runs.slice(from, from + rows);
  drawHead();
  const focused = document.activeElement?.closest("#runs-body tr") && focusPlace();
  $("runs-body").replaceChildren(...visible.map(rowOf));
  if (focused) $("runs-body").querySelector(focused)?.focus();
  $("previous").disabled = page === 0;
  $("next").disabled = page === last;
  const count = selection.runs.length.toLocaleString("en");
  $("page-status").textContent = visible.length
    ? `${(from + 1).toLocaleString("en")}–${(from + visible.length).toLocaleString("en")} of ${count} selected`
    : DATA.total ? `no run matches; there are ${DATA.total.toLocaleString("en")}` : "no runs yet";
}

/** A selector for what has the focus in the table: a row that is drawn anew keeps it. */
function focusPlace() {
  const row = document.activeElement.closest("tr").dataset.run;
  return `tr[data-run="${CSS.escape(row)}"] ${document.activeElement.tagName}`;
}

function rowOf(run) {
  const name = value("run_id", run);
  const box = element("input", {
    type: "checkbox", "aria-label": `compare ${name}`, ...(chosen.includes(run) ? { checked: true } : {}),
    onchange: (event) => choose(run, event.target.checked),
  });
  return element("tr", { "data-run": name }, element("td", {}, box), ...shownColumns.map((key) => cellOf(key, run)));
}

function cellOf(key, run) {
  const v = value(key, run);
  if (key === "run_id") {
    const link = element("a", { href: hashOf(run), title: v }, ...ends(v));
    return element("th", { scope: "row" }, link);
  }
  if (key === "state") {
    const error = value("error", run);
    const more = error && v !== "finished" ? [element("span", { class: "muted" }, ` ${error.slice(0, 60)}`)] : [];
    return element("td", { class: `state-${v}`, title: error ?? "" }, shown(key, v), ...more);
  }
  return element("td", { class: isNumeric(key) ? "number" : "" }, shown(key, v));
}

/** A name in two parts, of which the first is cut where there is no room. */
function ends(name) {
  const at = Math.max(0, name.length - 14);
  return [element("span", { class: "start" }, name.slice(0, at)), element("span", { class: "end" }, name.slice(at))];
}

/** The columns as boxes to tick, with a search over their names. */
function drawChooser() {
  const wanted = $("column-search").value.toLowerCase();
  const others = [...columns.keys()].filter((name) => !shownColumns.includes(name)).sort();
  const matching = [...shownColumns, ...others].filter((name) => `${name} ${heading(name)}`.toLowerCase().includes(wanted));
  $("column-boxes").replaceChildren(...matching.map((name) => {
    const box = element("input", { type: "checkbox", value: name, ...(shownColumns.includes(name) ? { checked: true } : {}) });
    box.addEventListener("change", () => showColumn(name, box.checked));
    return element("label", {}, box, ` ${heading(name)}`);
  }));
}

function showColumn(name, on) {
  if (on) shownColumns.push(name);
  else shownColumns.splice(shownColumns.indexOf(name), 1);
  const usual = shownColumns.length === DATA.shown.length && shownColumns.every((key, place) => key === DATA.shown[place]);
  remember("columns", usual ? "" : shownColumns.map(encodeURIComponent).join(","));
  drawTable();
}

/** The selected runs, all pages, with the shown columns as CSV. */
function tableAsCsv() {
  const rows = selection.runs.map((run) => shownColumns.map((key) => value(key, run)));
  return csv([shownColumns, ...rows]);
}

/** Rows of values as CSV. */
function csv(rows) {
  const cell = (v) => {
    const written = v === null ? "" : String(text(v));
    return /[",\r\n]/.test(written) ? `"${written.replaceAll('"', '""')}"` : written;
  };
  return rows.map((row) => `${row.map(cell).join(",")}\n`).join("");
}

function download(name, content, kind) {
  const link = element("a", { href: URL.createObjectURL(new Blob([content], { type: kind })), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

function startTable() {
  const wanted = address.get("columns")?.split(",").map(decodeURIComponent).filter((name) => columns.has(name));
  shownColumns.push(...(wanted?.length ? wanted : DATA.shown));
  keep("rows");
  $("columns").addEventListener("toggle", drawChooser);
  $("column-search").addEventListener("input", drawChooser);
  $("rows").addEventListener("change", drawTable);
  $("previous").addEventListener("click", () => { page -= 1; drawTable(); });
  $("next").addEventListener("click", () => { page += 1; drawTable(); });
  $("csv").addEventListener("click", () => download("runs.csv", tableAsCsv(), "text/csv"));
  selection.listeners.push(drawTable);
  for (const id of ["filter", "state", "scene"]) $(id).addEventListener("input", () => { page = 0; });
}
