"""Decoders of reply streams: frames, vertices, states and forces. Each call has its own decoder."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Generic, Protocol, TypeVar

import numpy as np
from google.protobuf.message import DecodeError, Message

from modalcast._chunks import Assembler, ChunkFormat, malformed
from modalcast._types import Bytes
from modalcast.forces import ForceSet, force_set
from modalcast.frame import Frame, Image, frames_of_step
from modalcast.states import SceneState, StateDecoder, StateLayout
from modalcast.v1 import forces_pb2, frames_pb2, states_pb2, vertices_pb2
from modalcast.vertices import VertexDecoder, VertexSet

ReplyT_co = TypeVar("ReplyT_co", covariant=True)
MessageT = TypeVar("MessageT", bound=Message)


class ReplyDecoder(Protocol[ReplyT_co]):
    """Turns the messages of a call into replies."""

    def add(self, message: bytes) -> ReplyT_co | None:
        """Adds a message. Returns the reply that it completes."""
        ...

    def check_end(self) -> None:
        """Raises `MalformedReply` if a reply is incomplete at the end of the call."""
        ...


class Settings(Generic[MessageT]):
    """The settings in effect, which are the first message of a stream."""

    def __init__(self, name: str, message: type[MessageT]) -> None:
        self._name = name
        self._message = message
        self._settings: MessageT | None = None

    def add(self, content: memoryview) -> None:
        """Stores the settings."""
        self._settings = parse(self._name, self._message, content.tobytes())

    def get(self) -> MessageT:
        """The settings."""
        if self._settings is None:
            raise malformed(f"{self._name}.settings", "settings as the first message", "another message")
        return self._settings


def parse(name: str, message: type[MessageT], content: bytes) -> MessageT:
    """Parses a message of the server."""
    try:
        return message.FromString(content)
    except DecodeError as error:
        raise malformed(f"{name} message", "a message of the contract", str(error)) from error


class FrameDecoder:
    """Collects the pictures of a step (one per camera and output) and groups them into one frame per camera."""

    def __init__(self, names: Sequence[str], camera_count: int, chunk_field: int) -> None:
        """`names` are the outputs of each camera. `chunk_field` is the field of the chunk in the message."""
        self._names = names
        self._picture_count = len(names) * camera_count
        self._format = ChunkFormat("frame", frames_pb2.FrameChunk, chunk_field, data_field=3)
        self._assembler = Assembler[frames_pb2.FrameHead]("frame", lambda head: head.total)
        self._images: list[Image] = []

    def add(self, message: bytes) -> list[Frame] | None:
        """Adds a message. Returns one frame per camera after the last picture of a step."""
        parsed = self._format.parse(message)
        if parsed is None:
            return None
        chunk, data = parsed
        reply = self._assembler.add(chunk.head if chunk.HasField("head") else None, chunk.offset, data)
        if reply is None:
            return None
        head, pixels = reply
        if head.picture != len(self._images):
            raise malformed("frame.picture", str(len(self._images)), str(head.picture))
        self._images.append(Image(head, pixels))
        if len(self._images) < self._picture_count:
            return None
        frames = frames_of_step(self._names, self._images)
        self._images = []
        return frames

    def check_end(self) -> None:
        """Raises if pictures are missing."""
        self._assembler.check_end()
        if self._images:
            raise malformed("frame", f"{self._picture_count} pictures of a step", str(len(self._images)))


class VertexSetDecoder:
    """Decodes the layout, then the vertices of each step."""

    def __init__(self, layout_field: int, chunk_field: int, target: Bytes | None = None) -> None:
        """`target` receives the data of a step, as far as they fit. The remaining bytes get memory of their own."""
        self._layout_field = layout_field
        self._target: Bytes = np.empty(0, np.uint8) if target is None else target
        self._format = ChunkFormat("vertices", vertices_pb2.VertexChunk, chunk_field, data_field=3)
        self._assembler = Assembler[vertices_pb2.VertexHead]("vertices", lambda head: head.total, target)
        self._decoder = VertexDecoder()

    def add(self, message: bytes) -> VertexSet | None:
        """Adds a message. Returns the vertices after the last chunk of a step."""
        parsed = self._format.parse(message)
        if parsed is None:
            layout = self._format.other_field(message, self._layout_field)
            if layout is not None:
                self._decoder.add_layout(parse("vertices.layout", vertices_pb2.VertexLayout, layout.tobytes()))
            return None
        chunk, data = parsed
        reply = self._assembler.add(chunk.head if chunk.HasField("head") else None, chunk.offset, data)
        if reply is None:
            return None
        head, tail = reply
        return self._decoder.decode(head, self._target, tail)

    def check_end(self) -> None:
        """Raises if chunks are missing."""
        self._assembler.check_end()


class SceneStateDecoder:
    """Reconstructs the complete state of every step from a stream of complete states and changes."""

    def __init__(self, layout: StateLayout, chunk_field: int) -> None:
        self._format = ChunkFormat("states", states_pb2.StateChunk, chunk_field, data_field=3)
        self._assembler = Assembler[states_pb2.StateHead]("states", lambda head: head.total)
        self._decoder = StateDecoder(layout)

    def add(self, message: bytes) -> SceneState | None:
        """Adds a message. Returns the state after its last chunk."""
        parsed = self._format.parse(message)
        if parsed is None:
            return None
        chunk, data = parsed
        reply = self._assembler.add(chunk.head if chunk.HasField("head") else None, chunk.offset, data)
        return None if reply is None else self._decoder.decode(*reply)

    def check_end(self) -> None:
        """Raises if chunks are missing."""
        self._assembler.check_end()


class ForceDecoder:
    """Decodes sets of forces. Each set is one message."""

    def add(self, message: bytes) -> ForceSet:
        """Returns the forces of the message."""
        return force_set(parse("forces", forces_pb2.StreamForcesResponse, message))

    def check_end(self) -> None:
        """A set is never incomplete."""
