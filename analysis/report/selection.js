/** Which runs are selected, in the order of the table; everything that shows runs listens. */

const selection = { runs: [], key: null, descending: true, listeners: [] };

/** A predicate on runs. Words between spaces: parts of ids, or a column with `=` or `!=` and values between commas, or
 * with `<` or `>` and a number. Values with spaces are quoted. */
function parseFilter(text) {
  const conditions = (text.match(/(?:"[^"]*"|\S)+/g) ?? []).map((word) => conditionOf(word.replaceAll('"', "")));
  return (run) => conditions.every((meets) => meets(run));
}

function conditionOf(word) {
  const [, name, operator, wanted] = /^([^=<>!]+)(!=|[=<>])(.*)$/s.exec(word) ?? [];
  if (!name) return (run) => value("run_id", run).includes(word);
  const plain = DATA.aliases[name] ?? name.replace(/^colour\./, "color.");
  const key = columns.has(plain) ? plain : `train.${plain}`; // as an option of a tracked run is called
  if (!columns.has(key)) {
    const near = [...columns.keys()].filter((one) => one.includes(plain)).slice(0, 4).join(", ");
    throw new Error(`no run has a column ${plain}${near && `; did you mean ${near}?`}`);
  }
  if (operator === "<") return (run) => typeof value(key, run) === "number" && value(key, run) < Number(wanted);
  if (operator === ">") return (run) => typeof value(key, run) === "number" && value(key, run) > Number(wanted);
  const values = [wanted, ...wanted.split(",")];
  const has = (run) => [value(key, run) ?? "none"].flat().some((v) => values.includes(String(v)));
  return operator === "=" ? has : (run) => !has(run);
}

function select() {
  const state = $("state").value;
  const scene = $("scene").value;
  let meets;
  try {
    meets = parseFilter($("filter").value);
    $("filter-error").textContent = "";
  } catch (error) {
    $("filter-error").textContent = error.message;
    return;
  }
  selection.runs = [...Array(DATA.total).keys()].filter(
    (run) =>
      (!state || value("state", run) === state) && (!scene || value("scene_name", run) === scene) && meets(run),
  );
  sort();
}

function sort() {
  const { key, descending } = selection;
  if (key) {
    const values = column(key);
    const sign = descending ? -1 : 1;
    selection.runs.sort((a, b) => {
      const [one, two] = [values[a], values[b]];
      if (one === null || two === null) return (one === null) - (two === null) || a - b;
      const order = typeof one === "number" ? one - two : String(one).localeCompare(String(two), "en", { numeric: true });
      return sign * order || a - b;
    });
  }
  for (const listener of selection.listeners) listener();
}

/** Fills the choices of state and scene from the runs that there are. */
function offerSelection() {
  const values = (name) => [...new Set(column(name).filter((v) => v !== null))].sort().map((v) => [v, v]);
  options($("state"), [["", "all"], ...values("state")]);
  options($("scene"), [["", "all"], ...values("scene_name")]);
}

function startSelection() {
  const [key, direction] = (address.get("sort") ?? "").split(" ");
  selection.key = columns.has(key) ? key : columns.has(DATA.metric) ? DATA.metric : null;
  if (key) selection.descending = direction !== "up";
  offerSelection();
  keep("filter", "state", "scene");
  let waiting;
  $("filter").addEventListener("input", () => {
    clearTimeout(waiting);
    waiting = setTimeout(select, 120);
  });
  for (const id of ["state", "scene"]) $(id).addEventListener("change", select);
  select();
}

/** The function, called only while its section is near the screen, and then at the next call that was left out. */
function whenSeen(id, draw) {
  let [seen, missed] = [false, false];
  const drawOrWait = () => {
    missed = !seen;
    if (seen) draw();
  };
  new IntersectionObserver(([entry]) => {
    seen = entry.isIntersecting;
    if (seen && missed) drawOrWait();
  }, { rootMargin: "400px" }).observe($(id));
  return drawOrWait;
}
