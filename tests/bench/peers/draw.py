"""A plain moderngl program that draws the scene of mesh.py with a shadow map and one forward pass.

Camera, light and map size come from times.json of `modalcast report render --scene`. For each shadow method, the program
writes an image to the same folder, and the times to peer.json. Times are wall-clock times of a frame with its pixels in host
memory. The program times as many frames as modalcast.
"""

import json
import sys
import time
from pathlib import Path

import moderngl
import numpy as np

from mesh import build_mesh, cloth_image, write_png

BLUR_RADIUS = 5  # texels on each side of the center: over three times the standard deviation of 1.5 texels in modalcast

DEPTH = """#version 430
uniform mat4 map_from_world; in vec3 position;
void main() { gl_Position = map_from_world * vec4(position, 1.0); }"""
EMPTY = "#version 430\nvoid main() {}"
# Moments of the depth relative to 0.5, which lose less precision than those of the depth itself.
MOMENTS = "#version 430\nout vec2 moments; void main() { float m = gl_FragCoord.z - 0.5; moments = vec2(m, m * m); }"
FULL_SCREEN = """#version 430
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0); }"""
BLUR = """#version 430
uniform sampler2D source; uniform ivec2 direction; uniform float weights[%d]; out vec2 sum;
void main() {
    sum = vec2(0.0);
    ivec2 last = textureSize(source, 0) - 1;
    for (int tap = -%d; tap <= %d; tap++)
        sum += weights[tap + %d] * texelFetch(source, clamp(ivec2(gl_FragCoord.xy) + tap * direction, ivec2(0), last), 0).rg;
}""" % (2 * BLUR_RADIUS + 1, BLUR_RADIUS, BLUR_RADIUS, BLUR_RADIUS)
VERTEX = """#version 430
uniform mat4 clip_from_world;
in vec3 position; in vec3 normal; in vec2 uv;
out vec3 world; out vec3 surface_normal; centroid out vec2 texture_uv;
void main() { world = position; surface_normal = normal; texture_uv = uv; gl_Position = clip_from_world * vec4(position, 1.0); }"""
# Phong shading with the material of mesh.mtl (Ks 0.2, Ns 24). %s is replaced by an entry of SUN_VISIBILITY. The comments
# there explain `limits`.
FRAGMENT = """#version 430
uniform mat4 map_from_world; uniform vec3 eye, to_sun, sunlight, skylight; uniform vec4 limits;
uniform sampler2D cloth;
in vec3 world; in vec3 surface_normal; centroid in vec2 texture_uv; out vec4 color;
%s
float srgb(float c) { return c <= 0.0031308 ? 12.92 * c : 1.055 * pow(c, 1.0 / 2.4) - 0.055; }
void main() {
    vec3 n = normalize(surface_normal) * (gl_FrontFacing ? 1.0 : -1.0);
    vec3 tint = texture(cloth, texture_uv).rgb, v = normalize(eye - world);
    vec3 map_position = 0.5 * (map_from_world * vec4(world, 1.0)).xyz + 0.5;
    float cosine = dot(n, to_sun);
    vec3 light = skylight * tint;
    if (cosine > 0.0) {
        float specular = max(dot(2.0 * dot(v, n) * n - v, to_sun), 0.0);
        light += sun_visibility(map_position, cosine) * sunlight * (cosine * tint + 0.2 * pow(specular, 24.0));
    }
    light = clamp(light, 0.0, 1.0);
    color = vec4(srgb(light.r), srgb(light.g), srgb(light.b), 1.0);
}"""
SUN_VISIBILITY = {
    # Nine comparisons, each filtered between four texels by the sampler. The bias against shadow acne has a constant and a
    # slope-scaled part, both in texels. `limits.x` is the width of a texel in units of depth.
    "filtered": """uniform sampler2DShadow map;
float sun_visibility(vec3 map_position, float cosine) {
    float slope = sqrt(1.0 - cosine * cosine) / max(cosine, 0.1), sum = 0.0;
    vec2 texel = 1.0 / vec2(textureSize(map, 0));
    map_position.z -= limits.x * (1.5 + 2.0 * slope);
    for (int y = -1; y <= 1; y++) for (int x = -1; x <= 1; x++) sum += texture(map, map_position + vec3(vec2(x, y) * texel, 0.0));
    return sum / 9.0;
}""",
    # Chebyshev's bound, with the minimum variance (`limits.y`) and the light bleeding reduction (`limits.z`) of modalcast.
    "variance": """uniform sampler2D map;
float sun_visibility(vec3 map_position, float cosine) {
    vec2 moments = texture(map, map_position.xy).rg;
    float depth_difference = map_position.z - 0.5 - moments.x;
    if (depth_difference <= 0.0) return 1.0;
    float variance = max(moments.y - moments.x * moments.x, limits.y);
    return clamp((variance / (variance + depth_difference * depth_difference) - limits.z) / (1.0 - limits.z), 0.0, 1.0);
}""",
}


def light_box(points, to_sun, size):
    """An orthographic matrix whose box contains all points, and the width of a texel as a fraction of the box's depth.

    `size` is the width of the shadow map in texels.
    """
    z = to_sun / np.linalg.norm(to_sun)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    axes = np.stack([x, np.cross(z, x), -z])
    light_points = points @ axes.T
    low, high = light_points.min(0) - 1e-3, light_points.max(0) + 1e-3
    matrix = np.eye(4)
    matrix[:3, :3] = axes * (2 / (high - low))[:, None]
    matrix[:3, 3] = -(high + low) / (high - low)
    return matrix, (high - low)[:2].max() / size / (high - low)[2]


def srgb(color):
    """The sRGB encoding of a linear color."""
    return [12.92 * c if c <= 0.0031308 else 1.055 * c ** (1 / 2.4) - 0.055 for c in color]


class Peer:
    """The shader programs, buffers and textures for one shadow method."""

    def __init__(self, gl, size, scene):
        self.gl, self.size, self.method = gl, size, scene["look"]["shadow"]["method"]
        look, shadow = scene["look"], scene["look"]["shadow"]
        points, normals, uvs, triangles = build_mesh()
        box, texel = light_box(points, np.array(scene["to_sun"]), shadow["size"])
        self.clear = srgb(look["horizon"])
        index = gl.buffer(triangles.astype("u4").tobytes())
        position = gl.buffer(points.astype("f4").tobytes())
        attributes = gl.buffer(np.concatenate([normals, uvs], axis=1).astype("f4").tobytes())
        variance = self.method == "variance"
        depth = gl.program(vertex_shader=DEPTH, fragment_shader=MOMENTS if variance else EMPTY)
        paint = gl.program(vertex_shader=VERTEX, fragment_shader=FRAGMENT % SUN_VISIBILITY[self.method])
        self.casters = gl.vertex_array(depth, [(position, "3f", "position")], index)
        self.surfaces = gl.vertex_array(paint, [(position, "3f", "position"), (attributes, "3f 2f", "normal", "uv")], index)
        map_size = (shadow["size"], shadow["size"])
        self.depth = gl.depth_texture(map_size)
        self.depth.compare_func, self.depth.repeat_x, self.depth.repeat_y = "<=", False, False
        self.depth.filter = (moderngl.LINEAR, moderngl.LINEAR)
        self.blur_target, self.map = None, self.depth
        if variance:
            self.map, self.blur_target = gl.texture(map_size, 2, dtype="f4"), gl.texture(map_size, 2, dtype="f4")
            self.map.repeat_x = self.map.repeat_y = False
            # Targets of the shadow map, of its horizontal blur and of its vertical blur.
            self.framebuffers = [gl.framebuffer([self.map], self.depth), gl.framebuffer([self.blur_target]), gl.framebuffer([self.map])]
            weights = np.exp(-0.5 * (np.arange(-BLUR_RADIUS, BLUR_RADIUS + 1) / shadow["blur"]) ** 2)
            self.blur = gl.program(vertex_shader=FULL_SCREEN, fragment_shader=BLUR)
            self.blur["weights"] = list(weights / weights.sum())
            self.full_screen = gl.vertex_array(self.blur, [])
        else:
            self.framebuffers = [gl.framebuffer(depth_attachment=self.depth)]
        cloth = cloth_image()
        # 0x8C41 is GL_SRGB8.
        self.cloth = gl.texture(cloth.shape[1::-1], 3, cloth.tobytes(), alignment=1, internal_format=0x8C41)
        self.cloth.build_mipmaps()
        self.cloth.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        samples = scene["samples"]
        self.frame = gl.framebuffer([gl.renderbuffer(size, 4, samples=samples)], gl.depth_renderbuffer(size, samples=samples))
        self.resolved = gl.framebuffer([gl.renderbuffer(size, 4)])
        column_major = lambda matrix: tuple(matrix.T.ravel())
        depth["map_from_world"].value = column_major(box)
        # Width of a texel in units of depth, minimum variance, light bleeding reduction, unused.
        limits = (texel, max(shadow["least_variance"], 1e-6), shadow["bleeding"], 0.0)
        # Both matrices are in column-major order.
        uniforms = {
            "clip_from_world": tuple(scene["clip_from_world"]), "map_from_world": column_major(box), "eye": scene["eye"],
            "to_sun": scene["to_sun"], "sunlight": look["sunlight"], "skylight": look["skylight"],
            "limits": limits, "cloth": 0, "map": 1,
        }
        for name, value in uniforms.items():
            if name in paint:
                paint[name].value = tuple(value) if isinstance(value, (list, tuple)) else value

    def draw(self):
        """Draws one frame. Its pixels stay on the device."""
        gl = self.gl
        gl.enable_only(moderngl.DEPTH_TEST)
        self.framebuffers[0].use()
        # The moments of the far plane: 1 - 0.5, and its square.
        self.framebuffers[0].clear(0.5, 0.25, depth=1.0)
        self.casters.render()
        if self.blur_target:
            gl.enable_only(moderngl.NOTHING)
            passes = [(self.framebuffers[1], self.map, (1, 0)), (self.framebuffers[2], self.blur_target, (0, 1))]
            for framebuffer, source, direction in passes:
                framebuffer.use()
                source.use(0)
                self.blur["direction"].value = direction
                self.full_screen.render(vertices=3)
            gl.enable_only(moderngl.DEPTH_TEST)
        self.frame.use()
        self.frame.clear(*self.clear, depth=1.0)
        self.cloth.use(0)
        self.map.use(1)
        self.surfaces.render()
        gl.copy_framebuffer(self.resolved, self.frame)

    def pixels(self):
        """Reads the RGBA pixels of the last frame, bottom row first."""
        return self.resolved.read(components=4, alignment=1)


def quartiles(times):
    """Median and quartiles of times in microseconds."""
    q1, median, q3 = np.percentile(times, [25, 50, 75])
    return {"median_us": median, "q1_us": q1, "q3_us": q3, "replays": len(times)}


def measure(peer, replays):
    """Times frames with their pixels in host memory, after three frames that are not timed."""
    times = []
    for _ in range(3):
        peer.draw()
        peer.gl.finish()
    for _ in range(replays):
        begin = time.perf_counter()
        peer.draw()
        peer.pixels()
        times.append(1e6 * (time.perf_counter() - begin))
    return quartiles(times)


def main(folder):
    folder = Path(folder)
    request = json.loads((folder / "times.json").read_text())
    size = (request["size"]["width"], request["size"]["height"])
    gl = moderngl.create_context(standalone=True, backend="egl", require=430)
    results = {"renderer": gl.info["GL_RENDERER"], "moderngl": moderngl.__version__, "scenes": {}}
    for scene in request["scenes"]:
        peer = Peer(gl, size, scene)
        results["scenes"][scene["name"]] = {"whole": measure(peer, scene["whole"]["replays"])}
        rgba = np.frombuffer(peer.pixels(), np.uint8).reshape(size[1], size[0], 4)
        write_png(folder / f"{scene['name']}-peer.png", rgba[::-1, :, :3])
    (folder / "peer.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main(sys.argv[1])
