"""Streams of replies: frames, vertices, states and forces."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from typing import Generic, Self, TypeVar

from modalcast._async.transport import RETRY_SECONDS, ReplyStream, Transport, sleep
from modalcast._decoders import ReplyDecoder, parse
from modalcast._methods import UPDATE_FRAME_STREAM
from modalcast.camera import Camera
from modalcast.errors import ConnectionLost
from modalcast.frame import Frame
from modalcast.v1 import frames_pb2

T = TypeVar("T")


async def with_reconnect(transport: Transport, reconnect: float, operation: Callable[[], Awaitable[T]]) -> T:
    """Repeats an operation without side effects, for up to `reconnect` seconds, while no server answers.

    Raises:
        ConnectionLost: No server answered in time.
    """
    end = time.monotonic() + reconnect
    while True:
        try:
            return await operation()
        except ConnectionLost:
            remaining = end - time.monotonic()
            if remaining <= 0:
                raise
        await sleep(RETRY_SECONDS)
        await transport.wait_for_server(remaining)


async def read_reply(stream: ReplyStream, decoder: ReplyDecoder[T]) -> T | None:
    """The next reply of a call; None at its end.

    Raises:
        MalformedReply: The call ended within a reply.
        Error: The call failed.
    """
    while (message := await stream.read()) is not None:
        reply = decoder.add(message)
        if reply is not None:
            return reply
    decoder.check_end()
    return None


class Stream(Generic[T]):
    """An iterator over the replies of a subscription. Leave its `with` block or call `close` to unsubscribe.

    A stream of the latest steps continues by itself after a lost connection, for as long as the client's `reconnect`
    allows. A stream of every step raises `ConnectionLost`, because steps may be missing. With asyncio, a cancelled
    iteration ends the stream.
    """

    def __init__(
        self,
        open_call: Callable[[int, bool], ReplyStream],
        new_decoder: Callable[[], ReplyDecoder[T]],
        *,
        transport: Transport,
        count: int,
        reconnect: float,
    ) -> None:
        """Prepares a subscription, which `start` opens.

        Args:
            open_call: Subscribes to the given number of replies, 0 for no limit. The second argument is whether to
                wait for the connection.
            new_decoder: Creates the decoder of a call.
            transport: The connection.
            count: Number of replies after which the stream ends; 0 for no limit.
            reconnect: Seconds for which the stream tries to connect again after a lost connection.
        """
        self._open_call = open_call
        self._transport = transport
        self._new_decoder = new_decoder
        self._remaining = count
        self._is_limited = count > 0
        self._reconnect = reconnect
        self._is_closed = False
        self._first_message: bytes | None = None
        self._stream: ReplyStream | None = None
        self._decoder = new_decoder()

    async def start(self, *, wait_for_ready: bool = False) -> None:
        """Subscribes. When this returns, the server has accepted the subscription.

        Raises:
            Error: The server rejects the subscription, or no server answers.
        """
        self._stream = self._open_call(self._remaining, wait_for_ready)
        self._decoder = self._new_decoder()
        # The settings of the stream or, for a stream of forces, the current forces.
        self._first_message = await self._stream.read()
        if self._first_message is not None:
            self._started(self._first_message)

    def _started(self, message: bytes) -> None:
        """Receives the first message of a call."""

    def __aiter__(self) -> AsyncIterator[T]:
        return self

    async def __anext__(self) -> T:
        reply = None if self._is_closed else await self._next_reply()
        if reply is None:
            self.close()
            raise StopAsyncIteration
        if self._is_limited:
            self._remaining -= 1
        return reply

    async def _next_reply(self) -> T | None:
        try:
            while True:
                try:
                    return await self._read()
                except ConnectionLost:
                    if self._reconnect <= 0 or self._is_closed:
                        raise
                await self._transport.wait_for_server(self._reconnect)
                await with_reconnect(self._transport, self._reconnect, lambda: self.start(wait_for_ready=True))
        except BaseException:
            self.close()
            raise

    async def _read(self) -> T | None:
        if self._stream is None or (self._is_limited and self._remaining == 0):
            return None
        if self._first_message is not None:
            message, self._first_message = self._first_message, None
            reply = self._decoder.add(message)
            if reply is not None:
                return reply
        return await read_reply(self._stream, self._decoder)

    def close(self) -> None:
        """Unsubscribes; later iterations end."""
        self._is_closed = True
        if self._stream is not None:
            self._stream.cancel()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        stream = getattr(self, "_stream", None)
        if stream is not None and not self._is_closed:
            stream.cancel()


class FrameBatchStream(Stream[list[Frame]]):
    """A stream of one frame per camera and step."""

    def __init__(
        self,
        transport: Transport,
        pictures: list[frames_pb2.Picture],
        outputs_per_camera: int,
        scene_up: str,
        timeout: float,
        open_call: Callable[[int, bool], ReplyStream],
        new_decoder: Callable[[], ReplyDecoder[list[Frame]]],
        *,
        count: int,
        reconnect: float,
    ) -> None:
        super().__init__(open_call, new_decoder, transport=transport, count=count, reconnect=reconnect)
        self._pictures = pictures
        self._outputs_per_camera = outputs_per_camera
        self._scene_up = scene_up
        self._timeout = timeout
        self.settings = frames_pb2.FrameStreamSettings()

    def _started(self, message: bytes) -> None:
        self.settings = parse("frames.settings", frames_pb2.StreamFramesResponse, message).settings

    async def move_cameras(self, cameras: Sequence[Camera | None], *, timeout: float | None = None) -> int:
        """Moves the cameras. If no step arrives, the stream sends the current step again.

        Args:
            cameras: One per frame of a step; None: a camera that shows the whole scene.
            timeout: In seconds; None: that of the client.

        Returns:
            The version of the cameras: frames with this `Frame.camera_version` or a later one show the new cameras.

        Raises:
            ValueError: There are more or fewer cameras than frames.
            ServerError: The stream has ended.
        """
        camera_count = len(self._pictures) // self._outputs_per_camera
        if len(cameras) != camera_count:
            raise ValueError(f"cameras: expected {camera_count}, got {len(cameras)}")
        updates: list[frames_pb2.PictureCamera] = []
        for index, picture in enumerate(self._pictures):
            camera = cameras[index // self._outputs_per_camera]
            message = None if camera is None else camera.to_message(self._scene_up)
            updates.append(frames_pb2.PictureCamera(picture=index, camera=message))
            # If the connection is lost, the next call requests the new cameras.
            picture.ClearField("camera")
            if message is not None:
                picture.camera.CopyFrom(message)
        request = frames_pb2.UpdateFrameStreamRequest(stream=self.settings.stream, cameras=updates)
        timeout = self._timeout if timeout is None else timeout
        reply = await self._transport.unary(UPDATE_FRAME_STREAM, request, timeout)
        return reply.camera_version


class FrameStream:
    """An iterator over one frame per step. Leave its `with` block or call `close` to unsubscribe."""

    def __init__(self, batches: FrameBatchStream) -> None:
        self._batches = batches

    @property
    def settings(self) -> frames_pb2.FrameStreamSettings:
        """The settings in effect, with complete cameras."""
        return self._batches.settings

    async def move_camera(self, camera: Camera | None, *, timeout: float | None = None) -> int:
        """Moves the camera; see `FrameBatchStream.move_cameras`."""
        return await self._batches.move_cameras([camera], timeout=timeout)

    def close(self) -> None:
        """Unsubscribes; later iterations end."""
        self._batches.close()

    def __aiter__(self) -> AsyncIterator[Frame]:
        return self

    async def __anext__(self) -> Frame:
        return (await self._batches.__anext__())[0]

    async def __aenter__(self) -> FrameStream:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()
