/** Theme, copying, and the start of every part in the order of the page. */

function startTheme() {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const drawn = [...document.querySelectorAll("img.figure")].map((image) => [image, image.src]);
  const show = (on) => {
    toggle($("theme"), on);
    for (const [image, light] of drawn) image.src = on ? darkened(light) : light;
    drawPlots();
    drawCurves();
  };
  $("theme").addEventListener("click", () => {
    const on = $("theme").getAttribute("aria-pressed") !== "true";
    document.documentElement.dataset.theme = on ? "dark" : "light";
    show(on);
  });
  dark.addEventListener("change", () => { if (!document.documentElement.dataset.theme) show(dark.matches); });
  if (dark.matches) show(true);
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

selection.key = columns.has("psnr") ? "psnr" : null;
startSelection();
startTable();
startCompare();
drawTable();
startPlots();
startCurves();
startDetail();
startTheme();
for (const button of document.querySelectorAll("[data-copy]")) button.addEventListener("click", () => copy(button));
