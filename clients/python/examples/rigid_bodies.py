"""Rigid bodies of MuJoCo that fall onto a table: the poses of the bodies are the transforms T of domains without modes.

Usage: python rigid_bodies.py [ADDRESS]. Without ADDRESS, it starts a server. Writes bodies.png.
Needs `pip install mujoco`.
"""

import itertools
import sys

import mujoco
import numpy as np

import modalcast as mc

STEPS, STEPS_PER_FRAME = 1500, 10
COLORS = [(0.80, 0.25, 0.10), (0.85, 0.55, 0.08), (0.10, 0.42, 0.55), (0.30, 0.16, 0.45)]  # one per body, in turn
# The server draws a ground of its own, so the plane is not part of the scene.
GROUND, TABLE = '<geom type="plane" size="9 9 1"/>', '<geom type="box" size="1 1 0.2" pos="0 0 0.2"/>'
BODY = """<body pos="{x} {y} {z}" euler="{angle} 20 40"><freejoint/>
    <geom type="{kind}" size="0.2 0.14 0.1" density="800"/></body>"""


def tower() -> mujoco.MjModel:
    """Boxes and ellipsoids above a table, four in each layer."""
    places = itertools.product(range(4), (-0.35, 0.35), (-0.35, 0.35))
    bodies = [
        BODY.format(
            x=x + 0.1 * layer, y=y, z=0.8 + 0.5 * layer, angle=25 * number, kind=("box", "ellipsoid")[number % 2]
        )
        for number, (layer, x, y) in enumerate(places)
    ]
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{GROUND}{TABLE}{''.join(bodies)}</worldbody></mujoco>")


def box(size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a box with half the sides `size`."""
    vertices = np.array(list(itertools.product((-1, 1), repeat=3))) * size
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return vertices, quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def ellipsoid(radii: np.ndarray, rows: int = 16, columns: int = 32) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of an ellipsoid: a grid of latitudes and longitudes, with a pole at each end."""
    latitude, longitude = np.meshgrid(
        np.linspace(0, np.pi, rows + 1)[1:-1], np.arange(columns) * 2 * np.pi / columns, indexing="ij"
    )
    ring = np.stack([np.sin(latitude) * np.cos(longitude), np.sin(latitude) * np.sin(longitude), np.cos(latitude)], -1)
    vertices = np.concatenate([[(0, 0, 1)], ring.reshape(-1, 3), [(0, 0, -1)]]) * radii
    here = 1 + np.arange((rows - 1) * columns).reshape(rows - 1, columns)
    right = np.roll(here, -1, axis=1)
    top = np.stack([np.zeros(columns, int), here[0], right[0]], -1)
    bottom = np.stack([np.full(columns, len(vertices) - 1), right[-1], here[-1]], -1)
    upper = np.stack([here[:-1], here[1:], right[1:]], -1).reshape(-1, 3)
    lower = np.stack([here[:-1], right[1:], right[:-1]], -1).reshape(-1, 3)
    return vertices, np.concatenate([top, upper, lower, bottom])


def pose(data: mujoco.MjData, geom: int) -> np.ndarray:
    """world_from_domain of a geom: 3 x 4."""
    return np.column_stack([data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]])


def main() -> None:
    model = tower()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    builder = mc.SceneBuilder("bodies", up="z")
    bodies = range(2, model.ngeom)
    for geom in (1, *bodies):
        is_box = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX
        mesh = (box if is_box else ellipsoid)(model.geom_size[geom])
        color = COLORS[geom % 4] if geom in bodies else (0.5, 0.5, 0.5)
        builder.add(*mesh, name=f"geom {geom}", placement=pose(data, geom), color=color)
    with mc.connect(sys.argv[1]) if len(sys.argv) > 1 else mc.spawn() as client:
        scene = client.upload(builder, replace=True)
        with scene.drive(delivery="latest") as drive:
            for step in range(STEPS):
                mujoco.mj_step(model, data)
                if (step + 1) % STEPS_PER_FRAME == 0:
                    transforms = {f"geom {geom}": pose(data, geom) for geom in bodies}
                    drive.step(transforms=transforms, time=data.time)
        scene.frame(mc.look_at(eye=(4.4, -5.0, 3.6), target=(0, 0, 0.3), field_of_view=30)).save("bodies.png")
        vertices = scene.vertex_set(["positions"])
    table, *tops = (vertices.positions_of(domain)[:, 2].max() for domain in scene.domains)
    on_table = sum(top > table for top in tops)
    print(f"{on_table} of {len(tops)} bodies are on the table, the lowest top is at {min(tops):.2f} m")


if __name__ == "__main__":
    main()
