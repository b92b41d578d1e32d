// Reader of graspd's binary glTF (worker/stages/models.py): nodes, triangles with normals, points.
const TYPES = { 5120: Int8Array, 5121: Uint8Array, 5123: Uint16Array, 5125: Uint32Array, 5126: Float32Array };
const WIDTHS = { SCALAR: 1, VEC3: 3 };
const POINTS = 0;

/** Content of a GLB file: `{extras, nodes: [{name, translation, rotation, extras, children, solid, collision, points}]}`. */
export function readGlb(buffer) {
  const view = new DataView(buffer);
  if (view.getUint32(0, true) !== 0x46546c67) throw new Error("the model is not binary glTF");
  const length = view.getUint32(12, true);
  const json = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 20, length)));
  const base = 20 + length + 8;
  const attribute = (index) => {
    const { bufferView, componentType: type, type: shape, count, normalized } = json.accessors[index];
    const { byteOffset, byteStride: stride = 0 } = json.bufferViews[bufferView];
    const Type = TYPES[type], size = WIDTHS[shape];
    return { data: new Type(buffer, base + byteOffset, count * (stride / Type.BYTES_PER_ELEMENT || size)), size, type, stride, count, normalized };
  };
  const solid = ({ attributes: { POSITION, NORMAL, COLOR_0 }, indices }) => {
    const made = { position: attribute(POSITION), normal: attribute(NORMAL), index: attribute(indices) };
    return COLOR_0 === undefined ? made : { ...made, color: attribute(COLOR_0) };
  };
  const nodes = json.nodes.map((node) => {
    const made = { translation: [0, 0, 0], rotation: [0, 0, 0, 1], extras: {}, children: [], ...node, solid: null, collision: null, points: null };
    for (const primitive of node.mesh === undefined ? [] : json.meshes[node.mesh].primitives) {
      if (primitive.mode === POINTS) made.points = attribute(primitive.attributes.POSITION).data;
      else made.solid = solid(primitive);
    }
    if (made.extras.collision !== undefined) made.collision = solid(json.meshes[made.extras.collision].primitives[0]);
    return made;
  });
  return { extras: json.asset.extras, nodes };
}

const loading = new Map();

/** Content of the GLB file at a URL, fetched once. */
export function loadGlb(address) {
  if (!loading.has(address)) {
    const promise = fetch(address).then(async (answer) => {
      if (!answer.ok) throw new Error(answer.status === 404 ? "the model is not made yet" : `the model cannot be read (HTTP ${answer.status})`);
      return readGlb(await answer.arrayBuffer());
    });
    promise.catch(() => loading.delete(address));
    loading.set(address, promise);
  }
  return loading.get(address);
}
