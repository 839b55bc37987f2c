"use strict";

const $ = (id) => document.getElementById(id);
const DATA = JSON.parse($("data").textContent);

/** The columns of the runs' table by name; each is an array with a value a run, null where a run lacks it. */
const columns = new Map(Object.entries(DATA.columns).map(([name, packed]) => [name, unpack(packed)]));

function unpack({ all, values }) {
  return values ?? new Array(DATA.total).fill(all);
}

const column = (name) => columns.get(name) ?? new Array(DATA.total).fill(null);
const value = (name, run) => columns.get(name)?.[run] ?? null;
const numeric = new Map(); // column -> whether it has numbers, as far as it was asked
let told = null; // the columns of `telling`, once they were asked for

function isNumeric(name) {
  if (!numeric.has(name)) numeric.set(name, column(name).some((v) => typeof v === "number"));
  return numeric.get(name);
}

/** To be called when values have changed. */
function forget() {
  numeric.clear();
  told = null;
}

/** Where views and curves come from, set by static.js or live.js. */
let source;

/** What `name` is called on the page, with its unit. */
const heading = (name) => DATA.metrics[name]?.heading ?? name;

/** A value as it is shown: rounded as the tables round it, with an en dash where it is missing. */
function shown(name, v) {
  if (v === null || v === undefined) return "–";
  if (typeof v !== "number") return String(v);
  const digits = DATA.metrics[name]?.digits ?? null;
  if (digits === null) return String(v);
  return v.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits });
}

/** An element with attributes and children; text is only ever set as text. */
function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, v] of Object.entries(attributes)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), v);
    else if (v === true) made.setAttribute(name, "");
    else if (v !== false && v !== null) made.setAttribute(name, v);
  }
  made.append(...children);
  return made;
}

/** Fills a select: [value, text] each. What a user has chosen stays where it is still there; before, it is the choice
 * of the address, else `standard`. */
function options(select, items, standard = null) {
  const wanted = select.dataset.chosen ? select.value : address.get(select.id) ?? standard ?? select.value;
  select.replaceChildren(...items.map(([v, text]) => element("option", { value: v }, text)));
  if (items.some(([v]) => String(v) === wanted)) select.value = wanted;
}

/** `1 run`, `2 runs`. */
const counted = (number, what) => `${number.toLocaleString("en")} ${what}${number === 1 ? "" : "s"}`;

/** Turns a button that stays pressed on or off; says which. */
function toggle(button, on = button.getAttribute("aria-pressed") !== "true") {
  button.setAttribute("aria-pressed", String(on));
  return on;
}

const pressed = (id) => $(id).getAttribute("aria-pressed") === "true";

/** The colour that a CSS variable has under the present theme. */
function colour(variable) {
  const probe = document.body.appendChild(element("span", { style: `color: var(${variable})`, hidden: true }));
  const found = getComputedStyle(probe).color;
  probe.remove();
  return found;
}
