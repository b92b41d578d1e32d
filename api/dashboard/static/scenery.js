// Surroundings of an object: tables, walls, boards, other objects; viewpoints with a free view of the object.
import { BoxGeometry, CircleGeometry, Group, Mesh, MeshStandardMaterial, Quaternion, Vector3 } from "./vendor/three.min.js";
import { loadGlb } from "./glb.js";
import { place, Thing } from "./figures.js";

/** Radius of the disc that shows a half-space [m]. */
const DISC_M = 0.32;
const CORNERS = 96;
const COLOURS = { support: 0xcfd4d6, wall: 0x8fa3b0, neighbour: 0xb4aebf };
/** Viewing directions: step of azimuth, and elevations [rad]. */
const STEP = Math.PI / 8;
const HEIGHTS = [0.45, 0.8, 1.15];
const FAR_M = 0.6;

/** Plane of a half-space as a disc below `middle`, invisible from below. */
function disc({ normal, offset }, middle) {
  const made = new Mesh(new CircleGeometry(DISC_M, CORNERS), new MeshStandardMaterial({ color: COLOURS.support, roughness: 0.9 }));
  const up = new Vector3(...normal), length = up.length();
  up.divideScalar(length);
  made.quaternion.setFromUnitVectors(new Vector3(0, 0, 1), up);
  made.position.copy(middle).addScaledVector(up, offset / length - up.dot(middle));
  made.receiveShadow = true;
  return made;
}

function box({ size, pose }) {
  const look = new MeshStandardMaterial({ color: COLOURS.wall, roughness: 0.9, transparent: true, opacity: 0.34, depthWrite: false });
  const made = place(new Mesh(new BoxGeometry(...size), look), pose);
  made.receiveShadow = true;
  made.renderOrder = 1;
  return made;
}

/** Supports and neighbours of a scene. */
export class Scenery {
  constructor(scene) {
    this.group = new Group();
    const middle = new Vector3(...scene.object_pose);
    for (const support of scene.supports) this.group.add(support.kind === "box" ? box(support) : disc(support, middle));
  }

  /** Load the neighbours' models; a neighbour without model is omitted. */
  async addNeighbours(scene, changed) {
    await Promise.all(scene.neighbours.map(async ({ digest, pose }) => {
      const model = await loadGlb(new URL(`../v1/objects/${digest}/model`, import.meta.url).href).catch(() => null);
      if (!model) return;
      const thing = new Thing(model);
      thing.look.color.set(COLOURS.neighbour);
      this.group.add(place(thing.group, pose));
      changed();
    }));
  }
}

/** Hand and object at their poses in the scene (if any), and the surroundings. */
export function staged(grasp, hand, thing) {
  const all = new Group();
  all.add(hand.group, thing.group);
  if (grasp.scene) place(all, grasp.scene.object_pose);
  all.updateMatrixWorld(true);
  return { all, scenery: grasp.scene ? new Scenery(grasp.scene) : null };
}

/** Viewing direction nearest to a wanted one, with no wall in front of the object and the camera above all planes. */
export function freeSide(wanted, scene, centre) {
  const around = Math.atan2(wanted.y, wanted.x);
  const planes = scene.supports.filter((support) => support.kind === "half_space");
  const walls = scene.supports.filter((support) => support.kind === "box");
  for (const height of HEIGHTS) {
    for (let k = 0; k < 16; k++) {
      const angle = around + STEP * (k % 2 ? (k + 1) / 2 : -k / 2);
      const side = new Vector3(Math.cos(angle) * Math.cos(height), Math.sin(angle) * Math.cos(height), Math.sin(height));
      const eye = centre.clone().addScaledVector(side, FAR_M);
      if (planes.every(({ normal, offset }) => eye.dot(new Vector3(...normal)) > offset) && !walls.some((wall) => crosses(eye, centre, wall))) return side;
    }
  }
  return wanted;
}

/** Whether the line between two points intersects a box (slabs test of Kay and Kajiya 1986). */
function crosses(from, to, { size, pose }) {
  const [x, y, z, w, i, j, k] = pose;
  const back = new Quaternion(i, j, k, w).normalize().invert();
  const start = from.clone().sub(new Vector3(x, y, z)).applyQuaternion(back);
  const step = to.clone().sub(new Vector3(x, y, z)).applyQuaternion(back).sub(start);
  let enter = 0, leave = 1;
  ["x", "y", "z"].forEach((axis, n) => {
    const ends = [-1, 1].map((sign) => ((sign * size[n]) / 2 - start[axis]) / (Math.abs(step[axis]) < 1e-9 ? 1e-9 : step[axis]));
    enter = Math.max(enter, Math.min(...ends));
    leave = Math.min(leave, Math.max(...ends));
  });
  return enter < leave;
}
