/** Runs that meet every condition, the syntax of `--filter` (qnerf/records/filters.py), conditions with spaces between. */

const ALIASES = { id: "run_id", tag: "tags" };
const ORDER = {
  ">=": (a, b) => a >= b,
  "<=": (a, b) => a <= b,
  ">": (a, b) => a > b,
  "<": (a, b) => a < b,
};

/** A predicate on run numbers; throws an Error of one line for what cannot be meant. */
function parseFilter(text) {
  const conditions = text.split(/\s+/).filter(Boolean).map(parseCondition);
  return (run) => conditions.every((meets) => meets(run));
}

function parseCondition(text) {
  const match = /^([^=<>!]+)(!=|>=|<=|=|>|<)(.*)$/s.exec(text);
  if (!match) return (run) => String(value("run_id", run)).includes(text);
  const key = ALIASES[match[1]] ?? match[1];
  const [operator, wanted] = [match[2], match[3]];
  if (!columns.has(key)) throw new Error(`no run has a column ${key}; such are ${near(key)}`);
  if (operator in ORDER) {
    const limit = Number(wanted);
    if (wanted === "" || Number.isNaN(limit)) throw new Error(`${text}: ${operator} compares numbers`);
    return (run) => typeof value(key, run) === "number" && ORDER[operator](value(key, run), limit);
  }
  const tests = wanted.split(",").map(equals);
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
    if (typeof v === "number") return wanted !== "" && v === Number(wanted);
    return pattern.test(v);
  };
  return (v) => (Array.isArray(v) ? v.some(one) : one(v));
}

function wildcard(text) {
  const escaped = text.replace(/[.+^${}()|[\]\\]/g, "\\$&").replaceAll("*", ".*").replaceAll("?", ".");
  return new RegExp(`^${escaped}$`, "s");
}
