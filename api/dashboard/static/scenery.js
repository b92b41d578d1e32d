// Surroundings of an object: tables, walls, boards, other objects; viewpoints with a free view of the object.
import { Box, Quat, Vec3 } from "./vendor/ogl.min.js";
import { loadGlb } from "./glb.js";
import { groupOf, place, Thing } from "./figures.js";
import { geometryOf, lathe, linear, Shape, turnTo } from "./shapes.js";

/** Radius of the disc that shows a half-space [m]. */
const DISC_M = 0.32;
const CORNERS = 96;
const COLOURS = { support: 0xcfd4d6, wall: 0x8fa3b0, neighbour: 0xb4aebf };
/** Viewing directions: step of azimuth, and elevations [rad]. */
const STEP = Math.PI / 8;
const HEIGHTS = [0.45, 0.8, 1.15];
const FAR_M = 0.6;

/** Plane of a half-space as a disc below `middle`, invisible from below. */
function disc(stage, { normal, offset }, middle) {
  const made = new Shape(stage, lathe(stage, [[DISC_M, 0], [0, 0]], CORNERS), { color: linear(COLOURS.support) });
  const up = new Vec3(...normal), length = up.len();
  turnTo(made, up.divide(length)).position.copy(up).scale(offset / length - up.dot(middle)).add(middle);
  return made;
}

function box(stage, { size: [width, height, depth], pose }) {
  return place(new Shape(stage, geometryOf(stage, new Box(stage.gl, { width, height, depth }).attributes), { color: linear(COLOURS.wall), opacity: 0.34, order: 1 }), pose);
}

/** Supports and neighbours of a scene. */
export class Scenery {
  constructor(stage, scene) {
    const middle = new Vec3(...scene.object_pose);
    this.stage = stage;
    this.group = groupOf(...scene.supports.map((support) => (support.kind === "box" ? box(stage, support) : disc(stage, support, middle))));
  }

  /** Load the neighbours' models; a neighbour without model is omitted. */
  async addNeighbours(scene) {
    await Promise.all(scene.neighbours.map(async ({ digest, pose }) => {
      const model = await loadGlb(new URL(`../v1/objects/${digest}/model`, import.meta.url).href).catch(() => null);
      if (!model) return;
      const thing = new Thing(this.stage, model);
      thing.look.color = linear(COLOURS.neighbour);
      this.group.addChild(place(thing.group, pose));
      this.stage.invalidate();
    }));
  }
}

/** Hand and object at their poses in the scene (if any), and the surroundings. */
export function staged(stage, grasp, hand, thing) {
  const all = groupOf(hand.group, thing.group);
  if (grasp.scene) place(all, grasp.scene.object_pose);
  all.updateMatrixWorld();
  return { all, scenery: grasp.scene ? new Scenery(stage, grasp.scene) : null };
}

/** Viewing direction nearest to a wanted one, with no wall in front of the object and the camera above all planes. */
export function freeSide(wanted, scene, centre) {
  const around = Math.atan2(wanted.y, wanted.x);
  const planes = scene.supports.filter((support) => support.kind === "half_space");
  const walls = scene.supports.filter((support) => support.kind === "box");
  for (const height of HEIGHTS) {
    for (let k = 0; k < 16; k++) {
      const angle = around + STEP * (k % 2 ? (k + 1) / 2 : -k / 2);
      const side = new Vec3(Math.cos(angle) * Math.cos(height), Math.sin(angle) * Math.cos(height), Math.sin(height));
      const eye = side.clone().scale(FAR_M).add(centre);
      if (planes.every(({ normal, offset }) => eye.dot(normal) > offset) && !walls.some((wall) => crosses(eye, centre, wall))) return side;
    }
  }
  return wanted;
}

/** Whether the line between two points intersects a box (slabs test of Kay and Kajiya 1986). */
function crosses(from, to, { size, pose }) {
  const [x, y, z, w, i, j, k] = pose;
  const back = new Quat(i, j, k, w).normalize().inverse();
  const [start, end] = [from, to].map((point) => point.clone().sub([x, y, z]).applyQuaternion(back)), step = end.sub(start);
  let enter = 0, leave = 1;
  size.forEach((length, n) => {
    const ends = [-1, 1].map((sign) => ((sign * length) / 2 - start[n]) / (Math.abs(step[n]) < 1e-9 ? 1e-9 : step[n]));
    enter = Math.max(enter, Math.min(...ends));
    leave = Math.min(leave, Math.max(...ends));
  });
  return enter < leave;
}
