"""Transforms of attached domains that keep them on the surfaces of their parents.

A domain that is attached to a parent moves with the parent's surface: its transform T is the parent's T, times the
rigid transform that best fits the displacement U q of the parent's attachment vertices (Kabsch 1976), times
parent_from_child at rest. The correlation from which the rotation is fitted is linear in q, so its change per unit of
each coordinate is computed once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from modalcast._types import F32, F64
from modalcast.scene_description import Domain
from modalcast.states import StateLayout, square

# Attachment vertices count as collinear, and do not determine a rotation, if the second singular value of their
# correlation is below this fraction of the first one. Singular values are sums of squared distances.
_COLLINEAR = 1e-9


@dataclass(frozen=True)
class AttachmentPoints:
    """The k parent vertices to which a domain is attached: rest positions k x 3, and rows of U, 3k x r."""

    rest_positions: F32
    modes: F32


def has_fit(domain: Domain, layout: StateLayout) -> bool:
    """Whether the domain is attached to a parent whose modes move it."""
    if domain.parent is None or domain.follows is not None:
        return False
    return layout.domains[domain.parent].rank > 0 and len(domain.attachment_vertices) > 0


class Kinematics:
    """Computes the transforms of all domains of a scene from its coordinates."""

    def __init__(self, layout: StateLayout, points: Mapping[int, AttachmentPoints]) -> None:
        """Precomputes the fits.

        Args:
            layout: The layout of the scene.
            points: The attachment vertices of the domains for which `has_fit` is true, by domain.
        """
        self._layout = layout
        self._fitted = np.array(sorted(points), np.intp)
        self._rest_means = np.zeros((len(points), 3))
        parents = [self._parent(index) for index in self._fitted.tolist()]
        largest_rank = max((parent.rank for parent in parents), default=0)
        # Per joint: mean and correlation at rest (12 numbers), and their change per coordinate of the parent.
        self._rest_moments = np.zeros((len(points), 12))
        self._mode_moments = np.zeros((len(points), largest_rank, 12))
        # For a parent with fewer modes, the remaining entries are the index of a zero after the last coordinate.
        self._coordinates = np.full((len(points), largest_rank), layout.coordinate_count, np.intp)
        for joint, (index, parent) in enumerate(zip(self._fitted.tolist(), parents, strict=True)):
            place = layout.q_slice(parent)
            self._coordinates[joint, : parent.rank] = np.arange(place.start, place.stop)
            self._add_moments(joint, points[index], parent.rank)
        self._frames = self._rest_frames()
        self._levels = self._order_by_depth()

    def transforms(self, q: F64, root_transforms: F64) -> F64:
        """world_from_domain of every domain, 4x4, at the coordinates `q` of the scene.

        Args:
            q: All coordinates.
            root_transforms: 4x4 per domain; those of attached domains and of followers are ignored.
        """
        local = self._frames.copy()
        if len(self._fitted) > 0:
            local[self._fitted] = self._fit(q) @ self._frames[self._fitted]
        result = root_transforms.copy()
        for domains, sources in self._levels:
            result[domains] = result[sources] @ local[domains]
        return result

    def _fit(self, q: F64) -> F64:
        """The fitted rigid transform of each joint (the attachment of a domain to its parent), 4x4."""
        values = np.append(q, 0.0)[self._coordinates]
        moments = self._rest_moments + (values[:, None] @ self._mode_moments)[:, 0]
        rotations = nearest_rotations(moments[:, 3:].reshape(-1, 3, 3))
        rigid = np.tile(np.eye(4), (len(moments), 1, 1))
        rigid[:, :3, :3] = rotations
        rigid[:, :3, 3] = moments[:, :3] - (rotations @ self._rest_means[:, :, None])[..., 0]
        return rigid

    def _parent(self, index: int) -> Domain:
        parent = self._layout.domains[index].parent
        return self._layout.domains[index if parent is None else parent]

    def _add_moments(self, joint: int, points: AttachmentPoints, rank: int) -> None:
        rest = points.rest_positions.astype(np.float64)
        mean = rest.mean(axis=0)
        centered = rest - mean
        modes = points.modes.astype(np.float64).reshape(-1, 3, rank)
        self._rest_means[joint] = mean
        self._rest_moments[joint] = np.concatenate((mean, (rest.T @ centered).ravel()))
        self._mode_moments[joint, :rank, :3] = modes.mean(axis=0).T
        # The mean of a column drops out of the correlation, because the centered rest positions have the sum 0.
        self._mode_moments[joint, :rank, 3:] = np.einsum("kcr,kd->rcd", modes, centered).reshape(rank, 9)

    def _rest_frames(self) -> F64:
        frames = np.tile(np.eye(4), (len(self._layout.domains), 1, 1))
        for domain in self._layout.domains:
            if domain.follows is not None and domain.follow_frame is not None:
                frames[domain.index] = square(domain.follow_frame)
            elif domain.attachment_frame is not None:
                frames[domain.index] = square(domain.attachment_frame)
        return frames

    def _order_by_depth(self) -> list[tuple[np.ndarray[tuple[int], np.dtype[np.intp]], list[int]]]:
        """Domains with the domains that they depend on: those of a level depend on earlier levels only."""
        depths: list[int] = []
        levels: list[list[tuple[int, int]]] = []
        for domain in self._layout.domains:
            source = domain.parent if domain.follows is None else domain.follows
            if source is None:
                depths.append(0)
                continue
            depths.append(depths[source] + 1)
            if depths[-1] > len(levels):
                levels.append([])
            levels[depths[-1] - 1].append((domain.index, source))
        return [(np.array([pair[0] for pair in level], np.intp), [pair[1] for pair in level]) for level in levels]


def nearest_rotations(correlations: F64) -> F64:
    """The proper rotations nearest to 3x3 matrices; the identity for matrices of rank 0 or 1."""
    left, singular_values, right = np.linalg.svd(correlations)
    # If the orthogonal factor is a reflection, flip the direction of the smallest singular value.
    left[:, :, 2] *= np.sign(np.linalg.det(left) * np.linalg.det(right))[:, None]
    rotations = left @ right
    rotations[singular_values[:, 1] <= _COLLINEAR * singular_values[:, 0]] = np.eye(3)
    return rotations
