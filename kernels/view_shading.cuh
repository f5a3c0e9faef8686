// Shading of a pixel of a view: the color of a visible triangle, of the ground or of the sky. Same formulas as the
// renderer's shaders (shaders/shade.comp and shaders/shared), without shadows and without ambient occlusion. Colors are
// linear. Positions are in scene units, relative to the origin of the frame's positions. views.cu describes the macros.
// Twin: src/compute/reference/views/shading.rs.
#pragma once

// A camera, and the ground as it sees it. Twin: `ViewCamera` in src/model/views.rs.
struct ViewCamera {
    float clip_from_world[16];  // row-major
    float world_from_ndc[9];    // row-major: from (x, y, 1) in normalized device coordinates to a view ray's direction
    float eye[3];
    float ground_center[3];     // a point of the ground plane
    float ground_half_side;     // of the square in which the ground is drawn
    float ground_fade;          // distance D: at distance d from the center, the ground's weight is exp(-(d / D)^2)
    unsigned sees_ground;       // 1 if the scene has a ground and the camera is above it
};

// Lights and background of a scene. Twin: `ViewLight` in src/model/views.rs.
struct ViewLight {
    float to_sun[3], sunlight[3];
    float ambient_cube[6][3];   // light from +x, -x, +y, -y, +z and -z; six times the skylight outdoors
    float fill[3];              // light from the camera; 0 outdoors
    float zenith[3], horizon[3];
    float up[3];                // a coordinate axis
    float ground[3];
    float exposure;
    unsigned tone;              // TONE_CLAMP, TONE_REINHARD or TONE_ACES
    unsigned dithers;           // 1: ordered dithering of 8 x 8 pixels
};

constexpr unsigned TONE_REINHARD = 1, TONE_ACES = 2; // 0: values above 1 are clamped
constexpr float MAX_RADIANCE = 1000.0f;              // as in src/render/shaders/post.rs

// Twin: `ViewMaterial` in src/compute/gpu/executor/views.rs.
struct ViewMaterial {
    float ambient[3], diffuse[3], specular[3], exponent;
    unsigned long long color_image, normal_image; // texture objects; 0 without an image
};

__device__ inline float3 operator+(const float3& a, const float3& b) {
    return make_float3(a.x + b.x, a.y + b.y, a.z + b.z);
}

__device__ inline float3 operator-(const float3& a, const float3& b) {
    return make_float3(a.x - b.x, a.y - b.y, a.z - b.z);
}

__device__ inline float3 operator*(const float3& a, const float3& b) {
    return make_float3(a.x * b.x, a.y * b.y, a.z * b.z);
}

__device__ inline float3 operator*(float s, const float3& v) {
    return make_float3(s * v.x, s * v.y, s * v.z);
}

__device__ inline float dot(const float3& a, const float3& b) {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

__device__ inline float3 cross(const float3& a, const float3& b) {
    return make_float3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}

__device__ inline float3 to_float3(const float (&v)[3]) {
    return make_float3(v[0], v[1], v[2]);
}

__device__ inline float3 mix(const float3& a, const float3& b, float weight) {
    return (1.0f - weight) * a + weight * b;
}

// Normalizes a vector. Vectors shorter than 1e-15 give a finite result that is shorter than 1.
__device__ inline float3 safe_normalize(const float3& v) {
    return rsqrtf(fmaxf(dot(v, v), 1e-30f)) * v;
}

__device__ inline float clamp01(float value) {
    return fminf(fmaxf(value, 0.0f), 1.0f);
}

// Direction of the view ray through an image point. Its length along the view axis is 1, so a distance in units of this
// vector is a depth.
__device__ inline float3 view_ray(const ViewCamera& camera, float2 ndc) {
    const float* m = camera.world_from_ndc;
    return make_float3(m[0] * ndc.x + m[1] * ndc.y + m[2], m[3] * ndc.x + m[4] * ndc.y + m[5],
                       m[6] * ndc.x + m[7] * ndc.y + m[8]);
}

__device__ inline float3 sky(const ViewLight& light, const float3& direction) {
    const float sine = fmaxf(dot(rsqrtf(dot(direction, direction)) * direction, to_float3(light.up)), 0.0f);
    return mix(to_float3(light.horizon), to_float3(light.zenith), 1.0f - __expf(-6.0f * sine * sine / (sine + 0.06f)));
}

// Height of the camera.
__device__ inline float height_above_ground(const ViewLight& light, const ViewCamera& camera) {
    const float3 up = to_float3(light.up);
    return dot(to_float3(camera.eye), up) - dot(to_float3(camera.ground_center), up);
}

// Whether a view ray hits the ground from above, within the square around the scene. Comparisons with NaN are false.
__device__ inline bool ray_hits_ground(const ViewLight& light, const ViewCamera& camera, const float3& direction) {
    const float3 up = to_float3(light.up), eye = to_float3(camera.eye);
    const float descent = -dot(direction, up), eye_height = height_above_ground(light, camera);
    const float3 offset = eye - to_float3(camera.ground_center) + (eye_height / descent) * direction;
    const float half_side = camera.ground_half_side;
    return camera.sees_ground && descent > 0.0f && eye_height > 0.0f && fabsf(offset.x) * (1.0f - up.x) <= half_side &&
           fabsf(offset.y) * (1.0f - up.y) <= half_side && fabsf(offset.z) * (1.0f - up.z) <= half_side;
}

// Depth along a view ray where it meets the ground plane. The ray must hit the ground.
__device__ inline float ground_ray_depth(const ViewLight& light, const ViewCamera& camera, const float3& direction) {
    const float3 up = to_float3(light.up);
    const float ascent = fminf(dot(direction, up), -1e-9f * sqrtf(dot(direction, direction)));
    return -height_above_ground(light, camera) / ascent;
}

// Ambient cube (McTaggart 2004): a color for each side of a box, weighted by the squared components of the normal. A
// normal that is 0 or not finite receives light from three sides.
__device__ inline float3 ambient_light(const ViewLight& light, const float3& normal) {
    float3 weights = normal * normal;
    const float squared_length = weights.x + weights.y + weights.z;
    if (!(squared_length > 0.25f && squared_length < 4.0f)) {
        weights = make_float3(1.0f / 3.0f, 1.0f / 3.0f, 1.0f / 3.0f);
    }
    return weights.x * to_float3(light.ambient_cube[normal.x < 0.0f ? 1 : 0]) +
           weights.y * to_float3(light.ambient_cube[normal.y < 0.0f ? 3 : 2]) +
           weights.z * to_float3(light.ambient_cube[normal.z < 0.0f ? 5 : 4]);
}

__device__ inline float3 shade_ground(const ViewLight& light, const ViewCamera& camera, const float3& world) {
    const float3 up = to_float3(light.up);
    const float cosine = fmaxf(dot(up, to_float3(light.to_sun)), 0.0f);
    const float3 incident = ambient_light(light, up) + cosine * to_float3(light.sunlight);
    const float3 offset = (1.0f / camera.ground_fade) * (world - to_float3(camera.ground_center));
    return mix(to_float3(light.horizon), incident * to_float3(light.ground), __expf(-dot(offset, offset)));
}

__device__ inline float3 shade_background(const ViewLight& light, const ViewCamera& camera, float2 ndc) {
    const float3 direction = view_ray(camera, ndc);
    if (ray_hits_ground(light, camera, direction)) {
        const float depth = ground_ray_depth(light, camera, direction);
        return shade_ground(light, camera, to_float3(camera.eye) + depth * direction);
    }
    return sky(light, direction);
}

// Phong shading with a sun, a fill light at the camera and ambient light; the formula is in shaders/shared/phong.glsl.
__device__ inline float3 phong(const ViewLight& light, const ViewCamera& camera, const ViewMaterial& material,
                               const float3& tint, const float3& normal, const float3& world) {
    const float3 diffuse = to_float3(material.diffuse) * tint;
    const float3 to_eye = safe_normalize(to_float3(camera.eye) - world), to_sun = to_float3(light.to_sun);
    float3 color = ambient_light(light, normal) * to_float3(material.ambient) * tint;
    const float eye_cosine = dot(normal, to_eye);
    color = color + fmaxf(eye_cosine, 0.0f) * to_float3(light.fill) * diffuse;
    const float cosine = dot(normal, to_sun);
    if (cosine > 0.0f) {
        const float highlight_cosine = dot(2.0f * eye_cosine * normal - to_eye, to_sun);
        const float highlight = highlight_cosine > 0.0f ? __powf(highlight_cosine, material.exponent) : 0.0f;
        color = color + to_float3(light.sunlight) * (cosine * diffuse + highlight * to_float3(material.specular));
    }
    return color;
}

// Perspective-correct barycentric coordinates of an image point.
struct Barycentrics {
    float3 weights;   // of the three corners; their sum is 1
    float3 ddx, ddy;  // derivatives of the weights per pixel
    bool is_front_facing;
};

// `a`, `b`, `c`: (x, y, w) of the corners in clip space, relative to the image point p: (x - p.x w, y - p.y w, w).
// `pixel_size`: size of a pixel in normalized device coordinates. These are homogeneous coordinates, so corners behind
// the camera need no clipping.
__device__ inline Barycentrics compute_barycentrics(float3 a, float3 b, float3 c, float2 pixel_size) {
    const float scale = 1.0f / fmaxf(fmaxf(fabsf(a.z), fabsf(b.z)), fmaxf(fabsf(c.z), 1e-30f));
    a = scale * a;
    b = scale * b;
    c = scale * c;
    const float3 edge_a = cross(b, c), edge_b = cross(c, a), edge_c = cross(a, b);
    const float sum = edge_a.z + edge_b.z + edge_c.z, inverse_sum = 1.0f / sum;
    Barycentrics result;
    result.is_front_facing = sum > 0.0f;
    // The image point lies in the triangle except for rounding. For a triangle without area, the weights become 1/3.
    const float3 weights = make_float3(clamp01(edge_a.z * inverse_sum), clamp01(edge_b.z * inverse_sum),
                                       clamp01(edge_c.z * inverse_sum));
    const float weight_sum = weights.x + weights.y + weights.z;
    result.weights = weight_sum > 0.5f ? (1.0f / weight_sum) * weights
                                       : make_float3(1.0f / 3.0f, 1.0f / 3.0f, 1.0f / 3.0f);
    const float3 edge_ddx = pixel_size.x * make_float3(edge_a.x, edge_b.x, edge_c.x);
    const float3 edge_ddy = pixel_size.y * make_float3(edge_a.y, edge_b.y, edge_c.y);
    result.ddx = inverse_sum * (edge_ddx - (edge_ddx.x + edge_ddx.y + edge_ddx.z) * result.weights);
    result.ddy = inverse_sum * (edge_ddy - (edge_ddy.x + edge_ddy.y + edge_ddy.z) * result.weights);
    return result;
}

__device__ inline float tone_map(const ViewLight& light, float radiance) {
    radiance *= light.exposure;
    if (!(radiance > 0.0f)) {
        return 0.0f; // NaN, too
    }
    if (light.tone == TONE_REINHARD) {
        return 1.0f - 1.0f / (1.0f + radiance);
    }
    if (light.tone == TONE_ACES) {
        radiance = fminf(radiance, MAX_RADIANCE);
        return fminf(radiance * (2.51f * radiance + 0.03f) / (radiance * (2.43f * radiance + 0.59f) + 0.14f), 1.0f);
    }
    return fminf(radiance, 1.0f);
}

// Rounds to f16, the format of the renderer's color image.
__device__ inline float round_to_half(float value) {
    float rounded;
    asm("{\n.reg .b16 half;\ncvt.rn.f16.f32 half, %1;\ncvt.f32.f16 %0, half;\n}" : "=f"(rounded) : "f"(value));
    return rounded;
}

// Threshold of ordered dithering in output levels; `x` and `y` count from the bottom left pixel. See
// shaders/encode_srgb.comp.
__device__ inline float bayer_threshold(unsigned x, unsigned y) {
    x ^= y;
    const unsigned rank = (x & 1) << 5 | (y & 1) << 4 | (x & 2) << 2 | (y & 2) << 1 | (x & 4) >> 1 | (y & 4) >> 2;
    return ((float)rank - 31.5f) / 64.0f;
}

// sRGB byte of a channel after the tone curve (IEC 61966-2-1). `threshold`: added to the encoded value, in levels.
__device__ inline unsigned encode_srgb(float linear, float threshold) {
    linear = round_to_half(linear);
    const float encoded = linear <= 0.0031308f ? 12.92f * linear
                                               : 1.055f * __powf(fmaxf(linear, 1e-6f), 1.0f / 2.4f) - 0.055f;
    return __float2uint_rn(255.0f * clamp01(encoded + threshold / 255.0f));
}
