"""Transforms of attached domains that keep them on the surfaces of their parents.

A domain that is attached to a parent moves with the parent's surface: its transform T is the parent's T, times the
rigid transform that best fits the displacement U q of the parent's attachment vertices (Kabsch 1976), times
parent_from_child at rest. The correlation from which the rotation is fitted is linear in q, so its change per unit of
each coordinate is computed once.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from modalcast._types import F32, F64, Indices
from modalcast.scene_description import Domain
from modalcast.states import StateLayout, square

# Attachment vertices count as collinear, and do not determine a rotation, if the second singular value of their
# correlation is below this fraction of the first one. Singular values are sums of squared distances.
_COLLINEAR = 1e-9


@dataclass(frozen=True)
class AttachmentPoints:
    """The k parent vertices to which a domain is attached: rest positions k x 3, and rows of U, 3k x r."""

    rest_positions: F64
    modes: F32


def has_fit(domain: Domain, layout: StateLayout) -> bool:
    """Whether the domain is attached to a parent whose modes move it."""
    if domain.parent is None or domain.follows is not None:
        return False
    return layout.domains[domain.parent].rank > 0 and len(domain.attachment_vertices) > 0


class Kinematics:
    """Computes the transforms of the domains of a scene that are attached to others or follow them."""

    def __init__(self, layout: StateLayout, points: Mapping[int, AttachmentPoints]) -> None:
        """Precomputes the fits.

        Args:
            layout: The layout of the scene.
            points: The attachment vertices of the domains for which `has_fit` is true, by domain.
        """
        self._layout = layout
        self._tree = _DomainTree(layout)
        fitted = sorted(points)
        # The joint (the attachment of a domain to its parent) of each domain with a fit, -1 for the others.
        self._joint_of: Indices = np.full(len(layout.domains), -1)
        self._joint_of[fitted] = np.arange(len(fitted))
        self._rest_means = np.zeros((len(points), 3))
        parents = [self._parent(index) for index in fitted]
        largest_rank = max((parent.rank for parent in parents), default=0)
        # Per joint: mean and correlation at rest (12 numbers), and their change per coordinate of the parent.
        self._rest_moments = np.zeros((len(points), 12))
        self._mode_moments = np.zeros((len(points), largest_rank, 12))
        # For a parent with fewer modes, the remaining entries are coordinate 0, whose moments are 0.
        self._coordinates: Indices = np.zeros((len(points), largest_rank), np.intp)
        for joint, (index, parent) in enumerate(zip(fitted, parents, strict=True)):
            place = layout.q_slice(parent)
            self._coordinates[joint, : parent.rank] = np.arange(place.start, place.stop)
            self._add_moments(joint, points[index], parent.rank)
        self._frames = self._rest_frames()

    def dependents(self, domains: Iterable[int] | None) -> Indices:
        """The domains whose transforms depend on the coordinates or the transforms of `domains`, sources first.

        None selects those that depend on any domain.
        """
        return self._tree.below(domains)

    def update(self, world: F64, q: F32, dependents: Indices) -> None:
        """Computes the transforms of domains that `dependents` has returned, from those of all others.

        Args:
            world: world_from_domain of every domain, ... x D x 4 x 4, which receives the result.
            q: All coordinates of the scene, ... x r. The leading dimensions are those of `world`.
            dependents: The domains to compute.
        """
        local = self._frames[dependents]
        joints = self._joint_of[dependents]
        has_fit = joints >= 0
        if has_fit.any():
            local = np.tile(local, (*q.shape[:-1], 1, 1, 1))
            local[..., has_fit, :, :] = self._fit(q, joints[has_fit]) @ local[..., has_fit, :, :]
        for level in self._tree.levels(dependents):
            domains = dependents[level]
            sources = world[..., self._tree.sources[domains], :, :]
            world[..., domains, :, :] = sources @ local[..., level, :, :]

    def _fit(self, q: F32, joints: Indices) -> F64:
        """The fitted rigid transforms of k joints, ... x k x 4 x 4."""
        values = q[..., self._coordinates[joints]].astype(np.float64)
        moments = self._rest_moments[joints] + (values[..., None, :] @ self._mode_moments[joints])[..., 0, :]
        rotations = nearest_rotations(moments[..., 3:].reshape(*moments.shape[:-1], 3, 3))
        translations = moments[..., :3] - (rotations @ self._rest_means[joints][:, :, None])[..., 0]
        return square(np.concatenate((rotations, translations[..., None]), axis=-1))

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


class _DomainTree:
    """The domains that each domain depends on: the one that it follows, or the one that it is attached to.

    Domains that depend on a domain are consecutive in the preorder of the tree, so that the domains below several
    others are found without a loop over all domains.

    Attributes:
        sources: The domain that each domain depends on, -1 for none.
    """

    def __init__(self, layout: StateLayout) -> None:
        sources = [domain.parent if domain.follows is None else domain.follows for domain in layout.domains]
        self.sources: Indices = np.array([-1 if source is None else source for source in sources], np.intp)
        self._depths: Indices = np.zeros(len(sources), np.intp)
        # Number of domains below each domain. Sources have smaller indices than the domains that depend on them.
        sizes = [0] * len(sources)
        for index, source in reversed(list(enumerate(sources))):
            if source is not None:
                sizes[source] += 1 + sizes[index]
        # The preorder: a domain, then all domains below it.
        first_below = [0] * len(sources)
        next_root = 0
        next_below = [0] * len(sources)
        self._preorder: Indices = np.zeros(len(sources), np.intp)
        for index, source in enumerate(sources):
            if source is None:
                position, next_root = next_root, next_root + 1 + sizes[index]
            else:
                position, next_below[source] = next_below[source], next_below[source] + 1 + sizes[index]
                self._depths[index] = self._depths[source] + 1
            self._preorder[position] = index
            first_below[index] = next_below[index] = position + 1
        self._below = [slice(first, first + size) for first, size in zip(first_below, sizes, strict=True)]
        # Domains with the same coordinates, by their owner, if there are several.
        self._owner = layout.owner
        self._sharing: dict[int, list[int]] = {}
        for index, owner in enumerate(layout.owner):
            self._sharing.setdefault(owner, []).append(index)
        self._all = self._by_depth(np.flatnonzero(self.sources >= 0))

    def below(self, domains: Iterable[int] | None) -> Indices:
        """All domains below `domains` and below those that have the same coordinates, sources first; None: all."""
        if domains is None:
            return self._all
        sharing = {other for domain in domains for other in self._sharing[self._owner[domain]]}
        ranges = [self._preorder[self._below[domain]] for domain in sharing]
        return self._by_depth(np.unique(np.concatenate(ranges))) if ranges else self._all[:0]

    def levels(self, domains: Indices) -> Iterator[slice]:
        """Slices of domains that `below` has returned: those of a slice depend on earlier slices only."""
        ends = np.flatnonzero(np.diff(self._depths[domains], append=-1)) + 1
        start = 0
        for end in ends.tolist():
            yield slice(start, end)
            start = end

    def _by_depth(self, domains: Indices) -> Indices:
        return domains[np.argsort(self._depths[domains], kind="stable")]


def nearest_rotations(correlations: F64) -> F64:
    """The proper rotations nearest to matrices, ... x 3 x 3; the identity for matrices of rank 0 or 1."""
    left, singular_values, right = np.linalg.svd(correlations)
    # If the orthogonal factor is a reflection, flip the direction of the smallest singular value.
    left[..., 2] *= np.sign(np.linalg.det(left) * np.linalg.det(right))[..., None]
    rotations = left @ right
    rotations[singular_values[..., 1] <= _COLLINEAR * singular_values[..., 0]] = np.eye(3)
    return rotations
