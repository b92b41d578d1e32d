// The parts of three.js that the viewer uses; vendor.json has the command that bundles them into three.min.js.
export {
  Box3, BoxGeometry, BufferAttribute, BufferGeometry, CircleGeometry, Color, DirectionalLight,
  DynamicDrawUsage, Group, HemisphereLight, InstancedMesh, LatheGeometry, Matrix4, Mesh, MeshBasicMaterial,
  MeshStandardMaterial, NoToneMapping, PCFShadowMap, PerspectiveCamera, Quaternion, Scene, Sphere, SphereGeometry,
  Vector2, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
