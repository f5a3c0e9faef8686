"""Calls over grpc.aio. Errors of gRPC become errors of this package."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any, Generic, TypeAlias, TypeVar, cast

import grpc
import grpc.aio
from google.protobuf.message import Message

from modalcast._channel import ConnectOptions, keep_memory_of_messages, options_of, route_to
from modalcast._chunks import malformed
from modalcast._methods import DRAW_VIEWS, DRIVE_SCENE, GET_SERVER_INFO, Method
from modalcast._shared_memory import MemoryConnection
from modalcast._step_progress import Progress, StreamProgress
from modalcast._view_progress import ViewProgress
from modalcast.errors import ConnectionLost, DeadlineExceeded, Error, MalformedReply, from_rpc_error
from modalcast.v1 import steps_pb2

RequestT = TypeVar("RequestT", bound=Message)
ReplyT = TypeVar("ReplyT", bound=Message)
StreamReplyT = TypeVar("StreamReplyT", steps_pb2.DriveSceneResponse, bytes)
ProgressT = TypeVar("ProgressT", bound=StreamProgress)

sleep = asyncio.sleep

RETRY_SECONDS = 0.1
"""Pause between two attempts to reach a server."""


class ReplyStream:
    """The messages of a call, as bytes."""

    def __init__(self, call: grpc.aio.UnaryStreamCall[Any, bytes], address: str) -> None:
        self._call = call
        self._address = address

    async def read(self) -> bytes | None:
        """The next message; None at the end.

        Raises:
            Error: The call failed.
        """
        try:
            message = await self._call.read()
        except grpc.RpcError as error:
            raise from_rpc_error(error, self._address) from None
        except asyncio.InvalidStateError:  # cancelled by `cancel`
            return None
        return message if isinstance(message, bytes) else None

    def cancel(self) -> None:
        """Ends the call."""
        self._call.cancel()


class BidirectionalStream(Generic[StreamReplyT, ProgressT]):
    """A call that sends steps and receives a reply to each. A task reads the replies, also while the caller waits."""

    def __init__(
        self,
        call: grpc.aio.StreamStreamCall[Any, Any],
        reply_type: type[StreamReplyT],
        name: str,
        address: str,
        progress: ProgressT,
    ) -> None:
        """`name` is that of the stream in errors. `progress` receives all replies except the first one."""
        self._call = call
        self._reply_type = reply_type
        self._name = name
        self._address = address
        self._changed = asyncio.Event()
        self._reader: asyncio.Task[None] | None = None
        self.progress = progress

    async def open(self, request: bytes, timeout: float) -> StreamReplyT:
        """Sends the first message, returns the first reply, and begins to read the others.

        Raises:
            Error: The server rejects the request, or does not answer in time.
        """
        try:
            async with asyncio.timeout(timeout):
                # If the call has ended already, `read` raises its status.
                with contextlib.suppress(asyncio.InvalidStateError):
                    await self._call.write(request)
                reply = await self._call.read()
        except grpc.RpcError as error:
            raise from_rpc_error(error, self._address) from None
        except TimeoutError:
            raise DeadlineExceeded(f"{self._address}: the {self._name} did not open within {timeout:g} s") from None
        if not isinstance(reply, self._reply_type):
            raise malformed(f"{self._name}.opened", "`opened` first", "the end of the stream")
        self._reader = asyncio.create_task(self._read_replies())
        return reply

    async def send(self, request: bytes, timeout: float) -> None:
        """Sends an encoded step or a part of one. gRPC ends the stream if this is cancelled.

        Raises:
            DeadlineExceeded: The server had no capacity in time, and the stream has ended.
            Error: The stream has ended.
        """
        if self.progress.end is not None:
            raise self.progress.end.with_traceback(None)
        try:
            async with asyncio.timeout(timeout):
                await self._call.write(request)
        except TimeoutError:
            complaint = f"the server had no capacity for a step within {timeout:g} s, and the {self._name} has ended"
            raise DeadlineExceeded(f"{self._address}: {complaint}") from None
        except (grpc.RpcError, asyncio.InvalidStateError):
            # The task that reads the replies receives the reason. `wait_until` raises it.
            await self.wait_until(lambda: False, 5.0)

    async def wait_until(self, condition: Callable[[], bool], timeout: float) -> None:
        """Waits until the progress satisfies a condition.

        Raises:
            DeadlineExceeded: The timeout has passed; the stream remains open.
            Error: The stream has ended.
        """
        if self.progress.end is not None:
            raise self.progress.end.with_traceback(None)
        try:
            async with asyncio.timeout(timeout):
                while not condition():
                    if self.progress.end is not None:
                        raise self.progress.end.with_traceback(None)
                    self._changed.clear()
                    await self._changed.wait()
        except TimeoutError:
            raise DeadlineExceeded(f"{self._address}: no reply to a step within {timeout:g} s") from None

    async def finish(self, timeout: float) -> None:
        """Ends the stream from this side, and waits until the server has ended the call."""
        await self._call.done_writing()
        if self._reader is not None:
            await asyncio.wait([self._reader], timeout=timeout)
        self.cancel()

    def cancel(self) -> None:
        """Ends the stream at once."""
        self._call.cancel()
        if self._reader is not None:
            self._reader.cancel()

    async def _read_replies(self) -> None:
        end: Error = ConnectionLost(f"{self._address}: the server has ended the {self._name}")
        try:
            while isinstance(reply := await self._call.read(), self._reply_type):
                if self.progress.add(reply):
                    self._changed.set()
        except grpc.RpcError as error:
            end = from_rpc_error(error, self._address)
        except Error as error:
            end = error
            self._call.cancel()
        finally:
            self.progress.end = end
            self._changed.set()


StepStream: TypeAlias = BidirectionalStream[steps_pb2.DriveSceneResponse, Progress]
ViewStream: TypeAlias = BidirectionalStream[bytes, ViewProgress]


class Transport:
    """Connections to a server: one for calls and steps, and one for subscriptions, which opens with the first of them.

    Subscriptions that are not read fill the flow-control window of their connection, but not that of calls.
    """

    def __init__(self, address: str, options: ConnectOptions) -> None:
        """Connects with the first call, and sends the token and the metadata with every call.

        Raises:
            ValueError: The address or an option is invalid.
            OSError: A file cannot be read.
        """
        self.address = address
        self._route = route_to(address, options)
        keep_memory_of_messages()
        self._channel = self._new_channel()
        self._subscriptions: grpc.aio.Channel | None = None

    async def unary(self, method: Method[RequestT, ReplyT], request: RequestT, timeout: float) -> ReplyT:
        """Makes a call with one reply.

        Raises:
            Error: The call failed.
        """
        call = self._channel.unary_unary(method.path, method.request.SerializeToString, method.reply.FromString)
        try:
            return await call(request, timeout=timeout, metadata=self._route.metadata)
        except grpc.RpcError as error:
            raise from_rpc_error(error, self.address) from None

    async def wait_for_server(self, timeout: float) -> None:
        """Waits until a server answers.

        Raises:
            ConnectionLost: No server has answered in time.
        """
        method = GET_SERVER_INFO
        call = self._channel.unary_unary(method.path, method.request.SerializeToString, method.reply.FromString)
        end = time.monotonic() + timeout
        while True:
            # Without `wait_for_ready`, the call fails while the connection is being established. With it, it still
            # fails if it was sent on a connection that is being lost.
            remaining = max(end - time.monotonic(), RETRY_SECONDS)
            try:
                await call(method.request(), timeout=remaining, wait_for_ready=True, metadata=self._route.metadata)
            except grpc.RpcError:
                if time.monotonic() + RETRY_SECONDS >= end:
                    raise ConnectionLost(f"{self.address}: no connection for {timeout:g} s") from None
            else:
                return
            await sleep(RETRY_SECONDS)

    async def upload(
        self, method: Method[RequestT, ReplyT], requests: Iterator[RequestT], timeout: float | None
    ) -> ReplyT:
        """Makes a call with a stream of requests. The requests are created as they are sent.

        Raises:
            Error: The call failed.
        """
        call = self._channel.stream_unary(method.path, method.request.SerializeToString, method.reply.FromString)
        try:
            return await call(requests, timeout=timeout, metadata=self._route.metadata)
        except grpc.RpcError as error:
            raise from_rpc_error(error, self.address) from None

    def stream(self, method: Method[RequestT, ReplyT], request: RequestT, timeout: float) -> ReplyStream:
        """Makes a call with a stream of replies, which the caller reads to its end."""
        return self._stream(self._channel, method, request, timeout)

    def subscribe(self, method: Method[RequestT, ReplyT], request: RequestT, *, wait_for_ready: bool) -> ReplyStream:
        """Makes a call with a stream of replies without end, which the caller cancels.

        With `wait_for_ready`, the call waits for the connection, without a time limit.
        """
        if self._subscriptions is None:
            self._subscriptions = self._new_subscription_channel()
        return self._stream(self._subscriptions, method, request, None, wait_for_ready=wait_for_ready)

    def step_stream(self) -> StepStream:
        """Makes a call that drives a scene."""
        method = DRIVE_SCENE
        # The requests are encoded already.
        call = cast(Any, self._channel.stream_stream(method.path, None, method.reply.FromString))
        return StepStream(call(metadata=self._route.metadata), method.reply, "drive", self.address, Progress())

    def open_memory(self) -> MemoryConnection | None:
        """Connects to the shared memory of a server on this machine.

        None if the server offers none to this client, has no connection left, or is of another version.
        """
        path = self._route.memory_socket
        try:
            return None if path is None else MemoryConnection(path)
        except (ConnectionLost, MalformedReply):
            return None

    def view_stream(self, memory: MemoryConnection | None = None) -> ViewStream:
        """Makes a call that draws views. `memory` receives their pictures."""
        call = cast(Any, self._channel.stream_stream(DRAW_VIEWS.path))
        metadata = (*self._route.metadata, *(() if memory is None else (memory.metadata,)))
        return ViewStream(call(metadata=metadata), bytes, "view stream", self.address, ViewProgress(memory))

    async def close(self) -> None:
        """Closes the connections, and ends all calls."""
        await self._channel.close()
        if self._subscriptions is not None:
            await self._subscriptions.close()

    def _stream(
        self,
        channel: grpc.aio.Channel,
        method: Method[RequestT, ReplyT],
        request: RequestT,
        timeout: float | None,
        *,
        wait_for_ready: bool = False,
    ) -> ReplyStream:
        call = cast(Any, channel.unary_stream(method.path, method.request.SerializeToString))
        metadata = self._route.metadata
        started = call(request, timeout=timeout, wait_for_ready=wait_for_ready, metadata=metadata)
        return ReplyStream(started, self.address)

    def _new_channel(self) -> grpc.aio.Channel:
        target, credentials = self._route.target, self._route.credentials
        if credentials is None:
            return grpc.aio.insecure_channel(target, options=options_of(target))
        return grpc.aio.secure_channel(target, credentials, options=options_of(target))

    def _new_subscription_channel(self) -> grpc.aio.Channel:
        # As the channel for calls; the synchronous client needs other options here.
        return self._new_channel()
