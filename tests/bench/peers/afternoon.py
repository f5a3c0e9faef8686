"""A viewer and its sender as a user could write them in an afternoon, to compare their rates with those of modalcast.

    afternoon.py FOLDER VARIANT FRAMES      VARIANT: raw, png, png-pool or vertices
    afternoon.py FOLDER picture FILE        writes the picture of the first step as PNG

The program deforms with cupy, or with numpy if cupy or a GPU is missing, draws with moderngl, encodes with OpenCV and
sends every frame through ZeroMQ to a process of its own. `modalcast-report stream` writes the folder: scene.json, the
arrays that `Scene` reads, and the motion that modalcast-sim has recorded (q.npy, transforms.npy). The last line of the
output is JSON: frames per second at the receiver, bytes per frame, and the libraries in use.

It draws the same triangles, textures, light, ground, sky and samples as the default look of modalcast, with a shadow
map of the same kind and size. Simplifications, each of which saves it time:
- no normal maps; blended materials are drawn as opaque
- the shadow map is fitted to the rest bounds once, not to the vertices of each step
- samples are averaged after the sRGB encoding, not before
- images are not filtered anisotropically

The dependencies are binary wheels. For a machine without a network:
    pip download --only-binary :all: --dest wheels moderngl pyzmq opencv-python-headless numpy
"""

import json
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import moderngl
import numpy as np
import zmq

try:
    import cupy as xp

    xp.cuda.runtime.getDeviceCount()
except Exception:  # cupy raises errors of several kinds without a GPU
    xp = np

from draw import BLUR, BLUR_RADIUS, EMPTY, FULL_SCREEN, MOMENTS, SUN_VISIBILITY

CASTER = """#version 430
uniform mat4 map_from_world; in vec3 position; in vec2 uv; out vec2 texture_uv;
void main() { texture_uv = uv; gl_Position = map_from_world * vec4(position, 1.0); }"""
# Discards the holes of cut-out leaves. `cutoff` is 0 for other materials.
CUT_OUT = "uniform sampler2D image; uniform float cutoff; in vec2 texture_uv;"
DISCARD = "if (cutoff > 0.0 && texture(image, texture_uv).a < cutoff) discard;"
SURFACE = """#version 430
uniform mat4 clip_from_world; in vec3 position, normal; in vec2 uv; out vec3 world, surface_normal; out vec2 texture_uv;
void main() {
    world = position; surface_normal = normal; texture_uv = uv;
    gl_Position = clip_from_world * vec4(position, 1.0);
}"""
LIGHT = """#version 430
uniform mat4 map_from_world; uniform vec3 eye, to_sun, sunlight, skylight; uniform vec4 limits; out vec4 color;
%s
float visibility(vec3 world, float cosine) {
    vec3 map_position = 0.5 * (map_from_world * vec4(world, 1.0)).xyz + 0.5;
    bool is_inside = all(greaterThan(map_position.xy, vec2(0.0))) && all(lessThan(map_position.xy, vec2(1.0)));
    return is_inside ? sun_visibility(min(map_position, vec3(1.0)), cosine) : 1.0;
}
float srgb(float c) { return c <= 0.0031308 ? 12.92 * c : 1.055 * pow(c, 1.0 / 2.4) - 0.055; }
// OpenCV expects blue first.
void write(vec3 light) { light = clamp(light, 0.0, 1.0); color = vec4(srgb(light.b), srgb(light.g), srgb(light.r), 1.0); }
"""
SHADE = """uniform sampler2D image; uniform float cutoff; uniform vec3 ambient, diffuse, specular; uniform float shininess;
in vec3 world, surface_normal; in vec2 texture_uv;
void main() {
    vec4 texel = texture(image, texture_uv);
    if (cutoff > 0.0 && texel.a < cutoff) discard;
    vec3 n = normalize(surface_normal) * (gl_FrontFacing ? 1.0 : -1.0), v = normalize(eye - world);
    float cosine = dot(n, to_sun);
    vec3 light = skylight * ambient * texel.rgb;
    if (cosine > 0.0) {
        float highlight = max(dot(2.0 * dot(v, n) * n - v, to_sun), 0.0);
        vec3 reflectance = cosine * diffuse * texel.rgb + (highlight > 0.0 ? pow(highlight, shininess) : 0.0) * specular;
        light += visibility(world, cosine) * sunlight * reflectance;
    }
    write(light);
}"""
# The ground is a plane that fades into the horizon. `ground`: color and fade distance; the distance is 0 without one.
BACKGROUND = """uniform mat4 world_from_ray; uniform vec2 half_size; uniform vec3 up, zenith, horizon, ground_center;
uniform vec4 ground; uniform vec2 image_size;
void main() {
    vec2 ndc = 2.0 * gl_FragCoord.xy / image_size - 1.0;
    vec3 direction = mat3(world_from_ray) * vec3(ndc.x * half_size.x, -ndc.y * half_size.y, -1.0);
    float height = dot(eye - ground_center, up), descent = -dot(direction, up);
    if (ground.a > 0.0 && height > 0.0 && descent > 0.0) {
        vec3 point = eye + height / descent * direction, offset = point - ground_center;
        float cosine = max(dot(up, to_sun), 0.0);
        vec3 light = skylight + visibility(point, cosine) * cosine * sunlight;
        write(mix(horizon, light * ground.rgb, exp(-dot(offset, offset) / (ground.a * ground.a))));
    } else {
        float sine = max(dot(normalize(direction), up), 0.0);
        write(mix(horizon, zenith, 1.0 - exp(-6.0 * sine * sine / (sine + 0.06))));
    }
}"""


class Scene:
    """The arrays of a scene, and its motion: x = T (x0 + U q) for all vertices of all domains."""

    def __init__(self, folder):
        self.folder = Path(folder)
        self.settings = json.loads((self.folder / "scene.json").read_text())
        read = lambda name, kind, *shape: np.fromfile(self.folder / name, kind).reshape(shape)
        rank = self.settings["max_rank"]
        self.rest_positions = xp.asarray(read("rest_positions.f32", "<f4", -1, 3))
        self.modes = xp.asarray(read("modes.f32", "<f4", len(self.rest_positions), 3, rank)) if rank else None
        self.rest_normals = xp.asarray(read("rest_normals.f32", "<f4", -1, 3))
        self.uvs = read("uvs.f32", "<f4", -1, 2)
        self.corner_vertices = xp.asarray(read("corner_vertices.u32", "<u4", -1))
        self.domains = xp.asarray(read("vertex_domains.u32", "<u4", -1))
        self.corner_domains = self.domains[self.corner_vertices]
        self.indices = read("indices.u32", "<u4", -1)
        q, transforms = np.load(self.folder / "q.npy"), np.load(self.folder / "transforms.npy")
        # The coordinates of each domain, filled up with zeros to the largest rank. Column `q.shape[1]` is zero.
        columns = np.full((transforms.shape[1], rank), q.shape[1])
        for domain, (first, count) in enumerate(self.settings["coordinates"]):
            columns[domain, :count] = np.arange(first, first + count)
        self.q = xp.asarray(np.pad(q, ((0, 0), (0, 1)))[:, columns].astype("f4"))
        self.transforms = xp.asarray(transforms.reshape(len(transforms), -1, 3, 4).astype("f4"))

    def deform(self, step):
        """Positions of all vertices, and the linear parts of all transforms."""
        step %= len(self.transforms)
        transforms, local = self.transforms[step], self.rest_positions
        if self.modes is not None:
            local = local + xp.einsum("vcr,vr->vc", self.modes, self.q[step][self.domains])
        of_vertex = transforms[self.domains]
        return xp.einsum("vij,vj->vi", of_vertex[:, :, :3], local) + of_vertex[:, :, 3], transforms[:, :, :3]

    def corners(self, step):
        """Position and normal of each corner, six numbers each, in host memory."""
        positions, linear = self.deform(step)
        normals = xp.einsum("cij,cj->ci", linear[self.corner_domains], self.rest_normals)
        joined = xp.concatenate([positions[self.corner_vertices], normals], axis=1)
        return joined if xp is np else joined.get()


def look_at(eye, target, up):
    """camera_from_world."""
    z = np.subtract(eye, target) / np.linalg.norm(np.subtract(eye, target))
    x = np.cross(up, z) / np.linalg.norm(np.cross(up, z))
    matrix = np.eye(4)
    matrix[:3, :3] = [x, np.cross(z, x), z]
    matrix[:3, 3] = -matrix[:3, :3] @ np.array(eye)
    return matrix


def perspective(half_size, near, far):
    """Projects upside down, so that rows are read from top to bottom."""
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[1, 1] = 1 / half_size[0], -1 / half_size[1]
    matrix[2, 2:], matrix[3, 2] = [(far + near) / (near - far), 2 * far * near / (near - far)], -1
    return matrix


def light_matrix(to_sun, up, corners, ground):
    """Orthographic matrix around the rest bounds, a tenth larger, and down to their shadow on the ground."""
    z = np.array(to_sun)
    x = np.cross(up, z) / np.linalg.norm(np.cross(up, z))
    axes = np.stack([x, np.cross(z, x), -z])
    points = corners @ axes.T
    low, high = points.min(0), points.max(0)
    low, high = low - 0.05 * (high - low), high + 0.05 * (high - low)
    if ground is not None and np.dot(up, to_sun) > 0.02:
        heights = corners @ np.array(up) - ground
        high[2] = max(high[2], ((corners - np.outer(heights / np.dot(up, to_sun), to_sun)) @ axes.T)[:, 2].max())
    matrix = np.eye(4)
    matrix[:3, :3] = axes * (2 / (high - low))[:, None]
    matrix[:3, 3] = -(high + low) / (high - low)
    return matrix, (high - low)[:2].max(), (high - low)[2]


class Viewer:
    """Draws the scene with a shadow map, a background pass and a forward pass."""

    def __init__(self, scene):
        self.gl = gl = moderngl.create_context(standalone=True, backend="egl", require=430)
        settings = self.settings = scene.settings
        self.size = size = tuple(settings["size"])
        look, self.shadow = settings["look"], settings["look"]["shadow"]
        variance = self.shadow["method"] == "variance"
        self.buffer = gl.buffer(reserve=24 * len(scene.rest_normals), dynamic=True)
        uvs, indices = gl.buffer(scene.uvs.tobytes()), gl.buffer(scene.indices.tobytes())
        caster = (MOMENTS if variance else EMPTY).replace("#version 430", "#version 430\n" + CUT_OUT)
        caster = caster.replace("void main() {", "void main() { " + DISCARD)
        light = LIGHT % SUN_VISIBILITY["variance" if variance else "filtered"]
        self.programs = {
            "caster": gl.program(vertex_shader=CASTER, fragment_shader=caster),
            "surface": gl.program(vertex_shader=SURFACE, fragment_shader=light + SHADE),
            "background": gl.program(vertex_shader=FULL_SCREEN, fragment_shader=light + BACKGROUND),
        }
        uv_buffer = (uvs, "2f", "uv")
        self.casters = gl.vertex_array(self.programs["caster"], [(self.buffer, "3f 3x4", "position"), uv_buffer], indices)
        attributes = [(self.buffer, "3f 3f", "position", "normal"), uv_buffer]
        self.surfaces = gl.vertex_array(self.programs["surface"], attributes, indices)
        self.background = gl.vertex_array(self.programs["background"], [])
        self.create_images(scene)
        self.create_targets(variance)
        self.set_uniforms(look)

    def create_images(self, scene):
        """One texture per image. Materials without an image use a white one."""
        gl, self.images = self.gl, []
        for index, (width, height) in enumerate(self.settings["images"]):
            # 0x8C43 is GL_SRGB8_ALPHA8.
            pixels = (scene.folder / f"image-{index}.rgba").read_bytes()
            self.images.append(gl.texture((width, height), 4, pixels, internal_format=0x8C43))
            self.images[-1].build_mipmaps()
            self.images[-1].filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        self.images.append(gl.texture((1, 1), 4, b"\xff" * 4))

    def create_targets(self, variance):
        """The shadow map with the targets of its blur, and the multisampled frame with the one it is resolved to."""
        gl, size, side = self.gl, self.size, self.shadow["size"]
        depth = gl.depth_texture((side, side))
        depth.compare_func, depth.repeat_x, depth.repeat_y = "<=", False, False
        self.map, self.targets = depth, [gl.framebuffer(depth_attachment=depth)]
        if variance:
            self.map, self.blurred = (gl.texture((side, side), 2, dtype="f4") for _ in range(2))
            self.map.repeat_x = self.map.repeat_y = False
            self.targets = [gl.framebuffer([self.map], depth), gl.framebuffer([self.blurred]), gl.framebuffer([self.map])]
            blur = self.programs["blur"] = gl.program(vertex_shader=FULL_SCREEN, fragment_shader=BLUR)
            weights = np.exp(-0.5 * (np.arange(-BLUR_RADIUS, BLUR_RADIUS + 1) / max(self.shadow["blur"], 1e-3)) ** 2)
            blur["weights"] = list(weights / weights.sum())
            self.full_screen = gl.vertex_array(blur, [])
        samples = self.settings["samples"] if self.settings["samples"] > 1 else 0
        self.frame = gl.framebuffer([gl.renderbuffer(size, 4, samples=samples)], gl.depth_renderbuffer(size, samples=samples))
        self.resolved = gl.framebuffer([gl.renderbuffer(size, 4)])
        # Read-backs rotate through two buffers, so that a frame is read while the next one is drawn.
        self.pixels = [gl.buffer(reserve=3 * size[0] * size[1]) for _ in range(2)]

    def set_uniforms(self, look):
        settings, camera = self.settings, self.settings["camera"]
        low, high = np.array(settings["bounds"]).reshape(2, 3)
        corners = np.array([[(low, high)[i >> axis & 1][axis] for axis in range(3)] for i in range(8)])
        up, eye, diagonal = np.array(settings["up"]), np.array(camera["eye"]), np.linalg.norm(high - low)
        half_height = np.tan(np.radians(camera["field_of_view"]) / 2)
        half_size = (half_height * self.size[0] / self.size[1], half_height)
        camera_from_world = look_at(eye, camera["target"], camera["up"])
        distances = -(corners @ camera_from_world[2, :3] + camera_from_world[2, 3])
        near, far = max(0.5 * distances.min(), 1e-3 * diagonal), 1.5 * distances.max()
        center = (low + high) / 2
        center += up * (low @ up - center @ up)
        offset = eye - center
        fade = 3.5 * max(diagonal, np.linalg.norm(offset - up * (offset @ up)))
        ground = None if look["ground"] is None else low @ up
        light, width, depth = light_matrix(settings["to_sun"], up, corners, ground)
        texel = width / self.shadow["size"] / depth
        column_major = lambda matrix: tuple(np.asarray(matrix).T.ravel())
        world_from_ray = np.eye(4)
        world_from_ray[:3, :3] = camera_from_world[:3, :3].T
        uniforms = {
            "map_from_world": column_major(light), "eye": eye, "to_sun": settings["to_sun"], "up": up,
            "clip_from_world": column_major(perspective(half_size, near, far) @ camera_from_world),
            "sunlight": look["sunlight"], "skylight": look["skylight"], "zenith": look["zenith"], "horizon": look["horizon"],
            "limits": (texel, max(self.shadow["least_variance"], 1e-6), self.shadow["bleeding"], 0.0),
            "image": 0, "map": 1, "world_from_ray": column_major(world_from_ray), "half_size": half_size,
            "image_size": self.size, "ground_center": center,
            "ground": (0, 0, 0, 0) if ground is None else (*look["ground"]["color"], fade),
        }
        for program in self.programs.values():
            for name, value in uniforms.items():
                if name in program:
                    program[name].value = tuple(value) if hasattr(value, "__len__") else value

    def draw_groups(self, array, program):
        """Draws the triangles of each material."""
        for material in self.settings["materials"]:
            image = material["image"]
            self.images[-1 if image is None else image].use(0)
            for name in ("cutoff", "ambient", "diffuse", "specular", "shininess"):
                if name in program:
                    value = material[name]
                    program[name].value = tuple(value) if isinstance(value, list) else value
            culling = moderngl.NOTHING if material["double_sided"] else moderngl.CULL_FACE
            self.gl.enable_only(moderngl.DEPTH_TEST | culling)
            if material["count"]:
                array.render(vertices=3 * material["count"], first=3 * material["first"])

    def draw(self, corners):
        """Draws one step. Its pixels stay on the device."""
        gl = self.gl
        self.buffer.write(np.ascontiguousarray(corners))
        self.targets[0].use()
        # The moments of the far plane: 1 - 0.5, and its square.
        self.targets[0].clear(0.5, 0.25, depth=1.0)
        gl.front_face = "ccw"
        self.draw_groups(self.casters, self.programs["caster"])
        gl.enable_only(moderngl.NOTHING)
        for target, source, direction in zip(self.targets[1:], (self.map, getattr(self, "blurred", None)), ((1, 0), (0, 1))):
            target.use()
            source.use(0)
            self.programs["blur"]["direction"].value = direction
            self.full_screen.render(vertices=3)
        self.frame.use()
        self.frame.clear(depth=1.0)
        self.map.use(1)
        self.background.render(vertices=3)
        gl.front_face = "cw"
        self.draw_groups(self.surfaces, self.programs["surface"])
        gl.copy_framebuffer(self.resolved, self.frame)

    def frames(self, scene, count):
        """The frames of `count` steps as BGR arrays of shape (height, width, 3)."""
        width, height = self.size
        for step in range(count + 1):
            if step < count:
                self.draw(scene.corners(step))
                self.resolved.read_into(self.pixels[step % 2], components=3, alignment=1)
            if step > 0:
                pixels = self.pixels[(step - 1) % 2].read()
                yield np.frombuffer(pixels, np.uint8).reshape(height, width, 3)


def encode(frame):
    import cv2

    return cv2.imencode(".png", frame, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


def messages(scene, viewer, variant, count):
    """The message of each step, in order."""
    if variant == "vertices":
        for step in range(count):
            positions, _ = scene.deform(step)
            yield np.ascontiguousarray(positions if xp is np else positions.get())
    elif variant == "raw":
        yield from viewer.frames(scene, count)
    elif variant == "png":
        yield from map(encode, viewer.frames(scene, count))
    else:
        workers = os.cpu_count() or 1
        with ThreadPoolExecutor(workers) as pool:
            pending = []
            for frame in viewer.frames(scene, count):
                pending.append(pool.submit(encode, frame))
                while pending and (len(pending) > workers + 8 or pending[0].done()):
                    yield pending.pop(0).result()
            for future in pending:
                yield future.result()


def receive(port, count):
    """Receives all messages and prints their rate, counted from the first to the last one, as JSON."""
    socket = zmq.Context.instance().socket(zmq.PULL)
    socket.connect(f"tcp://127.0.0.1:{port}")
    received, first = 0, None
    for _ in range(count):
        received += len(socket.recv())
        first = first or time.perf_counter()
    print(json.dumps({"per_second": (count - 1) / (time.perf_counter() - first), "bytes": received / count}))


def send(folder, variant, count):
    """Sends all messages to a new process and prints its summary."""
    scene = Scene(folder)
    viewer = None if variant == "vertices" else Viewer(scene)
    # The first frames compile shaders and kernels, and are not sent.
    for _ in messages(scene, viewer, variant, 3):
        pass
    socket = zmq.Context.instance().socket(zmq.PUSH)
    socket.set_hwm(16)
    port = socket.bind_to_random_port("tcp://127.0.0.1")
    arguments = [sys.executable, __file__, "receive", str(port), str(count)]
    receiver = subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True)
    for message in messages(scene, viewer, variant, count):
        socket.send(message, copy=False)
    summary = json.loads(receiver.communicate()[0])
    renderer = None if viewer is None else viewer.gl.info["GL_RENDERER"]
    print(json.dumps({**summary, "frames": count, "arrays": xp.__name__, "renderer": renderer}))


def main(first, second, third):
    import cv2

    cv2.setNumThreads(1)
    if first == "receive":
        receive(int(second), int(third))
    elif second == "picture":
        scene = Scene(first)
        Path(third).write_bytes(encode(next(Viewer(scene).frames(scene, 1))))
    elif second in ("raw", "png", "png-pool", "vertices"):
        send(first, second, int(third))
    else:
        sys.exit(f"expected raw, png, png-pool, vertices or picture, got {second}")


if __name__ == "__main__":
    main(*sys.argv[1:4])
