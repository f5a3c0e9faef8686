"""Writes the surface of a mesh of another format as a model that the server opens.

```sh
python3 -m modalcast.surface beam.msh beam.ply
```

Reads the formats of meshio, and VTK's PolyData with PyVista. Of a volume, the surface consists of the faces that belong
to one cell only. All vertices are kept in their order, also those inside of the volume, so that the rows of U remain
valid. Needs the extra `modalcast[surface]`; PolyData also needs `pip install pyvista`.
"""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modalcast._types import F64

# The faces of volume cells: indices of corners, in the order around each face. The corners of a cell precede its other
# nodes, such as those at the middles of edges.
_VOLUME_FACES = {
    "tetra": ((0, 1, 2), (0, 1, 3), (1, 2, 3), (2, 0, 3)),
    "pyramid": ((0, 1, 2, 3), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
    "wedge": ((0, 1, 2), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "hexahedron": ((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
}
_SURFACE_CORNERS = {"triangle": 3, "quad": 4}
_WITHOUT_FACES = ("vertex", "line")


def surface_of(points: ArrayLike, cells: Iterable[tuple[str, ArrayLike]]) -> tuple[F64, list[NDArray[np.int64]]]:
    """The surface of a mesh.

    Faces of volume cells are counterclockwise seen from outside. Surface cells keep their order of corners. They are
    left out where they coincide with a face of a volume cell.

    Args:
        points: Coordinates, n x 2 or n x 3.
        cells: Blocks of cells: the kind as meshio names it, such as "tetra10", and the indices of their nodes.

    Returns:
        The coordinates, n x 3, and the faces: an array m x 3 of triangles and an array m x 4 of quadrilaterals, without
        empty arrays.

    Raises:
        ValueError: A kind of cell is not supported, or the mesh has no faces.
    """
    positions = np.asarray(points, dtype=np.float64)
    if positions.shape[1] == 2:
        positions = np.pad(positions, ((0, 0), (0, 1)))
    volume: dict[int, list[NDArray[np.int64]]] = {3: [], 4: []}
    shells: dict[int, list[NDArray[np.int64]]] = {3: [], 4: []}
    kinds: list[str] = []
    for kind, nodes in cells:
        kinds.append(kind)
        shape = kind.rstrip("0123456789")
        indices = np.asarray(nodes, dtype=np.int64)
        if shape in _VOLUME_FACES:
            for face in _volume_faces(positions, indices, _VOLUME_FACES[shape]):
                volume[face.shape[1]].append(face)
        elif shape in _SURFACE_CORNERS:
            corners = _SURFACE_CORNERS[shape]
            shells[corners].append(indices[:, :corners])
        elif shape not in _WITHOUT_FACES:
            expected = ", ".join([*_WITHOUT_FACES, *_SURFACE_CORNERS, *_VOLUME_FACES])
            raise ValueError(f"cells: expected {expected}, got {kind}")
    faces = [_outer_faces(volume[corners], shells[corners]) for corners in volume if volume[corners] or shells[corners]]
    faces = [block for block in faces if len(block) > 0]
    if not faces:
        raise ValueError(f"cells: expected faces or volumes, got {', '.join(kinds) or 'none'}")
    return positions, faces


def _volume_faces(
    positions: F64, cells: NDArray[np.int64], templates: tuple[tuple[int, ...], ...]
) -> Iterable[NDArray[np.int64]]:
    """The faces of volume cells, counterclockwise seen from outside."""
    corner_count = 1 + max(max(template) for template in templates)
    centers = positions[cells[:, :corner_count]].mean(axis=1)
    for template in templates:
        faces = cells[:, template]
        corners = positions[faces]
        # The cross product of the diagonals; in a triangle, of two edges.
        normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, -1] - corners[:, 1])
        is_inward = np.einsum("ij,ij->i", normals, corners.mean(axis=1) - centers) < 0
        yield np.where(is_inward[:, None], faces[:, ::-1], faces)


def _outer_faces(volume: list[NDArray[np.int64]], shells: list[NDArray[np.int64]]) -> NDArray[np.int64]:
    """The faces that belong to one volume cell, and the surface cells that are no face of a volume cell."""
    faces = np.concatenate([*volume, *shells])
    volume_count = sum(len(block) for block in volume)
    _, first, cell_of = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_inverse=True)
    uses = np.bincount(cell_of.ravel()[:volume_count], minlength=len(first))
    return faces[np.sort(first[uses <= 1])]


def _read(path: Path) -> Any:
    """The mesh of a file, as meshio represents it."""
    if _is_poly_data(path):
        pyvista = importlib.import_module("pyvista")
        return pyvista.to_meshio(pyvista.read(path))
    return importlib.import_module("meshio").read(path)


def _is_poly_data(path: Path) -> bool:
    """Whether a file has VTK's PolyData, which meshio does not read."""
    if path.suffix.lower() == ".vtk":
        with path.open("rb") as file:
            return b"POLYDATA" in file.read(512).upper()
    return path.suffix.lower() == ".vtp"


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python3 -m modalcast.surface", description="Writes the surface of a mesh with all of its vertices."
    )
    parser.add_argument("mesh", type=Path, help="a file in a format of meshio, or VTK's PolyData")
    parser.add_argument("model", type=Path, help="the file to write: .ply, .obj or .stl")
    arguments = parser.parse_args()
    try:
        mesh = _read(arguments.mesh)
    except ModuleNotFoundError as error:
        raise SystemExit(f"{arguments.mesh}: {error}. Install it with: pip install {error.name}") from error
    except Exception as error:  # meshio reports damaged files with many types.
        raise SystemExit(f"{arguments.mesh}: expected a readable mesh, got {type(error).__name__}: {error}") from error
    try:
        positions, faces = surface_of(mesh.points, [(block.type, block.data) for block in mesh.cells])
    except ValueError as error:
        raise SystemExit(f"{arguments.mesh}: {error}") from error
    meshio = importlib.import_module("meshio")
    # PLY has no 64-bit integers.
    blocks = [("triangle" if block.shape[1] == 3 else "quad", block.astype(np.int32)) for block in faces]
    meshio.write(arguments.model, meshio.Mesh(positions, blocks))


if __name__ == "__main__":
    main()
