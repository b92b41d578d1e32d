// Page of a hand: 3D view with the findings of its check, a slider for each joint, and a form that moves the view.
import { Quat, Vec3 } from "./vendor/ogl.min.js";
import { loadGlb } from "./glb.js";
import { Hand, turnOf } from "./figures.js";
import { Marks } from "./marks.js";
import { boundsOf } from "./shapes.js";
import { beforePalm, LiveStage, startViewers } from "./stage.js";

const ROOT = [0, 0, 0, 1, 0, 0, 0];
/** Closed share of a hand on its approach; a gripper approaches open. */
const PRESHAPE_SHARE = 0.25;
const GRIPPER_DOFS = 2;
const STEP = 0.02;

class HandPage {
  constructor(figure, form, model) {
    this.figure = figure;
    this.form = form;
    ({ facts: this.facts, links: this.links, drives: this.drives } = model.extras);
    this.dofs = this.facts.dofs;
    this.stage = new LiveStage(figure.querySelector("canvas"));
    this.hand = new Hand(this.stage, model);
    this.q = this.preshape();
    this.pose(this.q);
    const [low, high] = boundsOf(this.hand.group);
    this.marks = new Marks(this.stage, this.hand, Math.max(...high.sub(low)));
    this.hand.group.setParent(this.stage.scene);
    this.stage.frame(this.hand.group, beforePalm(this.hand), 1.0);
    this.hand.group.addChild(this.marks.group);
    this.link = this.field("palm_link").value;
    this.show();
    this.wire();
  }

  field(name) {
    return this.form.elements[name];
  }

  closing() {
    return this.dofs.map((_, i) => Number(this.field(`closing.${i}`).value));
  }

  preshape() {
    return this.dofs.map((_, i) => Number(this.field(`preshape.${i}`).value) || 0);
  }

  limits(i) {
    return [this.facts.lower[this.dofs[i]], this.facts.upper[this.dofs[i]]];
  }

  /** Joint values at a share from open to closed; joints without closing direction stay. */
  posture(share) {
    return this.closing().map((way, i) => {
      const [low, high] = this.limits(i);
      if (way === 0) return this.q[i];
      return way > 0 ? low + share * (high - low) : high - share * (high - low);
    });
  }

  pose(q) {
    const values = Object.fromEntries(this.dofs.map((name, i) => [name, q[i]]));
    const positions = Object.fromEntries(Object.entries(this.drives).map(([joint, drive]) => [joint, drive.times * values[drive.dof] + drive.plus]));
    this.hand.pose(ROOT, positions);
  }

  /** Pose of a link in the root frame while the hand is in its pre-shape. */
  frameOf(link) {
    this.pose(this.preshape());
    const { body, pose: [x, y, z, w, i, j, k] } = this.links[link];
    const group = this.hand.bodies[body].group;
    const turn = turnOf(group);
    return { at: new Vec3(x, y, z).applyMatrix4(group.worldMatrix), turn: turn.multiply(new Quat(i, j, k, w)) };
  }

  vector(name, scale = 1) {
    return new Vec3(...["x", "y", "z"].map((axis) => scale * Number(this.field(`${name}_${axis}`).value)));
  }

  write(name, vector, scale, digits) {
    ["x", "y", "z"].forEach((axis, i) => { this.field(`${name}_${axis}`).value = String(Number((scale * vector[i]).toFixed(digits))); });
  }

  /** Palm of the form, in the root frame. */
  palm() {
    const { at, turn } = this.frameOf(this.field("palm_link").value);
    const approach = this.vector("approach").applyQuaternion(turn);
    return { centre: this.vector("centre", 0.001).applyQuaternion(turn).add(at), approach: approach.len() > 1e-6 ? approach.normalize() : null };
  }

  /** Position of a fingertip's pad, or else of the middle of its surface. */
  spot({ group, points, name }) {
    const pad = this.hand.extras.pads.find((one) => this.hand.bodies[one.body].name === name);
    const flat = pad ? pad.points.flat() : points ?? [0, 0, 0];
    const mean = [0, 1, 2].map((axis) => flat.reduce((sum, value, i) => sum + (i % 3 === axis ? value : 0), 0) / (flat.length / 3));
    return new Vec3(...mean).applyMatrix4(group.worldMatrix);
  }

  show() {
    const { centre, approach } = this.palm();
    this.marks.palm.visible = approach !== null;
    if (approach) this.marks.placePalm(centre, approach);
    const chosen = new Set([...this.form.querySelectorAll("[name=fingertip]:checked")].map((box) => box.value));
    const tips = this.hand.bodies.filter((body) => chosen.has(body.name));
    const closer = this.q.map((value, i) => value + STEP * this.closing()[i] * (this.limits(i)[1] - this.limits(i)[0]));
    this.pose(closer);
    const after = tips.map((body) => this.spot(body));
    this.pose(this.q);
    this.marks.placeClosing(tips.map((body, i) => [this.spot(body), after[i]]));
    this.dofs.forEach((_, i) => {
      const slider = this.form.querySelector(`[data-joint="${i}"]`);
      slider.value = String(this.q[i]);
      slider.nextElementSibling.textContent = this.said(i);
    });
    this.figure.querySelector("[data-close]").value = String(this.share());
    this.stage.invalidate();
  }

  /** Mean closed share of the joints that close, 0 to 1. */
  share() {
    const ways = this.closing(), closing = this.dofs.map((_, i) => i).filter((i) => ways[i] !== 0);
    const shares = closing.map((i) => {
      const [low, high] = this.limits(i);
      return (ways[i] > 0 ? this.q[i] - low : high - this.q[i]) / Math.max(high - low, 1e-9);
    });
    return shares.reduce((sum, one) => sum + one, 0) / Math.max(shares.length, 1);
  }

  said(i) {
    const joint = this.hand.joints.get(this.dofs[i]);
    return joint?.slides ? `${(1000 * this.q[i]).toFixed(1)} mm` : `${((180 / Math.PI) * this.q[i]).toFixed(0)}°`;
  }

  take(q) {
    this.q = q;
    this.show();
  }

  /** Express the palm in the frame of the selected link. */
  movePalm() {
    const before = this.frameOf(this.link), link = this.field("palm_link").value, after = this.frameOf(link);
    const back = new Quat().inverse(after.turn);
    const centre = this.vector("centre", 0.001).applyQuaternion(before.turn).add(before.at).sub(after.at).applyQuaternion(back);
    const approach = this.vector("approach").applyQuaternion(before.turn).applyQuaternion(back);
    this.link = link;
    this.write("centre", centre, 1000, 3);
    this.write("approach", approach, 1, 6);
    this.show();
  }

  /** Write a joint's value into the form, as its pre-shape. */
  keep(i) {
    this.field(`preshape.${i}`).value = String(Number(this.q[i].toFixed(6)));
  }

  /** Set the pre-shape of a joint after a change of its closing direction. */
  turn(i) {
    const [low, high] = this.limits(i);
    const shaped = this.posture(this.dofs.length <= GRIPPER_DOFS ? 0 : PRESHAPE_SHARE)[i];
    this.q[i] = this.closing()[i] === 0 ? Math.min(Math.max(0, low), high) : shaped;
    this.keep(i);
    this.show();
  }

  wire() {
    const every = (selector, event, act) => this.form.querySelectorAll(selector).forEach((element) => element.addEventListener(event, () => act(element)));
    every("[data-joint]", "input", (slider) => { this.q[Number(slider.dataset.joint)] = Number(slider.value); this.show(); });
    every("[name^='closing.']", "change", (radio) => this.turn(Number(radio.name.slice(8))));
    every("[name^='preshape.']", "input", (input) => { this.q[Number(input.name.slice(9))] = Number(input.value) || 0; this.show(); });
    every("[name=palm_link]", "change", () => this.movePalm());
    every("[name^='centre_'], [name^='approach_'], [name=fingertip]", "input", () => this.show());
    every("[data-approach]", "click", (button) => { this.write("approach", new Vec3(...button.dataset.approach.split(",").map(Number)), 1, 0); this.show(); });
    every("[data-take]", "click", () => { this.dofs.forEach((_, i) => this.keep(i)); this.show(); });
    const postures = { open: () => this.posture(0), preshape: () => this.preshape(), closed: () => this.posture(1) };
    for (const button of this.figure.querySelectorAll("[data-posture]")) {
      button.addEventListener("click", () => this.take(postures[button.dataset.posture]()));
    }
    this.figure.querySelector("[data-close]").addEventListener("input", (event) => this.take(this.posture(Number(event.target.value))));
    const toggles = {
      housing: (on) => this.hand.setGlass(on, this.hand.housing),
      collision: (on) => this.hand.setCollision(on),
      marks: (on) => this.marks.groups.forEach((group) => { group.visible = on; }),
    };
    for (const [name, apply] of Object.entries(toggles)) {
      const box = this.figure.querySelector(`[data-toggle=${name}]`);
      box.closest("label").hidden = name === "collision" && !this.hand.hasCollision;
      const change = () => { apply(box.checked); this.stage.invalidate(); };
      box.addEventListener("change", change);
      change();
    }
    this.figure.querySelector("[data-reset]").addEventListener("click", () => { this.stage.view = this.stage.home; });
    for (const hidden of document.querySelectorAll("[data-moves]")) hidden.hidden = false;
  }
}

async function start(figure) {
  const model = await loadGlb(figure.dataset.model);
  if (!model.extras.facts) throw new Error("the model was made by an older version");
  figure.graspd = new HandPage(figure, document.getElementById("hand"), model);
}

const find = () => startViewers("hand", start, "The form lists all settings.");
find();
// The page shows the hand when its check has ended.
document.addEventListener("graspd:swapped", find);
