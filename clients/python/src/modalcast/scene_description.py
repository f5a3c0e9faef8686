"""Descriptions of scenes: domains, and the shapes, materials and textures that they share."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, TypeAlias, overload

import numpy as np

from modalcast._chunks import malformed
from modalcast._types import F32, F64, U32, Bytes
from modalcast.v1 import scenes_pb2

ArrayName: TypeAlias = Literal[
    "indices", "corner_vertices", "rest_positions", "uvs", "rest_normals", "modes", "centered_positions"
]

# Value of the enum `Array`, type, and number of columns. The modes have `rank` columns.
_ARRAYS: dict[str, tuple[scenes_pb2.Array, str, int | None]] = {
    "indices": (scenes_pb2.ARRAY_INDICES, "<u4", 3),
    "corner_vertices": (scenes_pb2.ARRAY_CORNER_VERTICES, "<u4", 1),
    "rest_positions": (scenes_pb2.ARRAY_REST_POSITIONS, "<f4", 3),
    "uvs": (scenes_pb2.ARRAY_UVS, "<f4", 2),
    "rest_normals": (scenes_pb2.ARRAY_REST_NORMALS, "<f4", 3),
    "modes": (scenes_pb2.ARRAY_MODES, "<f4", None),
    "centered_positions": (scenes_pb2.ARRAY_CENTERED_POSITIONS, "<f4", 3),
}
ARRAY_NAMES = {number: name for name, (number, _, _) in _ARRAYS.items()}
ALPHA_MODES = {
    scenes_pb2.ALPHA_MODE_OPAQUE: "opaque",
    scenes_pb2.ALPHA_MODE_MASK: "mask",
    scenes_pb2.ALPHA_MODE_BLEND: "blend",
}


@dataclass(frozen=True, eq=False)
class Shape:
    """A mesh of n vertices and its r modes. Arrays that were not requested are missing in `arrays`.

    Attributes:
        index: Index in the scene.
        vertex_count: n; U has 3n rows.
        rank: r, the number of columns of U.
        corner_count: Number of corners: vertices with one normal and one pair of texture coordinates.
        triangle_count: Number of triangles.
        eigenvalues: Squared angular frequencies in (rad/s)^2, one per mode; empty if unknown.
        hashes: SHA-256 of the arrays by name, if hashes were requested.
        sizes: Sizes of the arrays in bytes, by name.
        origin: The point c that "centered_positions" are relative to, in scene units and in the domain's own frame.
            Zero unless f32 would round x0 too coarsely.
        arrays: "indices" (m x 3, corners), "corner_vertices" (one vertex per corner), "rest_positions" (n x 3, scene
            units, in the domain's own frame), "uvs" (two per corner), "rest_normals" (three per corner) and "modes"
            (U: 3n x r, scene units per unit of q). "centered_positions" (n x 3, x0 - c) is empty if the shape has no
            origin.
    """

    index: int
    vertex_count: int
    rank: int
    corner_count: int
    triangle_count: int
    eigenvalues: F64
    hashes: Mapping[str, bytes]
    sizes: Mapping[str, int]
    origin: F64 = field(default_factory=lambda: np.zeros(3))
    arrays: dict[str, F32 | U32] = field(default_factory=dict[str, "F32 | U32"], repr=False)

    @property
    def faces(self) -> U32:
        """Vertices of each triangle, m x 3. Needs the arrays "indices" and "corner_vertices"."""
        faces = self.arrays["corner_vertices"][self.arrays["indices"].astype(np.intp)]
        return faces.astype(np.uint32, copy=False)

    @property
    def exact_positions(self) -> F64:
        """x0 in f64, n x 3. Needs the array "centered_positions" if the shape has an origin, else "rest_positions"."""
        if self.origin.any():
            return self.arrays["centered_positions"] + self.origin
        return self.arrays["rest_positions"].astype(np.float64)


@dataclass(frozen=True, eq=False)
class Material:
    """A Phong material; `MaterialDescription` in `scenes.proto` documents the fields. Colors are linear."""

    index: int
    name: str
    ambient: F32
    diffuse: F32
    specular: F32
    shininess: float
    alpha: float
    alpha_mode: str
    alpha_cutoff: float
    double_sided: bool
    color_texture: int | None
    normal_texture: int | None


@dataclass(frozen=True, eq=False)
class Texture:
    """An image. `pixels` is H x W x 4, top row first; None if textures were not requested."""

    index: int
    name: str
    width: int
    height: int
    sha256: bytes
    pixels: Bytes | None = field(default=None, repr=False)


@dataclass(frozen=True, eq=False)
class Domain:
    """A domain: a mesh, a matrix U of `rank` modes, and coordinates q.

    Attributes:
        index: Index in the scene.
        name: Unique in the scene.
        rank: r, the number of modes: q has r numbers.
        vertex_count: n, the number of vertices.
        eigenvalues: Squared angular frequencies in (rad/s)^2, one per mode; empty if unknown.
        notes: Free-form metadata of the scene's author, such as the unit of q.
        placement: world_from_domain at rest, 3x4, translation in scene units.
        rest_q: q at rest, r numbers.
        parent: Index of the domain to which this one is attached; None if it is not attached.
        attachment_frame: parent_from_child at rest, 3x4; None without parent.
        attachment_vertices: Vertices of the parent to which this domain is attached.
        follows: Index of the domain whose transform this domain follows; None if it has its own.
        follow_frame: followed_from_follower, 3x4; None if `follows` is None.
        shares_q_with: Index of the domain whose coordinates this domain has; None if it has its own.
        shape: Index of its shape.
        material: Index of its material, unless `material_ranges` is set.
        material_ranges: Pairs of first triangle and material; empty if all triangles have `material`.
        exact_placement: `placement` in f64; None unless the domain is so far from the scene's origin that f32 rounds
            it.
    """

    index: int
    name: str
    rank: int
    vertex_count: int
    eigenvalues: F64
    notes: Mapping[str, str]
    placement: F32
    rest_q: F32
    parent: int | None
    attachment_frame: F32 | None
    attachment_vertices: U32
    follows: int | None
    follow_frame: F32 | None
    shares_q_with: int | None
    shape: int
    material: int
    material_ranges: tuple[tuple[int, int], ...]
    exact_placement: F64 | None = None

    @property
    def frequencies(self) -> F64:
        """Frequencies of the modes in Hz; empty if the eigenvalues are unknown."""
        return np.sqrt(np.maximum(self.eigenvalues, 0)) / (2 * np.pi)

    def __repr__(self) -> str:
        return f"Domain({self.index}, '{self.name}', rank {self.rank}, {self.vertex_count} vertices)"


class Domains(Sequence[Domain]):
    """The domains of a scene in order. `domains["name"]` and `domains[index]` return one domain."""

    def __init__(self, domains: Iterable[Domain]) -> None:
        self._list = list(domains)

    @cached_property
    def _by_name(self) -> dict[str, Domain]:
        return {domain.name: domain for domain in self._list}

    @overload
    def __getitem__(self, key: int | str | Domain) -> Domain: ...
    @overload
    def __getitem__(self, key: slice) -> Sequence[Domain]: ...
    def __getitem__(self, key: int | str | Domain | slice) -> Domain | Sequence[Domain]:
        """A domain by its name or index.

        Raises:
            KeyError: No domain has the name; the message lists near names.
            IndexError: No domain has the index.
        """
        if isinstance(key, Domain):
            key = key.index
        if isinstance(key, str):
            return self._named(key)
        if isinstance(key, int) and not -len(self._list) <= key < len(self._list):
            raise IndexError(f"expected an index of a domain below {len(self._list)}, got {key}")
        return self._list[key]

    def _named(self, name: str) -> Domain:
        if name not in self._by_name:
            near = difflib.get_close_matches(name, self._by_name, n=4, cutoff=0.4) or list(self._by_name)[:4]
            raise KeyError(f"no domain is named '{name}'; the scene has {len(self)} domains, near names: {near}")
        return self._by_name[name]

    def __contains__(self, key: object) -> bool:
        return key in self._by_name if isinstance(key, str) else key in self._list

    def __len__(self) -> int:
        return len(self._list)

    def __iter__(self) -> Iterator[Domain]:
        return iter(self._list)

    def __repr__(self) -> str:
        shown = ", ".join(f"'{domain.name}'" for domain in self._list[:6])
        return f"<{len(self)} domains: {shown}{', ...' if len(self) > 6 else ''}>"


@dataclass(frozen=True, eq=False)
class SceneDescription:
    """A description. `shapes`, `materials` and `textures` are those that the described domains use, by index."""

    info: scenes_pb2.SceneInfo
    domains: Domains
    shapes: Mapping[int, Shape]
    materials: Mapping[int, Material]
    textures: Mapping[int, Texture]

    def shape_of(self, domain: Domain) -> Shape:
        """The mesh and the modes of a domain."""
        return self.shapes[domain.shape]


def array_enum_values(names: Sequence[str]) -> list[scenes_pb2.Array]:
    """The values of the enum `Array` in the contract.

    Raises:
        ValueError: A name is unknown.
    """
    for name in names:
        if name not in _ARRAYS:
            raise ValueError(f"arrays: expected names from {list(_ARRAYS)}, got '{name}'")
    return [_ARRAYS[name][0] for name in names]


def decode_array(shape: Shape, name: str, data: Bytes) -> F32 | U32:
    """Converts the bytes of an array of a shape."""
    _, dtype, columns = _ARRAYS[name]
    columns = shape.rank if columns is None else columns
    if len(data) == 0:
        return np.empty((0,) if columns == 1 else (0, columns), dtype)
    if columns == 0 or len(data) % (4 * columns) != 0:
        raise malformed(f"describe.{name}", f"a multiple of {4 * columns} bytes", str(len(data)))
    values = data.view(dtype)
    return values if columns == 1 else values.reshape(-1, columns)


def shape_from_message(message: scenes_pb2.ShapeDescription) -> Shape:
    """Converts a shape without arrays."""
    origin = _numbers(f"describe.shapes[{message.shape}].origin", message.origin, 3)
    known = [array for array in message.arrays if array.array in ARRAY_NAMES]
    return Shape(
        index=message.shape,
        vertex_count=message.vertices,
        rank=message.rank,
        corner_count=message.corners,
        triangle_count=message.triangles,
        eigenvalues=np.array(message.eigenvalues, np.float64),
        hashes={ARRAY_NAMES[array.array]: array.sha256 for array in known if array.sha256},
        sizes={ARRAY_NAMES[array.array]: array.bytes for array in known},
        origin=np.zeros(3) if origin is None else origin,
    )


def material_from_message(message: scenes_pb2.MaterialDescription) -> Material:
    """Converts a material."""
    return Material(
        index=message.material,
        name=message.name,
        ambient=np.array(message.ambient, np.float32),
        diffuse=np.array(message.diffuse, np.float32),
        specular=np.array(message.specular, np.float32),
        shininess=message.shininess,
        alpha=message.alpha,
        alpha_mode=ALPHA_MODES.get(message.alpha_mode, ""),
        alpha_cutoff=message.alpha_cutoff,
        double_sided=message.double_sided,
        color_texture=message.color_texture if message.HasField("color_texture") else None,
        normal_texture=message.normal_texture if message.HasField("normal_texture") else None,
    )


def texture_from_message(message: scenes_pb2.TextureDescription) -> Texture:
    """Converts a texture without pixels."""
    return Texture(message.texture, message.name, message.width, message.height, message.sha256)


def domain_from_message(message: scenes_pb2.DomainDescription, shapes: Mapping[int, Shape]) -> Domain:
    """Converts a domain. `shapes` has its shape."""
    if message.shape not in shapes:
        raise malformed(f"describe.domains[{message.domain}].shape", "a described shape", str(message.shape))
    shape = shapes[message.shape]
    field_ = f"describe.domains[{message.domain}]"
    attachment_frame = _matrix(f"{field_}.attachment_frame", message.attachment_frame)
    follow_frame = _matrix(f"{field_}.follow_frame", message.follow_frame)
    follows = message.follows if message.HasField("follows") else None
    eigenvalues = np.array(message.eigenvalues.values) if message.HasField("eigenvalues") else shape.eigenvalues
    rest_q = np.frombuffer(message.rest_q, "<f4") if message.rest_q else np.zeros(shape.rank, np.float32)
    placement = _matrix(f"{field_}.placement", message.placement)
    exact_placement = _numbers(f"{field_}.exact_placement", message.exact_placement, 12)
    if placement is None or len(rest_q) != shape.rank:
        raise malformed(field_, f"a placement and {shape.rank} coordinates", f"{len(rest_q)} coordinates")
    return Domain(
        index=message.domain,
        name=message.name,
        rank=shape.rank,
        vertex_count=shape.vertex_count,
        eigenvalues=eigenvalues,
        notes=dict(message.notes),
        placement=placement,
        rest_q=rest_q,
        parent=message.parent if message.HasField("parent") else None,
        attachment_frame=attachment_frame,
        attachment_vertices=np.array(message.attachment_vertices, np.uint32),
        follows=follows,
        # A follower without a frame of its own is fixed at its attachment frame.
        follow_frame=None if follows is None else attachment_frame if follow_frame is None else follow_frame,
        shares_q_with=message.shares_q_with if message.HasField("shares_q_with") else None,
        shape=message.shape,
        material=message.material,
        material_ranges=tuple((part.first_triangle, part.material) for part in message.material_ranges),
        exact_placement=None if exact_placement is None else exact_placement.reshape(3, 4),
    )


def _numbers(name: str, given: Sequence[float], count: int) -> F64 | None:
    """A list of `count` numbers; None for an empty list."""
    if len(given) not in (0, count):
        raise malformed(name, f"none or {count} numbers", str(len(given)))
    return np.array(given, np.float64) if len(given) > 0 else None


def _matrix(name: str, data: bytes) -> F32 | None:
    if not data:
        return None
    if len(data) != 48:
        raise malformed(name, "48 bytes", str(len(data)))
    return np.frombuffer(data, "<f4").reshape(3, 4)
