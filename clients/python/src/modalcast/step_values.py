"""The values that steps send: conversion of the caller's arrays, transforms of attached domains, and messages."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike

from modalcast._types import F32, F64, Vector, affine, to_f32, vector3
from modalcast.kinematics import Kinematics
from modalcast.scene_description import Domain
from modalcast.states import StateLayout, square
from modalcast.v1 import steps_pb2

# In bytes: a step of at most _MAX_SINGLE_BYTES is one message, a larger one is sent in parts of _PART_BYTES.
_MAX_SINGLE_BYTES = 1 << 20
_PART_BYTES = 512 << 10
# The index of a domain is a varint of at most 5 bytes.
_PART_DOMAINS = _PART_BYTES // 5


@dataclass(frozen=True)
class WorldPose:
    """A rigid transform relative to the origin of the world, with an f64 translation, for scenes far from the origin.

    Attributes:
        rotation: Quaternion x, y, z, w; w is the real part. Its norm may differ from 1 by at most 0.001.
        translation: In scene units.
    """

    rotation: Vector
    translation: Vector

    def to_bytes(self) -> bytes:
        """The quaternion in f32, then the translation in f64."""
        rotation = to_f32("rotation", self.rotation, (4,))
        return rotation.tobytes() + np.array(vector3("translation", self.translation), "<f8").tobytes()


DomainKey: TypeAlias = int | str | Domain
"""The name or the index of a domain, or the domain itself."""

# The keys of mappings are invariant, so a mapping of `int | str | Domain` would reject a dictionary of names.
Coordinates: TypeAlias = Mapping[Any, ArrayLike] | ArrayLike
"""q by domain (name, index or domain), r numbers each; or all coordinates of the scene."""

Transforms: TypeAlias = Mapping[Any, "ArrayLike | WorldPose"]
"""world_from_domain by domain (name, index or domain): 3x4 or 4x4 matrices, or world poses."""


class StepValues:
    """The current coordinates and transforms of a scene, and what has changed since the last step.

    The arguments of a step are converted and checked completely before any value changes.
    """

    def __init__(self, layout: StateLayout, kinematics: Kinematics | None, q: F32, transforms: F32) -> None:
        """Begins with a state.

        Args:
            layout: The layout of the scene.
            kinematics: Computes the transforms of attached domains; None leaves them to the caller.
            q: All coordinates.
            transforms: world_from_domain of every domain, domains x 3 x 4.
        """
        self._layout = layout
        self._kinematics = kinematics
        self._q = q.copy()
        # world_from_domain as 4 x 4 per domain. `kinematics` ignores those of attached domains and followers.
        self._roots: F64 = np.stack([square(transform) for transform in transforms])
        self._sent: F32 = transforms.copy()
        # The last pose of each domain, if the caller sends poses instead of matrices.
        self._poses: dict[int, WorldPose] = {}
        domains = layout.domains
        self._is_attached = np.array([domain.parent is not None and domain.follows is None for domain in domains])

    def step(
        self,
        number: int,
        time: float,
        q: Coordinates | None,
        transforms: Transforms | None,
    ) -> steps_pb2.Step:
        """The message with the given values and the transforms of attached domains that change.

        Raises:
            KeyError: A domain name is unknown.
            ValueError: An array has another shape, or a domain has no coordinates or no transform of its own.
        """
        step = steps_pb2.Step(number=number, time=time)
        changed_q = self._convert_q(q)
        matrices, poses = self._convert_transforms(transforms or {})
        for domain, values in changed_q.items():
            step.q_domains.append(domain)
            self._q[self._layout.q_slice(self._layout.domains[domain])] = values
        step.q = b"".join(values.tobytes() for values in changed_q.values())
        self._poses.update(poses)
        if poses:
            _add_poses(step, poses)
        else:
            self._add_matrices(step, matrices)
        return step

    def complete_step(self, number: int, time: float) -> steps_pb2.Step:
        """A step with all values, for a server that may have lost some of them.

        Transforms of a step have one format. If earlier steps have sent world poses, this step has the last pose of
        each domain, and domains without a pose keep the transforms that the server has.
        """
        domains = self._layout.domains
        step = steps_pb2.Step(number=number, time=time)
        owners = [domain for domain in domains if self._layout.owns_q[domain.index] and domain.rank > 0]
        step.q_domains.extend(domain.index for domain in owners)
        step.q = b"".join(self._q[self._layout.q_slice(domain)].tobytes() for domain in owners)
        if self._poses:
            _add_poses(step, self._poses)
            return step
        moved = [domain.index for domain in domains if domain.follows is None]
        step.transform_domains.extend(moved)
        step.transforms = self._sent[moved].tobytes()
        return step

    def _add_matrices(self, step: steps_pb2.Step, matrices: Mapping[int, F32]) -> None:
        for index, matrix in matrices.items():
            self._roots[index] = square(matrix)
        current = self._sent.copy()
        # The server rejects a step with infinite numbers or NaN.
        is_finite = bool(np.isfinite(self._q).all() and np.isfinite(self._roots).all())
        if self._kinematics is not None and (step.q_domains or matrices) and is_finite:
            computed = self._kinematics.transforms(self._q.astype(np.float64), self._roots)[:, :3]
            current[self._is_attached] = computed[self._is_attached]
        for index, matrix in matrices.items():
            current[index] = matrix
        moved = np.flatnonzero((current.view(np.uint32) != self._sent.view(np.uint32)).any(axis=(1, 2)))
        step.transform_domains.extend(moved.tolist())
        step.transforms = current[moved].tobytes()
        self._sent = current

    def _convert_q(self, q: Coordinates | None) -> dict[int, F32]:
        layout = self._layout
        if q is None:
            return {}
        if not isinstance(q, Mapping):
            values = to_f32("q of the scene", q, (layout.coordinate_count,))
            owners = [domain for domain in layout.domains if layout.owns_q[domain.index] and domain.rank > 0]
            return {domain.index: values[layout.q_slice(domain)] for domain in owners}
        converted: dict[int, F32] = {}
        coordinates_of = cast(Mapping[DomainKey, ArrayLike], q)
        for key, coordinates in coordinates_of.items():
            domain = layout.domains[key]
            if domain.shares_q_with is not None:
                owner = layout.domains[domain.shares_q_with].name
                raise ValueError(f"q: domain '{domain.name}' has the coordinates of domain '{owner}': set those")
            converted[domain.index] = to_f32(f"q of domain '{domain.name}'", coordinates, (domain.rank,))
        return converted

    def _convert_transforms(self, transforms: Transforms) -> tuple[dict[int, F32], dict[int, WorldPose]]:
        matrices: dict[int, F32] = {}
        poses: dict[int, WorldPose] = {}
        for key, transform in cast(Mapping[DomainKey, "ArrayLike | WorldPose"], transforms).items():
            domain = self._layout.domains[key]
            name = f"transform of domain '{domain.name}'"
            if domain.follows is not None:
                leader = self._layout.domains[domain.follows].name
                raise ValueError(f"{name}: the domain follows domain '{leader}': set the transform of that domain")
            if isinstance(transform, WorldPose):
                poses[domain.index] = transform
            elif self._kinematics is not None and self._is_attached[domain.index]:
                raise ValueError(f"{name}: it follows from the joint; open the drive with joints=False to set it")
            else:
                matrices[domain.index] = affine(name, transform)
        if poses and (matrices or self._kinematics is not None):
            raise ValueError("transforms: expected world poses only, in a drive with joints=False")
        if matrices and self._poses:
            raise ValueError("transforms: expected world poses, as in earlier steps of the drive, got matrices")
        return matrices, poses


def _add_poses(step: steps_pb2.Step, poses: Mapping[int, WorldPose]) -> None:
    step.transform_domains.extend(poses)
    step.transforms = b"".join(pose.to_bytes() for pose in poses.values())
    step.transform_format = steps_pb2.TRANSFORM_FORMAT_QUATERNION_XYZW_F64


def step_parts(step: steps_pb2.Step) -> Iterator[steps_pb2.Step]:
    """The step as one message or, above 1 MiB, in parts."""
    if step.ByteSize() <= _MAX_SINGLE_BYTES:
        yield step
        return
    parts = [
        steps_pb2.Step(number=step.number, time=step.time, transform_format=step.transform_format),
        *(steps_pb2.Step(number=step.number, q_domains=piece) for piece in _pieces(step.q_domains, _PART_DOMAINS)),
        *(steps_pb2.Step(number=step.number, q=piece) for piece in _pieces(step.q, _PART_BYTES)),
        *(
            steps_pb2.Step(number=step.number, transform_domains=piece)
            for piece in _pieces(step.transform_domains, _PART_DOMAINS)
        ),
        *(steps_pb2.Step(number=step.number, transforms=piece) for piece in _pieces(step.transforms, _PART_BYTES)),
    ]
    for part in parts[:-1]:
        part.has_more = True
    yield from parts


def _pieces(values: Any, size: int) -> Iterator[Any]:
    """Splits a list or bytes."""
    for start in range(0, len(values), size):
        yield values[start : start + size]


def rest_values(layout: StateLayout) -> tuple[F32, F32]:
    """The coordinates and the transforms of the scene at rest."""
    q = np.zeros(layout.coordinate_count, np.float32)
    for domain in layout.domains:
        if layout.owns_q[domain.index]:
            q[layout.q_slice(domain)] = domain.rest_q
    return q, np.stack([domain.placement for domain in layout.domains]).astype(np.float32)


def to_time(time: float) -> float:
    """Checks a simulation time in seconds.

    Raises:
        ValueError: The time is not a finite number.
    """
    if not math.isfinite(time):
        raise ValueError(f"time: expected a finite number of seconds, got {time}")
    return float(time)
