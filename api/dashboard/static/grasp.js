// Views of grasps, one or several side by side: hand, object and scene in 3D, contacts coloured by distance, and a
// slider along the trajectory, planned or replayed in MuJoCo. Several views turn and move together.
import { Transform } from "./vendor/ogl.min.js";
import { loadGlb } from "./glb.js";
import { Hand, place, Thing } from "./figures.js";
import { Contacts } from "./contacts.js";
import { Forces } from "./forces.js";
import { AXES, drawArrows } from "./marks.js";
import { freeSide, staged } from "./scenery.js";
import { besideHand, LiveStage, startViewers } from "./stage.js";
import { Way } from "./way.js";

const STOP_MS = 1300;
const views = [];
let leading = null;

/** Call a function for all other views, without an echo; trajectories meet at their grasps. */
function others(view, change) {
  if (leading) return;
  leading = view;
  for (const one of views) if (one !== view) change(one);
  leading = null;
}

async function json(address) {
  const answer = await fetch(address);
  const content = await answer.json().catch(() => ({}));
  if (!answer.ok) throw new Error(content.detail ?? "the shard cannot be read");
  return content;
}

class View {
  constructor(figure, grasp, handModel, objectModel) {
    Object.assign(this, { figure, grasp });
    this.find = (what) => figure.querySelector(what);
    this.slider = this.find("input[type=range]");
    this.stage = new LiveStage(this.find("canvas"));
    this.hand = new Hand(this.stage, handModel);
    this.thing = new Thing(this.stage, objectModel);
    const { all, scenery } = staged(this.stage, grasp, this.hand, this.thing);
    this.all = all;
    this.scenery = scenery;
    all.setParent(this.stage.scene);
    scenery?.group.setParent(this.stage.scene);
    scenery?.addNeighbours(grasp.scene);
    this.contacts = new Contacts(this.stage, this.hand, this.thing);
    this.axes = new Transform();
    drawArrows(this.stage, this.axes, AXES.map((color, k) => [color, [0, 0, 0], [0, 1, 2].map((axis) => Number(axis === k)), 0.05]));
    for (const part of [this.contacts.group, this.axes]) part.setParent(this.thing.group);
    this.planned = new Way(grasp.way, grasp.joint_names);
    this.follow(this.planned, this.planned.place("grasp"));
    const beside = besideHand(this.hand), middle = all.position;
    this.stage.frame(all, grasp.scene ? freeSide(beside, grasp.scene, middle) : beside, this.planned.place("grasp") > 1 ? 1.2 : 0.7);
  }

  /** Put a trajectory on the slider. */
  follow(way, at) {
    this.way = way;
    this.slider.max = String(way.last);
    this.find(".track").dataset.stops = way.stops.length;
    this.find(".ticks").replaceChildren(...way.stops.map(({ name, place: to }) => {
      const tick = Object.assign(document.createElement("button"), { type: "button", textContent: name });
      tick.dataset.posture = to;
      tick.addEventListener("click", () => this.move(to));
      return tick;
    }));
    this.show(at);
  }

  /** Show a slider position here and the corresponding one in the other views. */
  move(to) {
    this.stop();
    this.show(to);
    others(this, (one) => one.move(this.shifted(to, one)));
  }

  shifted(to, one) {
    return to - this.way.place("grasp") + one.way.place("grasp");
  }

  show(to) {
    this.slider.value = String(to);
    const at = Number(this.slider.value);
    const { pose, positions, body, point } = this.way.at(at);
    place(this.thing.group, body).updateMatrixWorld();
    this.hand.pose(pose, positions);
    const { touching, lowest } = this.contacts.update();
    const depth = lowest < 0 ? `deepest ${(-1000 * lowest).toFixed(2)} mm inside` : lowest < 0.005 ? `nearest ${(1000 * lowest).toFixed(2)} mm away` : "nothing within 5 mm";
    const ended = this.outcome && at === this.way.last ? `; the replay ends: ${this.outcome}` : "";
    this.find("[data-say]").textContent = `${touching} surface points within 1 mm, ${depth}${ended}`;
    this.find("[data-stage]").textContent = this.way.say(at);
    this.slider.setAttribute("aria-valuetext", this.way.say(at));
    for (const button of this.figure.querySelectorAll("[data-posture]")) {
      button.setAttribute("aria-current", String(Math.abs(Number(button.dataset.posture) - at) < 0.02));
    }
    this.forces?.show(point);
    Forces.tell(this.find("[data-balance]"), this.forces?.group.visible ? point : {}, this.grasp.scene);
    this.stage.invalidate();
  }

  /** Follow the trajectory that MuJoCo simulates, or the planned one again. */
  async replay(on) {
    this.figure.toggleAttribute("data-physics", on);
    if (on && !this.replayed) {
      this.find("[data-stage]").textContent = "MuJoCo simulates the validation …";
      const { way, outcome } = await json(`${this.figure.dataset.grasp}/replay`);
      this.replayed = new Way(way, this.grasp.joint_names);
      this.said = outcome;
      this.forces = new Forces(this.stage, this.replayed);
      this.all.addChild(this.forces.group);
    }
    if (this.forces) this.forces.group.visible = on;
    this.outcome = on ? this.said : null;
    this.follow(on ? this.replayed : this.planned, this.linked ?? Number(this.slider.value));
    this.linked = null;
  }

  stop() {
    cancelAnimationFrame(this.playing);
    this.playing = null;
    this.find("[data-play]").setAttribute("aria-pressed", "false");
  }

  play() {
    if (this.playing) return this.stop();
    this.find("[data-play]").setAttribute("aria-pressed", "true");
    const began = performance.now();
    const step = (now) => {
      const to = Math.min(Math.max(now - began, 0) / STOP_MS, this.way.last);
      this.show(to);
      others(this, (one) => one.show(this.shifted(to, one)));
      if (to < this.way.last) this.playing = requestAnimationFrame(step); else this.stop();
    };
    this.playing = requestAnimationFrame(step);
    return null;
  }

  wire() {
    const toggles = {
      contacts: (on) => { this.contacts.group.visible = on; },
      physics: (on) => this.replay(on).catch((error) => this.fail(error)),
      axes: (on) => { this.axes.visible = on; },
      glass: (on) => this.hand.setGlass(on),
      collision: (on) => this.hand.setCollision(on),
      wire: (on) => { this.thing.setWire(on); },
      scenery: (on) => { this.scenery.group.visible = on; },
    };
    const [, numbers = "", at = "", names = ""] = location.hash.match(/^#view=([-\d.,]+);([\d.]+);([a-z,]*)$/) ?? [];
    const chosen = names.split(",");
    if (chosen.includes("physics")) this.linked = Number(at); // the replay may be longer than the planned trajectory
    for (const [name, apply] of Object.entries(toggles)) {
      const box = this.find(`[data-toggle=${name}]`);
      if (!box) continue;
      if (at) box.checked = chosen.includes(name);
      if (name === "collision") box.closest("label").hidden = !this.hand.hasCollision;
      const change = () => { apply(box.checked); this.stage.invalidate(); };
      box.addEventListener("change", () => {
        change();
        others(this, (one) => { const twin = one.find(`[data-toggle=${name}]`); if (twin && twin.checked !== box.checked) twin.click(); });
      });
      if (name !== "physics" || box.checked) change();
    }
    if (numbers.split(",").length === 6) this.stage.view = numbers.split(",").map(Number);
    if (at) this.show(Number(at));
    this.slider.addEventListener("input", () => this.move(Number(this.slider.value)));
    this.find("[data-play]").addEventListener("click", () => this.play());
    this.find("[data-reset]").addEventListener("click", () => { this.stage.view = this.stage.home; });
    this.find("[data-link]")?.addEventListener("click", (event) => this.link(event.target));
    this.stage.onTurn = (view) => others(this, (one) => { one.stage.view = view; });
  }

  /** Put the camera, the slider and the boxes into the address, and copy it. */
  link(button) {
    const on = [...this.figure.querySelectorAll("[data-toggle]:checked")].map((box) => box.dataset.toggle);
    const view = this.stage.view.map((value) => Number(value.toFixed(3)));
    history.replaceState(null, "", `#view=${view};${Number(this.slider.value)};${on}`);
    navigator.clipboard?.writeText(location.href).catch(() => {});
    button.textContent = "Link copied";
  }

  fail(error) {
    this.figure.toggleAttribute("data-physics", false);
    this.find("[data-toggle=physics]").checked = false;
    this.find("[data-stage]").textContent = "";
    this.find("[data-say]").textContent = `No replay: ${error.message}`;
  }
}

async function start(figure) {
  const { grasp, hand, object } = figure.dataset;
  const view = new View(figure, ...(await Promise.all([json(grasp), loadGlb(hand), loadGlb(object)])));
  view.wire();
  views.push(view);
}

startViewers("grasp", start, "The page lists all numbers.");
