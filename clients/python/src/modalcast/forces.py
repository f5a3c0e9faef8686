"""Forces that viewers apply to a scene, for the physics process that drives it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from modalcast._common import StepId, step_id
from modalcast._types import F32, F64, Vector, to_f32, vector3
from modalcast.scene_description import Domain, Domains
from modalcast.v1 import forces_pb2, frames_pb2


@dataclass(frozen=True, eq=False)
class Force:
    """A force on a domain: `surface_force`, `modal_force` and `Hit.force` create forces.

    Attributes:
        domain: Name or index of the domain.
        message: The protobuf message of the force, without id and domain.
    """

    domain: int | str | Domain
    message: forces_pb2.Force


def surface_force(domain: int | str | Domain, triangle: int, barycentric: Vector, vector: Vector) -> Force:
    """A force at a point of a triangle, which moves with the surface.

    Args:
        domain: Name or index of the domain.
        triangle: Index of the triangle in the domain's mesh.
        barycentric: Weights of the triangle's vertices, with sum 1.
        vector: The force in newtons, in world axes.

    Raises:
        ValueError: A vector does not have three numbers.
    """
    surface = forces_pb2.SurfaceForce(
        triangle=triangle, barycentric=vector3("barycentric", barycentric), vector=vector3("vector", vector)
    )
    return Force(domain, forces_pb2.Force(surface=surface))


def modal_force(domain: int | str | Domain, f_q: ArrayLike) -> Force:
    """A force on the r coordinates of a domain, in newtons times scene units per unit of q.

    Raises:
        ValueError: `f_q` is not a list of numbers.
    """
    f_q = to_f32("f_q", f_q, (None,))
    return Force(domain, forces_pb2.Force(modal=forces_pb2.ModalForce(f_q=f_q.tobytes())))


def force_messages(domains: Domains, forces: Sequence[Force]) -> list[forces_pb2.Force]:
    """The messages of a list of forces; the id of a force is its index in the list.

    Raises:
        KeyError: A domain name is unknown.
        ValueError: A modal force does not have one number per mode.
    """
    messages: list[forces_pb2.Force] = []
    for index, force in enumerate(forces):
        domain = domains[force.domain]
        message = forces_pb2.Force(id=index, domain=domain.index)
        message.MergeFrom(force.message)
        count = len(message.modal.f_q) // 4
        if message.HasField("modal") and count != domain.rank:
            raise ValueError(f"f_q of domain '{domain.name}': expected shape ({domain.rank},), got ({count},)")
        messages.append(message)
    return messages


@dataclass(frozen=True, eq=False)
class AppliedForce:
    """A force that a viewer applies.

    Attributes:
        owner: Number of the viewer that applies the force.
        domain: Index of the domain.
        f_q: The force on the domain's coordinates, r numbers.
        vector: The force in newtons, in world axes; None for a modal force.
        rest_point: The point of the force at rest, in scene units and the frame of the domain; None for a modal force.
    """

    owner: int
    domain: int
    f_q: F32
    vector: F64 | None
    rest_point: F64 | None


@dataclass(frozen=True, eq=False)
class ForceSet:
    """All forces in a scene.

    Attributes:
        step: The step whose transforms were used to compute `f_q` of surface forces; None without surface forces.
        forces: Ordered by owner.
    """

    step: StepId | None
    forces: tuple[AppliedForce, ...]


def force_set(message: forces_pb2.StreamForcesResponse) -> ForceSet:
    """Converts from a message."""

    def applied(force: forces_pb2.AppliedForce) -> AppliedForce:
        surface = force.force.HasField("surface")
        vector = np.array(force.force.surface.vector) if surface else None
        rest_point = np.array(force.rest_point) if surface else None
        return AppliedForce(force.owner, force.force.domain, np.frombuffer(force.f_q, "<f4"), vector, rest_point)

    step = step_id(message.step) if message.HasField("step") else None
    return ForceSet(step, tuple(applied(force) for force in message.forces))


@dataclass(frozen=True, eq=False)
class Hit:
    """A point of the deformed surface at the center of a pixel.

    Attributes:
        x: Column of the pixel.
        y: Row of the pixel.
        domain: Index of the domain.
        triangle: Index of the triangle in the domain's mesh.
        vertices: The three vertices of the triangle; vertex v has the rows 3v, 3v + 1 and 3v + 2 of U.
        barycentric: Weights of `vertices`, with sum 1.
        position: In scene units, relative to the scene's origin.
        normal: Unit normal in world axes that faces the camera; zeros if the vertex normals cancel.
        depth: Meters along the view axis.
        linear: A, the linear part of the domain's transform, 3x3.
        modes: U at the point, 3 x r; 3 x 0 if it was not requested.
    """

    x: int
    y: int
    domain: int
    triangle: int
    vertices: tuple[int, int, int]
    barycentric: F64
    position: F64
    normal: F64
    depth: float
    linear: F64 = field(repr=False)
    modes: F32 = field(repr=False)

    def reduced_force(self, vector: Vector) -> F64:
        """f_q = U^T A^T f, r numbers, of a force f in newtons and world axes at the point."""
        return self.modes.T.astype(np.float64) @ (self.linear.T @ np.array(vector3("vector", vector)))

    def force(self, vector: Vector) -> Force:
        """A force in newtons and world axes at the point, for `Scene.apply_forces`."""
        return surface_force(self.domain, self.triangle, self.barycentric, vector)


@dataclass(frozen=True, eq=False)
class PickResult:
    """The hits in a rectangle of pixels, row by row. A pixel that shows no opaque surface has no hit."""

    step: StepId
    hits: tuple[Hit, ...]


def hit_from_message(message: frames_pb2.Hit) -> Hit:
    """Converts from a message."""
    modes = np.frombuffer(message.modes, "<f4").reshape(3, -1) if message.modes else np.empty((3, 0), np.float32)
    first, second, third = message.vertices
    return Hit(
        x=message.x,
        y=message.y,
        domain=message.domain,
        triangle=message.triangle,
        vertices=(first, second, third),
        barycentric=np.array(message.barycentric),
        position=np.array(message.position),
        normal=np.array(message.normal),
        depth=message.depth,
        linear=np.array(message.linear, np.float64).reshape(3, 3),
        modes=modes,
    )
