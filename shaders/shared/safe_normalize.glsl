// Normalizes a vector. Vectors shorter than 1e-15 give a finite result that is shorter than 1.
vec3 safe_normalize(vec3 v) { return v * inversesqrt(max(dot(v, v), 1e-30)); }
