// Lit stage with an orbiting camera. Draws only after changes, so an idle page costs nothing.
import {
  Box3, DirectionalLight, HemisphereLight, NoToneMapping, PCFShadowMap, PerspectiveCamera, Quaternion, Scene, Sphere, Vector3,
  WebGLRenderer, OrbitControls,
} from "./vendor/three.min.js";

const FIELD_DEG = 32;
const TURN = Math.PI / 24;
/** Lengths of the scale bar [m], and its greatest length [pixels]. */
const SCALES_M = [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5];
const SCALE_PX = 130;

function lit(scene) {
  scene.add(new HemisphereLight(0xffffff, 0xb5aea4, 1.9));
  const key = new DirectionalLight(0xfff6ea, 1.9);
  key.castShadow = true;
  key.shadow.mapSize.set(1024, 1024);
  Object.assign(key.shadow, { bias: -0.0006, normalBias: 0.0012 });
  const rim = new DirectionalLight(0xdbe9ff, 0.9);
  scene.add(key, key.target, rim, rim.target);
  return { key, rim };
}

/** Scene, camera and renderer; without `canvas` it draws into its own canvas (for thumbnails). */
export class Stage {
  constructor(canvas) {
    this.renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true, preserveDrawingBuffer: !canvas });
    this.renderer.toneMapping = NoToneMapping;
    Object.assign(this.renderer.shadowMap, { enabled: true, type: PCFShadowMap });
    this.scene = new Scene();
    this.lights = lit(this.scene);
    this.camera = new PerspectiveCamera(FIELD_DEG, 1, 0.01, 10);
    this.camera.up.set(0, 0, 1);
    this.sphere = new Sphere(new Vector3(), 0.1);
  }

  /** Fill the view with a group; `direction` points from the group to the camera. */
  frame(group, direction, margin = 1.0) {
    group.updateMatrixWorld(true);
    new Box3().setFromObject(group).getBoundingSphere(this.sphere);
    const half = (Math.min(1, this.camera.aspect) * FIELD_DEG * Math.PI) / 360;
    const distance = (margin * this.sphere.radius) / Math.sin(half);
    this.camera.position.copy(direction).normalize().multiplyScalar(distance).add(this.sphere.center);
    Object.assign(this.camera, { near: distance / 50, far: distance * 10 });
    this.camera.lookAt(this.sphere.center);
    this.camera.updateProjectionMatrix();
    this.light();
  }

  /** Move the lamps with the camera. */
  light() {
    const { center, radius } = this.sphere;
    const place = (lamp, ...at) => { // in radii to the right, up and back
      lamp.position.set(...at).multiplyScalar(radius).applyQuaternion(this.camera.quaternion).add(center);
      lamp.target.position.copy(center);
      lamp.target.updateMatrixWorld();
    };
    place(this.lights.key, -1.6, 2.6, 2.4);
    place(this.lights.rim, 2.2, 0.6, -2.2);
    const side = 1.2 * radius, span = { left: -side, bottom: -side, right: side, top: side, near: 0.1 * radius, far: 8 * radius };
    Object.assign(this.lights.key.shadow.camera, span).updateProjectionMatrix();
  }

  size(width, height, ratio) {
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
  }

  draw() {
    this.camera.updateMatrixWorld();
    this.light();
    this.renderer.render(this.scene, this.camera);
  }
}

/** Stage on the page: follows its canvas's size, mouse, touch and arrow keys. */
export class LiveStage extends Stage {
  constructor(canvas) {
    super(canvas);
    this.canvas = canvas;
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = false;
    this.controls.addEventListener("change", () => {
      this.invalidate();
      this.onTurn?.(this.view);
    });
    canvas.addEventListener("keydown", (event) => this.#key(event));
    new ResizeObserver(() => this.#resize()).observe(canvas);
    this.#resize();
  }

  frame(group, direction, margin) {
    super.frame(group, direction, margin);
    this.controls.target.copy(this.sphere.center);
    Object.assign(this.controls, { minDistance: this.sphere.radius * 0.4, maxDistance: this.sphere.radius * 12 });
    this.controls.update();
    this.home = this.view;
    this.invalidate();
  }

  /** Camera and its target relative to the middle, in radii of what is shown. */
  get view() {
    const { center, radius } = this.sphere;
    return [this.camera.position, this.controls.target].flatMap((at) => at.clone().sub(center).divideScalar(radius).toArray());
  }

  set view(numbers) {
    const { center, radius } = this.sphere;
    [this.camera.position, this.controls.target].forEach((at, k) => at.fromArray(numbers, 3 * k).multiplyScalar(radius).add(center));
    this.controls.update();
    this.invalidate();
  }

  reset() {
    this.view = this.home;
  }

  draw() {
    super.draw();
    const scale = this.canvas.parentElement.querySelector("[data-scale]");
    if (!scale) return;
    const distance = this.camera.position.distanceTo(this.controls.target);
    const pixels = this.canvas.clientHeight / (2 * distance * Math.tan((FIELD_DEG * Math.PI) / 360)); // of a metre
    const length = SCALES_M.findLast((one) => one * pixels < SCALE_PX) ?? SCALES_M[0];
    scale.textContent = length < 0.01 ? `${1000 * length} mm` : `${100 * length} cm`;
    scale.style.width = `${length * pixels}px`;
  }

  invalidate() {
    this.waiting ??= requestAnimationFrame(() => {
      this.waiting = null;
      this.draw();
    });
  }

  #resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.size(width, height, Math.min(devicePixelRatio, 2));
    this.invalidate();
  }

  #key(event) {
    const turns = { ArrowLeft: [-TURN, 0], ArrowRight: [TURN, 0], ArrowUp: [0, -TURN], ArrowDown: [0, TURN] };
    const zooms = { "+": 0.88, "=": 0.88, "-": 1.14 };
    const offset = this.camera.position.clone().sub(this.controls.target);
    if (turns[event.key]) {
      const [around, over] = turns[event.key], { up } = this.camera, polar = offset.angleTo(up);
      const tilt = Math.min(Math.max(polar + over, 0.05), Math.PI - 0.05) - polar;
      offset.applyAxisAngle(up.clone().cross(offset).normalize(), tilt).applyAxisAngle(up, around);
    } else if (zooms[event.key]) {
      offset.multiplyScalar(zooms[event.key]);
    } else {
      return;
    }
    event.preventDefault();
    this.camera.position.copy(this.controls.target).add(offset);
    this.controls.update();
    this.invalidate();
  }
}

/** Viewing direction of a grasp: beside the hand, a little above and behind it. */
export function besideHand(hand) {
  const turn = hand.group.getWorldQuaternion(new Quaternion());
  const approach = new Vector3(...(hand.extras.palm?.approach ?? [0, 0, 1])).applyQuaternion(turn);
  const up = new Vector3(0, 0, 1);
  const side = new Vector3().crossVectors(up, approach);
  if (side.length() < 0.2) side.set(1, 0.4, 0);
  side.normalize();
  return side.multiplyScalar(1).addScaledVector(up, 0.55).addScaledVector(approach, -0.35);
}

/** Viewing direction of a hand's palm in its own frame, or of an object. */
export function beforePalm({ extras }) {
  if (!extras) return new Vector3(1, -1.5, 0.8);
  const approach = new Vector3(...extras.palm.approach);
  const up = new Vector3(0, 0, 1);
  const side = new Vector3().crossVectors(up, approach);
  if (side.length() < 0.2) return new Vector3(1, -1.2, 0.55);
  return approach.addScaledVector(side.normalize(), 0.75).addScaledVector(up, 0.35);
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
