"""Deformed vertices: selections, encodings, and the arrays of a step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np

from modalcast._chunks import malformed
from modalcast._common import StepId, stage_times, step_id
from modalcast._types import F32, F64, Bytes, check_shape
from modalcast.scene_description import Domain, Domains
from modalcast.v1 import vertices_pb2

AttributeName: TypeAlias = Literal["positions", "normals", "displacements", "boxes"]
EncodingName: TypeAlias = Literal["f32", "f16", "u16_box", "octahedral_i16"]
Attributes: TypeAlias = Sequence[AttributeName] | Mapping[AttributeName, EncodingName]
"""Names of attributes, or their encodings by name. `vertices.proto` states the size and the error of each encoding."""

_ATTRIBUTES: dict[str, vertices_pb2.Attribute] = {
    "positions": vertices_pb2.ATTRIBUTE_POSITIONS,
    "normals": vertices_pb2.ATTRIBUTE_NORMALS,
    "displacements": vertices_pb2.ATTRIBUTE_DISPLACEMENTS,
    "boxes": vertices_pb2.ATTRIBUTE_BOXES,
}
_ENCODINGS: dict[str, vertices_pb2.Encoding] = {
    "f32": vertices_pb2.ENCODING_F32,
    "f16": vertices_pb2.ENCODING_F16,
    "u16_box": vertices_pb2.ENCODING_U16_BOX,
    "octahedral_i16": vertices_pb2.ENCODING_OCTAHEDRAL_I16,
}
# Number of consecutive vectors that share a box in ENCODING_U16_BOX.
_VECTORS_PER_BOX = 256


def vertex_selection(
    domains: Domains, selected: Sequence[int | str | Domain], attributes: Attributes
) -> vertices_pb2.VertexSelection:
    """The message of a selection. An empty list selects all domains.

    Raises:
        KeyError: A domain name is unknown.
        ValueError: An attribute or an encoding is unknown, or no attribute is selected.
    """
    encodings = dict(attributes) if isinstance(attributes, Mapping) else dict.fromkeys(attributes, "f32")
    if not encodings:
        raise ValueError(f"attributes: expected at least one of {list(_ATTRIBUTES)}, got none")
    for attribute, encoding in encodings.items():
        if attribute not in _ATTRIBUTES:
            raise ValueError(f"attributes: expected names from {list(_ATTRIBUTES)}, got '{attribute}'")
        if encoding not in _ENCODINGS:
            raise ValueError(f"encoding of {attribute}: expected one of {list(_ENCODINGS)}, got '{encoding}'")
    return vertices_pb2.VertexSelection(
        domains=[domains[domain].index for domain in selected],
        attributes=[
            vertices_pb2.SelectedAttribute(attribute=_ATTRIBUTES[attribute], encoding=_ENCODINGS[encoding])
            for attribute, encoding in encodings.items()
        ],
    )


def output_bytes(out: F32, vertex_count: int) -> Bytes:
    """The bytes of `out`, an array of the caller that receives positions.

    Raises:
        ValueError: The array has another shape or type, is not C-contiguous, or is read-only.
    """
    check_shape("out", out, (vertex_count, 3))
    if out.dtype != np.dtype("<f4") or not out.flags.c_contiguous or not out.flags.writeable:
        flags = f"contiguous {out.flags.c_contiguous}, writable {out.flags.writeable}"
        raise ValueError(f"out: expected a writable C-contiguous array of float32, got {out.dtype}, {flags}")
    return out.reshape(-1).view(np.uint8)


@dataclass(frozen=True, eq=False)
class VertexSet:
    """The vertices of a step, for one selected domain after the other. Attributes that were not requested are None.

    Attributes:
        step: The step.
        layout: The selected domains, and their numbers of vertices and corners, as a message.
        positions: vertices x 3 in scene units: a vertex is at origin + unit * position in the world.
        normals: corners x 3, unit vectors in world axes. A corner is a vertex with its normal and texture coordinates.
        displacements: u = U q, vertices x 3 in scene units, in each domain's own frame.
        boxes: Minimum and maximum of the positions of each domain: domains x 2 x 3.
        origins: World position in meters of the origin of the positions: 1 x 3, or one row per selected domain.
        skipped: Number of steps skipped since the previous step of the stream.
        stages: Milliseconds by stage.
    """

    step: StepId
    layout: vertices_pb2.VertexLayout = field(repr=False)
    positions: F32 | None
    normals: F32 | None
    displacements: F32 | None
    boxes: F32 | None
    origins: F64
    skipped: int
    stages: dict[str, float] = field(repr=False)

    @cached_property
    def domains(self) -> tuple[int, ...]:
        """Indices of the selected domains."""
        return tuple(self.layout.domains)

    @cached_property
    def vertex_counts(self) -> tuple[int, ...]:
        """Number of vertices of each selected domain."""
        return tuple(self.layout.vertices)

    @cached_property
    def corner_counts(self) -> tuple[int, ...]:
        """Number of corners of each selected domain."""
        return tuple(self.layout.corners)

    def positions_of(self, domain: int | Domain) -> F32:
        """The positions of one domain, vertices x 3, as a view of `positions`.

        Raises:
            ValueError: The domain or the positions were not selected.
        """
        index = domain.index if isinstance(domain, Domain) else domain
        if index not in self.domains or self.positions is None:
            raise ValueError(f"expected a selection with positions of domain {index}, got domains {self.domains}")
        place = self.domains.index(index)
        first = sum(self.vertex_counts[:place])
        return self.positions[first : first + self.vertex_counts[place]]


class VertexDecoder:
    """Decodes the replies of one call. Keeps the layout and the origins, which are sent once."""

    def __init__(self) -> None:
        self._layout = vertices_pb2.VertexLayout()
        self._vectors: dict[int, int] = {}
        self._origins: F64 = np.zeros((1, 3))

    def add_layout(self, part: vertices_pb2.VertexLayout) -> None:
        """Adds a part of the layout."""
        self._layout.MergeFrom(part)
        vertex_count, corner_count = sum(self._layout.vertices), sum(self._layout.corners)
        self._vectors = {
            vertices_pb2.ATTRIBUTE_POSITIONS: vertex_count,
            vertices_pb2.ATTRIBUTE_NORMALS: corner_count,
            vertices_pb2.ATTRIBUTE_DISPLACEMENTS: vertex_count,
            vertices_pb2.ATTRIBUTE_BOXES: 2 * len(self._layout.domains),
        }

    def decode(self, head: vertices_pb2.VertexHead, target: Bytes, data: Bytes) -> VertexSet:
        """Decodes the sections of a step. Their offsets count the bytes of `target`, then those of `data`."""
        arrays: dict[int, F32] = {}
        for section in head.sections:
            start, end = section.offset, section.offset + section.bytes
            in_target = end <= len(target)
            content = target[start:end] if in_target else data[max(start - len(target), 0) : end - len(target)]
            if len(content) != section.bytes:
                raise malformed("vertices.sections", f"{section.bytes} bytes at {start}", f"{len(content)} bytes")
            if section.attribute == vertices_pb2.ATTRIBUTE_ORIGINS:
                self._origins = content.view("<f8").reshape(-1, 3)
            elif section.attribute in self._vectors:
                arrays[section.attribute] = decode_vectors(section.encoding, self._vectors[section.attribute], content)
        boxes = arrays.get(vertices_pb2.ATTRIBUTE_BOXES)
        return VertexSet(
            step=step_id(head.step),
            layout=self._layout,
            positions=arrays.get(vertices_pb2.ATTRIBUTE_POSITIONS),
            normals=arrays.get(vertices_pb2.ATTRIBUTE_NORMALS),
            displacements=arrays.get(vertices_pb2.ATTRIBUTE_DISPLACEMENTS),
            boxes=None if boxes is None else boxes.reshape(-1, 2, 3),
            origins=self._origins,
            skipped=head.skipped,
            stages=stage_times(head.stages),
        )


def decode_vectors(encoding: int, count: int, data: Bytes) -> F32:
    """Decodes `count` vectors to count x 3. f32 vectors are a view of `data`."""
    boxes = -(-count // _VECTORS_PER_BOX)
    sizes: dict[int, int] = {
        vertices_pb2.ENCODING_UNSPECIFIED: 12 * count,
        vertices_pb2.ENCODING_F32: 12 * count,
        vertices_pb2.ENCODING_F16: 6 * count,
        vertices_pb2.ENCODING_U16_BOX: 24 * boxes + 6 * count,
        vertices_pb2.ENCODING_OCTAHEDRAL_I16: 4 * count,
    }
    if sizes.get(encoding) != len(data):
        raise malformed("vertices.sections.bytes", str(sizes.get(encoding, "a known encoding")), str(len(data)))
    if encoding == vertices_pb2.ENCODING_F16:
        return data.view("<f2").astype(np.float32).reshape(-1, 3)
    if encoding == vertices_pb2.ENCODING_U16_BOX:
        corners = data[: 24 * boxes].view("<f4").reshape(-1, 2, 3).astype(np.float64)
        box_of_vector = np.arange(count) // _VECTORS_PER_BOX
        minimum, maximum = corners[box_of_vector, 0], corners[box_of_vector, 1]
        codes = data[24 * boxes :].view("<u2").reshape(-1, 3)
        return (minimum + codes * ((maximum - minimum) / 65535)).astype(np.float32)
    if encoding == vertices_pb2.ENCODING_OCTAHEDRAL_I16:
        return _decode_octahedral(data)
    return data.view("<f4").reshape(-1, 3)


def _decode_octahedral(data: Bytes) -> F32:
    xy = data.view("<i2").reshape(-1, 2).astype(np.float32) / np.float32(32767)
    z = 1 - np.abs(xy).sum(axis=1)
    # The lower half of the octahedron is folded over the diagonals of the square.
    folded = np.copysign(1 - np.abs(xy[:, ::-1]), xy)
    vectors = np.column_stack((np.where((z < 0)[:, None], folded, xy), z))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)
