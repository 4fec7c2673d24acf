// The equations are those of ChronoScene's rasterizer: chronoscene/rasterizer/README.md.

const PER_ROW = 256, ORDER_ROW = 1024;  // Gaussians in a row of the textures, numbers of the order

const GAUSSIAN_VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;
uniform sampler2D geometry;  // 4 texels each: see spz.js
uniform usampler2D sh;       // 15 texels each
uniform mat3 rotation;       // from the page to the camera: right, down, forward
uniform vec3 eye;
uniform vec2 focal, middle, size;  // pixels
uniform float near;
uniform bool antialiased;
uniform usampler2D order;    // numbers of the Gaussians, the farthest first
out vec2 offset;             // pixels from the centre of the Gaussian
flat out vec4 color;
flat out vec3 conic;

vec4 numbers(int i, int k) {
  return texelFetch(geometry, ivec2((i % ${PER_ROW}) * 4 + k, i / ${PER_ROW}), 0);
}

vec3 coefficient(int i, int k) {
  uvec4 bytes = texelFetch(sh, ivec2((i % ${PER_ROW}) * 15 + k, i / ${PER_ROW}), 0);
  return (vec3(bytes.rgb) - 128.0) / 128.0;
}

vec3 harmonics(int i, vec3 zeroth, vec3 to) {
  float x = to.x, y = to.y, z = to.z, xx = x * x, yy = y * y, zz = z * z;
  vec3 c = 0.28209479 * zeroth;
  c += 0.48860251 * (z * coefficient(i, 1) - y * coefficient(i, 0) - x * coefficient(i, 2));
  c += 1.09254843 * (x * y * coefficient(i, 3) - y * z * coefficient(i, 4)
    - x * z * coefficient(i, 6));
  c += 0.31539157 * (2.0 * zz - xx - yy) * coefficient(i, 5);
  c += 0.54627421 * (xx - yy) * coefficient(i, 7);
  c -= 0.59004359 * y * (3.0 * xx - yy) * coefficient(i, 8);
  c += 2.89061144 * x * y * z * coefficient(i, 9);
  c -= 0.45704579 * y * (4.0 * zz - xx - yy) * coefficient(i, 10);
  c += 0.37317633 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * coefficient(i, 11);
  c -= 0.45704579 * x * (4.0 * zz - xx - yy) * coefficient(i, 12);
  c += 1.44530572 * z * (xx - yy) * coefficient(i, 13);
  return c - 0.59004359 * x * (xx - 3.0 * yy) * coefficient(i, 14);
}

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);  // outside: not drawn
  int quad = gl_VertexID >> 2;
  int i = int(texelFetch(order, ivec2(quad % ${ORDER_ROW}, quad / ${ORDER_ROW}), 0).r);
  vec4 a = numbers(i, 0), b = numbers(i, 1), c = numbers(i, 2);
  vec3 p = rotation * (a.xyz - eye);
  if (p.z < near) return;
  // The linearisation is not continued far outside of the image.
  vec2 margin = 0.15 * size / focal;
  vec2 held = clamp(p.xy / p.z, -middle / focal - margin, (size - middle) / focal + margin);
  mat3 J = mat3(focal.x, 0.0, 0.0, 0.0, focal.y, 0.0, -focal * held, 0.0) / p.z;
  mat3 sigma = mat3(b.x, b.y, b.z, b.y, b.w, c.x, b.z, c.x, c.y);
  mat3 JW = J * rotation, flat_sigma = JW * sigma * transpose(JW);
  float A = flat_sigma[0][0], B = flat_sigma[0][1], C = flat_sigma[1][1];
  float before = max(A * C - B * B, 0.0);
  A += 0.3;
  C += 0.3;
  float after = A * C - B * B, opacity = a.w;
  if (antialiased) opacity *= sqrt(before / after);
  if (opacity <= 1.0 / 255.0) return;
  float reach = sqrt(2.0 * log(255.0 * opacity));
  vec2 corner = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0;
  offset = corner * reach * sqrt(vec2(A, C));
  conic = vec3(C, -B, A) / after;
  vec3 rgb = harmonics(i, vec3(c.zw, numbers(i, 3).x), normalize(a.xyz - eye)) + 0.5;
  color = vec4(max(rgb, 0.0), opacity);
  vec2 place = (focal * p.xy / p.z + middle + offset) / size * 2.0 - 1.0;
  gl_Position = vec4(place.x, -place.y, 0.0, 1.0);
}`;

const GAUSSIAN_FRAGMENT = `#version 300 es
precision highp float;
in vec2 offset;
flat in vec4 color;
flat in vec3 conic;
out vec4 result;
void main() {
  float power = -0.5 * (conic.x * offset.x * offset.x + conic.z * offset.y * offset.y)
    - conic.y * offset.x * offset.y;
  float alpha = min(0.999, color.a * exp(power));
  if (alpha < 1.0 / 255.0) discard;
  result = vec4(color.rgb * alpha, alpha);
}`;

const PICTURE_VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}`;

// Two finished pictures are mixed: mixing opacities would show what is behind both.
const PICTURE_FRAGMENT = `#version 300 es
precision highp float;
precision highp sampler2D;
uniform sampler2D first, second;
uniform float share;  // of the second picture
uniform float wipe;   // pixels from the left where the second begins; negative: none
out vec4 result;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  float t = wipe < 0.0 ? share : step(wipe, gl_FragCoord.x);
  result = vec4(mix(texelFetch(first, at, 0).rgb, texelFetch(second, at, 0).rgb, t), 1.0);
}`;
