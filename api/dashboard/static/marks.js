// Findings of a hand's check, drawn on the hand: palm frame, approach, closing directions, and pads of the fingertips.
import { Vec3 } from "./vendor/ogl.min.js";
import { groupOf } from "./figures.js";
import { dotsOf, lathe, linear, Shape, turnTo } from "./shapes.js";

const COLOURS = { approach: 0xdd7432, closing: 0x1f9c93, pad: 0xd6409f };
export const AXES = [0xc8343c, 0x3c9a4a, 0x3566c8];
/** Look of a mark that shines faintly through objects in front of it. */
const FAINT = { opacity: 0.3, lit: 0, through: true };
/** Unit arrow along z: radius and height, rotated about the axis. */
const PROFILE = [[0, 0], [0.03, 0], [0.03, 0.72], [0.09, 0.72], [0, 1]];

/** Arrow of a stage. */
export class Arrow {
  constructor(stage, code) {
    const color = linear(code);
    stage.arrow ??= lathe(stage, PROFILE);
    this.group = groupOf(...[{ color }, { color, ...FAINT }].map((look) => new Shape(stage, stage.arrow, look)));
  }

  place(from, direction, length) {
    turnTo(this.group, direction).position.copy(from);
    this.group.scale.set(length);
  }
}

/** All marks of a hand, scaled by its `size` [m]; `group` is in the hand's root frame. */
export class Marks {
  constructor(stage, hand, size) {
    this.stage = stage;
    this.hand = hand;
    this.size = size;
    this.approach = new Arrow(stage, COLOURS.approach);
    this.axes = AXES.map((color) => new Arrow(stage, color));
    this.closing = new Map();
    this.group = groupOf(this.approach.group, ...this.axes.map((axis) => axis.group));
    this.pads = hand.extras.pads.map(({ body, points }) => {
      const color = points.flatMap(() => linear(COLOURS.pad)), radius = 0.007 * size;
      const group = groupOf(...[{}, FAINT].map((look) => dotsOf(stage, points.flat(), color, { ...look, radius })));
      group.setParent(hand.bodies[body].group);
      return { body: hand.bodies[body].name, group };
    });
  }

  setVisible(on) {
    this.group.visible = on;
    for (const { group } of this.pads) group.visible = on;
  }

  /** Palm frame: z is the approach, as in the pictures of `graspd hands check`. */
  placePalm(centre, approach) {
    this.approach.place(centre, approach, 0.4 * this.size);
    const least = [0, 1, 2].reduce((a, b) => (Math.abs(approach[b]) < Math.abs(approach[a]) ? b : a));
    const side = new Vec3(...[0, 1, 2].map((k) => Number(k === least))).cross(approach).normalize();
    const frame = [side, new Vec3().cross(approach, side), approach];
    this.axes.forEach((axis, k) => axis.place(centre, frame[k], (k === 2 ? 0.26 : 0.2) * this.size));
  }

  /** Arrow at each fingertip in the direction of closing. */
  placeClosing(ways) {
    for (const { group } of this.closing.values()) group.visible = false;
    for (const [name, from, to] of ways) {
      const way = to.clone().sub(from);
      if (way.len() < 1e-7) continue;
      if (!this.closing.has(name)) {
        this.closing.set(name, new Arrow(this.stage, COLOURS.closing));
        this.group.addChild(this.closing.get(name).group);
      }
      const arrow = this.closing.get(name);
      arrow.group.visible = true;
      arrow.place(from, way.normalize(), 0.22 * this.size);
    }
  }
}
