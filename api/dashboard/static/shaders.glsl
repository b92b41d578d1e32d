// Vertex and fragment shaders of surfaces, then of dots. Colours are linear until the last line; alpha is premultiplied.

// Surface with the light of the sky, of a key lamp with shadow, and of a rim lamp; the lamps move with the camera.
#version 300 es
in vec3 position, normal, color;
uniform mat4 modelMatrix, modelViewMatrix, projectionMatrix, shadowMatrix;
uniform mat3 normalMatrix;
out vec3 at, outward, tint, shade;

void main() {
  at = (modelViewMatrix * vec4(position, 1)).xyz;
  outward = normalMatrix * normal;
  tint = color;
  vec3 raised = 0.001 * normalize(mat3(modelMatrix) * normal); // [m], or the surface would shade itself
  shade = (shadowMatrix * (modelMatrix * vec4(position, 1) + vec4(raised, 0))).xyz;
  gl_Position = projectionMatrix * vec4(at, 1);
}

#version 300 es
precision highp float;
precision highp sampler2DShadow;
in vec3 at, outward, tint, shade;
uniform vec3 color;
uniform float opacity, lit;
uniform mat4 viewMatrix;
uniform sampler2DShadow shadow;
out vec4 pixel;

const float PI = 3.14159265, A = 0.113; // fourth power of the roughness 0.58
const vec3 KEY = normalize(vec3(-1.6, 2.6, 2.4)), RIM = normalize(vec3(2.2, 0.6, -2.2));

// Lambert; GGX with the visibility of Smith (Heitz 2014) and Schlick's Fresnel term.
vec3 lamp(vec3 base, vec3 normal, vec3 to, vec3 light) {
  vec3 eye = normalize(-at), middle = normalize(to + eye);
  float l = max(dot(normal, to), 0.0), v = max(dot(normal, eye), 0.001), h = dot(normal, middle);
  float d = h * h * (A - 1.0) + 1.0;
  float spread = l * sqrt(v * v * (1.0 - A) + A) + v * sqrt(l * l * (1.0 - A) + A);
  float sheen = A / (PI * d * d) * 0.5 / spread * (0.04 + 0.96 * pow(1.0 - dot(eye, middle), 5.0));
  return light * l * (base / PI + sheen);
}

float lightReaches() {
  vec2 off = abs(shade.xy - 0.5);
  if (max(off.x, off.y) > 0.49) return 1.0;
  float open = 0.0;
  for (int k = 0; k < 9; k++) {
    open += texture(shadow, shade + vec3(vec2(k % 3 - 1, k / 3 - 1) / 900.0, -0.0006)) / 9.0;
  }
  return open;
}

void main() {
  vec3 base = tint * color, sum = base, normal = normalize(outward);
  if (lit > 0.0) {
    vec3 sky = mix(vec3(0.46, 0.42, 0.37), vec3(1), 0.5 + 0.5 * dot(normal, viewMatrix[2].xyz));
    sum = 1.9 / PI * base * sky;
    sum += lamp(base, normal, KEY, 1.9 * lightReaches() * vec3(1, 0.92, 0.82));
    sum += lamp(base, normal, RIM, 0.9 * vec3(0.71, 0.81, 1));
  }
  pixel = vec4(pow(min(sum, 1.0), vec3(1.0 / 2.2)), 1) * opacity;
}

// Dots: discs with the depth of spheres.
#version 300 es
in vec3 position, color;
uniform mat4 modelViewMatrix, projectionMatrix;
uniform float radius, height; // [m], and the canvas's [pixels]
out vec3 at, tint;

void main() {
  at = (modelViewMatrix * vec4(position, 1)).xyz;
  tint = color;
  gl_Position = projectionMatrix * vec4(at, 1);
  gl_PointSize = radius * height * projectionMatrix[1][1] / gl_Position.w;
}

#version 300 es
precision highp float;
in vec3 at, tint;
uniform mat4 projectionMatrix;
uniform float radius, opacity;
out vec4 pixel;

void main() {
  vec2 off = 2.0 * gl_PointCoord - 1.0;
  float rest = 1.0 - dot(off, off);
  float edge = fwidth(rest);
  if (rest < 0.0) discard;
  vec4 front = projectionMatrix * vec4(at + vec3(0, 0, radius * sqrt(rest)), 1);
  gl_FragDepth = 0.5 + 0.5 * front.z / front.w;
  pixel = vec4(pow(tint, vec3(1.0 / 2.2)), 1) * opacity * min(rest / edge, 1.0);
}
