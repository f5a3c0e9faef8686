"""Views: small pictures of many copies of a scene (worlds), which belong to one call."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from typing import Any, cast

from numpy.typing import ArrayLike, NDArray

from modalcast._async.streams import with_reconnect
from modalcast._async.transport import Transport, ViewStream
from modalcast._chunks import malformed
from modalcast._decoders import parse
from modalcast._device_slots import DeviceSlots
from modalcast._shared_memory import MemoryConnection
from modalcast._step_message import StepMessage
from modalcast._view_progress import ViewStepInFlight
from modalcast.errors import DeadlineExceeded, ServerError, Unavailable, from_rejection
from modalcast.states import StateLayout
from modalcast.v1 import views_pb2
from modalcast.views import (
    VIEW_FORMATS,
    StateTable,
    ViewArrays,
    ViewCameras,
    ViewOptions,
    camera_set,
    check_camera_sizes,
    encode_cameras,
    view_step,
)

MAX_STEPS_IN_FLIGHT = 4
"""Largest number of submitted steps of `Views` whose result was not read."""

# Batches of states that are drawn and received while the caller uses the one before.
_BATCHES_AHEAD = 2


class Views:
    """Worlds (copies of a scene) and their pictures, from `Scene.views`. The worlds begin at rest.

    Nobody else sees the worlds, and they leave the scene and its writer as they are. Leave the `with` block or call
    `close` to release them. A lost connection ends them. One thread at a time may use them.

    Attributes:
        worlds: Number of worlds.
        view_count: Number V of views of a step. With C cameras that see all worlds, view w * C + c shows world w as
            camera c sees it. With `camera_worlds`, view c shows world camera_worlds[c] as camera c sees it.
        shapes: The shapes of the arrays by output: V x H x W, and x 3 for color and normals.
    """

    def __init__(
        self,
        transport: Transport,
        scene: str,
        scene_up: str,
        layout: StateLayout,
        options: ViewOptions,
        *,
        timeout: float,
    ) -> None:
        """Prepares the call, which `start` makes."""
        self._transport = transport
        self._scene = scene
        self._scene_up = scene_up
        self._layout = layout
        self._options = options
        self._timeout = timeout
        self._opened_stream: ViewStream | None = None
        self._memory: MemoryConnection | None = None
        self._slots: DeviceSlots | None = None
        self._is_closed = False
        self._next_number = 0
        # Steps whose result was not read, oldest first.
        self._steps: deque[ViewStepInFlight] = deque()
        self._stages: dict[str, float] = {}
        self.worlds = options.worlds
        self.view_count = options.view_count
        self.shapes = options.format.shapes((self.view_count,))

    async def start(self) -> None:
        """Opens the worlds.

        Raises:
            Unavailable: The server does not draw views, or not in memory of a GPU that this process sees.
            Error: The call failed.
        """
        request = self._options.encode(self._scene, self._scene_up)
        address = self._transport.address
        self._memory = memory = self._transport.open_memory()
        if self._options.device_slots > 0 and memory is None:
            given = "one without shared memory, or with no connection to it left"
            raise Unavailable(f"{address}: device='cuda': expected a server of this user on this machine, got {given}")
        stream = self._transport.view_stream(memory)
        try:
            reply = parse("views", views_pb2.DrawViewsResponse, await stream.open(request, self._timeout))
            self._check_opened(reply)
            if self._options.device_slots > 0 and memory is not None:
                # The arrays are in the order of the server.
                names = {VIEW_FORMATS[name].output: name for name in self.shapes}
                shapes = {names[output]: self.shapes[names[output]] for output in reply.opened.outputs}
                dtypes = {name: VIEW_FORMATS[name].dtype for name in shapes}
                self._slots = DeviceSlots(memory, reply.opened.device_slots, shapes, dtypes)
        except ServerError as error:
            self._end(stream)
            if error.code != "UNIMPLEMENTED":
                raise
            raise Unavailable(
                f"{address}: expected a server that draws views, got an older one", code=error.code
            ) from None
        except BaseException:
            self._end(stream)
            raise
        self._opened_stream = stream

    async def step(
        self,
        q: ArrayLike | None = None,
        transforms: ArrayLike | None = None,
        *,
        worlds: ArrayLike | None = None,
        cameras: ViewCameras | None = None,
        out: Mapping[str, NDArray[Any]] | None = None,
        timeout: float | None = None,
    ) -> ViewArrays:
        """Sends new values of the worlds, and returns the pictures of all views. Other values remain unchanged.

        Args:
            q: All coordinates of each world, W x r, in the order of `SceneState.q`.
            transforms: world_from_domain of each world: W x R x 3 x 4 for the R domains that follow no other one, in
                the order of `Scene.domains`, or W x 3 x 4 if R is 1; or 4 x 4 in place of 3 x 4. Translations are in
                scene units relative to the scene's origin. `Scene.joint_transforms` computes those of attached domains,
                which do not move by themselves here.
            worlds: Indices of k worlds, each once: `q` and `transforms` have k rows, and other worlds remain unchanged.
            cameras: New cameras, as many as the views were opened with; None: unchanged.
            out: Arrays that receive the pictures, by output: writable and C-contiguous, of the shapes in `shapes`.
                Reused arrays save the time to allocate new ones.
            timeout: Seconds without a reply of the server after which the call fails; None: that of the client.

        Returns:
            By output: color V x H x W x 3 of uint8, sRGB; depth V x H x W of float32, meters along the view axis,
            infinity where nothing is; domains V x H x W of int32, the index of the domain, -1 where none is; normals
            V x H x W x 3 of float32, unit vectors in world axes, zeros where nothing is. `numpy.moveaxis(color, -1, 1)`
            has the channels first.

        Raises:
            ValueError: An array has another shape or type, an index is out of range, or steps are in flight.
            InvalidRequest: The server rejected the step. The worlds are as before, and the views remain open.
            ConnectionLost: The connection broke, and the worlds are lost.
            DeadlineExceeded: The timeout has passed; `result` may still return the pictures.
        """
        if self._steps:
            raise ValueError(
                f"step: expected no steps in flight, got {len(self._steps)}: read them with `result` first"
            )
        await self.submit(q, transforms, worlds=worlds, cameras=cameras, out=out, timeout=timeout)
        return await self.result(timeout=timeout)

    async def submit(
        self,
        q: ArrayLike | None = None,
        transforms: ArrayLike | None = None,
        *,
        worlds: ArrayLike | None = None,
        cameras: ViewCameras | None = None,
        out: Mapping[str, NDArray[Any]] | None = None,
        timeout: float | None = None,
    ) -> None:
        """Sends a step without waiting for its pictures, which `result` returns. `step` documents the arguments.

        Up to 4 steps may be in flight. The arrays of the step, also those in `out`, are written in the background until
        `result` returns them. `q` and `transforms` may change as soon as `submit` returns.

        Raises:
            ValueError: As for `step`, or too many steps are in flight.
            Error: The call failed, and the views are closed.
        """
        self._check_open()
        if len(self._steps) >= MAX_STEPS_IN_FLIGHT:
            raise ValueError(f"submit: expected less than {MAX_STEPS_IN_FLIGHT} steps in flight: call `result` first")
        if self._slots is not None:
            if out is not None:
                raise ValueError("out: expected none with device='cuda', got arrays")
            self._slots.require_free(len(self._steps))
        message = view_step(self._layout, self._next_number, self.worlds, q, transforms, worlds)
        encoded_cameras = b"" if cameras is None else self._encode_cameras(cameras)
        arrays = {} if self._slots is not None else self._options.format.arrays((self.view_count,), out)
        await self._send(message, arrays, self._timeout if timeout is None else timeout, cameras=encoded_cameras)

    async def submit_states(
        self, q: ArrayLike | None, transforms: ArrayLike | None, arrays: ViewArrays, drawn_worlds: int
    ) -> None:
        """Sends a step of which the arrays receive the views of the first worlds. For this package."""
        message = view_step(self._layout, self._next_number, self.worlds, q, transforms, None)
        await self._send(message, arrays, self._timeout, drawn_worlds=drawn_worlds % self.worlds)

    async def result(self, *, timeout: float | None = None) -> ViewArrays:
        """Waits for the pictures of the oldest submitted step, and returns them as `step` does.

        Args:
            timeout: Seconds without a reply of the server after which the call fails; None: that of the client.

        Raises:
            ValueError: No step is in flight.
            InvalidRequest: The server rejected this step. It has not changed the worlds, but later steps may have.
            Error: As for `step`.
        """
        self._check_open()
        if not self._steps:
            raise ValueError("result: expected a step in flight, got none: call `submit` first")
        step = self._steps[0]
        await self._wait(step, self._timeout if timeout is None else timeout)
        self._steps.popleft()
        if step.rejection is not None:
            raise step.rejection
        self._stages = step.stages
        if self._slots is not None and step.slot is not None:
            return cast(ViewArrays, self._slots.arrays(step.slot, step.number))
        return step.arrays

    async def finish(self, *, timeout: float | None = None) -> None:
        """Releases the worlds, and waits until the server has done so. A `with` block does this at its end."""
        if self._is_closed:
            return
        stream = self._stream
        if self._steps or stream.progress.end is not None:
            self.close()
            return
        self._is_closed = True
        await stream.finish(self._timeout if timeout is None else timeout)
        self._end(stream)

    def close(self) -> None:
        """Releases the worlds at once. Steps in flight are lost."""
        self._is_closed = True
        if self._opened_stream is not None:
            self._end(self._opened_stream)

    @property
    def in_flight(self) -> int:
        """Number of submitted steps whose result was not read."""
        return len(self._steps)

    @property
    def stages(self) -> dict[str, float]:
        """Milliseconds by stage of the last step that was returned."""
        return dict(self._stages)

    async def __aenter__(self) -> Views:
        return self

    async def __aexit__(self, error_type: object, *_: object) -> None:
        if error_type is None:
            await self.finish()
        else:
            self.close()

    def __del__(self) -> None:
        if not getattr(self, "_is_closed", True):
            # An asyncio client whose event loop is closed raises: the loop has ended the stream.
            with contextlib.suppress(RuntimeError):
                self.close()

    def __repr__(self) -> str:
        return f"<Views of '{self._scene}': {self.worlds} worlds, {self.view_count} views, {list(self.shapes)}>"

    @property
    def _stream(self) -> ViewStream:
        if self._opened_stream is None:
            raise ValueError("the views were not started")
        return self._opened_stream

    def _end(self, stream: ViewStream) -> None:
        """Ends the call and the use of its memory. Arrays on the GPU that exist remain valid."""
        stream.cancel()
        if self._slots is not None:
            self._slots.close()
        if self._memory is not None:
            self._memory.close()

    def _check_open(self) -> None:
        if self._is_closed:
            raise ValueError("the views are closed: Scene.views opens others")

    def _check_opened(self, reply: views_pb2.DrawViewsResponse) -> None:
        if reply.HasField("rejection"):
            raise from_rejection(reply.rejection)
        expected = {
            "worlds": self.worlds,
            "views": self.view_count,
            "width": self._options.format.width,
            "height": self._options.format.height,
            "coordinates": self._layout.coordinate_count,
            "transforms": len(self._layout.roots),
        }
        given = {name: getattr(reply.opened, name) for name in expected}
        outputs = sorted(VIEW_FORMATS[name].output for name in self.shapes)
        if sorted(reply.opened.outputs) != outputs:
            raise malformed("views.opened.outputs", str(outputs), str(list(reply.opened.outputs)))
        if given != expected:
            raise malformed("views.opened", str(expected), str(given))

    def _encode_cameras(self, cameras: ViewCameras) -> bytes:
        """The field `cameras` of a step."""
        items = camera_set(cameras)
        if len(items) != self._options.camera_count:
            raise ValueError(f"cameras: expected {self._options.camera_count}, as at the start, got {len(items)}")
        check_camera_sizes(items, self._options.format)
        return encode_cameras(items, views_pb2.ViewStep.CAMERAS_FIELD_NUMBER, self._scene_up)

    async def _send(
        self, message: StepMessage, arrays: ViewArrays, timeout: float, *, cameras: bytes = b"", drawn_worlds: int = 0
    ) -> None:
        stream = self._stream
        requests = message.encode_for_views(cameras, drawn_worlds)
        step = ViewStepInFlight(self._next_number, arrays)
        self._next_number += 1
        self._steps.append(step)
        stream.progress.in_flight.append(step)
        try:
            for request in requests:
                await stream.send(request, timeout)
        except BaseException:
            # The server may have received a part of the step.
            self.close()
            raise

    async def _wait(self, step: ViewStepInFlight, timeout: float) -> None:
        progress = self._stream.progress
        while not step.is_done:
            received = progress.received
            try:
                await self._stream.wait_until(lambda: step.is_done, timeout)
            except DeadlineExceeded:
                if progress.received == received and not step.is_done:
                    raise


class ViewBatchStream:
    """An iterator over the pictures of states, batch by batch, from `Scene.iter_states`.

    Each item is a slice of the states, and their pictures: a dict from output to an array of n x C x H x W, and x 3 for
    color and normals. While the caller uses a batch, the next two are drawn and received. After a lost connection, the
    iterator continues by itself, for as long as the client's `reconnect` allows.
    """

    def __init__(
        self,
        transport: Transport,
        open_views: Callable[[], Awaitable[Views]],
        states: StateTable,
        options: ViewOptions,
        out: Mapping[str, NDArray[Any]] | None,
        *,
        reconnect: float,
    ) -> None:
        """Prepares the iteration.

        Args:
            transport: The connection.
            open_views: Opens the worlds.
            states: The states.
            options: What the views show. The number of worlds is that of the states of a batch.
            out: Arrays of all states, of which the batches are slices; None: each batch has new arrays.
            reconnect: Seconds for which the iterator tries to connect again after a lost connection.
        """
        self._transport = transport
        self._open_views = open_views
        self._states = states
        self._options = options
        self._out = out
        self._reconnect = reconnect
        self._views: Views | None = None
        self._is_closed = False
        # The first state that the caller has not received, and the first one that was not sent.
        self._next = 0
        self._next_sent = 0

    @property
    def batch_size(self) -> int:
        """Largest number of states of a batch."""
        return self._options.worlds

    async def start(self) -> None:
        """Opens the worlds, and sends the first batches.

        Raises:
            Error: The call failed.
        """
        if self._states.count > 0:
            await with_reconnect(self._transport, self._reconnect, self._fill)

    def close(self) -> None:
        """Ends the call; later iterations end."""
        self._is_closed = True
        self._drop_views()

    def __aiter__(self) -> AsyncIterator[tuple[slice, ViewArrays]]:
        return self

    async def __anext__(self) -> tuple[slice, ViewArrays]:
        if self._is_closed or self._next >= self._states.count:
            await self._finish()
            raise StopAsyncIteration
        try:
            arrays = await with_reconnect(self._transport, self._reconnect, self._read)
        except BaseException:
            self.close()
            raise
        states = self._batch(self._next)
        self._next = states.stop
        return states, arrays

    async def __aenter__(self) -> ViewBatchStream:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()

    def _batch(self, first: int) -> slice:
        return slice(first, min(first + self._options.worlds, self._states.count))

    async def _read(self) -> ViewArrays:
        """The pictures of the next batch."""
        views = await self._fill()
        states = self._batch(self._next)
        try:
            return await views.result()
        except BaseException as error:
            if isinstance(error, ServerError) and error.step is not None:
                error.add_note(f"The step has the states {states.start} to {states.stop - 1}.")
            self._drop_views()
            raise

    async def _fill(self) -> Views:
        """Sends further batches. After a lost connection, sends those again that the caller has not received."""
        if self._views is None:
            self._next_sent = self._next
            self._views = await self._open_views()
        views = self._views
        try:
            while views.in_flight < _BATCHES_AHEAD + 1 and self._next_sent < self._states.count:
                states = self._batch(self._next_sent)
                count = states.stop - states.start
                arrays = self._arrays(states)
                await views.submit_states(
                    *self._states.batch(states.start, states.stop, views.worlds), arrays, drawn_worlds=count
                )
                self._next_sent = states.stop
        except BaseException:
            self._drop_views()
            raise
        return views

    def _arrays(self, states: slice) -> ViewArrays:
        if self._out is None:
            return self._options.format.arrays((states.stop - states.start, self._options.camera_count), None)
        return {name: array[states] for name, array in self._out.items()}

    async def _finish(self) -> None:
        views, self._views = self._views, None
        if views is not None and not self._is_closed:
            await views.finish()

    def _drop_views(self) -> None:
        views, self._views = self._views, None
        if views is not None:
            views.close()
