// Hand and object as groups of shapes. Lengths are in metres; poses are x y z, then quaternion w x y z.
import { Mat3, Mat4, Quat, Transform, Vec3 } from "./vendor/ogl.min.js";
import { geometryOf, linear, Shape } from "./shapes.js";

const COLOURS = { palm: 0x59636f, finger: 0x7b8794, tip: 0x2bb5a8, object: 0xe8b878 };

const lookOf = (color) => ({ color: linear(color), casts: true });
const solid = (stage, attributes, look) => new Shape(stage, geometryOf(stage, attributes), look);

/** Rotation of a transform in the world. */
export const turnOf = ({ worldMatrix }) => new Quat().fromMatrix3(new Mat3().fromMatrix4(worldMatrix));

/** Transform with children. */
export function groupOf(...children) {
  const group = new Transform();
  for (const child of children) group.addChild(child);
  return group;
}

/** Move an object to a pose x y z [m], quaternion w x y z. */
export function place(thing, [x, y, z, w, i, j, k]) {
  thing.position.set(x, y, z);
  thing.quaternion.set(i, j, k, w).normalize();
  return thing;
}

/** Hand: `pose` moves its links; `group` is the drawing. */
export class Hand {
  constructor(stage, model) {
    // Own colours have a look for the housing, which can be transparent alone.
    const looks = { palm: lookOf(COLOURS.palm), finger: lookOf(COLOURS.finger), tip: lookOf(COLOURS.tip), own: lookOf(0xffffff), housing: lookOf(0xffffff) };
    this.looks = Object.values(looks);
    this.housing = [looks.palm, looks.housing];
    this.extras = model.extras;
    this.joints = new Map();
    this.bodies = model.nodes.map((node, index) => {
      const group = new Transform();
      const rest = new Quat(...node.rotation);
      group.position.copy(node.translation);
      group.quaternion.copy(rest);
      const look = index === 0 ? looks.palm : node.extras.fingertip ? looks.tip : looks.finger;
      const shown = node.solid && solid(stage, node.solid, !node.solid.color ? look : index === 0 ? looks.housing : looks.own);
      const collision = node.collision && solid(stage, node.collision, look);
      for (const shape of [shown, collision]) shape?.setParent(group);
      if (node.extras.joint) {
        const at = new Vec3(...node.translation);
        this.joints.set(node.extras.joint, { group, rest, at, axis: new Vec3(...node.extras.axis), slides: node.extras.type === "prismatic" });
      }
      return { name: node.name, group, shown, collision, points: node.points };
    });
    this.hasCollision = this.bodies.some((body) => body.collision);
    this.setCollision(false);
    model.nodes.forEach((node, index) => node.children.forEach((child) => this.bodies[index].group.addChild(this.bodies[child].group)));
    this.group = groupOf(this.bodies[0].group);
  }

  /** Set a posture: pose of the root link, and joint positions by name [rad or m]. */
  pose(rootPose, positions) {
    place(this.group, rootPose);
    const turn = new Quat();
    for (const [name, joint] of this.joints) {
      const value = positions[name] ?? 0;
      if (joint.slides) {
        joint.group.position.copy(joint.axis).scale(value).applyQuaternion(joint.rest).add(joint.at);
      } else {
        joint.group.quaternion.copy(joint.rest).multiply(turn.fromAxisAngle(joint.axis, value));
      }
    }
    this.group.updateMatrixWorld();
  }

  /** Make the hand transparent, or only `housing`, the materials of its root body. */
  setGlass(on, looks = this.looks) {
    for (const look of looks) look.opacity = on ? 0.32 : 1;
  }

  /** Show collision shapes instead of visual meshes. */
  setCollision(on) {
    for (const { shown, collision } of this.bodies.filter((body) => body.collision)) {
      collision.visible = on;
      if (shown) shown.visible = !on;
    }
  }

  /** Call back with each surface point in the frame of a group. */
  eachPoint(frame, callback) {
    const point = new Vec3(), within = new Mat4(), outward = new Mat4().inverse(frame.worldMatrix);
    for (const { group, points } of this.bodies) {
      within.multiply(outward, group.worldMatrix);
      for (let i = 0; points && i < points.length; i += 3) {
        callback(point.fromArray(points, i).applyMatrix4(within));
      }
    }
  }
}

/** Object with its `mesh` at the pose in the model. */
export class Thing {
  constructor(stage, model) {
    this.solid = model.nodes[0].solid;
    this.look = lookOf(COLOURS.object);
    this.mesh = solid(stage, this.solid, this.look);
    this.mesh.position.copy(model.nodes[0].translation);
    this.group = groupOf(this.mesh);
  }

  /** Draw the edges of the triangles instead of their faces. */
  setWire(on) {
    const { stage, geometry } = this.mesh, { data, type } = this.solid.index;
    const edges = new data.constructor(2 * data.length).map((_, i) => data[3 * Math.floor(i / 6) + (((i % 6) + 1) >> 1) % 3]);
    this.faces ??= geometry;
    this.edges ??= geometryOf(stage, { ...this.solid, index: { data: edges, type } });
    Object.assign(this.mesh, { geometry: on ? this.edges : this.faces, mode: on ? stage.gl.LINES : stage.gl.TRIANGLES });
  }
}

/** Hand in its pre-shape, or object, of a model. */
export function figureOf(stage, model) {
  if (model.extras.kind !== "hand") return new Thing(stage, model);
  const hand = new Hand(stage, model);
  hand.pose([0, 0, 0, 1, 0, 0, 0], model.extras.preshape);
  return hand;
}

/** Interpolate two poses, 0 to 1: linear for the position, slerp for the rotation. */
export function mixPoses([ax, ay, az, aw, ai, aj, ak], [bx, by, bz, bw, bi, bj, bk], share) {
  const turn = new Quat(ai, aj, ak, aw).slerp(new Quat(bi, bj, bk, bw), share);
  return [ax + (bx - ax) * share, ay + (by - ay) * share, az + (bz - az) * share, turn.w, turn.x, turn.y, turn.z];
}

/** Interpolate two postures, 0 to 1. */
export function between(first, second, share, names) {
  const mix = (i) => first.joint_positions[i] * (1 - share) + second.joint_positions[i] * share;
  return { pose: mixPoses(first.hand_pose, second.hand_pose, share), positions: Object.fromEntries(names.map((name, i) => [name, mix(i)])) };
}
