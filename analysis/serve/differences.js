/** Means over seeds and verdicts, computed by the server from the selected runs. */

function offerDifferences() {
  options($("difference-metric"), DATA.quality.filter((name) => columns.has(name) && isNumeric(name)).map((name) => [name, heading(name)]));
  $("column-names").replaceChildren(...telling().map((name) => element("option", { value: name })));
}

/** The selection as the server's filter, whose language has that of the page in it. */
function selectionText() {
  const choices = [["state", "state"], ["scene", "scene_name"]].filter(([id]) => $(id).value);
  return [$("filter").value, ...choices.map(([id, key]) => `${key}="${$(id).value}"`)].join(" ");
}

async function showDifferences(event) {
  event?.preventDefault();
  const said = { filter: selectionText(), rows: $("row-keys").value, baseline: $("baseline").value, metric: $("difference-metric").value, within: $("within").value };
  $("differences-table").setAttribute("aria-busy", "true");
  try {
    const made = await (await ask("differences", said)).text();
    // Jinja has escaped every text in it, as in the static page; scripts in it would not run.
    $("differences-table").innerHTML = made;
    $("differences-error").textContent = "";
  } catch (error) {
    $("differences-table").replaceChildren();
    $("differences-error").textContent = error.message;
  }
  $("differences-table").removeAttribute("aria-busy");
}

function startDifferences() {
  offerDifferences();
  keep("row-keys", "baseline", "difference-metric", "within");
  $("differences-form").addEventListener("submit", showDifferences);
  if (address.has("row-keys") || address.has("baseline")) showDifferences();
}
