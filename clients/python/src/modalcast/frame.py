"""Frames and the pictures that request them."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from modalcast._common import StepId, stage_times, step_id
from modalcast._types import F32, U32, Bytes
from modalcast.camera import Camera
from modalcast.v1 import frames_pb2

OutputName: TypeAlias = Literal[
    "color", "depth", "depth_with_ground", "domains", "normals", "displacement", "mode_shape"
]
ColorFormat: TypeAlias = Literal["raw", "png", "jpeg"]

MAX_PICTURES = 16
"""Largest number of pictures in a request: cameras times outputs."""

NO_DOMAIN = 0xFFFFFFFF
"""Value of the output "domains" where there is no surface."""

_OUTPUTS: dict[str, frames_pb2.Output] = {
    "color": frames_pb2.OUTPUT_COLOR,
    "depth": frames_pb2.OUTPUT_DEPTH,
    "depth_with_ground": frames_pb2.OUTPUT_DEPTH_WITH_GROUND,
    "domains": frames_pb2.OUTPUT_DOMAINS,
    "normals": frames_pb2.OUTPUT_NORMALS,
    "displacement": frames_pb2.OUTPUT_DISPLACEMENT,
    "mode_shape": frames_pb2.OUTPUT_MODE_SHAPE,
}
_COLORED = ("color", "displacement", "mode_shape")
_COLOR_FORMATS: dict[str, frames_pb2.Format] = {
    "raw": frames_pb2.FORMAT_RGB,
    "png": frames_pb2.FORMAT_PNG,
    "jpeg": frames_pb2.FORMAT_JPEG,
}
# Type and number of channels of the formats that are arrays.
_ARRAYS = {
    frames_pb2.FORMAT_RGB: ("u1", 3),
    frames_pb2.FORMAT_RGBA: ("u1", 4),
    frames_pb2.FORMAT_F32: ("<f4", 1),
    frames_pb2.FORMAT_U32: ("<u4", 1),
    frames_pb2.FORMAT_F32X3: ("<f4", 3),
}
# The color type of a PNG file.
_PNG_RGB = 2
_RAW_COLORS = (frames_pb2.FORMAT_RGB, frames_pb2.FORMAT_RGBA)
_SUFFIXES = {frames_pb2.FORMAT_PNG: (".png",), frames_pb2.FORMAT_JPEG: (".jpg", ".jpeg")}


@dataclass(frozen=True)
class Output:
    """An output with parameters. A plain name means the output with default parameters.

    Attributes:
        name: "color" (shaded, sRGB), "depth" (meters along the view axis; infinity where there is no surface),
            "depth_with_ground", "domains" (index; `NO_DOMAIN` where there is no surface), "normals" (unit vectors in
            world axes; zeros where there is no surface), "displacement" (|u| as a color map) or "mode_shape" (the norm
            of one column of U as a color map).
        mode: Column of U for "mode_shape", from 0.
        largest: Value at the bright end of a color map, in meters or in meters per unit of q; 0 fits it to each frame.
        edge_width: For "color": width of lines along face edges in pixels, at most 32; None: as in the scene.
        samples: For "color": samples per pixel, 1 or 4; 0: as in the scene. If the scene sets none, a single frame has
            4, and the server chooses for a stream.
    """

    name: OutputName
    mode: int = 0
    largest: float = 0.0
    edge_width: float | None = None
    samples: int = 0


Outputs: TypeAlias = OutputName | Output | Sequence[OutputName | Output]
"""One or several outputs, by name or with parameters."""


@dataclass(frozen=True)
class PictureOptions:
    """What the frames of a request show.

    Attributes:
        cameras: One camera per frame; None shows the whole scene.
        outputs: The outputs of each frame, or one output.
        width: Width in pixels; None: that of the camera, or 1280.
        height: Height in pixels; None: that of the camera, or 720.
        format: Encoding of color and color maps.
        jpeg_quality: 1 to 100.
        has_rgb: Whether the server has FEATURE_RGB_FRAMES. Raw colors of another server have alpha.
    """

    cameras: Sequence[Camera | None]
    outputs: Outputs
    width: int | None
    height: int | None
    format: ColorFormat
    jpeg_quality: int
    has_rgb: bool

    def output_list(self) -> list[Output]:
        """The outputs with their parameters."""
        if isinstance(self.outputs, Output):
            return [self.outputs]
        if isinstance(self.outputs, str):
            return [Output(self.outputs)]
        return [output if isinstance(output, Output) else Output(output) for output in self.outputs]

    def names(self) -> list[str]:
        """The names of the outputs."""
        return [output.name for output in self.output_list()]

    def to_messages(self, scene_up: str) -> list[frames_pb2.Picture]:
        """The pictures of the request: all outputs of the first camera, then those of the second.

        Raises:
            ValueError: An output or a format is unknown, an output occurs twice, or there are too many pictures.
        """
        names = self.names()
        if len(set(names)) != len(names):
            raise ValueError(f"outputs: expected each output once, got {names}")
        count = len(self.cameras) * len(names)
        if not 1 <= count <= MAX_PICTURES:
            raise ValueError(
                f"expected 1 to {MAX_PICTURES} pictures, got {len(self.cameras)} cameras x {len(names)} outputs"
            )
        if self.format not in _COLOR_FORMATS:
            raise ValueError(f"format: expected one of {list(_COLOR_FORMATS)}, got '{self.format}'")
        return [self._picture(camera, output, scene_up) for camera in self.cameras for output in self.output_list()]

    def _picture(self, camera: Camera | None, output: Output, scene_up: str) -> frames_pb2.Picture:
        if output.name not in _OUTPUTS:
            raise ValueError(f"outputs: expected names from {list(_OUTPUTS)}, got '{output.name}'")
        is_colored = output.name in _COLORED
        format_ = _COLOR_FORMATS[self.format] if is_colored else frames_pb2.FORMAT_UNSPECIFIED
        if format_ == frames_pb2.FORMAT_RGB and not self.has_rgb:
            format_ = frames_pb2.FORMAT_RGBA
        size = picture_size(camera, self.width, self.height)
        picture = frames_pb2.Picture(
            width=size[0],
            height=size[1],
            format=format_,
            output=_OUTPUTS[output.name],
            mode=output.mode,
            largest=output.largest,
            jpeg_quality=self.jpeg_quality if format_ == frames_pb2.FORMAT_JPEG else 0,
            edge_width=output.edge_width,
            samples=output.samples,
        )
        if camera is not None:
            picture.camera.CopyFrom(camera.to_message(scene_up))
        return picture


def picture_size(camera: Camera | None, width: int | None, height: int | None) -> tuple[int, int]:
    """The size of a picture in pixels.

    Raises:
        TypeError: `camera` is not a camera.
        ValueError: A size is not positive, or a pinhole camera has another size.
    """
    if not isinstance(camera, Camera | None):  # pyright: ignore[reportUnnecessaryIsInstance] # of untyped callers
        raise TypeError(f"camera: expected a Camera or None, got {type(camera).__name__}")
    camera_size = (None, None) if camera is None else (camera.width, camera.height)
    size: list[int] = []
    pairs = zip(("width", "height"), (width, height), camera_size, (1280, 720), strict=True)
    for name, given, of_camera, default in pairs:
        if given is not None and of_camera is not None and given != of_camera:
            raise ValueError(f"{name}: expected {of_camera}, the {name} of the camera, got {given}")
        value = given if given is not None else of_camera if of_camera is not None else default
        if value < 1:
            raise ValueError(f"{name}: expected at least 1 pixel, got {value}")
        size.append(value)
    return size[0], size[1]


@dataclass(frozen=True, eq=False)
class Image:
    """One output of a frame.

    Attributes:
        head: Size, format, stage times, look and further fields; `frames.proto` documents them.
        data: The bytes: a PNG or JPEG file, or pixels.
    """

    head: frames_pb2.FrameHead
    data: Bytes

    @property
    def array(self) -> NDArray[np.uint8] | F32 | U32:
        """H x W, or H x W x channels. A view, not a copy.

        Raises:
            ValueError: The image is a PNG or JPEG file.
        """
        if self.head.format not in _ARRAYS:
            name = frames_pb2.Format.Name(self.head.format).removeprefix("FORMAT_")
            raise ValueError(f"expected an image in the format 'raw', got {name}: request format='raw' for arrays")
        dtype, channels = _ARRAYS[self.head.format]
        shape = (self.head.height, self.head.width) + ((channels,) if channels > 1 else ())
        return self.data.view(dtype).reshape(shape)


@dataclass(frozen=True, eq=False)
class Frame:
    """The outputs of one camera at one step. In a notebook, a frame shows its color.

    Attributes:
        step: The step that the frame shows.
        images: The images by the names of their outputs.
    """

    step: StepId
    images: Mapping[str, Image]

    @property
    def array(self) -> NDArray[np.uint8]:
        """Color, or the first color map: H x W x 3, sRGB."""
        # Frames of servers without FEATURE_RGB_FRAMES have alpha, which is 255.
        return self._colored().array[..., :3]  # pyright: ignore[reportReturnType] # color is u8

    @property
    def rgba(self) -> NDArray[np.uint8]:
        """Color with alpha, which is 255: H x W x 4. A copy, unless the server has sent alpha."""
        array: NDArray[np.uint8] = self._colored().array  # pyright: ignore[reportAssignmentType] # color is u8
        if array.shape[2] == 4:
            return array
        return np.concatenate((array, np.full_like(array[..., :1], 255)), axis=2)

    @property
    def depth(self) -> F32:
        """Meters along the view axis, H x W; infinity where there is no surface."""
        return self["depth"]  # pyright: ignore[reportReturnType] # depth is f32

    @property
    def domains(self) -> U32:
        """Index of the domain, H x W; `NO_DOMAIN` where there is no surface."""
        return self["domains"]  # pyright: ignore[reportReturnType] # domains are u32

    @property
    def normals(self) -> F32:
        """Unit normals in world axes, H x W x 3; zeros where there is no surface."""
        return self["normals"]  # pyright: ignore[reportReturnType] # normals are f32

    def __getitem__(self, output: str) -> NDArray[np.uint8] | F32 | U32:
        """The array of an output."""
        return self.image(output).array

    def image(self, output: str) -> Image:
        """The image of an output.

        Raises:
            KeyError: The frame does not have the output.
        """
        if output not in self.images:
            raise KeyError(f"the frame has the outputs {list(self.images)}, not '{output}': request it with outputs=")
        return self.images[output]

    @property
    def width(self) -> int:
        """In pixels."""
        return next(iter(self.images.values())).head.width

    @property
    def height(self) -> int:
        """In pixels."""
        return next(iter(self.images.values())).head.height

    @property
    def skipped(self) -> int:
        """Number of steps that the stream has skipped since its previous frame."""
        return next(iter(self.images.values())).head.skipped

    @property
    def camera_version(self) -> int:
        """Number of updates that the cameras of the stream had received when the frame was drawn."""
        return next(iter(self.images.values())).head.camera_version

    @property
    def stages(self) -> dict[str, float]:
        """Milliseconds by stage of the first image; `common.proto` lists the stages."""
        return stage_times(next(iter(self.images.values())).head.stages)

    @property
    def remarks(self) -> tuple[str, ...]:
        """Reasons why color may be misread: vertices below the ground, or domains that have left the default view."""
        heads = [image.head for image in self.images.values()]
        remarks: list[str] = []
        if any(head.reframed for head in heads):
            remarks.append("no domain is in the view of the rest state: the frame shows them where they are")
        depth = max(head.below_ground for head in heads)
        if depth > 0:
            remarks.append(f"vertices lie up to {depth:.4f} m below the ground, which hides no geometry")
        return tuple(remarks)

    def png(self) -> bytes:
        """Color as a PNG file. Encoded here unless the frame was requested as PNG.

        Raises:
            ValueError: The frame is a JPEG file.
        """
        image = self._colored()
        if image.head.format == frames_pb2.FORMAT_PNG:
            return image.data.tobytes()
        return encode_png(self.array)

    def save(self, path: str | Path, output: str | None = None) -> None:
        """Writes color as `.png`, the file of a frame in the format "jpeg" as `.jpg`, or any output as `.npy`.

        Args:
            path: The suffix selects the format.
            output: The output to write; None: color or the first color map.

        Raises:
            KeyError: The frame does not have the output.
            ValueError: The output cannot be written with this suffix.
            OSError: The file cannot be written.
        """
        path = Path(path)
        image = self._colored() if output is None else self.image(output)
        suffix = path.suffix.lower()
        if suffix == ".npy":
            np.save(path, image.array)
        elif suffix in _SUFFIXES.get(image.head.format, ()):
            path.write_bytes(image.data.tobytes())
        elif suffix == ".png" and image.head.format in _RAW_COLORS:
            path.write_bytes(encode_png(image.array[..., :3]))  # pyright: ignore[reportArgumentType] # color is u8
        else:
            name = frames_pb2.Format.Name(image.head.format).removeprefix("FORMAT_")
            arrays = ".png or .npy" if image.head.format in _RAW_COLORS else ".npy"
            expected = arrays if image.head.format in _ARRAYS else _SUFFIXES[image.head.format][0]
            raise ValueError(f"expected a path that ends with {expected} for an image of format {name}, got '{path}'")

    def _repr_png_(self) -> bytes | None:
        if not any(name in _COLORED for name in self.images):
            return None
        is_jpeg = self._colored().head.format == frames_pb2.FORMAT_JPEG
        return None if is_jpeg else self.png()

    def _repr_jpeg_(self) -> bytes | None:
        if not any(name in _COLORED for name in self.images):
            return None
        image = self._colored()
        return image.data.tobytes() if image.head.format == frames_pb2.FORMAT_JPEG else None

    def _colored(self) -> Image:
        for name in _COLORED:
            if name in self.images:
                return self.images[name]
        return self.image("color")


def frames_of_step(names: Sequence[str], images: Sequence[Image]) -> list[Frame]:
    """The frames of one step: one per camera, from all outputs of the first camera, then those of the second."""
    frames: list[Frame] = []
    for first in range(0, len(images), len(names)):
        of_camera = images[first : first + len(names)]
        frames.append(Frame(step_id(of_camera[0].head.step), dict(zip(names, of_camera, strict=True))))
    return frames


def encode_png(rgb: NDArray[np.uint8]) -> bytes:
    """Encodes H x W x 3 sRGB as PNG. Every row has the filter "up", and the compression level is 1."""
    height, width = rgb.shape[:2]
    rows = np.ascontiguousarray(rgb).reshape(height, -1)
    filtered = np.empty((height, rows.shape[1] + 1), np.uint8)
    filtered[:, 0] = 2
    filtered[0, 1:] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=filtered[1:, 1:])

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", width, height, 8, _PNG_RGB, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"sRGB", b"\0")
        + chunk(b"IDAT", zlib.compress(filtered.tobytes(), 1))
        + chunk(b"IEND", b"")
    )
