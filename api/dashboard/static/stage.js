// Lit stage with an orbiting camera. Draws only after changes, so an idle page costs nothing.
import { Camera, Mat4, Quat, Renderer, RenderTarget, Transform, Vec3 } from "./vendor/ogl.min.js";
import { turnOf } from "./figures.js";
import { boundsOf } from "./shapes.js";

const FIELD_DEG = 32;
const SLOPE = Math.tan((FIELD_DEG * Math.PI) / 360);
const TURN = Math.PI / 24;
const TURNS = { ArrowLeft: [-TURN, 0], ArrowRight: [TURN, 0], ArrowUp: [0, -TURN], ArrowDown: [0, TURN] };
const ZOOMS = { "+": 0.88, "=": 0.88, "-": 1.14 };
const UP = new Vec3(0, 0, 1);
/** Lengths of the scale bar [m], and its greatest length [pixels]. */
const SCALES_M = [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5];
const SCALE_PX = 130;
const ABLE = document.createElement("canvas").getContext("webgl2");
/** Key lamp in the camera's frame, in radii of what is shown, as in shaders.glsl; pixels of its shadows. */
const LAMP = [-1.6, 2.6, 2.4];
const SHADOW_PX = 1024;
/** From -1..1 to the texture's 0..1. */
const TO_TEXTURE = new Mat4().translate(new Vec3(0.5)).scale(new Vec3(0.5));

/** Scene, camera and renderer; without `canvas` it draws into its own canvas (for thumbnails). */
export class Stage {
  constructor(canvas) {
    if (!ABLE) throw new Error("this browser has no WebGL 2");
    this.renderer = new Renderer({ canvas, antialias: true, alpha: true, premultipliedAlpha: true, preserveDrawingBuffer: !canvas });
    const { gl } = this.renderer;
    gl.canvas.removeAttribute("style"); // the style sheet sets its size
    this.gl = gl;
    this.programs = new Map();
    this.scene = new Transform();
    this.camera = new Camera(gl, { fov: FIELD_DEG });
    this.camera.up.copy(UP);
    this.lamp = new Camera(gl, { left: -1 });
    this.lamp.position.set(...LAMP);
    this.aim = this.lamp.lookAt([0, 0, 0]).quaternion.toArray();
    this.map = new RenderTarget(gl, { width: SHADOW_PX, height: SHADOW_PX, color: 0, depthTexture: true });
    gl.bindTexture(gl.TEXTURE_2D, this.map.depthTexture.texture);
    const filters = { COMPARE_MODE: "COMPARE_REF_TO_TEXTURE", MIN_FILTER: "LINEAR", MAG_FILTER: "LINEAR" };
    for (const [name, value] of Object.entries(filters)) gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_${name}`], gl[value]);
    this.uniforms = { shadow: { value: this.map.depthTexture }, shadowMatrix: { value: new Mat4() }, height: { value: 1 } };
    Object.assign(this, { centre: new Vec3(), radius: 0.1 });
  }

  /** Fill the view with a group; `direction` points from the group to the camera. */
  frame(group, direction, margin = 1.0) {
    const [low, high] = boundsOf(group);
    this.centre.add(low, high).scale(0.5);
    this.radius = low.distance(high) / 2;
    const distance = (margin * this.radius) / Math.sin((Math.min(1, this.camera.aspect) * FIELD_DEG * Math.PI) / 360);
    this.camera.position.copy(direction).normalize().scale(distance).add(this.centre);
    this.camera.perspective({ near: distance / 50, far: distance * 10 }).lookAt(this.centre);
  }

  size(width, height, dpr) {
    Object.assign(this.renderer, { width, height, dpr });
    Object.assign(this.gl.canvas, { width: width * dpr, height: height * dpr });
    this.uniforms.height.value = height * dpr;
    this.camera.perspective({ aspect: width / height });
  }

  /** Draw the shadows of the key lamp, which moves with the camera, then the picture. */
  draw() {
    const { lamp, camera, renderer, scene, radius } = this, side = 1.2 * radius;
    lamp.position.set(...LAMP).scale(radius).applyQuaternion(camera.quaternion).add(this.centre);
    lamp.quaternion.multiply(camera.quaternion, new Quat(...this.aim));
    lamp.orthographic({ left: -side, right: side, bottom: -side, top: side, near: 0.1 * radius, far: 8 * radius });
    this.casting = true;
    renderer.render({ scene, camera: lamp, target: this.map, frustumCull: false });
    this.casting = false;
    this.uniforms.shadowMatrix.value.multiply(TO_TEXTURE, lamp.projectionViewMatrix);
    renderer.render({ scene, camera, frustumCull: false });
  }
}

/** Stage on the page: follows its canvas's size, mouse, touch and arrow keys. */
export class LiveStage extends Stage {
  constructor(canvas) {
    super(canvas);
    this.canvas = canvas;
    this.target = new Vec3();
    this.#follow(canvas);
    new ResizeObserver(() => this.#resize()).observe(canvas);
    this.#resize();
  }

  frame(group, direction, margin) {
    super.frame(group, direction, margin);
    this.target.copy(this.centre);
    this.home = this.view;
    this.invalidate();
  }

  /** Camera and its target relative to the middle, in radii of what is shown. */
  get view() {
    return [this.camera.position, this.target].flatMap((at) => at.clone().sub(this.centre).divide(this.radius).toArray());
  }

  set view(numbers) {
    this.target.fromArray(numbers, 3).scale(this.radius).add(this.centre);
    this.#place(new Vec3(...numbers).scale(this.radius).add(this.centre).sub(this.target));
  }

  draw() {
    super.draw();
    const scale = this.canvas.parentElement.querySelector("[data-scale]");
    if (!scale) return;
    const metre = this.canvas.clientHeight / (2 * this.offset.len() * SLOPE); // [pixels]
    const length = SCALES_M.findLast((one) => one * metre < SCALE_PX) ?? SCALES_M[0];
    scale.textContent = length < 0.01 ? `${1000 * length} mm` : `${100 * length} cm`;
    scale.style.width = `${length * metre}px`;
  }

  invalidate() {
    this.waiting ??= requestAnimationFrame(() => {
      this.waiting = null;
      this.draw();
    });
  }

  #resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (width && height) this.size(width, height, Math.min(devicePixelRatio, 2));
    this.invalidate();
  }

  get offset() {
    return this.camera.position.clone().sub(this.target);
  }

  /** Set the camera relative to its target. */
  #place(offset) {
    const distance = Math.min(Math.max(offset.len(), 0.4 * this.radius), 12 * this.radius);
    this.camera.position.copy(this.target).add(offset.normalize().scale(distance));
    this.camera.lookAt(this.target);
    this.invalidate();
    this.onTurn?.(this.view);
  }

  #turn(around, over) {
    const { offset } = this, polar = offset.angle(UP), axis = new Vec3().cross(UP, offset).normalize();
    const tilt = Math.min(Math.max(polar + over, 0.05), Math.PI - 0.05) - polar;
    for (const turn of [[axis, tilt], [UP, around]]) offset.applyQuaternion(new Quat().fromAxisAngle(...turn));
    this.#place(offset);
  }

  #pan(right, down) {
    const { offset } = this, pixel = (2 * offset.len() * SLOPE) / this.canvas.clientHeight; // [m]
    this.target.add(new Vec3(-right, down, 0).scale(pixel).applyQuaternion(this.camera.quaternion));
    this.#place(offset);
  }

  /** One finger or the left button turns; two fingers, the right button or a held key move; the wheel zooms. */
  #follow(canvas) {
    const held = new Map();
    canvas.style.touchAction = "none";
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => { held.set(event.pointerId, event); canvas.setPointerCapture(event.pointerId); });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => held.delete(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      const was = held.get(event.pointerId);
      if (!was) return;
      const [right, down] = [event.clientX - was.clientX, event.clientY - was.clientY], round = (-2 * Math.PI) / canvas.clientHeight;
      const other = [...held.values()].find((one) => one !== was), apart = (one) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
      held.set(event.pointerId, event);
      if (other) {
        this.#place(this.offset.scale(apart(was) / Math.max(apart(event), 1)));
        this.#pan(right / 2, down / 2);
      } else if (event.buttons === 1 && !event.shiftKey && !event.ctrlKey && !event.metaKey) {
        this.#turn(round * right, round * down);
      } else {
        this.#pan(right, down);
      }
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.#place(this.offset.scale(1.05 ** ((event.deltaY * (event.ctrlKey ? 10 : 1)) / 100))); // touchpads send the key
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const turn = TURNS[event.key], zoom = ZOOMS[event.key];
      if (turn) this.#turn(...turn);
      if (zoom) this.#place(this.offset.scale(zoom));
      if (turn || zoom) event.preventDefault();
    });
  }
}

/** Direction to a camera beside something that approaches; `fallback` if it approaches from above or below. */
function beside(approach, fallback) {
  const side = new Vec3().cross(UP, approach);
  return side.len() < 0.2 ? fallback : side.normalize();
}

/** Viewing direction of a grasp: beside the hand, a little above and behind it. */
export function besideHand(hand) {
  const approach = new Vec3(...(hand.extras.palm?.approach ?? UP)).applyQuaternion(turnOf(hand.group));
  return beside(approach, new Vec3(1, 0.4, 0).normalize()).add([0, 0, 0.55]).add(approach.scale(-0.35));
}

/** Viewing direction of a hand's palm in its own frame, or of an object. */
export function beforePalm({ extras }) {
  if (!extras) return new Vec3(1, -1.5, 0.8);
  const approach = new Vec3(...extras.palm.approach), side = beside(approach, null);
  return side ? approach.add(side.scale(0.75)).add([0, 0, 0.35]) : new Vec3(1, -1.2, 0.55);
}

/** Start the waiting viewers of a kind; the figure tells why one cannot start, and where its content is. */
export function startViewers(kind, start, instead) {
  for (const figure of document.querySelectorAll(`[data-viewer=${kind}][data-state=loading]`)) {
    figure.dataset.state = "reading";
    start(figure).then(() => { figure.dataset.state = "ready"; }, (error) => {
      figure.dataset.state = "failed";
      figure.querySelector("[data-say]").textContent = `No 3D view: ${error.message}. ${instead}`;
    });
  }
}
