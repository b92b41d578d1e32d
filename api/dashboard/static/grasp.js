// Page of one grasp: hand, object and scene in 3D, contacts coloured by distance, and a slider along the trajectory:
// standoff, pregrasp, grasp, squeeze, lift.
import { Vector3 } from "./vendor/three.min.js";
import { loadGlb } from "./glb.js";
import { Hand, Thing } from "./figures.js";
import { Contacts } from "./contacts.js";
import { freeSide, staged } from "./scenery.js";
import { besideHand, LiveStage } from "./stage.js";
import { Way } from "./way.js";

const STOP_MS = 1300;

async function start(figure) {
  const canvas = figure.querySelector("canvas");
  const said = figure.querySelector("[data-say]");
  const [grasp, handModel, objectModel] = await Promise.all([
    fetch(figure.dataset.grasp).then((answer) => (answer.ok ? answer.json() : Promise.reject(new Error("the shard cannot be read")))),
    loadGlb(figure.dataset.hand),
    loadGlb(figure.dataset.object),
  ]);
  const stage = new LiveStage(canvas);
  const hand = new Hand(handModel), thing = new Thing(objectModel);
  const { all, scenery } = staged(grasp, hand, thing);
  stage.scene.add(all);
  if (scenery) {
    stage.scene.add(scenery.group);
    scenery.addNeighbours(grasp.scene, () => stage.invalidate());
  }
  const contacts = new Contacts(hand, thing);
  thing.group.add(contacts.group);

  const way = new Way(grasp.way, grasp.joint_names);
  const slider = figure.querySelector("input[type=range]");
  const doing = figure.querySelector("[data-stage]");
  const show = () => {
    const place = Number(slider.value);
    const { pose, positions, carried } = way.at(place);
    thing.group.position.fromArray(carried);
    thing.group.updateMatrixWorld(true);
    hand.pose(pose, positions);
    const { touching, lowest } = contacts.update();
    const depth = lowest < 0 ? `deepest ${(-1000 * lowest).toFixed(2)} mm inside` : lowest < 0.005 ? `nearest ${(1000 * lowest).toFixed(2)} mm away` : "nothing within 5 mm";
    said.textContent = `${touching} surface points within 1 mm, ${depth}`;
    doing.textContent = way.say(place);
    slider.setAttribute("aria-valuetext", way.say(place));
    for (const button of figure.querySelectorAll("[data-posture]")) {
      button.setAttribute("aria-current", String(Math.abs(Number(button.dataset.posture) - place) < 0.02));
    }
    stage.invalidate();
  };
  slider.value = String(way.place("grasp"));
  show();
  const beside = besideHand(hand);
  const middle = all.localToWorld(new Vector3());
  stage.frame(all, grasp.scene ? freeSide(beside, grasp.scene, middle) : beside, way.place("grasp") > 1 ? 1.2 : 0.7);
  wire(figure, { stage, hand, thing, scenery, contacts, slider, way, show });
  figure.dataset.state = "ready";
}

function wire(figure, { stage, hand, thing, scenery, contacts, slider, way, show }) {
  const play = figure.querySelector("[data-play]");
  let playing = null;
  const stop = () => { cancelAnimationFrame(playing); playing = null; play.setAttribute("aria-pressed", "false"); };
  slider.addEventListener("input", () => { stop(); show(); });
  for (const button of figure.querySelectorAll("[data-posture]")) {
    button.addEventListener("click", () => { stop(); slider.value = button.dataset.posture; show(); });
  }
  const toggles = {
    contacts: (on) => { contacts.group.visible = on; },
    glass: (on) => hand.setGlass(on),
    collision: (on) => hand.setCollision(on),
    wire: (on) => thing.setWire(on),
    scenery: (on) => { scenery.group.visible = on; },
  };
  for (const [name, apply] of Object.entries(toggles)) {
    const box = figure.querySelector(`[data-toggle=${name}]`);
    if (!box) continue;
    if (name === "collision") box.closest("label").hidden = !hand.hasCollision;
    const change = () => { apply(box.checked); stage.invalidate(); };
    box.addEventListener("change", change);
    change();
  }
  figure.querySelector("[data-reset]").addEventListener("click", () => stage.reset());
  play.addEventListener("click", () => {
    if (playing !== null) return stop();
    play.setAttribute("aria-pressed", "true");
    const began = performance.now();
    const step = (now) => {
      const place = Math.min(Math.max(now - began, 0) / STOP_MS, way.last);
      slider.value = String(place);
      show();
      if (place < way.last) playing = requestAnimationFrame(step); else stop();
    };
    playing = requestAnimationFrame(step);
  });
}

for (const figure of document.querySelectorAll("[data-viewer=grasp]")) {
  start(figure).catch((error) => {
    figure.dataset.state = "failed";
    figure.querySelector("[data-say]").textContent = `No 3D view: ${error.message}. The page lists all numbers.`;
  });
}
