// Trajectory of a grasp on a slider: named postures at 0, 1, 2, ..., other waypoints in between.
import { between, mixPoses } from "./figures.js";

/** Motion of the hand before each named posture. */
const DOING = { pregrasp: "approach", grasp: "closing", squeeze: "squeezing", lift: "lifting" };
const bodyOf = (point) => point.object_pose ?? [...point.carried, 1, 0, 0, 0];

/** Planned trajectory, or a replay, whose points have phases and contacts. */
export class Way {
  constructor(points, names) {
    this.points = points;
    this.names = names;
    this.stops = points.filter((point) => point.name);
    this.last = points.at(-1).place;
  }

  /** Posture of the hand, pose of the object relative to rest, and nearest point, at a slider position. */
  at(place) {
    let k = this.points.findIndex((point) => point.place > place) - 1;
    if (k < 0) k = this.points.length - 2;
    const [a, b] = [this.points[k], this.points[k + 1]];
    const share = Math.min(Math.max((place - a.place) / (b.place - a.place), 0), 1);
    return { ...between(a, b, share, this.names), body: mixPoses(bodyOf(a), bodyOf(b), share), point: share < 0.5 ? a : b };
  }

  /** Slider position of a named posture. */
  place(name) {
    return this.stops.find((stop) => stop.name === name)?.place ?? 0;
  }

  /** Describe a slider position. */
  say(place) {
    const near = this.stops.find((stop) => Math.abs(stop.place - place) < 0.02);
    if (near) return near.name;
    const { phase } = this.at(place).point;
    const next = this.stops.find((stop) => stop.place > place);
    const before = this.stops[this.stops.indexOf(next) - 1];
    return phase ?? `${DOING[next.name]}, ${Math.round(100 * (place - before.place))} % of the way from ${before.name} to ${next.name}`;
  }
}
