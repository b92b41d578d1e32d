// Contacts: signed distance of the hand's surface points from the object's mesh, as coloured dots.
import { Vec3 } from "./vendor/ogl.min.js";
import { groupOf } from "./figures.js";
import { dotsOf, linear } from "./shapes.js";

/** Largest distance of a shown point from the object [m]: the contact threshold of the index. */
export const REACH_M = 0.005;
/** Largest computed distance from the surface [m]: more than the penetration of any plausible grasp. */
const FIELD_M = 0.01;
const DOT_M = 0.0013;
/** Distances that differ by less than this count as equal [m]. */
const SAME_M = 1e-7;
/** Height below which a triangle is a sliver [m]. */
const SLIVER_M = 1e-6;
// Blue over green to red, with changing lightness for readers with common colour blindnesses.
const STOPS = [[-0.001, 0xd1263c], [-0.0002, 0xf0803c], [0.0003, 0x14b87a], [0.002, 0x35a2f0], [REACH_M, 0xb9d4f5]].map(([limit, color]) => [limit, linear(color)]);

/** Signed distance from a triangle mesh, exact within `FIELD_M` of it; infinity elsewhere. */
export class DistanceField {
  constructor({ position: { data: at }, index: { data: index } }) {
    this.cells = new Map();
    for (let t = 0; t < index.length; t += 3) {
      const [a, b, c] = [0, 1, 2].map((k) => new Vec3().fromArray(at, 3 * index[t + k]));
      const ab = b.clone().sub(a), ac = c.clone().sub(a);
      const normal = new Vec3().cross(ab, ac);
      // A sliver of the triangulation has no normal, and its neighbours cover it.
      if (normal.len() < SLIVER_M * Math.max(ab.len(), ac.len(), b.distance(c))) continue;
      this.#insert({ a, b, c, ab, ac, normal: normal.normalize() });
    }
  }

  /** Distance; its sign follows the normals at the closest point, weighted by face angles (Baerentzen and Aanaes 2005). */
  distance(point) {
    let best = Infinity;
    const closest = new Vec3(), away = new Vec3(), side = new Vec3();
    const [i, j, k] = [point.x, point.y, point.z].map((value) => Math.floor(value / FIELD_M));
    for (const face of this.cells.get(key(i, j, k)) ?? []) {
      const weight = closestOnTriangle(point, face, closest);
      const distance = closest.distance(point);
      if (distance > best + SAME_M) continue;
      if (distance < best - SAME_M) {
        side.set(0);
        away.copy(point).sub(closest);
      }
      best = Math.min(best, distance);
      along(side, side, face.normal, weight);
    }
    // Beyond `FIELD_M` the nearest face may be missing in the cell's list.
    if (best > FIELD_M) return Infinity;
    return away.dot(side) < 0 ? -best : best;
  }

  #insert(face) {
    const [x, y, z] = [0, 1, 2].map((axis) => {
      const at = [face.a, face.b, face.c].map((corner) => corner[axis]);
      const first = Math.floor((Math.min(...at) - FIELD_M) / FIELD_M), last = Math.floor((Math.max(...at) + FIELD_M) / FIELD_M);
      return Array.from({ length: last - first + 1 }, (_, n) => first + n);
    });
    for (const i of x) for (const j of y) for (const k of z) {
      const cell = key(i, j, k);
      if (this.cells.has(cell)) this.cells.get(cell).push(face); else this.cells.set(cell, [face]);
    }
  }
}

const key = (i, j, k) => (i + 512) * 1048576 + (j + 512) * 1024 + (k + 512);
const ap = new Vec3(), bp = new Vec3(), cp = new Vec3();

/** Write `from + share * way` to `out`. */
function along(out, from, way, share) {
  return out.set(from[0] + share * way[0], from[1] + share * way[1], from[2] + share * way[2]);
}

/** Write a triangle's closest point to `out` (Ericson, Real-Time Collision Detection, 5.1.5); return its angle there [rad]. */
function closestOnTriangle(p, { a, b, c, ab, ac }, out) {
  ap.sub(p, a);
  const d1 = ab.dot(ap), d2 = ac.dot(ap);
  if (d1 <= 0 && d2 <= 0) return out.copy(a), ab.angle(ac);
  bp.sub(p, b);
  const d3 = ab.dot(bp), d4 = ac.dot(bp);
  if (d3 >= 0 && d4 <= d3) return out.copy(b), bp.sub(c, b).angle(cp.sub(a, b));
  const vc = d1 * d4 - d3 * d2;
  if (vc <= 0 && d1 >= 0 && d3 <= 0) return along(out, a, ab, d1 / (d1 - d3)), Math.PI;
  cp.sub(p, c);
  const d5 = ab.dot(cp), d6 = ac.dot(cp);
  if (d6 >= 0 && d5 <= d6) return out.copy(c), bp.sub(b, c).angle(cp.sub(a, c));
  const vb = d5 * d2 - d1 * d6;
  if (vb <= 0 && d2 >= 0 && d6 <= 0) return along(out, a, ac, d2 / (d2 - d6)), Math.PI;
  const va = d3 * d6 - d5 * d4;
  if (va <= 0 && d4 - d3 >= 0 && d5 - d6 >= 0) return out.sub(c, b).scale((d4 - d3) / (d4 - d3 + d5 - d6)).add(b), Math.PI;
  const scale = 1 / (va + vb + vc);
  return along(out, along(out, a, ab, vb * scale), ac, vc * scale), 2 * Math.PI;
}

function colourOf(distance, out) {
  const k = STOPS.findIndex(([limit]) => distance <= limit);
  if (k < 1) return out.copy(STOPS.at(k)[1]); // below the first one, or above the last one
  const [low, first] = STOPS[k - 1], [high, second] = STOPS[k];
  return out.copy(first).lerp(second, (distance - low) / (high - low));
}

/** Dots on the hand near the object, in the object's frame. */
export class Contacts {
  constructor(stage, hand, thing) {
    this.hand = hand;
    // Points are relative to the mesh, because numbers have 32 bits and the object's origin may be far away.
    this.frame = thing.mesh;
    this.field = new DistanceField(thing.solid);
    const count = hand.bodies.reduce((sum, { points }) => sum + (points?.length ?? 0) / 3, 0);
    this.dots = dotsOf(stage, 3 * count, 3 * count, { radius: DOT_M });
    this.group = groupOf(this.dots);
    this.group.position.copy(thing.mesh.position);
  }

  /** Place the dots for the hand's present posture; return the number within 1 mm and the lowest distance [m]. */
  update() {
    const { position, color } = this.dots.geometry.attributes, colour = new Vec3();
    let shown = 0, touching = 0, lowest = Infinity;
    this.hand.eachPoint(this.frame, (point) => {
      const distance = this.field.distance(point);
      if (distance > REACH_M) return;
      lowest = Math.min(lowest, distance);
      touching += distance < 0.001;
      position.data.set(point, 3 * shown);
      color.data.set(colourOf(distance, colour), 3 * shown);
      shown += 1;
    });
    this.dots.geometry.setDrawRange(0, shown);
    position.needsUpdate = color.needsUpdate = true;
    return { touching, lowest };
  }
}
