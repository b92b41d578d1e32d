// Selected hand or object of a job's form in 3D.
import { Vector3 } from "./vendor/three.min.js";
import { loadGlb } from "./glb.js";
import { Hand, Thing } from "./figures.js";
import { beforePalm, LiveStage } from "./stage.js";

const stages = new Map();

async function show(figure) {
  const address = figure.dataset.model;
  const said = figure.querySelector("[data-say]");
  if (!address) return clear(figure);
  if (figure.dataset.shown === address) return;
  figure.dataset.shown = address;
  figure.dataset.state = "loading";
  try {
    const model = await loadGlb(address);
    if (figure.dataset.model !== address) return;
    if (!stages.has(figure)) stages.set(figure, new LiveStage(figure.querySelector("canvas")));
    const stage = stages.get(figure);
    if (stage.shown) stage.scene.remove(stage.shown);
    const made = model.extras.kind === "hand" ? new Hand(model) : new Thing(model);
    if (made instanceof Hand) made.pose([0, 0, 0, 1, 0, 0, 0], model.extras.preshape);
    stage.shown = made.group;
    stage.scene.add(made.group);
    stage.frame(made.group, made instanceof Hand ? beforePalm(made) : new Vector3(1, -1.5, 0.8), 1.0);
    said.textContent = "";
    figure.dataset.state = "ready";
  } catch (error) {
    figure.dataset.state = "failed";
    said.textContent = error.message;
  }
}

/** Empty the stage: an old model must not look like the selected one. */
function clear(figure) {
  const stage = stages.get(figure);
  if (stage?.shown) {
    stage.scene.remove(stage.shown);
    stage.shown = null;
    stage.invalidate();
  }
  delete figure.dataset.shown;
  figure.dataset.state = "none";
}

for (const figure of document.querySelectorAll("[data-viewer=model]")) {
  show(figure);
  new MutationObserver(() => show(figure)).observe(figure, { attributes: true, attributeFilter: ["data-model"] });
}
