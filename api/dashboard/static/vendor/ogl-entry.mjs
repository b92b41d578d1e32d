// The parts of OGL that the viewer uses; vendor.json has the command that bundles them into ogl.min.js.
export { Box, Camera, Geometry, Mat3, Mat4, Mesh, Program, Quat, Renderer, RenderTarget, Transform, Vec3 } from "ogl";
