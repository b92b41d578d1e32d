// The parts of three.js that the viewer uses; vendor.json has the command that bundles them into three.min.js.
export {
  BufferAttribute, BufferGeometry, Color, DirectionalLight,
  DynamicDrawUsage, Group, HemisphereLight, InstancedMesh, Matrix4, Mesh, MeshBasicMaterial, MeshStandardMaterial,
  NoToneMapping, PCFShadowMap, PerspectiveCamera, Quaternion, Scene, SphereGeometry, Box3, Sphere,
  Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
