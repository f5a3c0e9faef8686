/** GLSL code that several sources share. */

import { TABLE_WIDTH, WIDTH } from "./texture_tables";

export const PRECISION = `
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp isampler2D;
precision highp usampler2D;
precision highp sampler2DShadow;
`;

export const TABLE_LOOKUP = `
ivec2 table_texel(int index) { return ivec2(index % ${TABLE_WIDTH}, index / ${TABLE_WIDTH}); }
`;

export const FETCH_VERTEX = `
uniform sampler2D positions;
uniform sampler2D transforms;
in uvec2 vertex;                     // index of the vertex in the scene, and of its domain
${TABLE_LOOKUP}
vec4 fetch_position() { return texelFetch(positions, ivec2(int(vertex.x) % ${WIDTH}, int(vertex.x) / ${WIDTH}), 0); }
`;

export const DECODE_OCTAHEDRAL = `
vec3 decode_octahedral(vec2 code) {
    vec3 n = vec3(code, 1.0 - abs(code.x) - abs(code.y));
    if (n.z < 0.0) n.xy = (1.0 - abs(n.yx)) * vec2(n.x < 0.0 ? -1.0 : 1.0, n.y < 0.0 ? -1.0 : 1.0);
    return normalize(n);
}
`;
