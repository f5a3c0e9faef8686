"""Scene files for attacks."""

import math


def write_grid(path, side):
    """A square of side x side vertices."""
    lines = [f"v {index % side} {index // side} 0" for index in range(side * side)]
    for row in range(side - 1):
        for first in range(row * side + 1, row * side + side):
            lines.append(f"f {first} {first + 1} {first + side + 1} {first + side}")
    path.write_text("\n".join(lines))


def write_domains(folder, count):
    """A scene of so many domains, which have one triangle each: the entry `scene.toml` in a folder."""
    (folder / "triangle.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (folder / "scene.toml").write_text("[[domain]]\nmodel = 'triangle.obj'\n" * count)


def write_thin_arcs(path, polygons, corners=256):
    """Polygons that are thin arcs of 4 radians. Each triangle of three corners on the outer side contains corners of
    the inner side, so that triangulation is slow. All polygons have the same vertices."""
    side = corners // 2
    angles = [4 * index / side for index in range(side)]
    outline = [(1.0, angle) for angle in angles] + [(0.9999, angle) for angle in reversed(angles)]
    lines = [f"v {radius * math.cos(angle):.7f} {radius * math.sin(angle):.7f} 0" for radius, angle in outline]
    face = "f " + " ".join(str(corner + 1) for corner in range(corners))
    path.write_text("\n".join(lines + [face] * polygons))
