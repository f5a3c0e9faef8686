"""Slots of device memory in which the pictures of steps arrive, and the arrays that borrow them."""

from __future__ import annotations

import gc
import math
import os
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from modalcast._chunks import malformed
from modalcast._cuda_driver import CudaDevice, ImportedMemory
from modalcast._shared_memory import FIRST_DEVICE_SLOT, MemoryConnection
from modalcast.device_array import DeviceArray
from modalcast.errors import DeadlineExceeded
from modalcast.v1 import views_pb2


class _Lease:
    """The right to a slot. Its arrays refer to it, and the slot is released when they no longer exist."""

    def __init__(self, slot: int, memory: ImportedMemory, released: deque[int]) -> None:
        # The arrays may exist longer than the call, and then keep the memory.
        self._memory = memory
        self._slot = slot
        self._released = released

    def __del__(self) -> None:
        self._released.append(self._slot)


class DeviceSlots:
    """The slots of a call."""

    def __init__(
        self,
        connection: MemoryConnection,
        opened: views_pb2.DeviceSlots,
        shapes: Mapping[str, tuple[int, ...]],
        dtypes: Mapping[str, np.dtype[Any]],
    ) -> None:
        """Imports the memory that the server has sent on a connection.

        Args:
            connection: The connection of the call.
            opened: What the server tells about the slots.
            shapes: The shape of each array by output, in the order of the server's outputs.
            dtypes: The types of the arrays.

        Raises:
            Unavailable: This process does not see the GPU of the server, or cannot import its memory.
            MalformedReply: The server contradicts the contract.
        """
        self._connection = connection
        self._shapes = dict(shapes)
        self._dtypes = dict(dtypes)
        files = connection.device_files()
        try:
            lengths = {name: math.prod(shape) * dtypes[name].itemsize for name, shape in shapes.items()}
            is_complete = len(opened.offsets) == len(shapes) and len(opened.bytes) == len(files)
            self._offsets = dict(zip(shapes, opened.offsets, strict=False))
            ends = [offset + lengths[name] for name, offset in self._offsets.items()]
            if not is_complete or any(max(ends) > length for length in opened.bytes):
                raise malformed("views.device_slots", f"slots for {dict(shapes)}", str(opened))
            self._device = CudaDevice(opened.device)
            sizes = zip(files, opened.bytes, strict=True)
            self._memory = [ImportedMemory(self._device, file, length) for file, length in sizes]
        finally:
            for file in files:
                os.close(file)
        self._released: deque[int] = deque()
        # The step of each slot that arrays may use.
        self._steps: dict[int, int] = {}

    def arrays(self, slot: int, step: int) -> dict[str, DeviceArray]:
        """The arrays of a step, by output.

        Raises:
            MalformedReply: The slot does not exist, or is in use.
        """
        if slot >= len(self._memory) or slot in self._steps:
            raise malformed("views.device.slot", f"a free slot of {len(self._memory)}", str(slot))
        self._steps[slot] = step
        memory = self._memory[slot]
        lease = _Lease(slot, memory, self._released)
        return {
            name: DeviceArray(
                lease, memory.address + self._offsets[name], shape, self._dtypes[name], self._device.ordinal
            )
            for name, shape in self._shapes.items()
        }

    def require_free(self, in_flight: int, *, is_retry: bool = False) -> None:
        """Returns the slots whose arrays no longer exist, and checks that one is free for a further step.

        Raises:
            DeadlineExceeded: All slots are in use.
        """
        released = [self._released.popleft() for _ in range(len(self._released))]
        if released:
            # The consumer of an array may still have queued work that reads it.
            self._device.synchronize()
            for slot in released:
                del self._steps[slot]
            self._connection.give_back([FIRST_DEVICE_SLOT + slot for slot in released])
        if len(self._steps) + in_flight >= len(self._memory) and not is_retry:
            # Arrays may be parts of reference cycles.
            gc.collect()
            self.require_free(in_flight, is_retry=True)
        elif len(self._steps) + in_flight >= len(self._memory):
            steps = ", ".join(str(step) for step in sorted(self._steps.values())) or "none"
            given = (
                f"{len(self._memory)} in use: {in_flight} by steps in flight, the others by arrays of the steps {steps}"
            )
            raise DeadlineExceeded(
                f"device='cuda': expected a free slot, got {given}. Delete these arrays, or use more slots."
            )

    def close(self) -> None:
        """Ends the use of the slots. Arrays that exist remain valid."""
        self._memory.clear()
