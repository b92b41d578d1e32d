// The way of a grasp on a slider: named postures at 0, 1, 2, ..., others between them.
import { between } from "./figures.js";

/** What the hand does on its way to a named posture, and what it did when it is there. */
const DOING = { pregrasp: "approach", grasp: "closing", squeeze: "squeezing", lift: "lifting" };

export class Way {
  constructor(points, names) {
    this.points = points;
    this.names = names;
    this.stops = points.filter((point) => point.name);
    this.last = points.at(-1).place;
  }

  /** Posture of the hand and how far the object was carried, at a place of the slider. */
  at(place) {
    let k = this.points.findIndex((point) => point.place > place) - 1;
    if (k < 0) k = this.points.length - 2;
    const [a, b] = [this.points[k], this.points[k + 1]];
    const share = Math.min(Math.max((place - a.place) / (b.place - a.place), 0), 1);
    const carried = a.carried.map((value, axis) => value + share * (b.carried[axis] - value));
    return { ...between(a, b, share, this.names), carried };
  }

  /** Place of a named posture. */
  place(name) {
    return this.stops.find((stop) => stop.name === name)?.place ?? 0;
  }

  /** In words where a place of the slider is. */
  say(place) {
    const near = this.stops.find((stop) => Math.abs(stop.place - place) < 0.02);
    if (near) return near.name;
    const next = this.stops.find((stop) => stop.place > place);
    const before = this.stops[this.stops.indexOf(next) - 1];
    return `${DOING[next.name]}, ${Math.round(100 * (place - before.place))} % of the way from ${before.name} to ${next.name}`;
  }
}
