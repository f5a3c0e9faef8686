"""A physics process in Python: a tree whose trunk a viewer pulls for two seconds and releases.

Usage: python pull.py [ADDRESS]. Without ADDRESS, it starts a server. Writes pulled.png and released.png.
Viewers on other machines can pull too: the forces of all of them arrive in `Scene.forces`.
"""

import sys
import threading
from collections import deque
from collections.abc import Iterable

import numpy as np

import modalcast as mc

DT, STEPS, RELEASE = 1 / 60, 300, 120  # seconds per step, number of steps, step at which the viewer lets go
PULL = (900.0, 0.0, 0.0)  # newtons, in world axes


class Oscillators:
    """One damped oscillator per coordinate, q'' + 2 zeta omega q' + omega^2 q = f, for mass-normalized modes."""

    def __init__(self, scene: mc.Scene) -> None:
        self.first = np.cumsum([0, *(domain.rank for domain in scene.domains)])
        self.omega2 = np.concatenate([domain.eigenvalues for domain in scene.domains])
        ratios = [np.full(domain.rank, float(domain.notes.get("damping_ratio", 0.05))) for domain in scene.domains]
        self.damping = 2 * np.concatenate(ratios) * np.sqrt(self.omega2)
        self.q, self.v = np.zeros_like(self.omega2), np.zeros_like(self.omega2)

    def advance(self, forces: Iterable[mc.AppliedForce]) -> None:
        """One step of the implicit Euler method, which is stable for stiff modes."""
        f = np.zeros_like(self.q)
        for force in forces:
            f[self.first[force.domain] : self.first[force.domain + 1]] += force.f_q
        self.v += DT * (f - self.omega2 * self.q)
        self.v /= 1 + DT * self.damping + DT**2 * self.omega2
        self.q += DT * self.v


def top_of(scene: mc.Scene) -> float:
    """x of the highest vertex of the trunk at rest, in meters."""
    vertices = scene.vertex_set(["positions"], domains=["trunk"]).positions_of(0)
    return float(vertices[vertices[:, 1].argmax(), 0]) * scene.info.unit


def main() -> None:
    with mc.connect(sys.argv[1]) if len(sys.argv) > 1 else mc.spawn() as client:
        scene = client.open("tree")
        scene.reset()
        camera = mc.look_at(eye=(0, 5, 17), target=(0, 4, 0))
        rows, columns = np.nonzero(scene.frame(camera, outputs="domains").domains == scene.domains["trunk"].index)
        hit = scene.pick(int(columns[0]), int(rows[0]), camera)  # the highest visible point of the trunk
        assert hit is not None
        at_rest = pulled = top_of(scene)
        oscillators = Oscillators(scene)
        with scene.forces() as forces, scene.drive(dt=DT) as drive:
            latest = deque([next(forces)], maxlen=1)
            threading.Thread(target=latest.extend, args=[forces], daemon=True).start()
            for number in range(STEPS):
                if number < RELEASE:
                    scene.apply_forces([hit.force(PULL)])  # as a viewer does, again and again
                elif number == RELEASE:
                    pulled = top_of(scene)
                    scene.frame(camera).save("pulled.png")
                    scene.apply_forces([])
                oscillators.advance(latest[0].forces)
                drive.step(oscillators.q)
        released = top_of(scene)
        scene.frame(camera).save("released.png")
    print(f"top of the trunk: moved by {pulled - at_rest:.2f} m, {released - at_rest:.2f} m after the release")


if __name__ == "__main__":
    main()
