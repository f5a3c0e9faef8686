"""States of a scene: the coordinates q and the transforms T of its domains at a step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modalcast._chunks import malformed
from modalcast._common import StepId, stage_times, step_id
from modalcast._types import F32, F64, Bytes, Indices
from modalcast.scene_description import Domain, Domains
from modalcast.v1 import states_pb2


class StateLayout:
    """Where the values of each domain are in a state.

    Attributes:
        domains: The domains of the scene.
        first_coordinate: Index of the first coordinate of each domain; equal for domains that share coordinates.
        coordinate_count: Number of coordinates of all domains.
        owner: Index of the domain whose coordinates each domain has: the end of the chain of domains with which it
            shares them, or the domain itself.
        owners: Indices of the domains of rank above 0 that are their own owners.
        all_q_domains: Indices of the domains with which a step lists all coordinates of the scene.
        root: Index of the root of each domain: the end of the chain of domains that it follows, or the domain itself.
        roots: Indices of the domains that are their own roots.
        root_from_domain: 4x4 for each domain; the identity for a root.
        is_attached: Whether each domain is a root that is attached to a parent.
        scene_origin: World position of the scene's origin in meters.
        unit: Meters per scene unit.
    """

    def __init__(
        self, domains: Domains, *, has_packed_q: bool, scene_origin: Sequence[float] = (0, 0, 0), unit: float = 1
    ) -> None:
        """Computes the layout.

        Args:
            domains: The domains of the scene.
            has_packed_q: Whether the server has FEATURE_PACKED_Q.
            scene_origin: World position of the scene's origin in meters.
            unit: Meters per scene unit.
        """
        self.domains = domains
        self.scene_origin: F64 = np.array(scene_origin, np.float64)
        self.unit = unit
        self.first_coordinate: list[int] = []
        self.owner: list[int] = []
        self.coordinate_count = 0
        root: list[int] = []
        self.root_from_domain: F64 = np.tile(np.eye(4), (len(domains), 1, 1))
        for domain in domains:
            others = {"parent": domain.parent, "shares_q_with": domain.shares_q_with, "follows": domain.follows}
            for name, other in others.items():
                if other is not None and other >= domain.index:
                    raise malformed(f"domains[{domain.index}].{name}", f"below {domain.index}", str(other))
            shared = domain.shares_q_with
            self.owner.append(domain.index if shared is None else self.owner[shared])
            self.first_coordinate.append(self.coordinate_count if shared is None else self.first_coordinate[shared])
            self.coordinate_count += domain.rank if shared is None else 0
            if domain.follows is None or domain.follow_frame is None:
                root.append(domain.index)
                continue
            root.append(root[domain.follows])
            frame = self.root_from_domain[domain.follows] @ square(domain.follow_frame)
            self.root_from_domain[domain.index] = frame
        self.owners = [index for index, owner in enumerate(self.owner) if owner == index and domains[index].rank > 0]
        shares_q = any(domain.rank > 0 and self.owner[domain.index] != domain.index for domain in domains)
        self.all_q_domains = self.owners if shares_q and not has_packed_q else []
        self.root: Indices = np.array(root, np.intp)
        self.roots: Indices = np.flatnonzero(self.root == np.arange(len(root)))
        self.is_attached = np.array([domain.parent is not None and domain.follows is None for domain in domains], bool)

    def q_slice(self, domain: Domain) -> slice:
        """The slice of a domain's coordinates in those of the scene."""
        first = self.first_coordinate[domain.index]
        return slice(first, first + domain.rank)


def square(matrices: F32 | F64) -> F64:
    """3x4 matrices, in an array of any number of dimensions, as 4x4 f64."""
    result = np.zeros((*matrices.shape[:-2], 4, 4))
    result[..., :3, :] = matrices
    result[..., 3, 3] = 1
    return result


@dataclass(frozen=True, eq=False)
class SceneState:
    """The state of a scene at a step.

    Attributes:
        step: The step.
        q: All coordinates of the scene, domain by domain.
        transforms: world_from_domain of every domain: domains x 3 x 4, in scene units relative to the origins.
        origins: World position in meters of the origin of each domain's transform: domains x 3.
        skipped: Number of steps skipped since the previous state of the stream.
        stages: Milliseconds by stage; those of `Scene.steps` only as `stages_every` demands.
    """

    step: StepId
    q: F32
    transforms: F32
    origins: F64
    skipped: int
    stages: dict[str, float] = field(repr=False)
    layout: StateLayout = field(repr=False)

    def q_of(self, domain: int | str | Domain) -> F32:
        """The coordinates of a domain, r numbers."""
        return self.q[self.layout.q_slice(self.layout.domains[domain])]

    def transform_of(self, domain: int | str | Domain) -> F32:
        """world_from_domain of a domain, 3x4."""
        return self.transforms[self.layout.domains[domain].index]

    @property
    def scene_transforms(self) -> F64:
        """world_from_domain of every domain relative to the scene's origin: domains x 3 x 4."""
        transforms = self.transforms.astype(np.float64)
        transforms[:, :, 3] += (self.origins - self.layout.scene_origin) / self.layout.unit
        return transforms


class StateDecoder:
    """Decodes the states of one call. Keeps the last state, to which changes are applied."""

    def __init__(self, layout: StateLayout) -> None:
        self._layout = layout
        self._q: F32 = np.zeros(layout.coordinate_count, np.float32)
        # Transforms of roots; those of followers are computed from them.
        self._root_transforms: F32 = np.zeros((len(layout.domains), 3, 4), np.float32)
        self._root = layout.root
        self._is_root = self._root == np.arange(len(self._root))
        self._origins: F64 = np.zeros((len(layout.domains), 3))

    def decode(self, head: states_pb2.StateHead, data: Bytes) -> SceneState:
        """Applies the bytes of a state."""
        sections: dict[int, Bytes] = {}
        for section in head.sections:
            sections[section.content] = data[section.offset : section.offset + section.bytes]
        try:
            self._apply(sections)
        except (ValueError, IndexError) as error:
            raise malformed("states.sections", "the sizes that the scene has", str(error)) from error
        transforms = self._root_transforms[self._root]
        if not self._is_root.all():
            followers = ~self._is_root
            frames = self._layout.root_from_domain[followers]
            of_roots = transforms[followers].astype(np.float64)
            transforms[followers] = of_roots[:, :, :3] @ frames[:, :3]
            transforms[followers, :, 3] += of_roots[:, :, 3]
        return SceneState(
            step=step_id(head.step),
            q=self._q.copy(),
            transforms=transforms,
            origins=self._origins[self._root],
            skipped=head.skipped,
            stages=stage_times(head.stages),
            layout=self._layout,
        )

    def _apply(self, sections: dict[int, Bytes]) -> None:
        def numbers(content: int, dtype: str) -> NDArray[Any]:
            return sections.get(content, np.empty(0, np.uint8)).view(dtype)

        q = numbers(states_pb2.STATE_CONTENT_Q, "<f4")
        listed = numbers(states_pb2.STATE_CONTENT_Q_DOMAINS, "<u4")
        # A list that is left out has all domains, each with coordinates of its own.
        places = [self._layout.q_slice(self._layout.domains[int(index)]) for index in listed]
        if len(listed) == 0 < len(q):
            places = [slice(0, self._layout.coordinate_count)]
        position = 0
        for place in places:
            rank = place.stop - place.start
            self._q[place] = q[position : position + rank]
            position += rank
        if position != len(q):
            raise ValueError(f"{len(q)} coordinates in place of {position}")
        transforms = numbers(states_pb2.STATE_CONTENT_TRANSFORMS, "<f4").reshape(-1, 3, 4)
        moved = numbers(states_pb2.STATE_CONTENT_TRANSFORM_DOMAINS, "<u4").astype(np.intp)
        if len(moved) == 0 < len(transforms):
            moved = self._layout.roots
        if len(moved) != len(transforms):
            raise ValueError(f"{len(transforms)} transforms in place of {len(moved)}")
        self._root_transforms[moved] = transforms
        origins = numbers(states_pb2.STATE_CONTENT_ORIGINS, "<f8").reshape(-1, 3)
        if len(origins) == 1:
            self._origins[:] = origins
        elif len(origins) > 1:
            self._origins[self._is_root] = origins
