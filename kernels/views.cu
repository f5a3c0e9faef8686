// Draws many small views in one launch: each is a picture of one world (a copy of the scene's vertices) by one camera,
// with one sample per pixel. A block draws a tile: a strip of rows of a view. It finds the visible triangle of each
// pixel in shared memory, with the rules of raster.cu, and then shades the pixels of the strip.
//   views       [views] View                                                                                (in)
//   cameras     [cameras] ViewCamera                                                                        (in)
//   positions   [worlds][vertices][3] f32; normals [worlds][corners][3] f32; tangents [worlds][corners] float4 (in)
//   triangle_vertices, triangle_corners [triangles][3] u32; triangle_materials, triangle_domains [triangles] u32 (in)
//   chunks      [chunks] TriangleChunk; materials [materials] ViewMaterial; uvs [corners][2] f32             (in)
//   boxes       [worlds][chunks][6] f32: minimum and maximum of the positions of each chunk. `bound_chunks` writes
//               them, `views` culls with them. 0: nothing is culled                                     (out, in)
//   color       [views][height][width][3] u8 sRGB, top row first; 0: no such output                         (out)
//   depth       [views][height][width] f32 along the view axis times `depth_scale`; infinite without surface (out)
//   domains     [views][height][width] i32: domain of the visible triangle, or -1                           (out)
//   out_normals [views][height][width][3] f32: unit normal of the visible side, or zeros                    (out)
// Macros:
//   CUT_OUTS     triangles from `first_cut_out` on pass an alpha test (cut_out.cuh)
//   TEXTURES     some material has a color image
//   NORMAL_MAPS  some material has a normal map
// Launch: BLOCK threads per block. `views` has `tiles_per_view` blocks per view, and 8 bytes of dynamic shared memory
// per pixel of a tile. `bound_chunks` has a warp per chunk of each world. CPU twin: ReferenceViewRenderer::draw.
// ReferenceViewRenderer is in src/compute/reference/views.rs.
#include "cut_out.cuh"
#include "raster_setup.cuh"
#include "view_shading.cuh"

// On an H200, 256 threads and four resident blocks per multiprocessor are fastest, although some registers spill.
constexpr unsigned BLOCK = 256, MIN_BLOCKS_PER_SM = 4;
constexpr unsigned ALL_LANES = 0xffffffffu;
constexpr unsigned long long EMPTY_KEY = ~0ull;

struct View {
    unsigned camera, world;
};

// Up to 32 consecutive triangles of one cull mode, either all or none of them cut-outs. They are culled together.
struct TriangleChunk {
    unsigned first_triangle, triangle_count, culls_back_faces, pad;
};

// Twin: src/compute/gpu/executor/views.rs.
struct ViewsArgs {
    const View* views;
    const ViewCamera* cameras;
    const float *positions, *normals;
    const float4* tangents;
    float* boxes;
    const unsigned *triangle_vertices, *triangle_corners, *triangle_materials, *triangle_domains;
    const TriangleChunk* chunks;
    const ViewMaterial* materials;
    const float2* uvs;
    unsigned long long cut_out_uvs, cut_out_materials, alpha_materials; // with CUT_OUTS, as in raster.cuh
    unsigned char* color;
    float* depth;
    int* domains;
    float* out_normals;
    unsigned vertex_count, corner_count, chunk_count, world_count;
    unsigned chunks_per_turn;               // number of chunks that a warp culls at once, 1 to 32
    unsigned width, height, tile_height, tiles_per_view;
    unsigned first_cut_out;                 // with CUT_OUTS
    float guard_x, guard_y, depth_scale;
    unsigned depth_includes_ground;         // 1: the depth of the ground where no triangle is visible
    ViewLight light;
};

// A strip of a view. In shared memory.
struct Tile {
    RasterArgs window; // of the whole view
    ViewCamera camera;
    int first_row, row_count;
    unsigned world;
    unsigned next_chunk;
};

extern __shared__ unsigned long long keys[]; // [row_count][width] of the tile: ~depth << 32 | triangle

// Whether the box of a chunk has a part in the view volume of the tile. All tests are conservative: the margin exceeds
// the rounding errors of clip coordinates.
__device__ inline bool is_box_visible(const Tile& tile, const float* box) {
    const float3 low = make_float3(box[0], box[1], box[2]), high = make_float3(box[3], box[4], box[5]);
    const float3 center = 0.5f * (low + high), extent = 0.5f * (high - low);
    const float* m = tile.window.clip_from_position;
    const float height = (float)tile.window.height;
    // The rows of the tile in normalized device coordinates.
    const float top = 1.0f - 2.0f * (float)tile.first_row / height;
    const float bottom = 1.0f - 2.0f * (float)(tile.first_row + tile.row_count) / height;
    // Whether the box is inside of a plane, in part: sign * row + factor * w is at least 0.
    const auto is_inside = [&](const float* row, float sign, float factor) {
        const float3 normal = make_float3(sign * row[0] + factor * m[12], sign * row[1] + factor * m[13],
                                          sign * row[2] + factor * m[14]);
        const float offset = sign * row[3] + factor * m[15];
        const float3 magnitudes = make_float3(fabsf(normal.x), fabsf(normal.y), fabsf(normal.z));
        const float reach = dot(magnitudes, extent);
        const float3 distances = make_float3(fabsf(center.x), fabsf(center.y), fabsf(center.z));
        const float margin = 1e-5f * (dot(magnitudes, distances) + reach + fabsf(offset));
        // A box that is not finite is inside.
        return !(dot(normal, center) + offset + reach < -margin);
    };
    return is_inside(m, 1.0f, 1.0f) && is_inside(m, -1.0f, 1.0f) && is_inside(m + 4, 1.0f, -bottom) &&
           is_inside(m + 4, -1.0f, top) && is_inside(m + 8, -1.0f, 1.0f);
}

template <typename AlphaTestPolicy, typename Setup>
__device__ inline void draw_sample(const Tile& tile, const AlphaTestPolicy& alpha_test, const Setup& setup, int column,
                                   int row, unsigned triangle) {
    float depth;
    if (!setup.covers(column, row, depth)) {
        return;
    }
    const unsigned long long key = (unsigned long long)~__float_as_uint(depth) << 32 | triangle;
    unsigned long long* target = keys + (row - tile.first_row) * tile.window.width + column;
    // The plain read may be stale, but keys only decrease.
    if (key < *(volatile unsigned long long*)target && alpha_test.passes_alpha_test(tile.window, column, row)) {
        atomicMin(target, key);
    }
}

// Draws the samples of a rectangle with a warp, which tests 8 x 4 samples at a time.
template <typename AlphaTestPolicy, typename Setup>
__device__ inline void draw_rect(const Tile& tile, const AlphaTestPolicy& alpha_test, const Setup& setup,
                                 const PixelRect& rect, unsigned triangle) {
    const int lane = (int)threadIdx.x % 32;
    for (int row = rect.y0 + lane / 8; row <= rect.y1; row += 4) {
        for (int column = rect.x0 + lane % 8; column <= rect.x1; column += 8) {
            draw_sample(tile, alpha_test, setup, column, row, triangle);
        }
    }
}

// The rectangle of the rows of a tile.
__device__ inline PixelRect tile_rect(const Tile& tile) {
    return {0, tile.first_row, (int)tile.window.width - 1, tile.first_row + tile.row_count - 1};
}

// Draws an unclipped triangle of at most 64 x 64 pixels with a warp.
template <typename AlphaTestPolicy>
__device__ inline void draw_medium(const Tile& tile, unsigned triangle) {
    float4 corners[3];
    load_triangle(tile.window, triangle, corners);
    BinnedTriangle binned;
    setup_unclipped(tile.window, false, corners, binned);
    const TriangleSetup<int> setup(binned.a, binned.b, binned.c, binned.is_flipped, (int)binned.doubled_area);
    const AlphaTestPolicy alpha_test(tile.window, triangle);
    draw_rect(tile, alpha_test, setup, intersect_rects(binned.rect, tile_rect(tile)), triangle);
}

// Draws any other triangle with a warp. Not inlined, because few triangles are large or clipped.
template <typename AlphaTestPolicy>
__device__ __noinline__ void draw_large(const Tile& tile, unsigned triangle) {
    ClippedPolygon polygon;
    load_clipped_polygon(tile.window, triangle, polygon);
    const PixelRect rect = intersect_rects(pixel_rect(tile.window, polygon), tile_rect(tile));
    const AlphaTestPolicy alpha_test(tile.window, triangle);
    const bool is_flipped = doubled_area(polygon) < 0;
    for (unsigned i = 1; i + 1 < polygon.count; ++i) {
        const SnappedVertex &a = polygon.corners[0], &b = polygon.corners[i], &c = polygon.corners[i + 1];
        const long long signed_area = doubled_area(a, b, c), triangle_area = is_flipped ? -signed_area : signed_area;
        if (triangle_area > 0) {
            draw_rect(tile, alpha_test, TriangleSetup<long long>(a, b, c, is_flipped, triangle_area), rect, triangle);
        }
    }
}

// Draws the triangles of a chunk with a warp: a lane draws a small triangle, the warp the others.
template <typename AlphaTestPolicy>
__device__ inline void draw_triangles(const Tile& tile, const TriangleChunk& chunk) {
    const unsigned lane = threadIdx.x % 32, triangle = chunk.first_triangle + lane;
    BinnedTriangle binned;
    binned.bin = NO_BIN;
    if (lane < chunk.triangle_count) {
        classify_triangle(tile.window, triangle, chunk.culls_back_faces == 1, binned);
        binned.rect = intersect_rects(binned.rect, tile_rect(tile));
        if (binned.bin <= LARGE && is_empty(binned.rect)) {
            binned.bin = NO_SAMPLE;
        }
    }
    if (binned.bin == SMALL) {
        const TriangleSetup<int> setup(binned.a, binned.b, binned.c, binned.is_flipped, (int)binned.doubled_area);
        const AlphaTestPolicy alpha_test(tile.window, triangle);
        for (int row = binned.rect.y0; row <= binned.rect.y1; ++row) {
            for (int column = binned.rect.x0; column <= binned.rect.x1; ++column) {
                draw_sample(tile, alpha_test, setup, column, row, triangle);
            }
        }
    }
    __syncwarp();
    const unsigned large_lanes = __ballot_sync(ALL_LANES, binned.bin == LARGE);
    unsigned warp_lanes = large_lanes | __ballot_sync(ALL_LANES, binned.bin == MEDIUM);
    while (warp_lanes != 0) {
        const unsigned source = __ffs(warp_lanes) - 1;
        warp_lanes &= warp_lanes - 1;
        if (large_lanes >> source & 1) {
            draw_large<AlphaTestPolicy>(tile, chunk.first_triangle + source);
        } else {
            draw_medium<AlphaTestPolicy>(tile, chunk.first_triangle + source);
        }
    }
}

__device__ inline TriangleChunk load_chunk(const ViewsArgs& args, unsigned chunk) {
    const uint4 words = __ldg((const uint4*)args.chunks + chunk);
    return {words.x, words.y, words.z, words.w};
}

// Draws all chunks. Each warp takes the next chunks, culls them with a lane per chunk, and draws the others.
__device__ inline void draw_chunks(const ViewsArgs& args, Tile& tile) {
    const unsigned lane = threadIdx.x % 32;
    const float* boxes = args.boxes + 6 * (size_t)tile.world * args.chunk_count;
    for (;;) {
        unsigned first = 0;
        if (lane == 0) {
            first = atomicAdd(&tile.next_chunk, args.chunks_per_turn);
        }
        first = __shfl_sync(ALL_LANES, first, 0);
        if (first >= args.chunk_count) {
            return;
        }
        bool is_visible = lane < args.chunks_per_turn && first + lane < args.chunk_count;
        if (is_visible && args.boxes != nullptr) {
            is_visible = is_box_visible(tile, boxes + 6 * (size_t)(first + lane));
        }
        unsigned visible_lanes = __ballot_sync(ALL_LANES, is_visible);
        while (visible_lanes != 0) {
            const TriangleChunk chunk = load_chunk(args, first + __ffs(visible_lanes) - 1);
            visible_lanes &= visible_lanes - 1;
#ifdef CUT_OUTS
            if (chunk.first_triangle >= args.first_cut_out) {
                draw_triangles<AlphaTest>(tile, chunk);
                continue;
            }
#endif
            draw_triangles<OpaqueTest>(tile, chunk);
        }
    }
}

struct SurfacePoint {
    Barycentrics bary;
    float3 world, normal; // normal: of the front side, not normalized
    float depth;          // along the view axis
    unsigned corners[3];
};

__device__ inline float3 load_float3(const float* list, size_t index) {
    const float* v = list + 3 * index;
    return make_float3(__ldg(v), __ldg(v + 1), __ldg(v + 2));
}

__device__ inline SurfacePoint interpolate_surface(const ViewsArgs& args, const Tile& tile, unsigned triangle,
                                                   float2 ndc, float2 pixel_size) {
    float3 world[3], clip[3];
    SurfacePoint surface;
    const float* m = tile.camera.clip_from_world;
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        const unsigned vertex = __ldg(args.triangle_vertices + 3 * (size_t)triangle + i);
        world[i] = load_float3((const float*)tile.window.positions, vertex);
        const float3 p = world[i];
        const float w = m[12] * p.x + m[13] * p.y + m[14] * p.z + m[15];
        clip[i] = make_float3(m[0] * p.x + m[1] * p.y + m[2] * p.z + m[3] - ndc.x * w,
                              m[4] * p.x + m[5] * p.y + m[6] * p.z + m[7] - ndc.y * w, w);
    }
    surface.bary = compute_barycentrics(clip[0], clip[1], clip[2], pixel_size);
    const float3 weights = surface.bary.weights;
    const float* normals = args.normals + 3 * (size_t)tile.world * args.corner_count;
    float3 normal[3];
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        surface.corners[i] = __ldg(args.triangle_corners + 3 * (size_t)triangle + i);
        normal[i] = load_float3(normals, surface.corners[i]);
    }
    surface.world = weights.x * world[0] + weights.y * world[1] + weights.z * world[2];
    surface.normal = weights.x * normal[0] + weights.y * normal[1] + weights.z * normal[2];
    surface.depth = weights.x * clip[0].z + weights.y * clip[1].z + weights.z * clip[2].z;
    return surface;
}

#ifdef TEXTURES
struct ImagePoint {
    float2 uv, ddx, ddy;
};

__device__ inline float2 finite_or_zero(float2 slope) {
    return isfinite(slope.x) && isfinite(slope.y) ? slope : make_float2(0.0f, 0.0f);
}

__device__ inline ImagePoint image_point(const ViewsArgs& args, const SurfacePoint& surface) {
    float2 uvs[3];
    for (int i = 0; i < 3; ++i) {
        uvs[i] = __ldg(args.uvs + surface.corners[i]);
    }
    const auto weighted_sum = [&](const float3& w) {
        return make_float2(w.x * uvs[0].x + w.y * uvs[1].x + w.z * uvs[2].x,
                           w.x * uvs[0].y + w.y * uvs[1].y + w.z * uvs[2].y);
    };
    return {weighted_sum(surface.bary.weights), finite_or_zero(weighted_sum(surface.bary.ddx)),
            finite_or_zero(weighted_sum(surface.bary.ddy))};
}

__device__ inline float4 texel_at(unsigned long long image, const ImagePoint& point) {
    return tex2DGrad<float4>((cudaTextureObject_t)image, point.uv.x, point.uv.y, point.ddx, point.ddy);
}
#endif

#ifdef NORMAL_MAPS
__device__ inline float3 apply_normal_map(const float3& normal, const float4& raw_tangent, const float4& texel) {
    const float3 raw = make_float3(raw_tangent.x, raw_tangent.y, raw_tangent.z);
    if (!(dot(raw, raw) > 0.0f)) {
        return normal;
    }
    const float3 tangent = safe_normalize(raw - dot(normal, raw) * normal);
    const float3 bitangent = (raw_tangent.w < 0.0f ? -1.0f : 1.0f) * cross(normal, tangent);
    const auto component = [](float value) { return (value * 255.0f - 128.0f) / 127.0f; };
    return safe_normalize(component(texel.x) * tangent + component(texel.y) * bitangent + component(texel.z) * normal);
}
#endif

__device__ inline float3 shade_triangle(const ViewsArgs& args, const Tile& tile, unsigned triangle,
                                        const SurfacePoint& surface) {
    const ViewMaterial& material = args.materials[__ldg(args.triangle_materials + triangle)];
    float3 normal = safe_normalize(surface.normal), tint = make_float3(1.0f, 1.0f, 1.0f);
#ifdef TEXTURES
    const ImagePoint point = image_point(args, surface);
    if (material.color_image != 0) {
        const float4 texel = texel_at(material.color_image, point);
        tint = make_float3(texel.x, texel.y, texel.z);
    }
#ifdef NORMAL_MAPS
    if (material.normal_image != 0) {
        const float4* tangents = args.tangents + (size_t)tile.world * args.corner_count;
        const float4 a = __ldg(tangents + surface.corners[0]), b = __ldg(tangents + surface.corners[1]),
                     c = __ldg(tangents + surface.corners[2]);
        const float3 w = surface.bary.weights;
        const float4 tangent = make_float4(w.x * a.x + w.y * b.x + w.z * c.x, w.x * a.y + w.y * b.y + w.z * c.y,
                                           w.x * a.z + w.y * b.z + w.z * c.z, w.x * a.w + w.y * b.w + w.z * c.w);
        normal = apply_normal_map(normal, tangent, texel_at(material.normal_image, point));
    }
#endif
#endif
    normal = (surface.bary.is_front_facing ? 1.0f : -1.0f) * normal;
    return phong(args.light, tile.camera, material, tint, normal, surface.world);
}

// Divides by the largest component first. 0 for vectors that are 0 or not finite.
__device__ inline float3 normalize_or_zero(const float3& v) {
    const float largest = fmaxf(fmaxf(fabsf(v.x), fabsf(v.y)), fabsf(v.z));
    if (!(largest > 0.0f && largest <= 0x1.fffffep127f)) {
        return make_float3(0.0f, 0.0f, 0.0f);
    }
    const float3 scaled = (1.0f / largest) * v;
    return rsqrtf(dot(scaled, scaled)) * scaled;
}

// Writes all outputs of a pixel except its color, which it returns as sRGB bytes in a word.
__device__ inline unsigned shade_pixel(const ViewsArgs& args, const Tile& tile, int column, int row,
                                       size_t output_index, unsigned long long key) {
    const float2 pixel_size = make_float2(2.0f / (float)args.width, 2.0f / (float)args.height);
    const unsigned row_from_bottom = args.height - 1 - row;
    const float2 ndc = make_float2(((float)column + 0.5f) * pixel_size.x - 1.0f,
                                   ((float)row_from_bottom + 0.5f) * pixel_size.y - 1.0f);
    const bool is_empty_pixel = key == EMPTY_KEY;
    const unsigned triangle = (unsigned)key;
    float3 color = make_float3(0.0f, 0.0f, 0.0f), normal = color;
    float depth = __int_as_float(0x7f800000);
    if (is_empty_pixel) {
        if (args.color != nullptr) {
            color = shade_background(args.light, tile.camera, ndc);
        }
        const float3 direction = view_ray(tile.camera, ndc);
        if (args.depth_includes_ground && ray_hits_ground(args.light, tile.camera, direction)) {
            depth = ground_ray_depth(args.light, tile.camera, direction);
        }
    } else {
        const SurfacePoint surface = interpolate_surface(args, tile, triangle, ndc, pixel_size);
        if (args.color != nullptr) {
            color = shade_triangle(args, tile, triangle, surface);
        }
        normal = normalize_or_zero((surface.bary.is_front_facing ? 1.0f : -1.0f) * surface.normal);
        depth = surface.depth;
    }
    if (args.depth != nullptr) {
        args.depth[output_index] = args.depth_scale * depth;
    }
    if (args.domains != nullptr) {
        args.domains[output_index] = is_empty_pixel ? -1 : (int)__ldg(args.triangle_domains + triangle);
    }
    if (args.out_normals != nullptr) {
        float* target = args.out_normals + 3 * output_index;
        target[0] = normal.x;
        target[1] = normal.y;
        target[2] = normal.z;
    }
    const float threshold = args.light.dithers ? bayer_threshold(column, row_from_bottom) : 0.0f;
    return encode_srgb(tone_map(args.light, color.x), threshold) |
           encode_srgb(tone_map(args.light, color.y), threshold) << 8 |
           encode_srgb(tone_map(args.light, color.z), threshold) << 16;
}

// Copies the colors of a tile, one word each in `keys`, to the output: whole words if the tile has a multiple of four
// pixels and starts at one, else bytes.
__device__ inline void store_colors(unsigned char* color, size_t first_pixel, unsigned pixel_count) {
    const unsigned* words = (const unsigned*)keys; // the color of pixel p is in word 2 p
    unsigned char* target = color + 3 * first_pixel;
    if (first_pixel % 4 != 0 || pixel_count % 4 != 0) {
        for (unsigned byte = threadIdx.x; byte < 3 * pixel_count; byte += BLOCK) {
            target[byte] = (unsigned char)(words[2 * (byte / 3)] >> 8 * (byte % 3));
        }
        return;
    }
    for (unsigned word = threadIdx.x; word < pixel_count / 4 * 3; word += BLOCK) {
        const unsigned pixel = word / 3 * 4 + word % 3, shift = 8 * (word % 3);
        ((unsigned*)target)[word] = words[2 * pixel] >> shift | words[2 * pixel + 2] << (24 - shift);
    }
}

// Loads the view of a tile with all threads of the block.
__device__ inline void load_tile(const ViewsArgs& args, const View& view, unsigned strip, Tile& tile) {
    constexpr unsigned CAMERA_WORDS = sizeof(ViewCamera) / 4;
    const unsigned* camera = (const unsigned*)(args.cameras + view.camera);
    if (threadIdx.x < CAMERA_WORDS) {
        ((unsigned*)&tile.camera)[threadIdx.x] = camera[threadIdx.x];
    }
    if (threadIdx.x < 16) {
        tile.window.clip_from_position[threadIdx.x] = __uint_as_float(camera[threadIdx.x]);
    }
    if (threadIdx.x == 0) {
        tile.first_row = strip * args.tile_height;
        tile.row_count = min(args.tile_height, args.height - tile.first_row);
        tile.world = view.world;
        tile.next_chunk = 0;
        RasterArgs& window = tile.window;
        window.positions = (unsigned long long)(args.positions + 3 * (size_t)view.world * args.vertex_count);
        window.triangles = (unsigned long long)args.triangle_vertices;
        window.uvs = args.cut_out_uvs;
        window.material_indices = args.cut_out_materials;
        window.materials = args.alpha_materials;
        window.half_width = 0.5f * (float)args.width;
        window.half_height = 0.5f * (float)args.height;
        window.guard_x = args.guard_x;
        window.guard_y = args.guard_y;
        window.width = args.width;
        window.height = args.height;
        window.first_cut_out = args.first_cut_out;
    }
}

extern "C" __global__ void __launch_bounds__(BLOCK, MIN_BLOCKS_PER_SM) views(const __grid_constant__ ViewsArgs args) {
    __shared__ Tile tile;
    const unsigned view = blockIdx.x / args.tiles_per_view, strip = blockIdx.x % args.tiles_per_view;
    load_tile(args, args.views[view], strip, tile);
    const unsigned max_pixels = args.tile_height * args.width;
    for (unsigned pixel = threadIdx.x; pixel < max_pixels; pixel += BLOCK) {
        keys[pixel] = EMPTY_KEY;
    }
    __syncthreads();
    draw_chunks(args, tile);
    __syncthreads();
    const unsigned pixel_count = tile.row_count * args.width;
    const size_t first_pixel = ((size_t)view * args.height + tile.first_row) * args.width;
    for (unsigned pixel = threadIdx.x; pixel < pixel_count; pixel += BLOCK) {
        const int row = tile.first_row + pixel / args.width, column = pixel % args.width;
        const unsigned color = shade_pixel(args, tile, column, row, first_pixel + pixel, keys[pixel]);
        ((unsigned*)keys)[2 * pixel] = color;
    }
    if (args.color != nullptr) {
        __syncthreads();
        store_colors(args.color, first_pixel, pixel_count);
    }
}

extern "C" __global__ void __launch_bounds__(BLOCK) bound_chunks(const __grid_constant__ ViewsArgs args) {
    const unsigned lane = threadIdx.x % 32;
    const size_t index = ((size_t)blockIdx.x * BLOCK + threadIdx.x) / 32;
    if (index >= (size_t)args.world_count * args.chunk_count) {
        return;
    }
    const TriangleChunk chunk = load_chunk(args, (unsigned)(index % args.chunk_count));
    const float* positions = args.positions + 3 * (index / args.chunk_count) * args.vertex_count;
    const float infinity = __int_as_float(0x7f800000);
    float low[3] = {infinity, infinity, infinity}, high[3] = {-infinity, -infinity, -infinity};
    for (unsigned corner = 0; corner < 3 && lane < chunk.triangle_count; ++corner) {
        const unsigned vertex = args.triangle_vertices[3 * (size_t)(chunk.first_triangle + lane) + corner];
        const float* position = positions + 3 * (size_t)vertex;
        for (unsigned axis = 0; axis < 3; ++axis) {
            low[axis] = fminf(low[axis], position[axis]);
            high[axis] = fmaxf(high[axis], position[axis]);
        }
    }
    for (unsigned axis = 0; axis < 3; ++axis) {
        for (unsigned offset = 16; offset > 0; offset /= 2) {
            low[axis] = fminf(low[axis], __shfl_xor_sync(ALL_LANES, low[axis], offset));
            high[axis] = fmaxf(high[axis], __shfl_xor_sync(ALL_LANES, high[axis], offset));
        }
    }
    if (lane < 3) {
        // A constant index keeps the arrays in registers.
        args.boxes[6 * index + lane] = lane == 0 ? low[0] : lane == 1 ? low[1] : low[2];
        args.boxes[6 * index + 3 + lane] = lane == 0 ? high[0] : lane == 1 ? high[1] : high[2];
    }
}
