"""Cameras: views, poses and pinhole matrices."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from modalcast._types import F64, Vector, real_array, to_f64, vector3
from modalcast._wire import length_prefix
from modalcast.v1 import frames_pb2

# Columns 1 and 2 of a pose change their sign between the axes of OpenCV (y down, z forward) and OpenGL (y up, z back).
_OPENGL_FROM_OPENCV = np.array([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Camera:
    """A camera. `look_at`, `at_pose` and `pinhole` create cameras.

    Attributes:
        message: The camera as a message of the contract.
        needs_up: Whether the up direction is that of the scene.
        width: Width of the image in pixels; None if the camera fits any size.
        height: Height of the image in pixels; None if the camera fits any size.
    """

    message: frames_pb2.Camera
    needs_up: bool = False
    width: int | None = None
    height: int | None = None

    def to_message(self, scene_up: str) -> frames_pb2.Camera:
        """The camera as a message, for a scene with the up axis "x", "y" or "z"."""
        message = frames_pb2.Camera()
        message.CopyFrom(self.message)
        if self.needs_up:
            message.look_at.up.extend(float(axis == scene_up) for axis in "xyz")
        return message

    def clipped(self, near: float, far: float) -> Camera:
        """The camera with a near and a far plane, in scene units along the view axis, 0 < near < far."""
        message = frames_pb2.Camera()
        message.CopyFrom(self.message)
        message.near, message.far = near, far
        return replace(self, message=message)


@dataclass(frozen=True, eq=False)
class CameraPoses:
    """Many cameras with the same lens, for views: arrays in place of one `Camera` for each view.

    Attributes:
        world_from_camera: C poses, C x 3 x 4 or C x 4 x 4, translations in scene units.
        lens: Vertical angle in degrees, 0.1 to 179; or a camera whose lens, near plane and far plane all cameras have.
        convention: Axes of the cameras: "opengl" (x right, y up, looking along -z) or "opencv" (x right, y down,
            looking along z).

    Raises:
        ValueError: The array has another shape, or the convention is unknown.
    """

    world_from_camera: ArrayLike
    lens: float | Camera = 45.0
    convention: str = "opengl"
    _matrices: F64 = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Converts the poses to the axes of OpenGL."""
        matrices = real_array("world_from_camera", self.world_from_camera).astype("<f8")
        if matrices.ndim != 3 or matrices.shape[1:] not in ((3, 4), (4, 4)):
            raise ValueError(f"world_from_camera: expected shape (n, 3, 4) or (n, 4, 4), got {matrices.shape}")
        if self.convention not in ("opengl", "opencv"):
            raise ValueError(f"convention: expected 'opencv' or 'opengl', got '{self.convention}'")
        axes = _OPENGL_FROM_OPENCV if self.convention == "opencv" else 1.0
        object.__setattr__(self, "_matrices", np.ascontiguousarray(matrices[:, :3] * axes))

    def __len__(self) -> int:
        return len(self._matrices)

    def encode(self, number: int) -> bytes:
        """The cameras as a repeated field of a message, without an object for each camera."""
        lens = frames_pb2.Camera()
        if isinstance(self.lens, Camera):
            lens.CopyFrom(self.lens.message)
            lens.ClearField("look_at")
            lens.ClearField("pose")
        else:
            lens.field_of_view = self.lens
        end = np.frombuffer(lens.SerializeToString(), np.uint8)
        poses = self._matrices.reshape(len(self), -1).view(np.uint8)
        entries = length_prefix(frames_pb2.Pose.WORLD_FROM_CAMERA_FIELD_NUMBER, poses.shape[1])
        pose = length_prefix(frames_pb2.Camera.POSE_FIELD_NUMBER, len(entries) + poses.shape[1])
        camera = length_prefix(number, len(pose) + len(entries) + poses.shape[1] + len(end))
        start = np.frombuffer(camera + pose + entries, np.uint8)
        rows = [np.broadcast_to(start, (len(self), len(start))), poses, np.broadcast_to(end, (len(self), len(end)))]
        return np.concatenate(rows, axis=1).tobytes()


def look_at(eye: Vector, target: Vector, up: Vector | None = None, field_of_view: float = 45.0) -> Camera:
    """A camera at `eye` that looks at `target`, both in scene units relative to the scene's origin.

    Args:
        eye: Position of the camera.
        target: A point on the view axis.
        up: A direction that points up in the image; None: the up axis of the scene.
        field_of_view: Vertical angle in degrees, 0.1 to 179.

    Raises:
        ValueError: A vector does not have three numbers.
    """
    view = frames_pb2.LookAt(eye=vector3("eye", eye), target=vector3("target", target))
    if up is not None:
        view.up.extend(vector3("up", up))
    return Camera(frames_pb2.Camera(look_at=view, field_of_view=field_of_view), needs_up=up is None)


def at_pose(world_from_camera: ArrayLike, field_of_view: float = 45.0) -> Camera:
    """A camera with a pose in the axes of OpenGL: x right, y up, looking along -z.

    Args:
        world_from_camera: 3x4 or 4x4 matrix, translation in scene units.
        field_of_view: Vertical angle in degrees, 0.1 to 179.

    Raises:
        ValueError: The matrix has another shape.
    """
    return Camera(frames_pb2.Camera(pose=_pose("world_from_camera", world_from_camera), field_of_view=field_of_view))


def pinhole(
    K: ArrayLike, width: int, height: int, world_from_camera: ArrayLike, *, convention: str = "opencv"
) -> Camera:
    """A pinhole camera.

    Args:
        K: 3x3 matrix fx 0 cx, 0 fy cy, 0 0 1 in pixels. (0, 0) is the top left corner of the image. Add 0.5 to cx and
            cy if (0, 0) is the center of the top left pixel.
        width: Width of the image in pixels.
        height: Height of the image in pixels.
        world_from_camera: 3x4 or 4x4 matrix, translation in scene units.
        convention: Axes of the camera: "opencv" (x right, y down, looking along z) or "opengl" (x right, y up, looking
            along -z).

    Raises:
        ValueError: A matrix has another shape, K has a skew, or the convention is unknown.
    """
    matrix = to_f64("K", K, (3, 3))
    zeros = matrix[[0, 1, 2, 2], [1, 0, 0, 1]]
    if zeros.any() or matrix[2, 2] != 1:
        raise ValueError(f"K: expected fx 0 cx, 0 fy cy, 0 0 1, got {matrix.tolist()}")
    lens = frames_pb2.Intrinsics(fx=matrix[0, 0], fy=matrix[1, 1], cx=matrix[0, 2], cy=matrix[1, 2])
    pose = _pose("world_from_camera", world_from_camera)
    if convention == "opencv":
        entries = np.reshape(pose.world_from_camera, (3, 4)) * _OPENGL_FROM_OPENCV
        pose = frames_pb2.Pose(world_from_camera=entries.ravel().tolist())
    elif convention != "opengl":
        raise ValueError(f"convention: expected 'opencv' or 'opengl', got '{convention}'")
    return Camera(frames_pb2.Camera(pose=pose, intrinsics=lens), width=width, height=height)


def _pose(name: str, transform: ArrayLike) -> frames_pb2.Pose:
    matrix = to_f64(name, transform, np.shape(transform))
    if matrix.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"{name}: expected shape (3, 4) or (4, 4), got {matrix.shape}")
    return frames_pb2.Pose(world_from_camera=matrix[:3].ravel().tolist())
