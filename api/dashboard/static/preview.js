// A hand or an object alone in 3D: what will be grasped, and with what.
import { Vector3 } from "./vendor/three.min.js";
import { loadGlb } from "./glb.js";
import { Hand, Thing } from "./figures.js";
import { besideHand, LiveStage } from "./stage.js";

const stages = new Map();

async function show(figure) {
  const address = figure.dataset.model;
  const said = figure.querySelector("[data-say]");
  if (!address || figure.dataset.shown === address) return;
  figure.dataset.shown = address;
  figure.dataset.state = "loading";
  try {
    const model = await loadGlb(address);
    if (figure.dataset.model !== address) return;
    if (!stages.has(figure)) stages.set(figure, new LiveStage(figure.querySelector("canvas")));
    const stage = stages.get(figure);
    if (stage.shown) stage.scene.remove(stage.shown);
    const made = model.extras.kind === "hand" ? new Hand(model) : new Thing(model);
    if (made instanceof Hand) made.pose(upright(model.extras.palm.approach), model.extras.preshape);
    stage.shown = made.group;
    stage.scene.add(made.group);
    stage.frame(made.group, made instanceof Hand ? besideHand(made) : new Vector3(1, -1.5, 0.8), 1.0);
    said.textContent = "";
    figure.dataset.state = "ready";
  } catch (error) {
    figure.dataset.state = "failed";
    said.textContent = error.message;
  }
}

/** Pose in which the palm looks up and a little forward, as one would hold a hand to look at it. */
function upright([x, y, z]) {
  const half = new Vector3(x, y, z).add(new Vector3(0.35, 0.1, 0.93).normalize()).normalize();
  // The rotation that takes the approach to the wanted direction is half a turn about their bisector.
  return [0, 0, 0, 0, half.x, half.y, half.z];
}

for (const figure of document.querySelectorAll("[data-viewer=model]")) {
  show(figure);
  new MutationObserver(() => show(figure)).observe(figure, { attributes: true, attributeFilter: ["data-model"] });
}
