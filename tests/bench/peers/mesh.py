"""Builds the scene that modalcast and the moderngl program draw: a field of hills and a knot above it, with one texture.

Writes the scene as OBJ, MTL, PNG and two scene files for modalcast. The moderngl program (draw.py) calls `build_mesh` and
`cloth_image`, so that both programs draw the same triangles in the same order.
"""

import struct
import sys
import zlib
from pathlib import Path

import numpy as np

FIELD = 320  # cells along each side of the field
KNOT = (900, 40)  # cells along the knot and around it
IMAGE = 512  # width and height of the texture in pixels

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
    """Two triangles for each cell of a grid of points, and area-weighted vertex normals."""
    index = lambda row, column: row * (columns + 1) + column
    row, column = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    a, b, c, d = index(row, column), index(row, column + 1), index(row + 1, column + 1), index(row + 1, column)
    triangles = np.stack([a, d, c, a, c, b], axis=-1).reshape(-1, 3)
    corners = points[triangles]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(points)
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], area)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return triangles, normals


def hills():
    """Positions, normals, texture coordinates and triangles of the field."""
    v, u = np.meshgrid(np.linspace(0, 1, FIELD + 1), np.linspace(0, 1, FIELD + 1), indexing="ij")
    x, z = 6 * (u - 0.5), 6 * (v - 0.5)
    y = 0.16 * np.sin(2.1 * x + 1.3 * z) + 0.11 * np.sin(3.1 * z - 1.7 * x) + 0.02 * np.sin(9 * x + 7 * z)
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    triangles, normals = grid(points, FIELD, FIELD)
    return points, normals, np.stack([6 * u, 6 * v], axis=-1).reshape(-1, 2), triangles


def knot():
    """Positions, normals, texture coordinates and triangles of the knot: a tube along a trefoil curve."""
    segments, sides = KNOT
    t = np.linspace(0, 2 * np.pi, segments + 1)
    curve = lambda t: np.stack(
        [(1 + 0.42 * np.cos(3 * t)) * np.cos(2 * t), 1.35 + 0.5 * np.sin(3 * t), (1 + 0.42 * np.cos(3 * t)) * np.sin(2 * t)],
        axis=-1,
    )
    tangent = curve(t + 1e-4) - curve(t - 1e-4)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.cross(tangent, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, tangent)
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    circle = np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * up[:, None]
    points = (curve(t)[:, None] + 0.16 * circle).reshape(-1, 3)
    u, v = np.meshgrid(np.linspace(0, 30, segments + 1), np.linspace(0, 2, sides + 1), indexing="ij")
    triangles, _ = grid(points, segments, sides)
    # Normals of the circle: averages of triangles would show a seam, because the vertices of the seam exist twice.
    return points, circle.reshape(-1, 3), np.stack([u, v], axis=-1).reshape(-1, 2), triangles


def cloth_image():
    """The RGB texture of the field and the knot, which repeats without seams."""
    v, u = np.meshgrid((np.arange(IMAGE) + 0.5) / IMAGE, (np.arange(IMAGE) + 0.5) / IMAGE, indexing="ij")
    wave = lambda periods: 0.5 + 0.5 * np.sin(2 * np.pi * periods)
    light = 0.45 + 0.4 * wave(4 * u + wave(2 * v)) * wave(4 * v + wave(2 * u)) + 0.15 * wave(32 * u) * wave(32 * v)
    color = np.stack([0.86 - 0.2 * wave(v), 0.70 + 0.2 * wave(u + v), 0.52 + 0.2 * wave(2 * v - u)], axis=-1)
    return (255 * np.clip(color * light[..., None], 0, 1)).astype(np.uint8)


def write_png(path, rgb):
    """Writes an 8-bit RGB array of shape (height, width, 3)."""
    height, width, _ = rgb.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), rgb.reshape(height, -1)], axis=1).tobytes()
    chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows, 6)) + chunk(b"IEND", b"")
    Path(path).write_bytes(b"\x89PNG\r\n\x1a\n" + body)


def build_mesh():
    """Positions, normals, texture coordinates (v downwards) and triangles of the whole scene."""
    parts, first = [hills(), knot()], 0
    joined = [[], [], [], []]
    for points, normals, uvs, triangles in parts:
        for arrays, array in zip(joined, (points, normals, uvs, triangles + first)):
            arrays.append(array)
        first += len(points)
    return tuple(np.concatenate(arrays) for arrays in joined)


def write(folder):
    """Writes all files of the scene."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    points, normals, uvs, triangles = build_mesh()
    lines = ["mtllib mesh.mtl", "o mesh", "usemtl cloth"]
    lines += ["v %.7g %.7g %.7g" % tuple(point) for point in points]
    lines += ["vt %.7g %.7g" % (u, 1 - v) for u, v in uvs]
    lines += ["vn %.7g %.7g %.7g" % tuple(normal) for normal in normals]
    lines += ["f %d/%d/%d %d/%d/%d %d/%d/%d" % tuple(np.repeat(triangle + 1, 3)) for triangle in triangles]
    (folder / "mesh.obj").write_text("\n".join(lines) + "\n")
    (folder / "mesh.mtl").write_text("newmtl cloth\nKa 1 1 1\nKd 1 1 1\nKs 0.2 0.2 0.2\nNs 24\nmap_Kd cloth.png\n")
    write_png(folder / "cloth.png", cloth_image())
    for name, shadow in SHADOWS.items():
        (folder / f"{name}.toml").write_text(LOOK.format(shadow=shadow))


if __name__ == "__main__":
    write(sys.argv[1])
