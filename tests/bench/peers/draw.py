"""A plain moderngl program that draws the scene of mesh.py as one would write it: a shadow map, then one forward pass.

Reads times.json of `modalcast report render --scene`, takes camera, light and map size from it, and writes peer.json and
a picture beside it for each shadow method. Times are medians, by the wall clock around a frame and its pixels in host
memory, of as many frames as modalcast's.
"""

import json
import sys
import time
from pathlib import Path

import moderngl
import numpy as np

from mesh import image, mesh, png

REACH = 5  # texels to each side of the Gaussian of deviation 1.5, as modalcast's

DEPTH = """#version 430
uniform mat4 map_from_world; in vec3 position;
void main() { gl_Position = map_from_world * vec4(position, 1.0); }"""
NOTHING = "#version 430\nvoid main() {}"
MOMENTS = "#version 430\nout vec2 moments; void main() { float m = gl_FragCoord.z - 0.5; moments = vec2(m, m * m); }"
WHOLE = """#version 430
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0); }"""
BLUR = """#version 430
uniform sampler2D from; uniform ivec2 along; uniform float weights[%d]; out vec2 sum;
void main() {
    sum = vec2(0.0);
    ivec2 last = textureSize(from, 0) - 1;
    for (int tap = -%d; tap <= %d; tap++)
        sum += weights[tap + %d] * texelFetch(from, clamp(ivec2(gl_FragCoord.xy) + tap * along, ivec2(0), last), 0).rg;
}""" % (2 * REACH + 1, REACH, REACH, REACH)
VERTEX = """#version 430
uniform mat4 clip_from_world;
in vec3 position; in vec3 normal; in vec2 uv;
out vec3 world; out vec3 way; centroid out vec2 place;
void main() { world = position; way = normal; place = uv; gl_Position = clip_from_world * vec4(position, 1.0); }"""
FRAGMENT = """#version 430
uniform mat4 map_from_world; uniform vec3 eye, to_sun, sunlight, skylight; uniform vec4 limits;
uniform sampler2D cloth;
in vec3 world; in vec3 way; centroid in vec2 place; out vec4 colour;
%s
float srgb(float c) { return c <= 0.0031308 ? 12.92 * c : 1.055 * pow(c, 1.0 / 2.4) - 0.055; }
void main() {
    vec3 n = normalize(way) * (gl_FrontFacing ? 1.0 : -1.0);
    vec3 tint = texture(cloth, place).rgb, v = normalize(eye - world);
    vec3 at = 0.5 * (map_from_world * vec4(world, 1.0)).xyz + 0.5;
    float cosine = dot(n, to_sun);
    vec3 light = skylight * tint;
    if (cosine > 0.0) {
        float gleam = max(dot(2.0 * dot(v, n) * n - v, to_sun), 0.0);
        light += lit(at, cosine) * sunlight * (cosine * tint + 0.2 * pow(gleam, 24.0));
    }
    light = clamp(light, 0.0, 1.0);
    colour = vec4(srgb(light.r), srgb(light.g), srgb(light.b), 1.0);
}"""
LIT = {
    # Nine comparisons, each between four texels by the sampler; against acne a slope and a constant, of a texel's depth.
    "filtered": """uniform sampler2DShadow map;
float lit(vec3 at, float cosine) {
    float slope = sqrt(1.0 - cosine * cosine) / max(cosine, 0.1), sum = 0.0;
    vec2 texel = 1.0 / vec2(textureSize(map, 0));
    at.z -= limits.x * (1.5 + 2.0 * slope);
    for (int y = -1; y <= 1; y++) for (int x = -1; x <= 1; x++) sum += texture(map, at + vec3(vec2(x, y) * texel, 0.0));
    return sum / 9.0;
}""",
    # Chebyshev's bound with the same least variance and the same cut against bleeding as modalcast's.
    "variance": """uniform sampler2D map;
float lit(vec3 at, float cosine) {
    vec2 moments = texture(map, at.xy).rg;
    float beyond = at.z - 0.5 - moments.x;
    if (beyond <= 0.0) return 1.0;
    float variance = max(moments.y - moments.x * moments.x, limits.y);
    return clamp((variance / (variance + beyond * beyond) - limits.z) / (1.0 - limits.z), 0.0, 1.0);
}""",
}


def light_box(points, to_sun, size):
    """An orthographic matrix whose box holds all points, and the depth that one texel is wide."""
    z = to_sun / np.linalg.norm(to_sun)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    axes = np.stack([x, np.cross(z, x), -z])
    own = points @ axes.T
    low, high = own.min(0) - 1e-3, own.max(0) + 1e-3
    matrix = np.eye(4)
    matrix[:3, :3] = axes * (2 / (high - low))[:, None]
    matrix[:3, 3] = -(high + low) / (high - low)
    return matrix, (high - low)[:2].max() / size / (high - low)[2]


def srgb(colour):
    return [12.92 * c if c <= 0.0031308 else 1.055 * c ** (1 / 2.4) - 0.055 for c in colour]


class Peer:
    """All that is drawn with one shadow method."""

    def __init__(self, gl, size, scene):
        self.gl, self.size, self.method = gl, size, scene["look"]["shadow"]["method"]
        look, shadow = scene["look"], scene["look"]["shadow"]
        points, normals, uvs, triangles = mesh()
        box, texel = light_box(points, np.array(scene["to_sun"]), shadow["size"])
        clip = np.array(scene["clip_from_world"]).reshape(4, 4)
        self.clear = srgb(look["horizon"])
        index = gl.buffer(triangles.astype("u4").tobytes())
        position = gl.buffer(points.astype("f4").tobytes())
        rest = gl.buffer(np.concatenate([normals, uvs], axis=1).astype("f4").tobytes())
        variance = self.method == "variance"
        depth = gl.program(vertex_shader=DEPTH, fragment_shader=MOMENTS if variance else NOTHING)
        paint = gl.program(vertex_shader=VERTEX, fragment_shader=FRAGMENT % LIT[self.method])
        self.casters = gl.vertex_array(depth, [(position, "3f", "position")], index)
        self.seen = gl.vertex_array(paint, [(position, "3f", "position"), (rest, "3f 2f", "normal", "uv")], index)
        side = (shadow["size"], shadow["size"])
        self.depth = gl.depth_texture(side)
        self.depth.compare_func, self.depth.repeat_x, self.depth.repeat_y = "<=", False, False
        self.depth.filter = (moderngl.LINEAR, moderngl.LINEAR)
        self.half, self.map = None, self.depth
        if variance:
            self.map, self.half = gl.texture(side, 2, dtype="f4"), gl.texture(side, 2, dtype="f4")
            self.map.repeat_x = self.map.repeat_y = False
            self.into = [gl.framebuffer([self.map], self.depth), gl.framebuffer([self.half]), gl.framebuffer([self.map])]
            weights = np.exp(-0.5 * (np.arange(-REACH, REACH + 1) / shadow["blur"]) ** 2)
            self.blur = gl.program(vertex_shader=WHOLE, fragment_shader=BLUR)
            self.blur["weights"] = list(weights / weights.sum())
            self.whole = gl.vertex_array(self.blur, [])
        else:
            self.into = [gl.framebuffer(depth_attachment=self.depth)]
        cloth = image()
        self.cloth = gl.texture(cloth.shape[1::-1], 3, cloth.tobytes(), alignment=1, internal_format=0x8C41)
        self.cloth.build_mipmaps()
        self.cloth.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        samples = scene["samples"]
        self.frame = gl.framebuffer([gl.renderbuffer(size, 4, samples=samples)], gl.depth_renderbuffer(size, samples=samples))
        self.shown = gl.framebuffer([gl.renderbuffer(size, 4)])
        column = lambda matrix: tuple(matrix.T.ravel())
        depth["map_from_world"].value = column(box)
        limits = (texel, max(shadow["least_variance"], 1e-6), shadow["bleeding"], 0.0)
        given = {
            "clip_from_world": tuple(clip.ravel()), "map_from_world": column(box), "eye": scene["eye"],
            "to_sun": scene["to_sun"], "sunlight": look["sunlight"], "skylight": look["skylight"],
            "limits": limits, "cloth": 0, "map": 1,
        }
        for name, value in given.items():
            if name in paint:
                paint[name].value = tuple(value) if isinstance(value, (list, tuple)) else value

    def draw(self):
        """One frame; its pixels stay with the device."""
        gl = self.gl
        gl.enable_only(moderngl.DEPTH_TEST)
        self.into[0].use()
        self.into[0].clear(0.5, 0.25, depth=1.0)
        self.casters.render()
        if self.half:
            gl.enable_only(moderngl.NOTHING)
            for into, read, along in ((self.into[1], self.map, (1, 0)), (self.into[2], self.half, (0, 1))):
                into.use()
                read.use(0)
                self.blur["along"].value = along
                self.whole.render(vertices=3)
            gl.enable_only(moderngl.DEPTH_TEST)
        self.frame.use()
        self.frame.clear(*self.clear, depth=1.0)
        self.cloth.use(0)
        self.map.use(1)
        self.seen.render()
        gl.copy_framebuffer(self.shown, self.frame)

    def pixels(self):
        return self.shown.read(components=4, alignment=1)


def quartiles(times):
    q1, median, q3 = np.percentile(times, [25, 50, 75])
    return {"median_us": median, "q1_us": q1, "q3_us": q3, "replays": len(times)}


def measure(peer, replays):
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
    told = json.loads((folder / "times.json").read_text())
    size = (told["size"]["width"], told["size"]["height"])
    gl = moderngl.create_context(standalone=True, backend="egl", require=430)
    results = {"renderer": gl.info["GL_RENDERER"], "moderngl": moderngl.__version__, "scenes": {}}
    for scene in told["scenes"]:
        peer = Peer(gl, size, scene)
        results["scenes"][scene["name"]] = {"whole": measure(peer, scene["whole"]["replays"])}
        rgba = np.frombuffer(peer.pixels(), np.uint8).reshape(size[1], size[0], 4)
        png(folder / f"{scene['name']}-peer.png", rgba[::-1, :, :3])
    (folder / "peer.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main(sys.argv[1])
