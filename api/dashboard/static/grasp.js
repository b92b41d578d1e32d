// The page of one grasp: hand and object in 3D, contacts by distance, a slider from pregrasp over grasp to squeeze.
import { Group } from "./vendor/three.min.js";
import { loadGlb } from "./glb.js";
import { between, Hand, Thing } from "./figures.js";
import { Contacts } from "./contacts.js";
import { besideHand, LiveStage } from "./stage.js";

const POSTURES = ["pregrasp", "grasp", "squeeze"];
const PLAY_MS = 2600;

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
  const all = new Group();
  all.add(hand.group, thing.group);
  stage.scene.add(all);
  const contacts = new Contacts(hand, thing);
  stage.scene.add(contacts.group);

  const slider = figure.querySelector("input[type=range]");
  const show = () => {
    const at = Number(slider.value);
    const first = Math.min(Math.floor(at), 1);
    const { pose, positions } = between(grasp.postures[POSTURES[first]], grasp.postures[POSTURES[first + 1]], at - first, grasp.joint_names);
    hand.pose(pose, positions);
    const { touching, lowest } = contacts.update();
    const depth = lowest < 0 ? `deepest ${(-1000 * lowest).toFixed(2)} mm inside` : lowest < 0.005 ? `nearest ${(1000 * lowest).toFixed(2)} mm away` : "nothing within 5 mm";
    said.textContent = `${touching} surface points within 1 mm, ${depth}`;
    slider.setAttribute("aria-valuetext", at < 0.02 ? "pregrasp" : Math.abs(at - 1) < 0.02 ? "grasp" : at > 1.98 ? "squeeze" : at < 1 ? `${Math.round(100 * at)} % of the way from pregrasp to grasp` : `${Math.round(100 * (at - 1))} % of the way from grasp to squeeze`);
    stage.invalidate();
  };
  show();
  stage.frame(all, besideHand(hand), 0.7);
  wire(figure, { stage, hand, thing, contacts, slider, show });
  figure.dataset.state = "ready";
}

function wire(figure, { stage, hand, thing, contacts, slider, show }) {
  slider.addEventListener("input", show);
  for (const button of figure.querySelectorAll("[data-posture]")) {
    button.addEventListener("click", () => { slider.value = button.dataset.posture; show(); });
  }
  const toggles = {
    contacts: (on) => { contacts.group.visible = on; },
    glass: (on) => hand.setGlass(on),
    wire: (on) => thing.setWire(on),
  };
  for (const [name, apply] of Object.entries(toggles)) {
    const box = figure.querySelector(`[data-toggle=${name}]`);
    const change = () => { apply(box.checked); stage.invalidate(); };
    box.addEventListener("change", change);
    change();
  }
  figure.querySelector("[data-reset]").addEventListener("click", () => stage.reset());
  const play = figure.querySelector("[data-play]");
  let playing = null;
  const stop = () => { cancelAnimationFrame(playing); playing = null; play.setAttribute("aria-pressed", "false"); };
  play.addEventListener("click", () => {
    if (playing !== null) return stop();
    play.setAttribute("aria-pressed", "true");
    const began = performance.now();
    const step = (now) => {
      const share = Math.min((now - began) / PLAY_MS, 1);
      slider.value = String(2 * share);
      show();
      if (share < 1) playing = requestAnimationFrame(step); else stop();
    };
    playing = requestAnimationFrame(step);
  });
}

for (const figure of document.querySelectorAll("[data-viewer=grasp]")) {
  start(figure).catch((error) => {
    figure.dataset.state = "failed";
    figure.querySelector("[data-say]").textContent = `No 3D view: ${error.message}. The numbers beside it are complete.`;
  });
}
