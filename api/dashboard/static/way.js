// Trajectory of a grasp on a slider: named postures at 0, 1, 2, ..., other waypoints in between.
import { between } from "./figures.js";

/** Motion of the hand before each named posture. */
const DOING = { pregrasp: "approach", grasp: "closing", squeeze: "squeezing", lift: "lifting" };

export class Way {
  constructor(points, names) {
    this.points = points;
    this.names = names;
    this.stops = points.filter((point) => point.name);
    this.last = points.at(-1).place;
  }

  /** Posture of the hand and displacement of the object [m] at a slider position. */
  at(place) {
    let k = this.points.findIndex((point) => point.place > place) - 1;
    if (k < 0) k = this.points.length - 2;
    const [a, b] = [this.points[k], this.points[k + 1]];
    const share = Math.min(Math.max((place - a.place) / (b.place - a.place), 0), 1);
    const carried = a.carried.map((value, axis) => value + share * (b.carried[axis] - value));
    return { ...between(a, b, share, this.names), carried };
  }

  /** Slider position of a named posture. */
  place(name) {
    return this.stops.find((stop) => stop.name === name)?.place ?? 0;
  }

  /** Describe a slider position. */
  say(place) {
    const near = this.stops.find((stop) => Math.abs(stop.place - place) < 0.02);
    if (near) return near.name;
    const next = this.stops.find((stop) => stop.place > place);
    const before = this.stops[this.stops.indexOf(next) - 1];
    return `${DOING[next.name]}, ${Math.round(100 * (place - before.place))} % of the way from ${before.name} to ${next.name}`;
  }
}
