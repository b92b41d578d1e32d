// Hand or object in 3D. In a job's form, htmx replaces the fields beside the figure, which name the model.
import { loadGlb } from "./glb.js";
import { figureOf } from "./figures.js";
import { beforePalm, LiveStage } from "./stage.js";

async function show(figure) {
  const address = figure.parentElement.querySelector("[data-model]").dataset.model, said = figure.querySelector("[data-say]");
  if (figure.dataset.shown === address) return;
  figure.dataset.shown = address;
  figure.dataset.state = address ? "loading" : "none";
  said.textContent = "";
  try {
    const model = address && await loadGlb(address);
    if (figure.dataset.shown !== address) return;
    const stage = figure.stage ??= new LiveStage(figure.querySelector("canvas"));
    // An old model must not look like the selected one.
    stage.shown?.setParent(null);
    stage.invalidate();
    if (!model) return;
    const made = figureOf(stage, model);
    stage.shown = made.group;
    made.group.setParent(stage.scene);
    stage.frame(made.group, beforePalm(made), 1.0);
    figure.dataset.state = "ready";
  } catch (error) {
    figure.dataset.state = "failed";
    said.textContent = error.message;
  }
}

for (const figure of document.querySelectorAll("[data-viewer=model]")) {
  show(figure);
  new MutationObserver(() => show(figure)).observe(figure.parentElement, { childList: true, subtree: true, attributeFilter: ["data-model"] });
}
