#version 300 es
// How far the photos show what a pixel shows: 1 for a surface that one of them shows, 0 for what the fit invented.
// The mean depth of the splat says where the surface is. kgs/page/seen.py describes the photos' depths.
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp sampler2DArray;

uniform sampler2D splat;        // sums over the layers of a pixel: red weight times depth, alpha weight
uniform sampler2DArray depths;  // nearest and farthest depth in each cell of each photo, as bytes
uniform sampler2D lenses;       // five texels per photo: rows of world to camera, focal and centre, position
uniform vec2 depthCode;         // low and step
uniform vec2 photoSize;         // in pixels
uniform float cell;             // side of a cell in pixels of a photo
uniform float depthUnit;
uniform mat3 rotation;          // world to the eye
uniform vec3 position;          // of the eye
uniform vec2 focal, centre;     // in pixels of the canvas
uniform vec2 size;              // of the canvas, in pixels
out vec4 result;

const float LEAST_ALPHA = 0.05;  // of a pixel that shows something
const float BEHIND = 0.02;       // share of the depth by which a surface may lie behind the depths of a cell
const float BEFORE = 0.1;        // likewise before them: splats have some fog in front of surfaces
const float FULL_ANGLE = radians(18.0);  // between the directions from the surface to the eye and to the camera
const float LAST_ANGLE = radians(62.0);

float shownBy(int photo, vec3 point) {
  vec3 seen;
  for (int row = 0; row < 3; row++) {
    vec4 texel = texelFetch(lenses, ivec2(row, photo), 0);
    seen[row] = dot(texel.xyz, point) + texel.w;
  }
  if (seen.z <= 0.0) return 0.0;
  vec4 lens = texelFetch(lenses, ivec2(3, photo), 0);
  vec2 pixel = lens.xy * seen.xy / seen.z + lens.zw;
  if (any(lessThan(pixel, vec2(-0.5))) || any(greaterThan(pixel, photoSize - 0.5))) return 0.0;
  ivec2 place = min(ivec2((pixel + 0.5) / cell), textureSize(depths, 0).xy - 1);
  vec2 code = round(255.0 * texelFetch(depths, ivec3(place, photo), 0).rg);
  if (code.x > code.y) return 0.0;
  vec2 range = exp(depthCode.x + depthCode.y * (code - 1.0));
  float mismatch = max((seen.z / range.y - 1.0) / BEHIND, (1.0 - seen.z / range.x) / BEFORE);
  vec3 toEye = normalize(position - point);
  vec3 toCamera = normalize(texelFetch(lenses, ivec2(4, photo), 0).xyz - point);
  float angle = acos(clamp(dot(toEye, toCamera), -1.0, 1.0));
  return clamp(1.5 - mismatch, 0.0, 1.0) * (1.0 - smoothstep(FULL_ANGLE, LAST_ANGLE, angle));
}

void main() {
  vec4 sums = texelFetch(splat, ivec2(gl_FragCoord.xy), 0);
  float coverage = 1.0;
  if (sums.a >= LEAST_ALPHA) {
    vec2 place = gl_FragCoord.xy / vec2(textureSize(splat, 0)) * size;  // from the lower left corner
    vec2 pixel = vec2(place.x, size.y - place.y) - 0.5;
    float depth = depthUnit * sums.r / sums.a;
    vec3 point = position + transpose(rotation) * (depth * vec3((pixel - centre) / focal, 1.0));
    coverage = 0.0;
    for (int photo = 0; photo < textureSize(lenses, 0).y; photo++) coverage = max(coverage, shownBy(photo, point));
  }
  result = vec4(coverage);
}
