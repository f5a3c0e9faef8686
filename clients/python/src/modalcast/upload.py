"""Scenes to upload: meshes and modes as arrays, or files."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modalcast._types import F32, F64, U32, Vector, affine, to_f32, to_f64, vector3
from modalcast.v1 import scenes_pb2

Progress: TypeAlias = Callable[[int, int], None]
"""Called with the number of bytes that were sent, and with that of the whole upload."""

_CHUNK_BYTES = 512 << 10
_MAX_FOLDER_DEPTH = 16
_MAX_INDEX = 0xFFFFFFFF
# A coordinate of more than this many diagonals of the bounds is sent in f64, because f32 would round it too coarsely.
_MAX_DIAGONALS = 8.0


@dataclass(frozen=True)
class _Domain:
    message: scenes_pb2.UploadedDomain
    arrays: tuple[F32 | F64 | U32, ...]
    diagonal: float


class SceneBuilder:
    """Collects domains for `Client.upload`."""

    def __init__(self, name: str, *, unit: float = 1.0, up: str = "y") -> None:
        """Begins a scene without domains.

        Args:
            name: The name that the scene gets: 1 to 64 of A-Z, a-z, 0-9, '.', '_' and '-'.
            unit: Meters per scene unit.
            up: The up axis: "x", "y" or "z".
        """
        self.name = name
        self._unit = unit
        self._up = up
        self._domains: list[_Domain] = []
        self._names: dict[str, int] = {}

    def add(
        self,
        positions: ArrayLike,
        faces: ArrayLike,
        modes: ArrayLike | None = None,
        *,
        name: str = "",
        eigenvalues: ArrayLike | None = None,
        placement: ArrayLike | None = None,
        color: Vector | None = None,
        crease_angle: float | None = None,
    ) -> SceneBuilder:
        """Adds a domain and returns the builder.

        Args:
            positions: Rest positions x0, n x 3, in scene units and in the domain's own frame. An array of f64 keeps its
                precision at any distance from the origin of this frame.
            faces: Vertices of the triangles, m x 3, counterclockwise seen from the front.
            modes: U, 3n x r (rows 3v, 3v + 1, 3v + 2 of vertex v) or n x 3 x r, in scene units per unit of q; None: a
                rigid domain.
            name: Unique in the scene; empty: "domain" and the number of earlier domains.
            eigenvalues: Squared angular frequencies in (rad/s)^2, one per mode.
            placement: world_from_domain at rest, 3x4 or 4x4; None: the identity.
            color: Linear red, green and blue, 0 to 1.
            crease_angle: In degrees, 0 (flat) to 180 (smooth): edges between triangles whose normals differ by more are
                hard. None: 40.

        Raises:
            ValueError: An array has another shape, an index is out of range, or a name occurs twice.
        """
        x0 = to_f64("positions", positions, (None, 3))
        rounded = to_f32("positions", positions, (None, 3))
        triangles = _faces(faces, len(x0))
        U = _modes(modes, len(x0))
        diagonal = _diagonal(x0, triangles)
        message = self._message(name, eigenvalues, placement, color, diagonal)
        message.vertices, message.triangles, message.rank = len(x0), len(triangles), U.shape[1]
        message.f64_positions = _needs_f64(x0[triangles], diagonal)
        if len(message.eigenvalues) not in (0, U.shape[1]):
            raise ValueError(f"eigenvalues: expected shape ({U.shape[1]},), got ({len(message.eigenvalues)},)")
        if crease_angle is not None:
            message.crease_angle = crease_angle
        return self._append(_Domain(message, (x0 if message.f64_positions else rounded, triangles, U), diagonal))

    def add_copy(
        self, of: str, *, name: str = "", placement: ArrayLike | None = None, color: Vector | None = None
    ) -> SceneBuilder:
        """Adds a domain with the mesh and the modes of the domain named `of`, and returns the builder.

        Raises:
            KeyError: No earlier domain has the name `of`.
            ValueError: An array has another shape, or a name occurs twice.
        """
        if of not in self._names:
            raise KeyError(f"no earlier domain is named '{of}'; the scene has {list(self._names)}")
        diagonal = self._domains[self._names[of]].diagonal
        message = self._message(name, None, placement, color, diagonal)
        message.shares_shape_with = self._names[of]
        return self._append(_Domain(message, (), diagonal))

    def messages(self, progress: Progress | None) -> Iterator[scenes_pb2.UploadArraysRequest]:
        """The messages of the upload."""
        total = sum(array.nbytes for domain in self._domains for array in domain.arrays)
        header = scenes_pb2.UploadArraysHeader(
            scene=self.name, domains=len(self._domains), total_bytes=total, unit=self._unit, up=self._up
        )
        yield scenes_pb2.UploadArraysRequest(header=header)
        sent = 0
        for domain in self._domains:
            yield scenes_pb2.UploadArraysRequest(domain=domain.message)
            for array in domain.arrays:
                data = array.reshape(-1).view(np.uint8)
                for start in range(0, len(data), _CHUNK_BYTES):
                    chunk = data[start : start + _CHUNK_BYTES].tobytes()
                    yield scenes_pb2.UploadArraysRequest(chunk=chunk)
                    sent += len(chunk)
                    if progress is not None:
                        progress(sent, total)

    def _message(
        self,
        name: str,
        eigenvalues: ArrayLike | None,
        placement: ArrayLike | None,
        color: Vector | None,
        diagonal: float,
    ) -> scenes_pb2.UploadedDomain:
        name = name or f"domain{len(self._domains)}"
        if name in self._names:
            raise ValueError(f"name: expected a name that no earlier domain has, got '{name}'")
        message = scenes_pb2.UploadedDomain(name=name)
        if eigenvalues is not None:
            message.eigenvalues.extend(to_f64("eigenvalues", eigenvalues, (None,)).tolist())
        if placement is not None:
            message.placement = _placement_bytes(placement, diagonal)
        if color is not None:
            message.color.extend(vector3("color", color))
        return message

    def _append(self, domain: _Domain) -> SceneBuilder:
        self._names[domain.message.name] = len(self._domains)
        self._domains.append(domain)
        return self


def _diagonal(positions: F64, triangles: U32) -> float:
    """Length of the diagonal of the bounds of the vertices that triangles use."""
    drawn = positions[triangles.reshape(-1)]
    return float(np.linalg.norm(np.ptp(drawn, axis=0))) if len(drawn) > 0 else 0.0


def _needs_f64(coordinates: F64, diagonal: float) -> bool:
    """Whether f32 rounds coordinates of an object of this size too coarsely."""
    return coordinates.size > 0 and bool(np.abs(coordinates).max() > _MAX_DIAGONALS * diagonal > 0)


def _placement_bytes(placement: ArrayLike, diagonal: float) -> bytes:
    """A placement in f32, or in f64 if it is far from the origin of the scene."""
    rounded = affine("placement", placement)
    exact = np.asarray(placement, dtype="<f8")[:3]
    return (exact if _needs_f64(exact[:, 3], diagonal) else rounded).tobytes()


def _faces(faces: ArrayLike, vertex_count: int) -> U32:
    given: NDArray[np.generic] = np.asarray(faces)
    if given.ndim != 2 or given.shape[1] != 3:
        hint = ": split the quadrilaterals" if given.ndim == 2 and given.shape[1] == 4 else ""
        raise ValueError(f"faces: expected triangles of shape (n, 3), got {given.shape}{hint}")
    if given.dtype.kind not in "iu":
        raise ValueError(f"faces: expected integers, got the type {given.dtype}")
    if given.size > 0 and not 0 <= int(given.min()) <= int(given.max()) < min(vertex_count, _MAX_INDEX):
        raise ValueError(f"faces: expected vertices of 0 to {vertex_count - 1}, got {given.min()} to {given.max()}")
    return np.ascontiguousarray(given, "<u4")


def _modes(modes: ArrayLike | None, vertex_count: int) -> F32:
    if modes is None:
        return np.empty((3 * vertex_count, 0), np.float32)
    shape = np.shape(modes)
    if len(shape) == 3:
        return to_f32("modes", modes, (vertex_count, 3, None)).reshape(3 * vertex_count, shape[2])
    if len(shape) != 2 or shape[0] != 3 * vertex_count:
        expected = f"({3 * vertex_count}, r) or ({vertex_count}, 3, r)"
        raise ValueError(f"modes: expected shape {expected} for {vertex_count} positions, got {shape}")
    return to_f32("modes", modes, (3 * vertex_count, None))


@dataclass(frozen=True)
class LocalFile:
    """A file to upload.

    Attributes:
        local_path: Where it is.
        path: Path in the upload.
        size: In bytes.
        sha256: Hash of the content.
    """

    local_path: Path
    path: str
    size: int
    sha256: bytes


def local_files(root: Path) -> list[LocalFile]:
    """All files of a folder in order of their paths, or the single file `root`.

    Raises:
        OSError: A file cannot be read.
        ValueError: The folder has more than 16 levels.
    """
    if root.is_file():
        return [_local_file(root, root.name)]
    found = sorted(path for path in root.rglob("*") if path.is_file())
    if not found:
        root.stat()
        raise ValueError(f"expected a folder with files, got no files in '{root}'")
    relative = [path.relative_to(root) for path in found]
    deepest = max(len(path.parts) for path in relative)
    if deepest > _MAX_FOLDER_DEPTH:
        raise ValueError(f"expected paths of at most {_MAX_FOLDER_DEPTH} parts in '{root}', got {deepest}")
    return [_local_file(path, name.as_posix()) for path, name in zip(found, relative, strict=True)]


def _local_file(local_path: Path, path: str) -> LocalFile:
    with local_path.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").digest()
    return LocalFile(local_path, path, local_path.stat().st_size, sha256)


def file_messages(
    name: str, entry: str, files: Sequence[LocalFile], known: Mapping[bytes, bool], progress: Progress | None
) -> Iterator[scenes_pb2.UploadSceneRequest]:
    """The messages of an upload of files. The server has the contents whose hashes are true in `known`."""
    total = sum(file.size for file in files)
    header = scenes_pb2.UploadHeader(scene=name, entry=entry, files=len(files), total_bytes=total)
    yield scenes_pb2.UploadSceneRequest(header=header)
    sent = 0
    for file in files:
        reuse = known.get(file.sha256, False)
        message = scenes_pb2.UploadFile(path=file.path, bytes=file.size, sha256=file.sha256, reuse=reuse)
        yield scenes_pb2.UploadSceneRequest(file=message)
        if not reuse:
            with file.local_path.open("rb") as content:
                while chunk := content.read(_CHUNK_BYTES):
                    yield scenes_pb2.UploadSceneRequest(chunk=chunk)
        sent += file.size
        if progress is not None:
            progress(sent, total)
