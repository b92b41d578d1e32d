// Pictures of grasps, hands and objects in lists: one small stage draws each picture when it scrolls into view.
import { loadGlb } from "./glb.js";
import { between, figureOf, Hand, Thing } from "./figures.js";
import { freeSide, staged } from "./scenery.js";
import { beforePalm, besideHand, Stage } from "./stage.js";

const SIDE = 220;
let stage = null;
const ready = () => (stage ??= new Stage());
const figures = new Map();
let queue = Promise.resolve();

function keep(address, Kind) {
  if (!figures.has(address)) figures.set(address, loadGlb(address).then((model) => new Kind(ready(), model)));
  return figures.get(address);
}

/** Draw a stage with all its figures, and copy the picture. */
function picture(canvas, shown, side, room) {
  for (const group of shown) group.setParent(stage.scene);
  stage.size(SIDE, SIDE * 0.8, Math.min(devicePixelRatio, 2));
  stage.frame(shown[0], side, room);
  stage.draw();
  canvas.width = stage.gl.canvas.width;
  canvas.height = stage.gl.canvas.height;
  canvas.getContext("2d").drawImage(stage.gl.canvas, 0, 0);
  for (const group of shown) group.setParent(null);
  canvas.dataset.state = "ready";
}

async function draw(canvas) {
  if (canvas.dataset.model) {
    const made = figureOf(ready(), await loadGlb(canvas.dataset.model));
    return picture(canvas, [made.group], beforePalm(made));
  }
  const [grasp, hand, thing] = await Promise.all([
    fetch(canvas.dataset.grasp).then((answer) => (answer.ok ? answer.json() : Promise.reject(new Error(answer.status)))),
    keep(canvas.dataset.hand, Hand),
    keep(canvas.dataset.object, Thing),
  ]);
  const { pose, positions } = between(grasp.postures.grasp, grasp.postures.grasp, 0, grasp.joint_names);
  hand.pose(pose, positions);
  thing.group.position.set(0, 0, 0);
  const { all, scenery } = staged(stage, grasp, hand, thing);
  const beside = besideHand(hand);
  const side = grasp.scene ? freeSide(beside, grasp.scene, all.position) : beside;
  picture(canvas, scenery ? [all, scenery.group] : [all], side, 0.74);
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
  for (const canvas of root.querySelectorAll(":is(canvas[data-grasp], canvas[data-model]):not([data-state], .viewer *)")) {
    canvas.dataset.state = "waiting";
    seen.observe(canvas);
  }
}

watch(document);
document.addEventListener("htmx:after:swap", () => watch(document));
document.addEventListener("graspd:swapped", () => watch(document));
