// Pictures of grasps in lists: one small stage draws each picture when it scrolls into view.
import { Vector3 } from "./vendor/three.min.js";
import { loadGlb } from "./glb.js";
import { between, Hand, Thing } from "./figures.js";
import { freeSide, staged } from "./scenery.js";
import { besideHand, Stage } from "./stage.js";

const SIDE = 220;
let stage = null;
const figures = new Map();
let queue = Promise.resolve();

function keep(address, Kind) {
  if (!figures.has(address)) figures.set(address, loadGlb(address).then((model) => new Kind(model)));
  return figures.get(address);
}

async function draw(canvas) {
  const [grasp, hand, thing] = await Promise.all([
    fetch(canvas.dataset.grasp).then((answer) => (answer.ok ? answer.json() : Promise.reject(new Error(answer.status)))),
    keep(canvas.dataset.hand, Hand),
    keep(canvas.dataset.object, Thing),
  ]);
  stage ??= new Stage();
  const ratio = Math.min(devicePixelRatio, 2);
  const { pose, positions } = between(grasp.postures.grasp, grasp.postures.grasp, 0, grasp.joint_names);
  hand.pose(pose, positions);
  thing.group.position.set(0, 0, 0);
  const { all, scenery } = staged(grasp, hand, thing);
  stage.scene.add(all);
  if (scenery) stage.scene.add(scenery.group);
  stage.size(SIDE, SIDE * 0.8, ratio);
  const beside = besideHand(hand);
  stage.frame(all, grasp.scene ? freeSide(beside, grasp.scene, all.localToWorld(new Vector3())) : beside, 0.74);
  stage.draw();
  canvas.width = stage.renderer.domElement.width;
  canvas.height = stage.renderer.domElement.height;
  canvas.getContext("2d").drawImage(stage.renderer.domElement, 0, 0);
  stage.scene.remove(all);
  if (scenery) stage.scene.remove(scenery.group);
  canvas.dataset.state = "ready";
}

const seen = new IntersectionObserver((entries) => {
  for (const { isIntersecting, target } of entries) {
    if (!isIntersecting) continue;
    seen.unobserve(target);
    // Sequential, with pauses, so that scrolling stays smooth.
    queue = queue.then(() => draw(target)).catch(() => { target.dataset.state = "failed"; }).then(() => new Promise(requestAnimationFrame));
  }
}, { rootMargin: "300px" });

function watch(root) {
  for (const canvas of root.querySelectorAll("canvas[data-grasp]:not([data-state])")) {
    canvas.dataset.state = "waiting";
    seen.observe(canvas);
  }
}

watch(document);
document.addEventListener("htmx:after:swap", () => watch(document));
document.addEventListener("graspd:swapped", () => watch(document));
