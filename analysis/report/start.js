/** Theme, copying, and the start of every part in the order of the page. */

function startTheme() {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const figures = [...document.querySelectorAll("img.figure")].map((image) => [image, image.src]);
  const show = (on) => {
    toggle($("theme"), on);
    for (const [image, light] of figures) image.src = on ? darkened(light) : light;
    for (const draw of [drawCurves, drawExplore]) draw();
  };
  const set = (name) => {
    document.documentElement.dataset.theme = name;
    show(name === "dark");
  };
  $("theme").addEventListener("click", () => {
    set(pressed("theme") ? "light" : "dark");
    remember("theme", document.documentElement.dataset.theme);
  });
  dark.addEventListener("change", () => { if (!document.documentElement.dataset.theme) show(dark.matches); });
  if (["light", "dark"].includes(address.get("theme"))) set(address.get("theme"));
  else if (dark.matches) show(true);
}

/** An SVG as a data URI in the colours of the dark theme; other images as they are. */
function darkened(uri) {
  const [head, body] = uri.split(",");
  if (!head.includes("svg")) return uri;
  const colours = Object.entries(DATA.dark);
  return `${head},${btoa(colours.reduce((svg, [light, dark]) => svg.replaceAll(light, dark), atob(body)))}`;
}

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
  if (target.dataset?.png) savePlot(target.dataset.png);
  if (target.matches?.("nav a")) { // its # would replace the view in the address
    const section = document.querySelector(target.hash);
    if (section.querySelector("details")) section.querySelector("details").open = true;
    section.scrollIntoView();
    section.focus();
  }
});
for (const link of document.querySelectorAll("nav a")) link.addEventListener("click", (event) => event.preventDefault());

source.prepare?.();
plotly = new Promise((resolve) => { setTimeout(resolve); }).then(source.plotly); // the table comes first
startTable();
startSelection();
startCurves();
startCompare();
startExplore();
startDetail();
startTheme();
source.start?.();
