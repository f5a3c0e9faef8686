"""Steps of a view stream: the arrays that receive their pictures, and the replies that fill these arrays."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np

from modalcast._chunks import Assembly, ChunkFormat, malformed
from modalcast._decoders import parse
from modalcast._shared_memory import MemoryConnection
from modalcast.errors import Error, ServerError, from_rejection
from modalcast.v1 import common_pb2, errors_pb2, views_pb2
from modalcast.views import VIEW_FORMATS, ViewArrays

_FORMAT = ChunkFormat("views", views_pb2.ViewChunk, views_pb2.DrawViewsResponse.CHUNK_FIELD_NUMBER, data_field=5)


class ViewStepInFlight:
    """A step that was sent, and the arrays that receive its pictures.

    Attributes:
        number: The number of the step.
        arrays: The arrays by the names of their outputs, C-contiguous.
        stages: Milliseconds by stage, the sum over the parts of the step.
        is_done: Whether all pictures have arrived, or the server has rejected the step.
        rejection: Why the server rejected the step; None if it did not.
        slot: The slot of device memory that has the pictures; None if `arrays` receive them.
    """

    def __init__(self, number: int, arrays: ViewArrays) -> None:
        self.number = number
        self.arrays = arrays
        self.stages: dict[str, float] = {}
        self.is_done = False
        self.rejection: ServerError | None = None
        self.slot: int | None = None
        # By output of the contract. An array that is complete has no entry.
        self._assemblies = {
            VIEW_FORMATS[name].output: Assembly(f"views.{name}", array.nbytes, array.reshape(-1).view(np.uint8))
            for name, array in arrays.items()
        }

    def add(self, chunk: views_pb2.ViewChunk, data: memoryview) -> None:
        """Copies the data of a chunk to their place in the array.

        Raises:
            MalformedReply: The chunk is not the next one of an array of this step.
        """
        if chunk.step != self.number:
            raise malformed("views.step", str(self.number), str(chunk.step))
        assembly = self._assemblies.get(chunk.output)
        if assembly is None:
            expected = ", ".join(str(output) for output in self._assemblies)
            raise malformed("views.output", expected, str(chunk.output))
        self._add_stages(chunk.stages)
        if assembly.add(chunk.offset, data):
            del self._assemblies[chunk.output]
            self.is_done = not self._assemblies

    def set_slot(self, views: views_pb2.DeviceViews) -> None:
        """Takes the slot of device memory that has all pictures.

        Raises:
            MalformedReply: The pictures are those of another step, or were expected in arrays.
        """
        if views.step != self.number or self._assemblies:
            raise malformed("views.device.step", str(self.number), str(views.step))
        self._add_stages(views.stages)
        self.slot = views.slot
        self.is_done = True

    def _add_stages(self, stages: Iterable[common_pb2.StageTime]) -> None:
        for stage in stages:
            self.stages[stage.stage] = self.stages.get(stage.stage, 0.0) + stage.milliseconds


class ViewProgress:
    """Progress of a view stream.

    Attributes:
        in_flight: The steps that were sent and are not complete, oldest first.
        received: Number of messages that have arrived.
        end: The error that ended the stream; None while it is open.
    """

    def __init__(self, memory: MemoryConnection | None = None) -> None:
        """`memory` contains the data of chunks that only refer to them."""
        self._memory = memory
        self.in_flight: deque[ViewStepInFlight] = deque()
        self.received = 0
        self.end: Error | None = None

    def add(self, reply: bytes) -> bool:
        """Applies a reply of the server. Returns whether it completes a step.

        Raises:
            MalformedReply: The reply contradicts the contract.
        """
        self.received += 1
        if not self.in_flight:
            raise malformed("views", "no message without a step", f"{len(reply)} bytes")
        step = self.in_flight[0]
        parsed = _FORMAT.parse(reply)
        if parsed is None:
            self._add_other(step, reply)
        else:
            self._add_chunk(step, *parsed)
        if step.is_done:
            self.in_flight.popleft()
        return step.is_done

    def _add_chunk(self, step: ViewStepInFlight, chunk: views_pb2.ViewChunk, data: memoryview) -> None:
        if not chunk.HasField("shared"):
            step.add(chunk, data)
        elif self._memory is None:
            raise malformed("views.shared", "data in the message", f"slot {chunk.shared.slot}")
        else:
            step.add(chunk, self._memory.data(chunk.shared.slot, chunk.shared.bytes))
            self._memory.give_back([chunk.shared.slot])

    def _add_other(self, step: ViewStepInFlight, reply: bytes) -> None:
        """Applies a reply without a chunk."""
        fields = views_pb2.DrawViewsResponse
        device = _FORMAT.other_field(reply, fields.DEVICE_FIELD_NUMBER)
        if device is not None:
            step.set_slot(parse("views.device", views_pb2.DeviceViews, device.tobytes()))
            return
        content = _FORMAT.other_field(reply, fields.REJECTION_FIELD_NUMBER)
        if content is None:
            raise malformed("views", "a chunk or a rejection", "another message")
        step.rejection = from_rejection(parse("views.rejection", errors_pb2.Rejection, content.tobytes()))
        if step.rejection.step not in (None, step.number):
            raise malformed("views.rejection.step", str(step.number), str(step.rejection.step))
        step.is_done = True
