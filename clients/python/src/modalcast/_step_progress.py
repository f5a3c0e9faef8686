"""Progress of streams of steps. Of a drive: steps in flight, acknowledgments and rejections."""

from __future__ import annotations

import contextlib
from collections import deque
from typing import Any, Protocol

from modalcast._common import stage_times
from modalcast.errors import Error, ServerError, from_rejection
from modalcast.v1 import steps_pb2

_MAX_REJECTIONS = 1024


class StreamProgress(Protocol):
    """The state that the replies of a stream change.

    Attributes:
        end: The error that ended the stream; None while it is open.
    """

    end: Error | None

    def add(self, reply: Any) -> bool:
        """Applies a reply of the server. Returns whether this may end the wait for a step.

        Raises:
            MalformedReply: The reply contradicts the contract.
        """
        ...


class Progress:
    """Progress of a drive.

    Attributes:
        in_flight: Numbers of the sent steps that were neither acknowledged nor rejected, oldest first.
        acknowledged: Number of the last acknowledged step.
        durable: Number of the newest step that survives a crash of the server and a power loss.
        skipped: Number of steps that were merged into a newer one.
        rejected: Number of rejected steps.
        rejections: Rejections that were not raised as errors yet, at most the newest 1024.
        stages: Milliseconds by stage of the last acknowledged step.
        end: The error that ended the stream; None while it is open.
    """

    def __init__(self) -> None:
        self.in_flight: deque[int] = deque()
        self.acknowledged: int | None = None
        self.durable: int | None = None
        self.skipped = 0
        self.rejected = 0
        self.rejections: deque[ServerError] = deque(maxlen=_MAX_REJECTIONS)
        self.stages: dict[str, float] = {}
        self.end: Error | None = None

    def add(self, reply: steps_pb2.DriveSceneResponse) -> bool:
        """Applies a reply of the server. Returns True, because each reply may end the wait for a step."""
        if reply.HasField("ack"):
            while self.in_flight and self.in_flight[0] <= reply.ack.step:
                self.in_flight.popleft()
            self.acknowledged = reply.ack.step
            if reply.ack.HasField("durable_step"):
                self.durable = reply.ack.durable_step
            self.skipped = reply.ack.skipped
            self.stages = stage_times(reply.ack.stages)
        elif reply.HasField("rejection"):
            rejection = from_rejection(reply.rejection)
            self.discard(rejection.step)
            self.rejected += 1
            self.rejections.append(rejection)
        return True

    def discard(self, number: int | None) -> None:
        """Removes a step from the steps in flight."""
        with contextlib.suppress(ValueError):
            self.in_flight.remove(number)  # pyright: ignore[reportArgumentType] # None is in no list

    def fits(self, window: int | None) -> bool:
        """Whether another step fits into the window."""
        return window is None or len(self.in_flight) < window
