"""Assembles chunks of the server into complete replies. The data of a chunk are copied once, to their place there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from google.protobuf.message import DecodeError, Message

from modalcast._types import Bytes
from modalcast._wire import split_data, submessage
from modalcast.errors import MalformedReply

REPLY_LIMIT = 1 << 30
"""Largest reply that is assembled, in bytes. Memory of the caller may be larger."""

HeadT = TypeVar("HeadT", bound=Message)
ChunkT = TypeVar("ChunkT", bound=Message)


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
        limit = max(REPLY_LIMIT, len(target))
        if not len(target) <= total <= limit:
            raise malformed(f"{name}.total", f"{len(target)} to {limit} bytes", str(total))
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
