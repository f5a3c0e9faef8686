// Unit vectors in octahedral coordinates, which are two numbers from -1 to 1 (Meyer et al., "On Floating-Point Normal
// Vectors", 2010).
vec2 encode_octahedral(vec3 n) {
    n /= abs(n.x) + abs(n.y) + abs(n.z);
    vec2 folded = (1.0 - abs(n.yx)) * vec2(n.x < 0.0 ? -1.0 : 1.0, n.y < 0.0 ? -1.0 : 1.0);
    return n.z < 0.0 ? folded : n.xy;
}

vec3 decode_octahedral(vec2 code) {
    vec3 n = vec3(code, 1.0 - abs(code.x) - abs(code.y));
    if (n.z < 0.0) n.xy = (1.0 - abs(n.yx)) * vec2(n.x < 0.0 ? -1.0 : 1.0, n.y < 0.0 ? -1.0 : 1.0);
    return normalize(n);
}
