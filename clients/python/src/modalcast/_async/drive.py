"""Drives a scene: sends steps with coordinates and transforms."""

from __future__ import annotations

import contextlib
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace

from modalcast._async.streams import with_reconnect
from modalcast._async.transport import StepStream, Transport
from modalcast._chunks import malformed
from modalcast._common import Delivery, StepId, delivery_message, stall_budget_milliseconds
from modalcast._step_message import StepMessage
from modalcast.errors import ConnectionLost, from_rejection
from modalcast.kinematics import Kinematics
from modalcast.states import SceneState, StateLayout
from modalcast.step_values import Coordinates, StepValues, Transforms, rest_values, to_time
from modalcast.v1 import steps_pb2


@dataclass(frozen=True)
class DriveOptions:
    """How a drive is opened; `Scene.drive` documents the fields."""

    delivery: Delivery
    reset: bool | None
    take_over: bool
    window: int | None
    stall_budget: float | None
    lease_token: bytes
    dt: float


class Drive:
    """The writer of a scene, from `Scene.drive`. A scene has one writer at a time.

    After a lost connection, a drive opens a new stream with its lease token, for as long as the client's `reconnect`
    allows, and sends all coordinates and transforms. Steps without acknowledgment may be lost, but not their values.
    Domains so far from the scene's origin that f32 rounds their transforms are sent only if a step has moved them.

    Attributes:
        run: The number of this writer. Later writers of the scene have larger numbers.
        lease_token: Identifies this writer, see `Scene.drive`.
    """

    def __init__(
        self,
        transport: Transport,
        scene: str,
        layout: StateLayout,
        kinematics: Kinematics | None,
        options: DriveOptions,
        read_state: Callable[[], Awaitable[SceneState]],
        *,
        timeout: float,
        reconnect: float,
    ) -> None:
        """Prepares a drive, which `start` opens."""
        self._transport = transport
        self._scene = scene
        self._layout = layout
        self._kinematics = kinematics
        self._options = options
        self._read_state = read_state
        self._timeout = timeout
        self._reconnect = reconnect
        self._values = StepValues(layout, kinematics, *rest_values(layout))
        self._opened_stream: StepStream | None = None
        self._is_closed = False
        # Whether sending a step has failed, so that the server lacks its values.
        self._is_stale = False
        self._next_number = 0
        self._time = -options.dt
        self.run = 0
        self.lease_token = options.lease_token

    async def start(self) -> None:
        """Becomes the writer of the scene.

        Raises:
            AlreadyExists: Another writer drives the scene.
            Error: The call failed.
        """
        starts_from_rest = await self._open(self._options)
        if not starts_from_rest:
            await self._load_state()

    async def step(
        self,
        q: Coordinates | None = None,
        transforms: Transforms | None = None,
        *,
        time: float | None = None,
        wait: bool = True,
        timeout: float | None = None,
    ) -> StepId:
        """Sends a step. Values that are not given remain unchanged.

        Domains that are attached to a domain that deforms move with it: their transforms are computed and sent. A step
        takes the time of the values that it changes. For a whole scene, arrays are much faster than mappings.

        Args:
            q: Coordinates by domain (name, index or domain), r numbers each; or all coordinates of the scene, in the
                order of `SceneState.q`.
            transforms: world_from_domain by domain: 3x4 or 4x4, translation in scene units relative to the scene's
                origin; or `WorldPose`. Or those of all domains: D x 3 x 4 or D x 4 x 4, or one `WorldPose` of arrays.
                In such arrays, domains that follow another one are ignored, and attached ones unless joints=False.
            time: Simulation time in seconds; None: dt after the previous step.
            wait: Whether to wait until the server has completed the step. If not, this waits only while the server has
                no capacity, and a rejection is raised by a later call.
            timeout: In seconds; None: that of the client.

        Returns:
            The step, which `Scene.frame` and other calls accept.

        Raises:
            KeyError: A domain name is unknown; the message lists near names.
            ValueError: An array has another shape, or the drive is closed.
            InvalidRequest: The server rejected this step or, without `wait`, an earlier one. The drive remains open.
            LeaseLost: Another writer has taken over the scene.
            ConnectionLost: No server answers.
            DeadlineExceeded: The timeout has passed; the step may complete later.
        """
        timeout = self._timeout if timeout is None else timeout
        self._check_open()
        new_time = self._time + self._options.dt if time is None else to_time(time)
        message = self._values.step(self._next_number, new_time, q, transforms)
        if self._is_stale:
            message = self._values.complete_step(self._next_number, new_time)
        self._time = new_time
        try:
            await self._send(message, timeout)
            if wait:
                await self._stream.wait_until(self._is_idle, timeout)
        except ConnectionLost:
            await self._resume()
        await self._raise_rejection()
        return StepId(self.run, self._next_number - 1, new_time)

    async def reset(self, *, timeout: float | None = None) -> StepId:
        """Sends a step with the coordinates and the transforms at rest.

        Domains that have moved return to their placement in f32, which rounds it far from the scene's origin.

        Raises:
            Error: As for `step`.
        """
        timeout = self._timeout if timeout is None else timeout
        self._check_open()
        self._values = self._values.at_rest()
        self._time += self._options.dt
        try:
            await self._send(self._values.complete_step(self._next_number, self._time), timeout)
            await self._stream.wait_until(self._is_idle, timeout)
        except ConnectionLost:
            await self._resume()
        await self._raise_rejection()
        return StepId(self.run, self._next_number - 1, self._time)

    async def flush(self, *, timeout: float | None = None) -> None:
        """Waits until the server has completed or rejected every step that was sent.

        Raises:
            InvalidRequest: The server rejected a step.
            Error: As for `step`.
        """
        self._check_open()
        try:
            await self._stream.wait_until(self._is_idle, self._timeout if timeout is None else timeout)
        except ConnectionLost:
            await self._resume()
        await self._raise_rejection()

    async def finish(self, *, timeout: float | None = None) -> None:
        """Waits until all steps are completed, and releases the scene. A `with` block does this at its end.

        Raises:
            Error: As for `flush`.
        """
        if self._is_closed:
            return
        timeout = self._timeout if timeout is None else timeout
        try:
            await self.flush(timeout=timeout)
        finally:
            self._is_closed = True
            await self._stream.finish(timeout)

    def close(self) -> None:
        """Releases the scene at once. Steps without acknowledgment may be lost."""
        self._is_closed = True
        if self._opened_stream is not None:
            self._opened_stream.cancel()

    @property
    def durable_step(self) -> int | None:
        """Number of the newest step that survives a crash of the server and a power loss; None before the first one.

        The server writes the newest step in the background, and no acknowledgment waits for that.
        """
        return self._stream.progress.durable

    @property
    def skipped(self) -> int:
        """Number of steps that were merged into a newer one, with the delivery "latest"."""
        return self._stream.progress.skipped

    @property
    def rejected(self) -> int:
        """Number of steps that the server rejected."""
        return self._stream.progress.rejected

    @property
    def stages(self) -> dict[str, float]:
        """Milliseconds by stage of the last acknowledged step."""
        return dict(self._stream.progress.stages)

    def __del__(self) -> None:
        if not getattr(self, "_is_closed", True):
            # An asyncio client whose event loop is closed raises: the loop has ended the stream.
            with contextlib.suppress(RuntimeError):
                self.close()

    async def __aenter__(self) -> Drive:
        return self

    async def __aexit__(self, error_type: object, *_: object) -> None:
        if error_type is None:
            await self.finish()
        else:
            self.close()

    @property
    def _stream(self) -> StepStream:
        if self._opened_stream is None:
            raise ValueError("the drive was not started")
        return self._opened_stream

    def _check_open(self) -> None:
        if self._is_closed:
            raise ValueError("the drive is closed: Scene.drive opens another one")

    def _is_idle(self) -> bool:
        return not self._stream.progress.in_flight

    async def _send(self, message: StepMessage, timeout: float) -> None:
        stream = self._stream
        self._is_stale = True
        requests = message.encode()
        await stream.wait_until(lambda: stream.progress.fits(self._options.window), timeout)
        stream.progress.in_flight.append(message.head.number)
        self._next_number = message.head.number + 1
        try:
            for request in requests:
                await stream.send(request, timeout)
        except BaseException:
            # No acknowledgment will arrive for this step.
            stream.progress.discard(message.head.number)
            raise
        self._is_stale = False

    async def _open(self, options: DriveOptions) -> bool:
        """Opens a stream. Returns whether its first step starts from the rest state."""
        overflow = steps_pb2.OVERFLOW_BLOCK if options.window is None else steps_pb2.OVERFLOW_REJECT
        initial_state = {
            None: steps_pb2.INITIAL_STATE_UNSPECIFIED,
            False: steps_pb2.INITIAL_STATE_KEEP,
            True: steps_pb2.INITIAL_STATE_RESET,
        }[options.reset]
        request = steps_pb2.OpenDrive(
            scene=self._scene,
            delivery=delivery_message(options.delivery),
            overflow=overflow,
            window=options.window or 0,
            stall_budget_ms=stall_budget_milliseconds(options.stall_budget),
            lease_token=self.lease_token,
            take_over=options.take_over,
            initial_state=initial_state,
        )
        stream = self._transport.step_stream()
        try:
            reply = await stream.open(steps_pb2.DriveSceneRequest(open=request).SerializeToString(), self._timeout)
            if reply.HasField("rejection"):
                raise from_rejection(reply.rejection)
            if not reply.HasField("opened"):
                raise malformed("drive.opened", "`opened` first", "another message")
        except BaseException:
            stream.cancel()
            raise
        if self._opened_stream is not None:
            self._opened_stream.cancel()
        self._opened_stream = stream
        self.run = reply.opened.run
        self.lease_token = reply.opened.lease_token
        return reply.opened.initial_state == steps_pb2.INITIAL_STATE_RESET

    async def _load_state(self) -> None:
        """Takes the first values from the current state of the server."""
        state = await self._read_state()
        self._values = StepValues(self._layout, self._kinematics, state.q, state.scene_transforms)

    async def _resume(self) -> None:
        """Opens a new stream after a lost connection, and sends all values."""
        if self._reconnect <= 0:
            raise self._stream.progress.end or ConnectionLost(f"{self._transport.address}: no connection")

        # The token replaces the old stream, but not a writer that has taken over in the meantime.
        options = replace(self._options, take_over=False)
        await with_reconnect(self._transport, self._reconnect, lambda: self._open(options))
        await self._send(self._values.complete_step(self._next_number, self._time), self._timeout)
        await self._stream.wait_until(self._is_idle, self._timeout)

    async def _raise_rejection(self) -> None:
        """Raises the oldest rejection. The values of rejected steps are replaced by those of the server."""
        rejections = self._stream.progress.rejections
        if not rejections:
            return
        rejection = rejections.popleft()
        await self._stream.wait_until(self._is_idle, self._timeout)
        await self._load_state()
        raise rejection
