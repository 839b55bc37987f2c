/** The language of qnerf/records/filters.py, in which `--filter` is written; tests/analysis/test_report_filter.py compares them. */

const ALIASES = { id: "run_id", tag: "tags" };
const NEXT_KEY = /,(?=[^=<>!,]+(?:!=|>=|<=|=|>|<))/;
const ORDER = {
  ">=": (a, b) => a >= b,
  "<=": (a, b) => a <= b,
  ">": (a, b) => a > b,
  "<": (a, b) => a < b,
};

/** A predicate on run numbers; throws an Error of one line for what cannot be meant. */
function parseFilter(text) {
  const conditions = words(text).flatMap((word) => word.split(NEXT_KEY)).map(parseCondition);
  return (run) => conditions.every((meets) => meets(run));
}

/** Splits at spaces that are not quoted. */
function words(text) {
  const found = text.match(/(?:'[^']*'|"[^"]*"|\\.|[^\s'"\\])+|['"\\]/g) ?? [];
  if (found.some((word) => /^['"\\]$/.test(word))) throw new Error("a quote is left open");
  return found.map((word) => word.replace(/'([^']*)'|"([^"]*)"|\\(.)/g, "$1$2$3"));
}

function parseCondition(text) {
  const match = /^([^=<>!,]+)(!=|>=|<=|=|>|<)(.*)$/s.exec(text);
  if (!match) return (run) => String(value("run_id", run)).includes(text);
  const [name, operator, wanted] = match.slice(1).map((part) => part.trim());
  const key = ALIASES[name] ?? name;
  if (!columns.has(key)) throw new Error(`no run has a column ${key}; such are ${near(key)}`);
  if (operator in ORDER) {
    const limit = number(wanted);
    if (Number.isNaN(limit)) throw new Error(`${text}: ${operator} compares numbers`);
    return (run) => typeof value(key, run) === "number" && ORDER[operator](value(key, run), limit);
  }
  const tests = wanted.split(/,(?![^[]*\])/).map(equals);
  const found = (run) => tests.some((test) => test(value(key, run)));
  return operator === "=" ? found : (run) => !found(run);
}

function near(key) {
  const known = [...columns.keys()];
  const ends = known.filter((name) => name.includes(key) || name.endsWith(`.${key}`));
  return (ends.length ? ends : known).slice(0, 6).join(", ");
}

function equals(wanted) {
  const none = ["none", "null", "nan"].includes(wanted.toLowerCase());
  const pattern = wildcard(wanted);
  const one = (v) => {
    if (v === null) return none;
    if (typeof v === "boolean") return wanted.toLowerCase() === String(v);
    if (wanted.startsWith("[") && wanted.endsWith("]")) return String(v).replaceAll(" ", "") === wanted.replaceAll(" ", "");
    return number(v) === number(wanted) || (typeof v !== "number" && pattern.test(v));
  };
  return (v) => (Array.isArray(v) ? v.some(one) : one(v));
}

/** NaN for what is no number. */
function number(v) {
  if (typeof v === "number") return v;
  const infinite = /^\s*([+-]?)inf(?:inity)?\s*$/i.exec(v);
  if (infinite) return infinite[1] === "-" ? -Infinity : Infinity;
  return /^\s*[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?\s*$/i.test(v) ? Number(v) : NaN;
}

function wildcard(text) {
  const escaped = text.replace(/[.+^${}()|[\]\\]/g, "\\$&").replaceAll("*", ".*").replaceAll("?", ".");
  return new RegExp(`^${escaped}$`, "s");
}
