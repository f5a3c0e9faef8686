"""Views: small pictures of many copies of a scene (worlds). Their sizes, their arrays, and the values of the worlds."""

from __future__ import annotations

import contextlib
import importlib
import operator
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, SupportsIndex, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modalcast._step_message import StepMessage
from modalcast._types import F32, U32, Indices, affine, check_shape, real_array, to_f32
from modalcast._wire import length_prefix, message_of_field
from modalcast.camera import Camera, CameraPoses
from modalcast.kinematics import Kinematics
from modalcast.states import StateLayout, square
from modalcast.step_values import rest_values
from modalcast.v1 import frames_pb2, steps_pb2, views_pb2

ViewOutputName: TypeAlias = Literal["color", "depth", "depth_with_ground", "domains", "normals"]

ViewOutputs: TypeAlias = ViewOutputName | Sequence[ViewOutputName]
"""One or several outputs by name."""

ViewSize: TypeAlias = int | tuple[int, int]
"""Side of a square, or width and height, in pixels."""

ViewCameras: TypeAlias = Camera | CameraPoses | Sequence[Camera | None]
"""One or several cameras; None frames the rest bounds of the scene."""

CameraSet: TypeAlias = CameraPoses | list[Camera | None]
"""The cameras of a call, at least one."""

ViewArrays: TypeAlias = dict[str, NDArray[Any]]
"""Arrays by the names of their outputs. With `device="cuda"`, these are `DeviceArray`s."""

StateProgress: TypeAlias = Callable[[int, int], object]
"""Called with the number of states that are drawn, and with that of all states."""

MAX_WORLDS = 65_536
"""Largest number of worlds of a call."""

MAX_VIEWS = 65_536
"""Largest number of views of a step, and of cameras."""

MAX_SIDE = 1024
"""Largest width and height of a view in pixels."""

MAX_DEVICE_SLOTS = 16
"""Largest number of steps whose pictures are on the GPU at a time."""

_DEFAULT_SIDE = 64

# Bytes of pictures that a batch of states has at most. Three batches are in flight. Smaller batches would draw less
# efficiently, because each one has a fixed cost of about a millisecond.
_BATCH_BYTES = 32 << 20

# The values of a batch of states have at most this fraction of the largest message of the server.
_MESSAGE_FRACTION = 0.5

# Limits the memory in which the transforms of attached domains are computed, to about 100 MB.
_DOMAINS_PER_FIT = 1 << 18

# States that are checked for NaN at once.
_CHECKED_STATES = 1 << 16


@dataclass(frozen=True)
class ViewFormat:
    """An output of the contract, and the type and the number of channels of its arrays."""

    output: frames_pb2.Output
    dtype: np.dtype[Any]
    channels: int


VIEW_FORMATS: dict[str, ViewFormat] = {
    "color": ViewFormat(frames_pb2.OUTPUT_COLOR, np.dtype("u1"), 3),
    "depth": ViewFormat(frames_pb2.OUTPUT_DEPTH, np.dtype("<f4"), 1),
    "depth_with_ground": ViewFormat(frames_pb2.OUTPUT_DEPTH_WITH_GROUND, np.dtype("<f4"), 1),
    "domains": ViewFormat(frames_pb2.OUTPUT_DOMAINS, np.dtype("<i4"), 1),
    "normals": ViewFormat(frames_pb2.OUTPUT_NORMALS, np.dtype("<f4"), 3),
}


@dataclass(frozen=True)
class PictureFormat:
    """Size and outputs of a view.

    Attributes:
        width: In pixels.
        height: In pixels.
        outputs: The names of the outputs.
    """

    width: int
    height: int
    outputs: tuple[str, ...]

    @property
    def view_bytes(self) -> int:
        """Size of all outputs of a view in bytes."""
        formats = [VIEW_FORMATS[name] for name in self.outputs]
        return self.width * self.height * sum(format_.channels * format_.dtype.itemsize for format_ in formats)

    def shapes(self, leading: tuple[int, ...]) -> dict[str, tuple[int, ...]]:
        """The shapes of the arrays by output: the `leading` dimensions, H x W, and x 3 for color and normals."""
        return {
            name: (*leading, self.height, self.width, *((3,) if VIEW_FORMATS[name].channels == 3 else ()))
            for name in self.outputs
        }

    def arrays(self, leading: tuple[int, ...], out: Mapping[str, NDArray[Any]] | None) -> ViewArrays:
        """New arrays, or those of the caller.

        Raises:
            ValueError: `out` lacks an output or has another one, or an array has another shape or type, is not
                C-contiguous, or is read-only.
        """
        shapes = self.shapes(leading)
        if out is None:
            return {name: np.empty(shape, VIEW_FORMATS[name].dtype) for name, shape in shapes.items()}
        if set(out) != set(shapes):
            raise ValueError(f"out: expected arrays for the outputs {list(shapes)}, got {list(out)}")
        return {name: _writable_array(f"out['{name}']", out[name], shape, name) for name, shape in shapes.items()}


def _writable_array(name: str, array: NDArray[Any], shape: tuple[int, ...], output: str) -> NDArray[Any]:
    if not isinstance(array, np.ndarray):  # pyright: ignore[reportUnnecessaryIsInstance] # of untyped callers
        raise TypeError(f"{name}: expected an array of numpy, got {type(array).__name__}")
    check_shape(name, array, shape)
    dtype = VIEW_FORMATS[output].dtype
    if array.dtype != dtype or not array.flags.c_contiguous or not array.flags.writeable:
        flags = f"contiguous {array.flags.c_contiguous}, writable {array.flags.writeable}"
        raise ValueError(f"{name}: expected a writable C-contiguous array of {dtype}, got {array.dtype}, {flags}")
    return array


def picture_format(size: ViewSize | None, outputs: ViewOutputs, cameras: CameraSet) -> PictureFormat:
    """Checks the size and the outputs of views.

    Raises:
        ValueError: A size is out of range or differs from that of a camera, or an output is unknown or occurs twice.
    """
    names = (outputs,) if isinstance(outputs, str) else tuple(outputs)
    unknown = [name for name in names if name not in VIEW_FORMATS]
    if unknown or not names:
        given = f"'{unknown[0]}'" if unknown else "none"
        raise ValueError(f"outputs: expected names from {list(VIEW_FORMATS)}, got {given}")
    if len(set(names)) != len(names):
        raise ValueError(f"outputs: expected each output once, got {list(names)}")
    if "depth" in names and "depth_with_ground" in names:
        raise ValueError("outputs: expected 'depth' or 'depth_with_ground', got both")
    width, height = _view_sides(size, cameras)
    for name, side in (("width", width), ("height", height)):
        if not 1 <= side <= MAX_SIDE:
            raise ValueError(f"size: expected a {name} of 1 to {MAX_SIDE} pixels, got {side}")
    format_ = PictureFormat(width, height, names)
    check_camera_sizes(cameras, format_)
    return format_


def _view_sides(size: ViewSize | None, cameras: CameraSet) -> tuple[int, int]:
    if size is None:
        for camera in _lenses(cameras):
            if camera is not None and camera.width is not None and camera.height is not None:
                return camera.width, camera.height
        return _DEFAULT_SIDE, _DEFAULT_SIDE
    sides = (size, size) if isinstance(size, SupportsIndex) else tuple(size)
    if len(sides) != 2:
        raise ValueError(f"size: expected a side, or a width and a height, got {len(sides)} numbers")
    return operator.index(sides[0]), operator.index(sides[1])


def _lenses(cameras: CameraSet) -> Sequence[Camera | None]:
    if isinstance(cameras, CameraPoses):
        return [cameras.lens] if isinstance(cameras.lens, Camera) else []
    return cameras


def check_camera_sizes(cameras: CameraSet, format_: PictureFormat) -> None:
    """Raises ValueError if a pinhole camera has another size than the views."""
    for index, camera in enumerate(_lenses(cameras)):
        if camera is None or camera.width is None:
            continue
        if (camera.width, camera.height) != (format_.width, format_.height):
            size = f"{format_.width} x {format_.height}"
            raise ValueError(
                f"cameras[{index}]: expected a camera of {size} pixels, got {camera.width} x {camera.height}"
            )


def camera_set(cameras: ViewCameras) -> CameraSet:
    """Checks the cameras of a call.

    Raises:
        TypeError: An item is no camera.
        ValueError: There are no cameras, or too many.
    """
    if isinstance(cameras, Camera):
        return [cameras]
    items = cameras if isinstance(cameras, CameraPoses) else list(cameras)
    if not 1 <= len(items) <= MAX_VIEWS:
        raise ValueError(f"cameras: expected 1 to {MAX_VIEWS}, got {len(items)}")
    for index, camera in enumerate(_lenses(items)):
        if not isinstance(camera, Camera | None):  # pyright: ignore[reportUnnecessaryIsInstance] # of untyped callers
            raise TypeError(f"cameras[{index}]: expected a Camera or None, got {type(camera).__name__}")
    return items


def encode_cameras(cameras: CameraSet, field: int, scene_up: str) -> bytes:
    """The cameras as a repeated field of a message. A camera without fields frames the rest bounds of a world."""
    if isinstance(cameras, CameraPoses):
        return cameras.encode(field)
    encoded = [b"" if camera is None else camera.to_message(scene_up).SerializeToString() for camera in cameras]
    return b"".join(length_prefix(field, len(camera)) + camera for camera in encoded)


@dataclass(frozen=True)
class ViewOptions:
    """What the views of a call show.

    Attributes:
        worlds: Number of worlds.
        cameras: The cameras; None: one camera that frames the rest bounds of a world.
        camera_worlds: The world of each camera; None: every camera sees every world.
        format: Size and outputs of the views.
        device_slots: Number of steps whose pictures can be on the GPU at a time; 0: they are in host memory.
    """

    worlds: int
    cameras: CameraSet | None
    camera_worlds: U32 | None
    format: PictureFormat
    device_slots: int = 0

    @property
    def camera_count(self) -> int:
        """Number of cameras."""
        return 1 if self.cameras is None else len(self.cameras)

    @property
    def view_count(self) -> int:
        """Number of views of a step."""
        return self.camera_count if self.camera_worlds is not None else self.worlds * self.camera_count

    def encode(self, scene: str, scene_up: str) -> bytes:
        """The encoded `DrawViewsRequest` that opens the worlds."""
        message = views_pb2.OpenViews(
            scene=scene,
            worlds=self.worlds,
            width=self.format.width,
            height=self.format.height,
            outputs=[VIEW_FORMATS[name].output for name in self.format.outputs],
            camera_worlds=None if self.camera_worlds is None else self.camera_worlds.tolist(),
            device_slots=self.device_slots,
        )
        cameras = b""
        if self.cameras is not None:
            cameras = encode_cameras(self.cameras, views_pb2.OpenViews.CAMERAS_FIELD_NUMBER, scene_up)
        return message_of_field(views_pb2.DrawViewsRequest.OPEN_FIELD_NUMBER, [message.SerializeToString(), cameras])


def view_options(
    worlds: int,
    cameras: ViewCameras | None,
    camera_worlds: ArrayLike | None,
    size: ViewSize | None,
    outputs: ViewOutputs,
    device_slots: int = 0,
) -> ViewOptions:
    """Checks the arguments of `Scene.views`, which documents them.

    Raises:
        TypeError: An item is not a Camera.
        ValueError: A number is out of range, or an output is unknown.
    """
    if not 1 <= operator.index(worlds) <= MAX_WORLDS:
        raise ValueError(f"worlds: expected 1 to {MAX_WORLDS}, got {worlds}")
    items = None if cameras is None else camera_set(cameras)
    format_ = picture_format(size, outputs, [None] if items is None else items)
    indices: U32 | None = None
    if camera_worlds is not None:
        if items is None:
            raise ValueError("camera_worlds: expected cameras, one for each index, got none")
        indices = world_indices("camera_worlds", camera_worlds, worlds).astype(np.uint32)
        if len(indices) != len(items):
            raise ValueError(f"camera_worlds: expected {len(items)} indices, one per camera, got {len(indices)}")
    options = ViewOptions(int(worlds), items, indices, format_, device_slots)
    if options.view_count > MAX_VIEWS:
        given = f"{worlds} worlds x {options.camera_count} cameras"
        raise ValueError(f"expected at most {MAX_VIEWS} views in a step, got {given}")
    return options


def device_slots_of(device: str | None, slots: int) -> int:
    """The number of slots of device memory: 0 without a device.

    Raises:
        ValueError: The device is unknown, or the number is out of range.
    """
    if device is None:
        return 0
    if device != "cuda":
        raise ValueError(f"device: expected 'cuda' or None, got '{device}'")
    if not 2 <= operator.index(slots) <= MAX_DEVICE_SLOTS:
        raise ValueError(f"slots: expected 2 to {MAX_DEVICE_SLOTS}, got {slots}")
    return operator.index(slots)


def world_indices(name: str, indices: ArrayLike, worlds: int) -> Indices:
    """Checks indices of worlds.

    Raises:
        ValueError: These are no integers, or an index is out of range.
    """
    array = real_array(name, indices)
    check_shape(name, array, (None,))
    if array.size > 0 and array.dtype.kind not in "iu":
        raise ValueError(f"{name}: expected integers, got the type {array.dtype}")
    converted = array.astype(np.intp)
    outside = converted[(converted < 0) | (converted >= worlds)]
    if len(outside) > 0:
        raise ValueError(f"{name}: expected indices of worlds below {worlds}, got {outside[0]}")
    return converted


def view_step(
    layout: StateLayout,
    number: int,
    worlds: int,
    q: ArrayLike | None,
    transforms: ArrayLike | None,
    changed_worlds: ArrayLike | None,
) -> StepMessage:
    """The message of a step. Its arrays may be those of the caller: encode it before they change.

    Args:
        layout: The layout of the scene.
        number: The number of the step.
        worlds: Number of worlds.
        q: All coordinates of the changed worlds, k x r.
        transforms: The transforms of the roots of the changed worlds, k x R x 3 x 4.
        changed_worlds: The indices of the changed worlds; None: all worlds.

    Raises:
        ValueError: An array has another shape, or an index is out of range or occurs twice.
    """
    message = StepMessage(steps_pb2.Step(number=number))
    changed = None if changed_worlds is None else world_indices("worlds", changed_worlds, worlds)
    count = worlds if changed is None else len(changed)
    if changed is not None:
        occurrences = np.bincount(changed, minlength=worlds)
        if occurrences.max() > 1:
            raise ValueError(f"worlds: expected each index once, got {occurrences.argmax()} several times")
    if q is not None:
        message.q = to_f32("q", q, (count, layout.coordinate_count))
        if changed is not None:
            message.head.q_domains.extend(_domains_of_worlds(layout, changed, np.array(layout.owners, np.intp)))
    if transforms is not None:
        message.transforms = root_transforms(layout, transforms, count)
        if changed is not None:
            message.head.transform_domains.extend(_domains_of_worlds(layout, changed, layout.roots))
    return message


def _domains_of_worlds(layout: StateLayout, worlds: Indices, domains: Indices) -> list[int]:
    """The indices of domains in a list of the domains of all worlds."""
    return (worlds[:, None] * len(layout.domains) + domains).ravel().tolist()


def root_transforms(layout: StateLayout, transforms: ArrayLike, count: int) -> F32:
    """Converts the transforms of the R roots of `count` states: N x R x 3 x 4 or, for one root, N x 3 x 4.

    Raises:
        ValueError: The array has another shape.
    """
    given = real_array("transforms", transforms)
    _check_transforms_shape(layout, given, count)
    return affine("transforms", given, given.shape[:-2]).reshape(count, len(layout.roots), 3, 4)


def _check_transforms_shape(layout: StateLayout, transforms: NDArray[np.generic], count: int) -> None:
    roots = len(layout.roots)
    leading = [(count, roots), (count,)] if roots == 1 else [(count, roots)]
    shapes = [(*dimensions, rows, 4) for dimensions in leading for rows in (3, 4)]
    if transforms.shape not in shapes:
        raise ValueError(f"transforms: expected shape {' or '.join(map(str, shapes))}, got {transforms.shape}")


def joint_transforms(layout: StateLayout, kinematics: Kinematics, q: F32, transforms: F32 | None) -> F32:
    """The transforms of the roots of N states, in which attached domains move with their parents.

    Args:
        layout: The layout of the scene.
        kinematics: Computes the transforms.
        q: All coordinates of the states, N x r, finite.
        transforms: Transforms of the roots, N x R x 3 x 4, finite. Those of attached domains are ignored. None: those
            at rest.
    """
    rest = square(rest_values(layout)[1])
    own = np.flatnonzero(~layout.is_attached[layout.roots])
    dependents = kinematics.dependents(None)
    result: F32 = np.empty((len(q), len(layout.roots), 3, 4), np.float32)
    states = max(_DOMAINS_PER_FIT // len(layout.domains), 1)
    for first in range(0, len(q), states):
        part = slice(first, first + states)
        world = np.tile(rest, (len(q[part]), 1, 1, 1))
        if transforms is not None:
            world[:, layout.roots[own], :3] = transforms[part, own]
        kinematics.update(world, q[part], dependents)
        result[part] = world[:, layout.roots, :3]
    return result


class StateTable:
    """N states of a scene, whose values are sent in batches.

    Attributes:
        count: N.
        kinematics: Computes the transforms of attached domains; None leaves them to the caller.
    """

    def __init__(self, layout: StateLayout, q: ArrayLike | None, transforms: ArrayLike | None) -> None:
        """Checks the states.

        Args:
            layout: The layout of the scene.
            q: N x r; None: at rest.
            transforms: N x R x 3 x 4 or, for one root, N x 3 x 4; None: at rest.

        Raises:
            ValueError: An array has another shape, or a number is not finite.
        """
        self._layout = layout
        self._q = None if q is None else real_array("q", q)
        self._transforms = None if transforms is None else real_array("transforms", transforms)
        self.kinematics: Kinematics | None = None
        if self._q is not None:
            check_shape("q", self._q, (None, layout.coordinate_count))
            self.count = len(self._q)
            _check_finite("q", self._q)
        elif self._transforms is not None:
            self.count = len(self._transforms) if self._transforms.ndim > 0 else 1
        else:
            raise ValueError("expected q or transforms, got none of them")
        if self._transforms is not None:
            _check_transforms_shape(layout, self._transforms, self.count)
            _check_finite("transforms", self._transforms)

    @property
    def state_bytes(self) -> int:
        """Size of the values of a state in bytes."""
        q_bytes = 0 if self._q is None else 4 * self._layout.coordinate_count
        has_transforms = self._transforms is not None or self.kinematics is not None
        return q_bytes + (48 * len(self._layout.roots) if has_transforms else 0)

    def batch(self, first: int, stop: int, worlds: int) -> tuple[F32 | None, F32 | None]:
        """The values of the states from `first` to `stop` and, for the remaining worlds, of the last state."""
        count = stop - first
        q = None if self._q is None else to_f32("q", self._q[first:stop], (count, self._layout.coordinate_count))
        transforms = self._transforms
        matrices = None if transforms is None else root_transforms(self._layout, transforms[first:stop], count)
        if self.kinematics is not None:
            coordinates = np.tile(rest_values(self._layout)[0], (count, 1)) if q is None else q
            matrices = joint_transforms(self._layout, self.kinematics, coordinates, matrices)
        return _repeat_last(q, worlds), _repeat_last(matrices, worlds)


def _repeat_last(rows: F32 | None, count: int) -> F32 | None:
    if rows is None or len(rows) == count:
        return rows
    return np.concatenate((rows, np.repeat(rows[-1:], count - len(rows), axis=0)))


def _check_finite(name: str, states: NDArray[np.generic]) -> None:
    for first in range(0, len(states), _CHECKED_STATES):
        part = states[first : first + _CHECKED_STATES]
        is_finite = np.isfinite(part).reshape(len(part), -1).all(axis=1)  # pyright: ignore
        if not is_finite.all():
            raise ValueError(f"{name}: expected finite numbers, got others in state {first + int(is_finite.argmin())}")


def batch_size_of(states: StateTable, options: ViewOptions, message_bytes: int, batch_size: int | None) -> int:
    """The number of states that a step draws, at least 1.

    Args:
        states: All states.
        options: What the views show. All cameras see every state.
        message_bytes: The size of the largest step that the server accepts.
        batch_size: The number that the caller demands; None: as many as are efficient.

    Raises:
        ValueError: The caller demands a number that is out of range.
    """
    most = min(MAX_WORLDS, MAX_VIEWS // options.camera_count)
    if batch_size is not None:
        if not 1 <= batch_size <= most:
            raise ValueError(f"batch_size: expected 1 to {most} states, got {batch_size}")
        return max(min(int(batch_size), states.count), 1)
    of_pictures = _BATCH_BYTES // (options.camera_count * options.format.view_bytes)
    of_values = int(_MESSAGE_FRACTION * message_bytes) // max(states.state_bytes, 1)
    most = max(min(most, of_pictures, of_values), 1)
    # Steps of equal size, because each step computes all worlds.
    steps = max(-(-states.count // most), 1)
    return max(-(-states.count // steps), 1)


@contextlib.contextmanager
def report_progress(progress: bool | StateProgress, total: int) -> Generator[Callable[[int], None]]:
    """Gives a function that reports the number of states that are drawn: to a progress bar, or to the caller.

    Raises:
        ImportError: `progress` is True, and tqdm is not installed.
    """
    if not isinstance(progress, bool):
        yield lambda done: (progress(done, total), None)[1]
        return
    if not progress:
        yield lambda _: None
        return
    try:
        tqdm: Any = importlib.import_module("tqdm.auto").tqdm
    except ImportError as error:
        raise ImportError("progress=True: expected the package tqdm, or a function as `progress`, got none") from error
    with tqdm(total=total, unit="state") as bar:
        yield lambda done: bar.update(done - bar.n)
