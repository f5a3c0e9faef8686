"""Surfaces of volumes, without files: faces, their orientation, and the order of the vertices."""

from __future__ import annotations

import numpy as np
import pytest

from modalcast.surface import surface_of

# The corners of a unit cube in the order of a hexahedron, and its center.
CORNERS = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
POINTS = np.array([*CORNERS, [0.5, 0.5, 0.5]])
HEXAHEDRON = [[0, 1, 2, 3, 4, 5, 6, 7]]
# One pyramid per face of the cube. Half of them are inverted.
PYRAMIDS = [
    [0, 1, 2, 3, 8],
    [4, 5, 6, 7, 8],
    [0, 1, 5, 4, 8],
    [3, 2, 6, 7, 8],
    [1, 2, 6, 5, 8],
    [0, 3, 7, 4, 8],
]
TETRAHEDRA = [corners for a, b, c, d, apex in PYRAMIDS for corners in ([a, b, c, apex], [a, c, d, apex])]
WEDGES = [[0, 1, 2, 4, 5, 6], [0, 2, 3, 4, 6, 7]]


def enclosed_volume(points: np.ndarray, faces: list[np.ndarray]) -> float:
    """By the divergence theorem; positive if all faces are counterclockwise seen from outside."""
    triangles = np.concatenate(
        [block[:, [0, corner, corner + 1]] for block in faces for corner in range(1, block.shape[1] - 1)]
    )
    a, b, c = (points[triangles[:, corner]] for corner in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize(
    ("cells", "triangles", "quads"),
    [
        ([("hexahedron", HEXAHEDRON)], 0, 6),
        ([("tetra", TETRAHEDRA)], 12, 0),
        ([("pyramid", PYRAMIDS)], 0, 6),
        ([("wedge", WEDGES)], 4, 4),
        # Blocks of one kind, and different kinds that share a face.
        ([("pyramid", PYRAMIDS[:2]), ("pyramid", PYRAMIDS[2:])], 0, 6),
        ([("pyramid", PYRAMIDS[:3]), ("tetra", TETRAHEDRA[6:])], 6, 3),
    ],
)
def test_faces_inside_are_left_out_and_others_face_outwards(
    cells: list[tuple[str, list[list[int]]]], triangles: int, quads: int
):
    points, faces = surface_of(POINTS, cells)
    np.testing.assert_array_equal(points, POINTS)  # The center remains.
    counts = {block.shape[1]: len(block) for block in faces}
    assert (counts.get(3, 0), counts.get(4, 0)) == (triangles, quads)
    assert enclosed_volume(points, faces) == pytest.approx(1)


def test_nodes_at_edges_are_left_out_of_the_faces():
    middles = [[0.5, 0, 0], [0.5, 0.5, 0], [0, 0.5, 0], [0, 0, 0.5], [0.5, 0, 0.5], [0, 0.5, 0.5]]
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], *middles])
    kept, faces = surface_of(points, [("tetra10", [list(range(10))]), ("line3", [[0, 1, 4]])])
    assert len(kept) == 10
    assert faces[0].max() == 3
    assert enclosed_volume(kept, faces) == pytest.approx(1 / 6)


def test_surface_cells_are_kept_unless_a_volume_has_the_face():
    flat = [[0, 0], [1, 0], [1, 1], [0, 1]]
    points, faces = surface_of(flat, [("vertex", [[0]]), ("triangle6", [[2, 1, 0, 9, 9, 9]]), ("quad", [[0, 1, 2, 3]])])
    assert points.shape == (4, 3)
    assert [block.tolist() for block in faces] == [[[2, 1, 0]], [[0, 1, 2, 3]]]
    # A sheet that stands on the cube, and a face of the cube as Gmsh writes it beside the volume.
    points = np.array([*CORNERS, [0, 0, 2], [1, 0, 2]])
    _, faces = surface_of(points, [("quad", [[4, 5, 9, 8], [3, 2, 1, 0]]), ("hexahedron", HEXAHEDRON)])
    assert len(faces[0]) == 7
    assert [4, 5, 9, 8] in faces[0].tolist()


def test_unknown_and_missing_cells_are_errors():
    with pytest.raises(ValueError, match=r"cells: expected vertex, line, triangle.*got polyhedron12"):
        surface_of(POINTS, [("polyhedron12", [list(range(8))])])
    with pytest.raises(ValueError, match="cells: expected faces or volumes, got line"):
        surface_of(POINTS, [("line", [[0, 1]])])
    with pytest.raises(ValueError, match="cells: expected faces or volumes, got none"):
        surface_of(POINTS, [])
