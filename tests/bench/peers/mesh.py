"""The scene that both programs draw: a field of hills, a knot above it, one image; OBJ, MTL, PNG and two scene files.

Both programs read what this writes, so that both draw the same triangles in the same order.
"""

import struct
import sys
import zlib
from pathlib import Path

import numpy as np

FIELD = 320  # cells along each side of the field
KNOT = (900, 40)  # cells along the knot and around it
IMAGE = 512

LOOK = """model = 'mesh.obj'
ground = false
look.sun = [0.45, 0.80, 0.55]
look.sunlight = [0.82, 0.77, 0.69]
look.skylight = [0.25, 0.28, 0.33]
look.zenith = [0.42, 0.58, 0.76]
look.horizon = [0.42, 0.58, 0.76]
look.samples = 4
look.shadow = {{ {shadow} }}
"""
SHADOWS = {
    "filtered": "method = 'filtered', size = 2048, blur = 0.33",
    "variance": "method = 'variance', size = 2048, blur = 1.5",
}


def grid(points, rows, columns):
    """Two triangles for each cell of a grid of points, and normals by area."""
    at = lambda row, column: row * (columns + 1) + column
    row, column = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    a, b, c, d = at(row, column), at(row, column + 1), at(row + 1, column + 1), at(row + 1, column)
    triangles = np.stack([a, d, c, a, c, b], axis=-1).reshape(-1, 3)
    corners = points[triangles]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(points)
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], area)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return triangles, normals


def field():
    v, u = np.meshgrid(np.linspace(0, 1, FIELD + 1), np.linspace(0, 1, FIELD + 1), indexing="ij")
    x, z = 6 * (u - 0.5), 6 * (v - 0.5)
    y = 0.16 * np.sin(2.1 * x + 1.3 * z) + 0.11 * np.sin(3.1 * z - 1.7 * x) + 0.02 * np.sin(9 * x + 7 * z)
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    triangles, normals = grid(points, FIELD, FIELD)
    return points, normals, np.stack([6 * u, 6 * v], axis=-1).reshape(-1, 2), triangles


def knot():
    along, around = KNOT
    t = np.linspace(0, 2 * np.pi, along + 1)
    line = lambda t: np.stack(
        [(1 + 0.42 * np.cos(3 * t)) * np.cos(2 * t), 1.35 + 0.5 * np.sin(3 * t), (1 + 0.42 * np.cos(3 * t)) * np.sin(2 * t)],
        axis=-1,
    )
    ahead = line(t + 1e-4) - line(t - 1e-4)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    side = np.cross(ahead, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    above = np.cross(side, ahead)
    angle = np.linspace(0, 2 * np.pi, around + 1)
    circle = np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * above[:, None]
    points = (line(t)[:, None] + 0.16 * circle).reshape(-1, 3)
    u, v = np.meshgrid(np.linspace(0, 30, along + 1), np.linspace(0, 2, around + 1), indexing="ij")
    triangles, _ = grid(points, along, around)
    # The two ends of the tube lie in one place: normals come from its own roundness.
    return points, circle.reshape(-1, 3), np.stack([u, v], axis=-1).reshape(-1, 2), triangles


def image():
    v, u = np.meshgrid((np.arange(IMAGE) + 0.5) / IMAGE, (np.arange(IMAGE) + 0.5) / IMAGE, indexing="ij")
    wave = lambda place: 0.5 + 0.5 * np.sin(2 * np.pi * place)
    light = 0.45 + 0.4 * wave(4 * u + wave(2 * v)) * wave(4 * v + wave(2 * u)) + 0.15 * wave(32 * u) * wave(32 * v)
    colour = np.stack([0.86 - 0.2 * wave(v), 0.70 + 0.2 * wave(u + v), 0.52 + 0.2 * wave(2 * v - u)], axis=-1)
    return (255 * np.clip(colour * light[..., None], 0, 1)).astype(np.uint8)


def png(path, rgb):
    height, width, _ = rgb.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), rgb.reshape(height, -1)], axis=1).tobytes()
    chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows, 6)) + chunk(b"IEND", b"")
    Path(path).write_bytes(b"\x89PNG\r\n\x1a\n" + body)


def mesh():
    """Positions, normals, texture coordinates (v downwards) and triangles of the whole scene."""
    parts, first = [field(), knot()], 0
    joined = [[], [], [], []]
    for points, normals, uvs, triangles in parts:
        for into, own in zip(joined, (points, normals, uvs, triangles + first)):
            into.append(own)
        first += len(points)
    return tuple(np.concatenate(own) for own in joined)


def write(folder):
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    points, normals, uvs, triangles = mesh()
    lines = ["mtllib mesh.mtl", "o mesh", "usemtl cloth"]
    lines += ["v %.7g %.7g %.7g" % tuple(point) for point in points]
    lines += ["vt %.7g %.7g" % (u, 1 - v) for u, v in uvs]
    lines += ["vn %.7g %.7g %.7g" % tuple(normal) for normal in normals]
    lines += ["f %d/%d/%d %d/%d/%d %d/%d/%d" % tuple(np.repeat(own + 1, 3)) for own in triangles]
    (folder / "mesh.obj").write_text("\n".join(lines) + "\n")
    (folder / "mesh.mtl").write_text("newmtl cloth\nKa 1 1 1\nKd 1 1 1\nKs 0.2 0.2 0.2\nNs 24\nmap_Kd cloth.png\n")
    png(folder / "cloth.png", image())
    for name, shadow in SHADOWS.items():
        (folder / f"{name}.toml").write_text(LOOK.format(shadow=shadow))


if __name__ == "__main__":
    write(sys.argv[1])
