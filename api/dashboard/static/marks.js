// Findings of a hand's check, drawn on the hand: palm frame, approach, closing directions, and pads of the fingertips.
import { Group, InstancedMesh, LatheGeometry, Matrix4, Mesh, MeshBasicMaterial, MeshStandardMaterial, SphereGeometry, Vector2, Vector3 } from "./vendor/three.min.js";

const COLOURS = { approach: 0xdd7432, closing: 0x1f9c93, pad: 0xd6409f };
export const AXES = [0xc8343c, 0x3c9a4a, 0x3566c8];
const SIDES = 20;
const Z = new Vector3(0, 0, 1);

/** Unit arrow along z: profile of radius and height, rotated about the axis. */
const PROFILE = [[0, 0], [0.03, 0], [0.03, 0.72], [0.09, 0.72], [0, 1]].map(([radius, height]) => new Vector2(radius, height));
const ARROW = new LatheGeometry(PROFILE, SIDES).rotateX(Math.PI / 2);

const looks = new Map();

/** Arrow that shines faintly through objects in front of it; arrows of one colour share their materials. */
export class Arrow {
  constructor(color) {
    const faded = { color, transparent: true, opacity: 0.3, depthTest: false };
    if (!looks.has(color)) looks.set(color, [new MeshStandardMaterial({ color, roughness: 0.5 }), new MeshBasicMaterial(faded)]);
    this.group = new Group().add(...looks.get(color).map((look) => new Mesh(ARROW, look)));
    this.group.children[1].renderOrder = 3;
  }

  place(from, direction, length) {
    this.group.position.copy(from);
    this.group.quaternion.setFromUnitVectors(Z, direction);
    this.group.scale.setScalar(length);
  }
}

function dots(points, radius) {
  const sphere = new SphereGeometry(radius, 8, 6);
  const group = new Group();
  for (const look of [{ color: COLOURS.pad }, { color: COLOURS.pad, transparent: true, opacity: 0.3, depthTest: false }]) {
    const mesh = new InstancedMesh(sphere, new MeshBasicMaterial(look), points.length);
    points.forEach(([x, y, z], i) => mesh.setMatrixAt(i, new Matrix4().makeTranslation(x, y, z)));
    mesh.frustumCulled = false;
    if (look.transparent) mesh.renderOrder = 2;
    group.add(mesh);
  }
  return group;
}

/** All marks of a hand, scaled by its `size` [m]; `group` is in the hand's root frame. */
export class Marks {
  constructor(hand, size) {
    this.hand = hand;
    this.size = size;
    this.group = new Group();
    this.approach = new Arrow(COLOURS.approach);
    this.axes = AXES.map((color) => new Arrow(color));
    this.closing = new Map();
    this.group.add(this.approach.group, ...this.axes.map((axis) => axis.group));
    this.pads = hand.extras.pads.map(({ body, points }) => {
      const group = dots(points, 0.007 * size);
      hand.bodies[body].group.add(group);
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
    const least = [0, 1, 2].reduce((a, b) => (Math.abs(approach.getComponent(b)) < Math.abs(approach.getComponent(a)) ? b : a));
    const side = new Vector3().setComponent(least, 1).cross(approach).normalize();
    const frame = [side, new Vector3().crossVectors(approach, side), approach];
    this.axes.forEach((axis, k) => axis.place(centre, frame[k], (k === 2 ? 0.26 : 0.2) * this.size));
  }

  /** Arrow at each fingertip in the direction of closing. */
  placeClosing(ways) {
    for (const { group } of this.closing.values()) group.visible = false;
    for (const [name, from, to] of ways) {
      const way = to.clone().sub(from);
      if (way.length() < 1e-7) continue;
      if (!this.closing.has(name)) {
        this.closing.set(name, new Arrow(COLOURS.closing));
        this.group.add(this.closing.get(name).group);
      }
      const arrow = this.closing.get(name);
      arrow.group.visible = true;
      arrow.place(from, way.normalize(), 0.22 * this.size);
    }
  }
}
