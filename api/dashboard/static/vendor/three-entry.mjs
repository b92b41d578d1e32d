// What the viewer uses of three.js, and nothing else. Bundled into three.min.js as vendor.json says.
export {
  BufferAttribute, BufferGeometry, Color, DirectionalLight,
  DynamicDrawUsage, Group, HemisphereLight, InstancedMesh, Matrix4, Mesh, MeshBasicMaterial, MeshStandardMaterial,
  NoToneMapping, PCFShadowMap, PerspectiveCamera, Quaternion, Scene, SphereGeometry, Box3, Sphere,
  Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
