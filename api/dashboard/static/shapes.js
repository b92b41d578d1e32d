// Drawn shapes: one shader for lit and flat surfaces, one for dots, surfaces of revolution, and bounds.
import { Geometry, Mesh, Program, Vec3 } from "./vendor/ogl.min.js";

const VERSION = "#version 300 es";
const [, ...SHADERS] = (await (await fetch(new URL("shaders.glsl", import.meta.url))).text()).split(VERSION).map((one) => VERSION + one);
const SOURCES = { surface: SHADERS.slice(0, 2), dots: SHADERS.slice(2), depth: [SHADERS[0], `${VERSION}\nvoid main() {}`] };
const PLAIN = { color: [1, 1, 1], opacity: 1, lit: 1, radius: 0 };

/** Colour 0xrrggbb as linear numbers. */
export const linear = (color) => [16, 8, 0].map((shift) => (((color >> shift) & 255) / 255) ** 2.2);

/** Program of a stage for a look; `uniforms` are shared. */
export function programOf({ gl, programs, uniforms, casting }, { opacity = 1, through = false, radius = 0 }) {
  const kind = casting ? "depth" : radius ? "dots" : "surface", key = `${kind} ${opacity < 1} ${through}`;
  if (!programs.has(key)) {
    const [vertex, fragment] = SOURCES[kind];
    const own = Object.fromEntries(Object.keys(PLAIN).map((name) => [name, { value: 0 }]));
    programs.set(key, new Program(gl, {
      vertex, fragment, uniforms: { ...uniforms, ...own }, cullFace: casting ? gl.FRONT : gl.BACK,
      transparent: opacity < 1 || radius > 0, depthWrite: opacity === 1, depthTest: !through,
    }));
  }
  return programs.get(key);
}

/** Attributes as a geometry of a stage, white without colours; attributes may belong to several stages. */
export function geometryOf({ gl }, attributes) {
  const own = Object.fromEntries(Object.entries(attributes).map(([name, one]) => [name, { ...one }]));
  own.color ??= { size: 3, type: gl.UNSIGNED_BYTE, normalized: true, data: new Uint8Array(own.position.data.length).fill(255) };
  return new Geometry(gl, own);
}

/** Geometry with a look `{color, opacity, lit, radius of dots, through: visible through everything, casts: a shadow}`. */
export class Shape extends Mesh {
  constructor(stage, geometry, look, mode) {
    super(stage.gl, { geometry, mode });
    Object.assign(this, { stage, look, renderOrder: look.order ?? 0 });
  }

  get program() {
    return programOf(this.stage, this.look);
  }

  set program(_) {} // a look may change

  draw(options) {
    if (this.stage.casting && (!this.look.casts || this.look.opacity < 1)) return;
    const { uniforms } = this.program;
    for (const name of Object.keys(PLAIN)) uniforms[name].value = this.look[name] ?? PLAIN[name];
    super.draw(options);
  }
}

/** Surface of revolution about z of a profile `[[radius, height], ...]`; it faces to the right of the profile's way. */
export function lathe(stage, profile, sides = 20) {
  const position = [], normal = [], index = [];
  profile.slice(1).forEach(([outer, top], k) => {
    const [inner, low] = profile[k];
    for (let side = 0; side <= sides; side++) {
      const angle = (2 * Math.PI * side) / sides, x = Math.cos(angle), y = Math.sin(angle), first = position.length / 3;
      position.push(inner * x, inner * y, low, outer * x, outer * y, top);
      for (let end = 0; end < 2; end++) normal.push((top - low) * x, (top - low) * y, inner - outer);
      if (side < sides) index.push(first, first + 2, first + 3, first, first + 3, first + 1);
    }
  });
  const of = (values) => ({ size: 3, data: new Float32Array(values) });
  return geometryOf(stage, { position: of(position), normal: of(normal), index: { data: new Uint16Array(index) } });
}

/** Dots of a stage: positions and colours as lists of numbers, look with a radius. */
export function dotsOf(stage, positions, colours, look) {
  const [position, color] = [positions, colours].map((list) => ({ size: 3, data: new Float32Array(list), usage: stage.gl.DYNAMIC_DRAW }));
  // Before surfaces through which they are seen.
  return new Shape(stage, geometryOf(stage, { position, color }), { order: -1, ...look }, stage.gl.POINTS);
}

/** Turn a shape's z axis to a unit vector, on the shortest way. */
export function turnTo(shape, way) {
  const axis = new Vec3(-way[1], way[0], 0), length = axis.len(); // none if the vector is along z, or against it
  shape.quaternion.fromAxisAngle(length > 1e-9 ? axis.divide(length) : [1, 0, 0], Math.atan2(length, way[2]));
  return shape;
}

/** Box about all shapes below a group, as its lowest and highest corner. */
export function boundsOf(group) {
  const ends = [new Vec3(Infinity), new Vec3(-Infinity)], point = new Vec3();
  group.updateMatrixWorld();
  group.traverse(({ geometry, worldMatrix }) => {
    const at = geometry ? geometry.attributes.position.data : [];
    for (let i = 0; i < at.length; i += 3) {
      point.fromArray(at, i).applyMatrix4(worldMatrix);
      for (let k = 0; k < 3; k++) [ends[0][k], ends[1][k]] = [Math.min(ends[0][k], point[k]), Math.max(ends[1][k], point[k])];
    }
  });
  return ends;
}
