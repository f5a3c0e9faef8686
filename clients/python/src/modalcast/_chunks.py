"""Assembles chunks of the server into complete replies, without the copies that parsing with protobuf makes.

protobuf copies the bytes of a field into its arena and again into a `bytes` object. Here, the data of a chunk is a view
of the message as gRPC has received it, and is copied once, to its place in the reply.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from google.protobuf.message import DecodeError, Message

from modalcast._types import Bytes
from modalcast.errors import MalformedReply

REPLY_LIMIT = 1 << 30
"""Largest reply that is assembled, in bytes."""

_LENGTH_DELIMITED = 2
_FIXED_BYTES = {1: 8, 5: 4}

HeadT = TypeVar("HeadT", bound=Message)
ChunkT = TypeVar("ChunkT", bound=Message)


def _varint(buffer: memoryview, position: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = buffer[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
        shift += 7
        if shift > 63:
            raise DecodeError("a number has more than 64 bits")


def _fields(buffer: memoryview) -> Iterator[tuple[int, int, int, int]]:
    """The fields of a message: number, start of the tag, start of the content, end."""
    position = 0
    while position < len(buffer):
        start = position
        tag, position = _varint(buffer, position)
        wire_type = tag & 7
        content = position
        if wire_type == _LENGTH_DELIMITED:
            length, content = _varint(buffer, position)
            position = content + length
        elif wire_type == 0:
            _, position = _varint(buffer, position)
        elif wire_type in _FIXED_BYTES:
            position += _FIXED_BYTES[wire_type]
        else:
            raise DecodeError(f"wire type {wire_type}")
        if position > len(buffer):
            raise DecodeError("a field exceeds its message")
        yield tag >> 3, start, content, position


def split_data(chunk: memoryview, data_field: int) -> tuple[bytes, memoryview]:
    """Separates the data of a chunk from its other fields."""
    for number, start, content, end in _fields(chunk):
        if number == data_field:
            return bytes(chunk[:start]) + bytes(chunk[end:]), chunk[content:end]
    return bytes(chunk), memoryview(b"")


def submessage(message: bytes, field: int) -> memoryview | None:
    """The content of a message field; None if it is not set."""
    view = memoryview(message)
    for number, _, content, end in _fields(view):
        if number == field:
            return view[content:end]
    return None


@dataclass(frozen=True)
class ChunkFormat(Generic[ChunkT]):
    """Where a reply message has its chunk, and where the chunk has its data.

    Attributes:
        name: Name of the reply in errors.
        message: The class of the chunk.
        chunk_field: Number of the chunk's field in the reply message; None if the reply message is the chunk.
        data_field: Number of the field with the data.
    """

    name: str
    message: type[ChunkT]
    chunk_field: int | None
    data_field: int

    def parse(self, raw: bytes) -> tuple[ChunkT, memoryview] | None:
        """The chunk without its data, and the data; None if the message has no chunk."""
        try:
            view = memoryview(raw) if self.chunk_field is None else submessage(raw, self.chunk_field)
            if view is None:
                return None
            rest, data = split_data(view, self.data_field)
            return self.message.FromString(rest), data
        except (DecodeError, IndexError) as error:
            raise malformed(f"{self.name} message", "a message of the contract", str(error)) from error

    def other_field(self, raw: bytes, number: int) -> memoryview | None:
        """The content of another field of a reply message; None if it is not set."""
        try:
            return submessage(raw, number)
        except (DecodeError, IndexError) as error:
            raise malformed(f"{self.name} message", "a message of the contract", str(error)) from error


class Assembly:
    """The bytes of one reply, which arrive in order: first those of `target`, then those of `bytes`."""

    def __init__(self, name: str, total: int, target: Bytes) -> None:
        if not len(target) <= total <= REPLY_LIMIT:
            raise malformed(f"{name}.total", f"{len(target)} to {REPLY_LIMIT} bytes", str(total))
        self._name = name
        self._target = target
        self.total = total
        self.bytes: Bytes = np.empty(total - len(target), np.uint8)
        self.received = 0

    def add(self, offset: int, data: memoryview) -> bool:
        """Adds the data of the next chunk. Returns whether the reply is complete."""
        if offset != self.received:
            raise malformed(f"{self._name}.offset", str(self.received), str(offset))
        end = offset + len(data)
        if end > self.total:
            raise malformed(f"{self._name}.data", f"at most {self.total} bytes", str(end))
        content = np.frombuffer(data, np.uint8)
        target_bytes = len(self._target)
        of_target = min(max(target_bytes - offset, 0), len(content))
        self._target[offset : offset + of_target] = content[:of_target]
        self.bytes[max(offset - target_bytes, 0) : max(end - target_bytes, 0)] = content[of_target:]
        self.received = end
        return end == self.total


class Assembler(Generic[HeadT]):
    """Assembles consecutive replies, of which each begins with a chunk that has a head."""

    def __init__(self, name: str, total: Callable[[HeadT], int], target: Bytes | None = None) -> None:
        """Prepares for replies of `total(head)` bytes, of which `target` receives the first ones."""
        self._name = name
        self._total = total
        self._target: Bytes = np.empty(0, np.uint8) if target is None else target
        self._head: HeadT | None = None
        self._assembly: Assembly | None = None

    def add(self, head: HeadT | None, offset: int, data: memoryview) -> tuple[HeadT, Bytes] | None:
        """Adds a chunk. The last chunk of a reply returns the head and the bytes that `target` has not received."""
        if head is not None:
            if self._assembly is not None:
                raise malformed(f"{self._name}.head", "the next chunk of the open reply", "a new head")
            self._head, self._assembly = head, Assembly(self._name, self._total(head), self._target)
        if self._head is None or self._assembly is None:
            raise malformed(f"{self._name}.head", "a head on the first chunk", "none")
        if not self._assembly.add(offset, data):
            return None
        reply = self._head, self._assembly.bytes
        self._head = self._assembly = None
        return reply

    def check_end(self) -> None:
        """Raises if a reply is incomplete at the end of the stream."""
        if self._assembly is not None:
            expected = f"{self._assembly.total} bytes"
            raise malformed(self._name, expected, f"the end of the stream after {self._assembly.received}")


def malformed(field: str, expected: str, given: str) -> MalformedReply:
    """The error for a reply whose `field` has the value `given`."""
    return MalformedReply(f"malformed reply: {field}: expected {expected}, got {given}")
