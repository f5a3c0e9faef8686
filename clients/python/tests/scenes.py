"""Scenes for tests."""

from __future__ import annotations

from typing import TypedDict

import numpy as np

import modalcast as mc


class Size(TypedDict):
    width: int
    height: int


SIZE: Size = {"width": 160, "height": 90}
SECTIONS = 8
RANK = 3


def beam() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A beam along x of length 2 with a square section of side 0.2: positions, faces and U (n x 3 x 3)."""
    corners = 0.1 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    x = np.linspace(0, 2, SECTIONS)
    positions = np.array([[at, y + 1, z] for at in x for y, z in corners])
    faces: list[tuple[int, int, int]] = []
    for section in range(SECTIONS - 1):
        for side in range(4):
            a, b = 4 * section + side, 4 * section + (side + 1) % 4
            faces += [(a, a + 4, b), (b, a + 4, b + 4)]
    last = 4 * (SECTIONS - 1)
    faces += [(0, 1, 2), (0, 2, 3), (last, last + 2, last + 1), (last, last + 3, last + 2)]
    modes = np.zeros((len(positions), 3, RANK))
    bend = (positions[:, 0] / 2) ** 2
    modes[:, 1, 0], modes[:, 2, 1], modes[:, 0, 2] = bend, bend, positions[:, 0] / 2
    return positions, np.array(faces), modes


def beam_builder(name: str) -> mc.SceneBuilder:
    positions, faces, modes = beam()
    builder = mc.SceneBuilder(name)
    builder.add(positions, faces, modes, name="beam", eigenvalues=[30.0, 40.0, 900.0], color=(0.1, 0.3, 0.7))
    moved = np.eye(4)
    moved[2, 3] = 1
    return builder.add_copy("beam", name="copy", placement=moved)
