// Findings of a hand's check, drawn on the hand: palm frame, approach, closing directions, and pads of the fingertips.
import { Transform, Vec3 } from "./vendor/ogl.min.js";
import { groupOf } from "./figures.js";
import { dotsOf, lathe, linear, Shape, turnTo } from "./shapes.js";

const COLOURS = { approach: 0xdd7432, closing: 0x1f9c93, pad: 0xd6409f };
export const AXES = [0xc8343c, 0x3c9a4a, 0x3566c8];
/** Look of a mark that shines faintly through objects in front of it. */
const FAINT = { opacity: 0.3, lit: 0, through: true };
/** Unit arrow along z: radius and height, rotated about the axis. */
const PROFILE = [[0, 0], [0.03, 0], [0.03, 0.72], [0.09, 0.72], [0, 1]];

/** Replace the content of a group by arrows `[colour, from, unit vector, length]`. */
export function drawArrows(stage, group, arrows) {
  for (const old of [...group.children]) old.setParent(null);
  stage.arrow ??= lathe(stage, PROFILE);
  for (const [code, from, way, length] of arrows) {
    const color = linear(code), arrow = groupOf(...[{}, FAINT].map((look) => new Shape(stage, stage.arrow, { color, ...look })));
    turnTo(arrow, way).position.copy(from);
    arrow.scale.set(length);
    arrow.setParent(group);
  }
}

/** All marks of a hand, scaled by its `size` [m]; `group` is in the hand's root frame. */
export class Marks {
  constructor(stage, hand, size) {
    Object.assign(this, { stage, size, palm: new Transform(), closing: new Transform() });
    this.group = groupOf(this.palm, this.closing);
    const pads = hand.extras.pads.map(({ body, points }) => {
      const color = points.flatMap(() => linear(COLOURS.pad)), radius = 0.007 * size;
      const group = groupOf(...[{}, FAINT].map((look) => dotsOf(stage, points.flat(), color, { ...look, radius })));
      group.setParent(hand.bodies[body].group);
      return group;
    });
    this.groups = [this.group, ...pads];
  }

  /** Palm frame: z is the approach, as in the pictures of `graspd hands check`. */
  placePalm(centre, approach) {
    const least = [0, 1, 2].reduce((a, b) => (Math.abs(approach[b]) < Math.abs(approach[a]) ? b : a));
    const side = new Vec3(...[0, 1, 2].map((k) => Number(k === least))).cross(approach).normalize();
    const axes = [side, new Vec3().cross(approach, side), approach].map((axis, k) => [AXES[k], centre, axis, (k === 2 ? 0.26 : 0.2) * this.size]);
    drawArrows(this.stage, this.palm, [[COLOURS.approach, centre, approach, 0.4 * this.size], ...axes]);
  }

  /** Arrow at each fingertip in the direction of closing, of pairs of positions before and after. */
  placeClosing(ways) {
    const moves = ways.map(([from, to]) => [from, to.clone().sub(from)]).filter(([, way]) => way.len() > 1e-7);
    drawArrows(this.stage, this.closing, moves.map(([from, way]) => [COLOURS.closing, from, way.normalize(), 0.22 * this.size]));
  }
}
