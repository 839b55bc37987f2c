/** The view in the page's address, behind its #: it comes back after a reload, and can be sent to others. */

const readAddress = () => new URLSearchParams(location.hash.includes("=") ? location.hash.slice(1) : "");
const address = readAddress();

/** Puts a value into the address; an empty one is taken out. */
function remember(key, v) {
  if (v) address.set(key, v);
  else address.delete(key);
  history.replaceState(null, "", address.size ? `#${address}` : location.pathname + location.search);
}

/** Keeps a control in the address: the value of a select or an input, or whether a button is pressed. What the page
 * begins with is left out. */
function keep(...ids) {
  for (const control of ids.map($)) {
    const state = () => control.type === "button" ? control.getAttribute("aria-pressed") : control.value;
    const standard = control.options?.length === 0 ? null : state();
    const stored = address.get(control.id);
    if (stored !== null && control.type === "button") toggle(control, stored === "true");
    else if (stored !== null && (!control.options || [...control.options].some((o) => o.value === stored))) control.value = stored;
    const event = control.type === "button" ? "click" : control.options ? "change" : "input";
    control.addEventListener(event, () => {
      control.dataset.chosen = "true";
      remember(control.id, state() === standard ? "" : state());
    });
  }
}
