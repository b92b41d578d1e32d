// Where a hand touches an object: signed distance of the hand's surface points from the object's mesh, as coloured dots.
import { Color, DynamicDrawUsage, Group, InstancedMesh, Matrix4, MeshBasicMaterial, SphereGeometry, Vector3 } from "./vendor/three.min.js";

/** Points farther than this from the object are not shown [m]; it is the contact threshold of the index. */
export const REACH_M = 0.005;
const DOT_M = 0.0011;
// Blue to red by way of green: readable with the common colour blindnesses because lightness changes too.
const STOPS = [[-0.001, 0xd1263c], [-0.0002, 0xf0803c], [0.0003, 0x14b87a], [0.002, 0x35a2f0], [REACH_M, 0xb9d4f5]];

/** Signed distance from a triangle mesh, exact within `REACH_M` of it; infinity elsewhere. */
export class DistanceField {
  constructor(geometry) {
    this.at = geometry.getAttribute("position").array;
    this.index = geometry.index.array;
    this.cell = 2 * REACH_M;
    this.cells = new Map();
    for (let t = 0; t < this.index.length; t += 3) this.#insert(t);
  }

  distance(point) {
    let best = Infinity;
    let sign = 1;
    let facing = 0;
    const normal = new Vector3();
    const closest = new Vector3();
    for (const t of this.cells.get(this.#key(...["x", "y", "z"].map((k) => Math.floor(point[k] / this.cell)))) ?? []) {
      const [a, b, c] = this.#corners(t);
      closestOnTriangle(point, a, b, c, closest);
      const distance = closest.distanceTo(point);
      if (distance > best + 1e-7) continue;
      // Several faces share an edge or a corner: the one that looks most directly at the point tells the side.
      normal.copy(b).sub(a).cross(c.clone().sub(a)).normalize();
      const side = normal.dot(closest.sub(point)) * -1;
      const directness = distance > 1e-9 ? Math.abs(side) / distance : 1;
      if (distance < best - 1e-7 || directness > facing) {
        facing = directness;
        sign = side < 0 ? -1 : 1;
      }
      best = Math.min(best, distance);
    }
    return sign * best;
  }

  #corners(t) {
    return [0, 1, 2].map((k) => new Vector3().fromArray(this.at, 3 * this.index[t + k]));
  }

  #key(i, j, k) {
    return (i + 512) * 1048576 + (j + 512) * 1024 + (k + 512);
  }

  #insert(t) {
    const corners = this.#corners(t);
    const [low, high] = [Math.min, Math.max].map((end, s) => ["x", "y", "z"].map((k) =>
      Math.floor((end(...corners.map((corner) => corner[k])) + (s ? REACH_M : -REACH_M)) / this.cell)));
    for (let i = low[0]; i <= high[0]; i++) {
      for (let j = low[1]; j <= high[1]; j++) {
        for (let k = low[2]; k <= high[2]; k++) {
          const key = this.#key(i, j, k);
          if (!this.cells.has(key)) this.cells.set(key, []);
          this.cells.get(key).push(t);
        }
      }
    }
  }
}

/** Closest point of a triangle (Ericson, Real-Time Collision Detection, 5.1.5). */
function closestOnTriangle(p, a, b, c, out) {
  const ab = b.clone().sub(a), ac = c.clone().sub(a), ap = p.clone().sub(a);
  const d1 = ab.dot(ap), d2 = ac.dot(ap);
  if (d1 <= 0 && d2 <= 0) return out.copy(a);
  const bp = p.clone().sub(b), d3 = ab.dot(bp), d4 = ac.dot(bp);
  if (d3 >= 0 && d4 <= d3) return out.copy(b);
  const vc = d1 * d4 - d3 * d2;
  if (vc <= 0 && d1 >= 0 && d3 <= 0) return out.copy(a).addScaledVector(ab, d1 / (d1 - d3));
  const cp = p.clone().sub(c), d5 = ab.dot(cp), d6 = ac.dot(cp);
  if (d6 >= 0 && d5 <= d6) return out.copy(c);
  const vb = d5 * d2 - d1 * d6;
  if (vb <= 0 && d2 >= 0 && d6 <= 0) return out.copy(a).addScaledVector(ac, d2 / (d2 - d6));
  const va = d3 * d6 - d5 * d4;
  if (va <= 0 && d4 - d3 >= 0 && d5 - d6 >= 0) return out.copy(b).addScaledVector(c.clone().sub(b), (d4 - d3) / (d4 - d3 + d5 - d6));
  const scale = 1 / (va + vb + vc);
  return out.copy(a).addScaledVector(ab, vb * scale).addScaledVector(ac, vc * scale);
}

function colourOf(distance, out) {
  const last = STOPS.length - 1;
  if (distance <= STOPS[0][0]) return out.set(STOPS[0][1]);
  for (let i = 0; i < last; i++) {
    const [low, first] = STOPS[i], [high, second] = STOPS[i + 1];
    if (distance <= high) return out.set(first).lerp(new Color(second), (distance - low) / (high - low));
  }
  return out.set(STOPS[last][1]);
}

/** Dots on the hand where it is near the object. Those behind something shine through faintly. */
export class Contacts {
  constructor(hand, thing) {
    this.hand = hand;
    this.field = new DistanceField(thing.geometry);
    let count = 0;
    hand.eachPoint(() => { count += 1; });
    const dot = new SphereGeometry(DOT_M, 8, 6);
    this.front = new InstancedMesh(dot, new MeshBasicMaterial(), count);
    this.behind = new InstancedMesh(dot, new MeshBasicMaterial({ transparent: true, opacity: 0.3, depthTest: false }), count);
    this.group = new Group();
    for (const mesh of [this.behind, this.front]) {
      mesh.instanceMatrix.setUsage(DynamicDrawUsage);
      mesh.frustumCulled = false;
      mesh.renderOrder = 2;
      this.group.add(mesh);
    }
  }

  /** Place the dots for the hand's present posture. Returns how many touch (within 1 mm) and the deepest point [m]. */
  update() {
    const place = new Matrix4();
    const colour = new Color();
    let shown = 0, touching = 0, lowest = Infinity;
    this.hand.eachPoint((point) => {
      const distance = this.field.distance(point);
      if (distance > REACH_M) return;
      lowest = Math.min(lowest, distance);
      touching += distance < 0.001;
      place.makeTranslation(point.x, point.y, point.z);
      colourOf(distance, colour);
      for (const mesh of [this.front, this.behind]) {
        mesh.setMatrixAt(shown, place);
        mesh.setColorAt(shown, colour);
      }
      shown += 1;
    });
    for (const mesh of [this.front, this.behind]) {
      mesh.count = shown;
      mesh.instanceMatrix.needsUpdate = true;
      if (mesh.instanceColor) mesh.instanceColor.needsUpdate = true;
    }
    return { touching, lowest };
  }
}
