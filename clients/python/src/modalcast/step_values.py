"""The values that steps send: conversion of the caller's arrays, transforms of attached domains, and messages."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modalcast._step_message import StepMessage
from modalcast._types import F32, F64, Indices, Rows, affine, to_f32, to_f64
from modalcast.kinematics import Kinematics
from modalcast.scene_description import Domain
from modalcast.states import StateLayout, square
from modalcast.v1 import steps_pb2

# A world pose on the wire.
_POSE = np.dtype([("rotation", "<f4", 4), ("translation", "<f8", 3)])


@dataclass(frozen=True)
class WorldPose:
    """A rigid transform relative to the origin of the world, with an f64 translation, for scenes far from the origin.

    Arrays with one more dimension have the poses of all domains of a scene.

    Attributes:
        rotation: Quaternion x, y, z, w; w is the real part. Its norm may differ from 1 by at most 0.001.
        translation: In scene units.
    """

    rotation: ArrayLike
    translation: ArrayLike

    def to_rows(self, name: str, shape: tuple[int, ...]) -> Rows:
        """The poses as on the wire, in an array of this shape.

        Raises:
            ValueError: The rotation or the translation has another shape.
        """
        rows = np.empty(shape, _POSE)
        rows["rotation"] = to_f32(f"rotation in {name}", self.rotation, (*shape, 4))
        rows["translation"] = to_f64(f"translation in {name}", self.translation, (*shape, 3))
        return rows


DomainKey: TypeAlias = int | str | Domain
"""The name or the index of a domain, or the domain itself."""

# The keys of mappings are invariant, so a mapping of `int | str | Domain` would reject a dictionary of names.
Coordinates: TypeAlias = Mapping[Any, ArrayLike] | ArrayLike
"""q by domain (name, index or domain), r numbers each; or all coordinates of the scene."""

Transforms: TypeAlias = Mapping[Any, "ArrayLike | WorldPose"] | ArrayLike | WorldPose
"""world_from_domain by domain (name, index or domain), 3x4 or 4x4 matrices or world poses; or those of all domains."""


@dataclass(frozen=True)
class _GivenTransforms:
    """Transforms of k domains, each given once. `is_whole`: of all domains whose transforms the caller sets."""

    domains: Indices
    rows: Rows
    is_whole: bool = False

    @property
    def are_poses(self) -> bool:
        """Whether the rows are poses, not matrices."""
        return self.rows.dtype == _POSE


_NO_TRANSFORMS = _GivenTransforms(np.empty(0, np.intp), np.empty((0, 3, 4), np.float32))


class StepValues:
    """The current coordinates and transforms of a scene, and what has changed since the last step.

    The arguments of a step are converted and checked completely before any value changes. The cost of a step depends on
    the domains that it changes, not on those of the scene. Arrays of all domains are converted without a loop.
    """

    def __init__(self, layout: StateLayout, kinematics: Kinematics | None, q: F32, transforms: F64 | F32) -> None:
        """Begins with a state.

        Args:
            layout: The layout of the scene.
            kinematics: Computes the transforms of attached domains; None leaves them to the caller.
            q: All coordinates.
            transforms: world_from_domain of every domain as the server has it, domains x 3 x 4.
        """
        self._layout = layout
        self._kinematics = kinematics
        self._q = q.copy()
        self._first: F64 = transforms.astype(np.float64)
        # The first transforms rounded to f32, or those that steps have sent since.
        self._sent: F32 = transforms.astype(np.float32)
        # Whether the server has exactly the transform in `_sent`: f32 represents the first one, or a step has sent it.
        self._is_exact = (self._sent == self._first).all(axis=(1, 2))
        # The last pose of each domain, if the caller sends poses instead of matrices.
        self._poses: Rows = np.zeros(len(transforms), _POSE)
        self._has_pose = np.zeros(len(transforms), bool)
        # Domains whose transforms follow from those of other domains, and domains whose transforms the caller sets.
        self._is_attached = layout.is_attached & (kinematics is not None)
        self._own = layout.roots[~self._is_attached[layout.roots]]
        # world_from_domain in f64, 4 x 4, from which the transforms of attached domains are computed.
        self._world: F64 = square(self._first) if kinematics is not None else np.empty((0, 4, 4))
        # Whether the transforms of attached domains may not follow from the coordinates, as those of the first state.
        self._is_world_stale = True

    def step(
        self,
        number: int,
        time: float,
        q: Coordinates | None,
        transforms: Transforms | None,
    ) -> StepMessage:
        """The message with the given values and the transforms of attached domains that change.

        Its arrays may be those of the caller: encode it before they change.

        Raises:
            KeyError: A domain name is unknown.
            ValueError: An array has another shape, or a domain has no coordinates or no transform of its own.
        """
        new_q = self._convert_q({} if q is None else q)
        given = _NO_TRANSFORMS if transforms is None else self._convert_transforms(transforms)
        message = StepMessage(steps_pb2.Step(number=number, time=time))
        self._add_q(message, new_q)
        if given.are_poses:
            self._add_poses(message, given)
        else:
            self._add_matrices(message, given, new_q)
        return message

    def complete_step(self, number: int, time: float) -> StepMessage:
        """A step with all values, for a server that may have lost some of them.

        Transforms of a step have one format. If earlier steps have sent world poses, this step has the last pose of
        each domain, and domains without a pose keep the transforms that the server has. Otherwise it has matrices. A
        domain whose first transform f32 would round keeps the one that the server has until a step sends another one.
        """
        message = StepMessage(steps_pb2.Step(number=number, time=time))
        self._add_q(message, self._q)
        if self._has_pose.any():
            domains = np.flatnonzero(self._has_pose)
            self._add_poses(message, _GivenTransforms(domains, self._poses[domains]))
        else:
            roots = self._layout.roots
            self._add_sent(message, roots[self._is_exact[roots]])
        return message

    def at_rest(self) -> StepValues:
        """The values at rest. Their complete step returns the scene to rest from the values of this object.

        Domains that have moved return to their placement in f32, and those that have not moved keep it in f64.
        """
        q, transforms = rest_values(self._layout)
        has_moved = self._is_exact | self._has_pose | _differ(self._first, transforms)
        transforms[has_moved] = transforms[has_moved].astype(np.float32)
        return StepValues(self._layout, self._kinematics, q, transforms)

    def _add_q(self, message: StepMessage, new_q: dict[int, F32] | F32) -> None:
        if not isinstance(new_q, dict):
            self._q[:] = new_q
            message.head.q_domains.extend(self._layout.all_q_domains)
            message.q = new_q
        elif new_q:
            for index, values in new_q.items():
                self._q[self._layout.q_slice(self._layout.domains[index])] = values
            message.head.q_domains.extend(new_q)
            message.q = np.concatenate(list(new_q.values()))

    def _add_poses(self, message: StepMessage, given: _GivenTransforms) -> None:
        self._poses[given.domains] = given.rows
        self._has_pose[given.domains] = True
        message.head.transform_format = steps_pb2.TRANSFORM_FORMAT_QUATERNION_XYZW_F64
        message.transforms = given.rows
        if not given.is_whole:
            message.head.transform_domains.extend(given.domains.tolist())

    def _add_matrices(self, message: StepMessage, given: _GivenTransforms, new_q: dict[int, F32] | F32) -> None:
        moved = self._store(given.domains, given.rows)
        if self._kinematics is not None:
            # The server keeps a transform in f64 if the given one is its rounding to f32.
            self._world[moved, :3] = self._sent[moved]
        moved = np.concatenate((moved, self._move_attached(given, new_q)))
        roots = self._layout.roots
        if given.is_whole and 2 * len(moved) > len(roots) and self._is_exact[roots].all():
            # A list of domains takes longer than the transforms that have not changed.
            moved = roots
        self._add_sent(message, moved)

    def _add_sent(self, message: StepMessage, domains: Indices) -> None:
        """Adds the stored transforms of domains, without a list if these are all roots in order."""
        if len(domains) == 0:
            return
        message.transforms = self._sent.take(domains, axis=0)
        if not np.array_equal(domains, self._layout.roots):
            message.head.transform_domains.extend(domains.tolist())

    def _store(self, domains: Indices, matrices: F32) -> Indices:
        """Stores transforms. Returns the domains whose transform has changed in any bit."""
        if len(domains) == 0:
            return domains
        stored = self._sent.take(domains, axis=0)
        self._sent[domains] = matrices
        changed = domains[(matrices.view(np.uint32) != stored.view(np.uint32)).any(axis=(1, 2))]
        self._is_exact[changed] = True
        return changed

    def _move_attached(self, given: _GivenTransforms, new_q: dict[int, F32] | F32) -> Indices:
        """Computes the transforms that depend on new values. Returns the domains whose transform has changed."""
        none = _NO_TRANSFORMS.domains
        if self._kinematics is None or (isinstance(new_q, dict) and len(new_q) + len(given.domains) == 0):
            return none
        changed: list[int] | None = None
        new_values: list[F32 | F64] = [self._q, self._world]
        if not self._is_world_stale:
            new_values = [*(new_q.values() if isinstance(new_q, dict) else [new_q]), given.rows]
            if isinstance(new_q, dict) and not given.is_whole:
                changed = [*new_q, *given.domains.tolist()]
        # The server rejects a step with infinite numbers or NaN.
        self._is_world_stale = not all(np.isfinite(values).all() for values in new_values)
        if self._is_world_stale:
            return none
        dependents = self._kinematics.dependents(changed)
        self._kinematics.update(self._world, self._q, dependents)
        attached = dependents[self._is_attached[dependents]]
        return self._store(attached, self._world[attached, :3].astype(np.float32))

    def _convert_q(self, q: Coordinates) -> dict[int, F32] | F32:
        layout = self._layout
        if not isinstance(q, Mapping):
            return to_f32("q of the scene", q, (layout.coordinate_count,))
        converted: dict[int, F32] = {}
        coordinates_of = cast(Mapping[DomainKey, ArrayLike], q)
        for key, coordinates in coordinates_of.items():
            domain = layout.domains[key]
            if domain.shares_q_with is not None:
                owner = layout.domains[domain.shares_q_with].name
                raise ValueError(f"q: domain '{domain.name}' has the coordinates of domain '{owner}': set those")
            converted[domain.index] = to_f32(f"q of domain '{domain.name}'", coordinates, (domain.rank,))
        return converted

    def _convert_transforms(self, transforms: Transforms) -> _GivenTransforms:
        name = "transforms of the scene"
        if isinstance(transforms, Mapping):
            given = self._convert_transforms_by_domain(cast(Mapping[DomainKey, "ArrayLike | WorldPose"], transforms))
        elif isinstance(transforms, WorldPose):
            poses = transforms.to_rows(name, (len(self._sent),))
            given = _GivenTransforms(self._own, poses.take(self._own), is_whole=True)
        else:
            matrices = affine(name, transforms, (len(self._sent),))
            given = _GivenTransforms(self._own, matrices.take(self._own, axis=0), is_whole=True)
        if given.are_poses and self._kinematics is not None:
            raise ValueError("transforms: expected world poses only, in a drive with joints=False")
        if not given.are_poses and len(given.domains) > 0 and self._has_pose.any():
            raise ValueError("transforms: expected world poses, as in earlier steps of the drive, got matrices")
        return given

    def _convert_transforms_by_domain(self, transforms: Mapping[DomainKey, ArrayLike | WorldPose]) -> _GivenTransforms:
        matrices: dict[int, F32] = {}
        poses: dict[int, Rows] = {}
        for key, transform in transforms.items():
            domain = self._layout.domains[key]
            name = f"transform of domain '{domain.name}'"
            if domain.follows is not None:
                leader = self._layout.domains[domain.follows].name
                raise ValueError(f"{name}: the domain follows domain '{leader}': set the transform of that domain")
            if isinstance(transform, WorldPose):
                poses[domain.index] = transform.to_rows(name, ())
            elif self._is_attached[domain.index]:
                raise ValueError(f"{name}: it follows from the joint; open the drive with joints=False to set it")
            else:
                matrices[domain.index] = affine(name, transform)
        if poses and matrices:
            raise ValueError("transforms: expected world poses only, in a drive with joints=False")
        rows: Mapping[int, Rows] = poses or matrices
        if not rows:
            return _NO_TRANSFORMS
        return _GivenTransforms(np.array(list(rows), np.intp), np.stack(list(rows.values())))


def rest_values(layout: StateLayout) -> tuple[F32, F64]:
    """The coordinates of the scene at rest, and world_from_domain of every domain at rest, domains x 3 x 4."""
    q = np.zeros(layout.coordinate_count, np.float32)
    for index in layout.owners:
        q[layout.q_slice(layout.domains[index])] = layout.domains[index].rest_q
    placements = [
        domain.placement if domain.exact_placement is None else domain.exact_placement for domain in layout.domains
    ]
    return q, np.stack(placements).astype(np.float64)


def _differ(transforms: F64, others: F64) -> NDArray[np.bool_]:
    """Whether each transform, n x 3 x 4, differs from the other one by more than the rounding of f32."""
    differences, magnitudes = np.abs(transforms - others), np.abs(others)
    # f32 rounds a number by at most 2^-24 of its magnitude.
    exceeds = [
        differences[:, :, part].max(axis=(1, 2)) > 2.0**-24 * magnitudes[:, :, part].max(axis=(1, 2))
        for part in (slice(0, 3), slice(3, 4))
    ]
    return exceeds[0] | exceeds[1]


def to_time(time: float) -> float:
    """Checks a simulation time in seconds.

    Raises:
        ValueError: The time is not a finite number.
    """
    if not math.isfinite(time):
        raise ValueError(f"time: expected a finite number of seconds, got {time}")
    return float(time)
