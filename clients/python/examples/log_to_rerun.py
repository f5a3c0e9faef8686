"""Logs the deforming tree to Rerun: positions and normals of each step, and the frame that the server draws.

Usage: python log_to_rerun.py [ADDRESS]. Without ADDRESS, it starts a server. Writes tree.rrd, which `rerun tree.rrd`
shows. Needs `pip install rerun-sdk`.
"""

import sys

import numpy as np
import rerun as rr

import modalcast as mc

STEPS, DT = 8, 1 / 8  # number of steps, seconds per step


class SceneMesh:
    """All domains of a scene as one mesh. It has one vertex per corner, because each corner has a normal."""

    def __init__(self, scene: mc.Scene) -> None:
        """Logs the triangles, which all steps share."""
        self.scene = scene
        description = scene.describe(["indices", "corner_vertices"])
        vertex_count = corner_count = 0
        corner_vertices, triangles = [], []
        for domain in description.domains:
            shape = description.shape_of(domain)
            corner_vertices.append(shape.arrays["corner_vertices"].astype(int) + vertex_count)
            triangles.append(shape.arrays["indices"].astype(int) + corner_count)
            vertex_count += shape.vertex_count
            corner_count += shape.corner_count
        self.corner_vertices = np.concatenate(corner_vertices)
        rr.log("scene", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
        rr.log("scene/tree", rr.Mesh3D.from_fields(triangle_indices=np.concatenate(triangles)), static=True)

    def log(self, step: mc.StepId) -> None:
        """Logs the vertices of a step, and its frame."""
        rr.set_time("simulation", duration=step.time)
        vertices = self.scene.vertex_set(["positions", "normals"], step=step)
        assert vertices.positions is not None
        positions = vertices.positions[self.corner_vertices]
        rr.log("scene/tree", rr.Mesh3D.from_fields(vertex_positions=positions, vertex_normals=vertices.normals))
        rr.log("frame", rr.Image(self.scene.frame(width=640, height=360, step=step).array).compress())


def main() -> None:
    rr.init("modalcast")
    rr.save("tree.rrd")
    with mc.connect(sys.argv[1]) if len(sys.argv) > 1 else mc.spawn() as client:
        scene = client.open("tree")
        scene.reset()
        mesh = SceneMesh(scene)
        trunk = scene.domains["trunk"]
        with scene.drive(dt=DT) as drive:
            for number in range(STEPS):
                sway = 8 * np.sin(2 * np.pi * number / STEPS)
                mesh.log(drive.step(q={"trunk": [sway] + [0] * (trunk.rank - 1)}))
    rr.disconnect()  # completes the file


if __name__ == "__main__":
    main()
