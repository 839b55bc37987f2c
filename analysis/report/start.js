/** Copying, and the start of every part in the order of the page. */

/** Copies a table's text; where the browser refuses, shows it selected instead. */
async function copy(button) {
  try {
    await navigator.clipboard.writeText(button.dataset.copy);
    const name = button.textContent;
    button.textContent = "Copied";
    setTimeout(() => { button.textContent = name; }, 1200);
  } catch {
    const area = button.parentElement.querySelector("textarea")
      ?? button.parentElement.appendChild(element("textarea", { readonly: true, "aria-label": "text to copy" }));
    area.value = button.dataset.copy;
    area.select();
  }
}

document.addEventListener("click", ({ target }) => {
  if (target.dataset?.copy) copy(target);
  if (target.matches?.("nav a")) { // its # would replace the view in the address
    const section = document.querySelector(target.hash);
    if (section.querySelector("details")) section.querySelector("details").open = true;
    section.scrollIntoView();
    section.focus();
  }
});
for (const link of document.querySelectorAll("nav a")) link.addEventListener("click", (event) => event.preventDefault());

plotly = new Promise((resolve) => { setTimeout(resolve); }).then(source.plotly); // the table comes first
startTable();
startSelection();
startCurves();
startCompare();
startExplore();
startDetail();
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { drawCurves(); drawExplore(); });
source.start?.();
