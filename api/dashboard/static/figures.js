// Hand and object as three.js groups. Lengths are in metres; poses are x y z, then quaternion w x y z.
import { Group, Matrix4, Mesh, MeshStandardMaterial, Quaternion, Vector3 } from "./vendor/three.min.js";

const COLOURS = { palm: 0x59636f, finger: 0x7b8794, tip: 0x2bb5a8, object: 0xe8b878 };

function material(color) {
  return new MeshStandardMaterial({ color, roughness: 0.58, metalness: 0 });
}

function solid(geometry, look) {
  const mesh = new Mesh(geometry, look);
  mesh.castShadow = mesh.receiveShadow = true;
  return mesh;
}

/** Move an object to a pose x y z [m], quaternion w x y z. */
export function place(thing, [x, y, z, w, i, j, k]) {
  thing.position.set(x, y, z);
  thing.quaternion.set(i, j, k, w).normalize();
  return thing;
}

/** Hand: `pose` moves its links; `group` is the drawing. */
export class Hand {
  constructor(model) {
    const looks = { palm: material(COLOURS.palm), finger: material(COLOURS.finger), tip: material(COLOURS.tip), own: material(0xffffff) };
    looks.own.vertexColors = true;
    // A separate material, because the housing can be transparent alone.
    looks.housing = looks.own.clone();
    this.looks = Object.values(looks);
    this.housing = [looks.palm, looks.housing];
    this.extras = model.extras;
    this.joints = new Map();
    this.bodies = model.nodes.map((node, index) => {
      const group = new Group();
      const rest = new Quaternion(...node.rotation);
      group.position.fromArray(node.translation);
      group.quaternion.copy(rest);
      const look = index === 0 ? looks.palm : node.extras.fingertip ? looks.tip : looks.finger;
      const shown = node.solid && solid(node.solid, !node.solid.getAttribute("color") ? look : index === 0 ? looks.housing : looks.own);
      if (shown) group.add(shown);
      const collision = node.collision && solid(node.collision, look);
      if (collision) group.add(collision);
      if (node.extras.joint) {
        const at = new Vector3(...node.translation);
        this.joints.set(node.extras.joint, { group, rest, at, axis: new Vector3(...node.extras.axis), slides: node.extras.type === "prismatic" });
      }
      return { name: node.name, group, shown, collision, points: node.points };
    });
    this.hasCollision = this.bodies.some((body) => body.collision);
    this.setCollision(false);
    model.nodes.forEach((node, index) => node.children.forEach((child) => this.bodies[index].group.add(this.bodies[child].group)));
    this.group = new Group();
    this.group.add(this.bodies[0].group);
  }

  /** Set a posture: pose of the root link, and joint positions by name [rad or m]. */
  pose(rootPose, positions) {
    place(this.group, rootPose);
    const turn = new Quaternion();
    for (const [name, joint] of this.joints) {
      const value = positions[name] ?? 0;
      if (joint.slides) {
        joint.group.position.copy(joint.axis).multiplyScalar(value).applyQuaternion(joint.rest).add(joint.at);
      } else {
        joint.group.quaternion.copy(joint.rest).multiply(turn.setFromAxisAngle(joint.axis, value));
      }
    }
    this.group.updateMatrixWorld(true);
  }

  /** Make the hand transparent, or only `housing`, the materials of its root body. */
  setGlass(on, looks = this.looks) {
    for (const look of looks) Object.assign(look, { transparent: on, opacity: on ? 0.32 : 1, depthWrite: !on, needsUpdate: true });
  }

  /** Show collision shapes instead of visual meshes. */
  setCollision(on) {
    for (const { shown, collision } of this.bodies) {
      if (!collision) continue;
      collision.visible = on;
      if (shown) shown.visible = !on;
    }
  }

  /** Call back with each surface point in the frame of a group. */
  eachPoint(frame, callback) {
    const point = new Vector3(), within = new Matrix4(), outward = frame.matrixWorld.clone().invert();
    for (const { group, points } of this.bodies) {
      within.multiplyMatrices(outward, group.matrixWorld);
      for (let i = 0; points && i < points.length; i += 3) {
        callback(point.fromArray(points, i).applyMatrix4(within));
      }
    }
  }
}

/** Object with its `mesh` at the pose in the model. */
export class Thing {
  constructor(model) {
    this.geometry = model.nodes[0].solid;
    this.look = material(COLOURS.object);
    this.mesh = solid(this.geometry, this.look);
    this.mesh.position.fromArray(model.nodes[0].translation);
    this.group = new Group();
    this.group.add(this.mesh);
  }
}

/** Hand in its pre-shape, or object, of a model. */
export function figureOf(model) {
  if (model.extras.kind !== "hand") return new Thing(model);
  const hand = new Hand(model);
  hand.pose([0, 0, 0, 1, 0, 0, 0], model.extras.preshape);
  return hand;
}

/** Interpolate two poses, 0 to 1: linear for the position, slerp for the rotation. */
export function mixPoses([ax, ay, az, aw, ai, aj, ak], [bx, by, bz, bw, bi, bj, bk], share) {
  const turn = new Quaternion(ai, aj, ak, aw).slerp(new Quaternion(bi, bj, bk, bw), share);
  return [ax + (bx - ax) * share, ay + (by - ay) * share, az + (bz - az) * share, turn.w, turn.x, turn.y, turn.z];
}

/** Interpolate two postures, 0 to 1. */
export function between(first, second, share, names) {
  const positions = {};
  names.forEach((name, i) => {
    const [a, b] = [first.joint_positions[i], second.joint_positions[i]];
    positions[name] = a + (b - a) * share;
  });
  return { pose: mixPoses(first.hand_pose, second.hand_pose, share), positions };
}
