/** Colours of runs by any column: fields as in every figure, numbers on a scale, other values in the palette's order. */

const SCALE = [[70, 110, 220], [30, 165, 150], [232, 160, 30]];
const MOST_LEVELS = 8;

/** {of: run -> CSS colour, entries: [text, colour] for the legend}. */
function colouring(key, runs) {
  if (!key) return { of: () => colour("--accent"), entries: [] };
  const values = key === "run_id" ? runs.map((run) => value(key, run)) : column(key).map(text);
  const levels = [...new Set(values)].filter((v) => v !== null);
  if (isNumeric(key) && levels.length > MOST_LEVELS) return scale(key, runs);
  if (key !== "run_id") levels.sort((a, b) => String(a).localeCompare(String(b), "en", { numeric: true }));
  const grey = DATA.palette.at(-1);
  const colours = new Map(levels.map((level, place) =>
    [level, (key === "field" ? DATA.fields[level]?.colour : null) ?? DATA.palette.slice(0, -1)[place] ?? `hsl(${(place * 137.5) % 360} 55% 50%)`]));
  const there = new Set(runs.map((run) => text(value(key, run))));
  const entries = levels.filter((level) => there.has(level)).map((level) => [String(level), colours.get(level)]);
  return { of: (run) => colours.get(text(value(key, run))) ?? grey, entries };
}

const text = (v) => (Array.isArray(v) ? v.join(", ") : v);

function scale(key, runs) {
  const values = runs.map((run) => value(key, run)).filter((v) => typeof v === "number");
  const [low, high] = [values.reduce((a, b) => Math.min(a, b), Infinity), values.reduce((a, b) => Math.max(a, b), -Infinity)];
  const at = (share) => {
    const place = Math.min(Math.max(share, 0), 1) * (SCALE.length - 1);
    const [from, part] = [Math.min(Math.floor(place), SCALE.length - 2), place];
    return `rgb(${SCALE[from].map((c, i) => Math.round(c + (part - from) * (SCALE[from + 1][i] - c))).join(", ")})`;
  };
  const of = (run) => typeof value(key, run) === "number" ? at((value(key, run) - low) / (high - low || 1)) : DATA.palette.at(-1);
  const marks = values.length ? [low, (low + high) / 2, high] : [];
  return { of, entries: marks.map((v) => [v.toLocaleString("en", { maximumSignificantDigits: 3 }), at((v - low) / (high - low || 1))]) };
}

const MOST_ENTRIES = 12;

function drawLegend(list, key, entries) {
  const more = entries.length - MOST_ENTRIES;
  const shownEntries = entries.slice(0, MOST_ENTRIES).map(([name, css]) =>
    element("li", { title: name }, element("span", { class: "swatch", style: `background: ${css}` }), middle(name, 40)));
  list.replaceChildren(...(entries.length ? [element("li", { class: "muted" }, heading(key))] : []), ...shownEntries,
    ...(more > 0 ? [element("li", { class: "muted" }, `and ${more} more`)] : []));
}

/** A long name without its middle: run ids differ at their ends. */
function middle(name, most) {
  if (name.length <= most) return name;
  const end = Math.floor(most / 2);
  return `${name.slice(0, most - end - 1)}…${name.slice(-end)}`;
}

/** What runs are grouped by to begin with: configurations, as long as their colours can be told apart. */
const groupKey = () => (new Set(column("configuration")).size <= 16 && telling().includes("configuration") ? "configuration" : "field");

/** Columns to choose colours from: those whose values differ, the usual ones first. */
function telling() {
  if (told) return told;
  const usual = ["field", "configuration", "seed", "state", "scene_name", "encoder", "density", "color", "run_id"];
  const differ = (name) => {
    if (name === "run_id") return true;
    const first = column(name).find((v) => v !== null);
    return name !== "path" && column(name).some((v) => v !== null && text(v) !== text(first));
  };
  told = [...new Set([...usual, ...[...columns.keys()].sort()])].filter((name) => columns.has(name) && differ(name));
  return told;
}
