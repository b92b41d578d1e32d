// Contact forces of a replay: arrows of force and normal at each contact of the hand, and a table of the wrenches.
import { Transform, Vec3 } from "./vendor/ogl.min.js";
import { drawArrows } from "./marks.js";

const COLOURS = { force: 0xdd7432, normal: 0x3566c8 };
const NORMAL_M = 0.02, LONGEST_M = 0.06, LEAST_N = 0.01;
const length = (sum) => Math.hypot(...sum);

export class Forces {
  /** `way` gives the largest force, which has the longest arrow. */
  constructor(stage, way) {
    const sizes = way.points.flatMap((point) => (point.contacts ?? []).map((one) => length(one.slice(6, 9))));
    Object.assign(this, { stage, group: new Transform(), scale: LONGEST_M / Math.max(...sizes, 1) });
  }

  show(point) {
    const drawn = (point.contacts ?? []).filter((one) => one[12]).flatMap(([x, y, z, nx, ny, nz, fx, fy, fz]) => [
      ["normal", [x, y, z], [nx, ny, nz], NORMAL_M],
      ["force", [x, y, z], [fx, fy, fz], this.scale * length([fx, fy, fz])],
    ]).filter(([, , , size]) => size > LEAST_N * this.scale);
    drawArrows(this.stage, this.group, drawn.map(([kind, at, along, size]) => [COLOURS[kind], at, new Vec3(...along).normalize(), size]));
  }

  /** Fill the table of wrenches: forces of hand and supports, weight or push, what is left; sum of contact torques. */
  static tell(table, { load, contacts = [] }, scene) {
    table.hidden = !load;
    if (!load) return;
    const sum = (first, wanted) => [0, 1, 2].map((k) => contacts.filter(wanted).reduce((all, one) => all + one[first + k], 0));
    const rows = { hand: sum(6, (one) => one[12]), ...(scene && { supports: sum(6, (one) => !one[12]) }), [scene ? "weight" : "push"]: load };
    rows.remaining = sum(6, () => true).map((value, k) => value + load[k]);
    rows["torque [N mm]"] = sum(9, () => true).map((value) => 1000 * value);
    const cell = (value) => `<td class="num">${(Math.round(100 * value) / 100 + 0).toFixed(2)}</td>`;
    const line = ([name, values]) => `<tr><th scope="row">${name}</th>${[...values, length(values)].map(cell).join("")}</tr>`;
    table.tBodies[0].innerHTML = Object.entries(rows).map(line).join("");
  }
}
