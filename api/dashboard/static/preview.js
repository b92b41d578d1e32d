// Selected hand or object of a job's form in 3D.
import { loadGlb } from "./glb.js";
import { figureOf } from "./figures.js";
import { beforePalm, LiveStage } from "./stage.js";

async function show(figure) {
  const address = figure.dataset.model, said = figure.querySelector("[data-say]");
  if (figure.dataset.shown === address) return;
  figure.dataset.shown = address;
  figure.dataset.state = address ? "loading" : "none";
  try {
    const model = address && await loadGlb(address);
    if (figure.dataset.model !== address) return;
    const stage = figure.stage ??= new LiveStage(figure.querySelector("canvas"));
    // An old model must not look like the selected one.
    stage.shown?.setParent(null);
    stage.invalidate();
    if (!model) return;
    const made = figureOf(stage, model);
    stage.shown = made.group;
    made.group.setParent(stage.scene);
    stage.frame(made.group, beforePalm(made), 1.0);
    said.textContent = "";
    figure.dataset.state = "ready";
  } catch (error) {
    figure.dataset.state = "failed";
    said.textContent = error.message;
  }
}

for (const figure of document.querySelectorAll("[data-viewer=model]")) {
  show(figure);
  new MutationObserver(() => show(figure)).observe(figure, { attributes: true, attributeFilter: ["data-model"] });
}
