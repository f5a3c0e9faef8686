"""Calls over grpc. Errors of gRPC become errors of this package."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, Generic, Protocol, TypeAlias, TypeVar, cast

import grpc
from google.protobuf.message import Message
from grpc.experimental import ChannelOptions  # pyright: ignore[reportMissingTypeStubs]

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

sleep = time.sleep

RETRY_SECONDS = 0.1
"""Pause between two attempts to reach a server."""

# Steps that wait inside this process for the connection.
_QUEUED_STEPS = 8


class _Call(Protocol):
    """An iterator over the replies of a call."""

    def __iter__(self) -> Iterator[Any]: ...
    def __next__(self) -> Any: ...
    def cancel(self) -> object: ...


class ReplyStream:
    """The messages of a call, as bytes."""

    def __init__(self, call: _Call, address: str) -> None:
        self._call = call
        self._address = address
        self._is_cancelled = False

    def read(self) -> bytes | None:
        """The next message; None at the end.

        Raises:
            Error: The call failed.
        """
        try:
            return next(self._call, None)
        except grpc.RpcError as error:
            if self._is_cancelled:
                return None
            raise from_rpc_error(error, self._address) from None

    def cancel(self) -> None:
        """Ends the call."""
        self._is_cancelled = True
        self._call.cancel()


class _RequestQueue:
    """The encoded requests of a step stream. gRPC takes them in a thread of its own; a full queue blocks `put`."""

    def __init__(self) -> None:
        self._requests: deque[bytes] = deque()
        self._condition = threading.Condition()
        self._is_closed = False

    def put(self, request: bytes, timeout: float) -> bool:
        """Adds a request. Returns False if the queue had no capacity in time. A closed queue drops the request."""

        def has_capacity() -> bool:
            return self._is_closed or len(self._requests) < _QUEUED_STEPS

        with self._condition:
            if not self._condition.wait_for(has_capacity, timeout):
                return False
            if not self._is_closed:
                self._requests.append(request)
                self._condition.notify_all()
            return True

    def close(self) -> None:
        """Accepts no more requests. Those in the queue are still sent."""
        with self._condition:
            self._is_closed = True
            self._condition.notify_all()

    def __iter__(self) -> Iterator[bytes]:
        return self

    def __next__(self) -> bytes:
        with self._condition:
            self._condition.wait_for(lambda: self._is_closed or self._requests)
            if not self._requests:
                raise StopIteration
            request = self._requests.popleft()
            self._condition.notify_all()
            return request


class BidirectionalStream(Generic[StreamReplyT, ProgressT]):
    """A call that sends steps and receives a reply to each. A thread reads the replies, also while the caller waits."""

    def __init__(
        self,
        call: Callable[[_RequestQueue], _Call],
        name: str,
        address: str,
        progress: ProgressT,
    ) -> None:
        """`name` is that of the stream in errors. `progress` receives all replies except the first one."""
        self._requests = _RequestQueue()
        self._name = name
        self._address = address
        self._changed = threading.Condition()
        self._first_reply: StreamReplyT | None = None
        self.progress = progress
        self._call = call(self._requests)
        self._reader = threading.Thread(target=self._read_replies, name=f"modalcast {name}", daemon=True)
        self._reader.start()

    def open(self, request: bytes, timeout: float) -> StreamReplyT:
        """Sends the first message, and returns the first reply.

        Raises:
            Error: The server rejects the request, or does not answer in time.
        """
        self._requests.put(request, timeout)
        self._wait(lambda: self._first_reply is not None, timeout, f"the {self._name} did not open")
        if self._first_reply is None:
            raise malformed(f"{self._name}.opened", "`opened` first", "the end of the stream")
        return self._first_reply

    def send(self, request: bytes, timeout: float) -> None:
        """Sends an encoded step or a part of one.

        Raises:
            DeadlineExceeded: The server had no capacity in time; the stream remains open.
            Error: The stream has ended.
        """
        if self.progress.end is not None:
            raise self.progress.end.with_traceback(None)
        if not self._requests.put(request, timeout):
            raise DeadlineExceeded(f"{self._address}: the server had no capacity for a step within {timeout:g} s")

    def wait_until(self, condition: Callable[[], bool], timeout: float) -> None:
        """Waits until the progress satisfies a condition.

        Raises:
            DeadlineExceeded: The timeout has passed; the stream remains open.
            Error: The stream has ended.
        """
        if self.progress.end is not None:
            raise self.progress.end.with_traceback(None)
        self._wait(condition, timeout, "no reply to a step")

    def finish(self, timeout: float) -> None:
        """Ends the stream from this side, and waits until the server has ended the call."""
        self._requests.close()
        self._reader.join(timeout)
        self.cancel()

    def cancel(self) -> None:
        """Ends the stream at once."""
        self._requests.close()
        self._call.cancel()

    def _wait(self, condition: Callable[[], bool], timeout: float, complaint: str) -> None:
        with self._changed:
            in_time = self._changed.wait_for(lambda: condition() or self.progress.end is not None, timeout)
            if condition():
                return
            if self.progress.end is not None:
                raise self.progress.end.with_traceback(None)
            if not in_time:
                raise DeadlineExceeded(f"{self._address}: {complaint} within {timeout:g} s")

    def _read_replies(self) -> None:
        end: Error = ConnectionLost(f"{self._address}: the server has ended the {self._name}")
        try:
            for reply in self._call:
                with self._changed:
                    if self._first_reply is None:
                        self._first_reply = reply
                        self._changed.notify_all()
                    elif self.progress.add(reply):
                        self._changed.notify_all()
        except grpc.RpcError as error:
            end = from_rpc_error(error, self._address)
        except Error as error:
            end = error
            self._call.cancel()
        finally:
            with self._changed:
                self.progress.end = end
                self._changed.notify_all()
            self._requests.close()


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
        self._subscriptions: grpc.Channel | None = None

    def unary(self, method: Method[RequestT, ReplyT], request: RequestT, timeout: float) -> ReplyT:
        """Makes a call with one reply.

        Raises:
            Error: The call failed.
        """
        call = self._channel.unary_unary(method.path, method.request.SerializeToString, method.reply.FromString)
        try:
            return call(request, timeout=timeout, metadata=self._route.metadata)
        except grpc.RpcError as error:
            raise from_rpc_error(error, self.address) from None

    def wait_for_server(self, timeout: float) -> None:
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
                call(method.request(), timeout=remaining, wait_for_ready=True, metadata=self._route.metadata)
            except grpc.RpcError:
                if time.monotonic() + RETRY_SECONDS >= end:
                    raise ConnectionLost(f"{self.address}: no connection for {timeout:g} s") from None
            else:
                return
            sleep(RETRY_SECONDS)

    def upload(self, method: Method[RequestT, ReplyT], requests: Iterator[RequestT], timeout: float | None) -> ReplyT:
        """Makes a call with a stream of requests. The requests are created as they are sent.

        Raises:
            Error: The call failed.
        """
        call = self._channel.stream_unary(method.path, method.request.SerializeToString, method.reply.FromString)
        try:
            return call(requests, timeout=timeout, metadata=self._route.metadata)
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
        metadata = self._route.metadata
        return StepStream(lambda requests: call(requests, metadata=metadata), "drive", self.address, Progress())

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
        progress = ViewProgress(memory)
        return ViewStream(lambda requests: call(requests, metadata=metadata), "view stream", self.address, progress)

    def close(self) -> None:
        """Closes the connections, and ends all calls."""
        self._channel.close()
        if self._subscriptions is not None:
            self._subscriptions.close()

    def _stream(
        self,
        channel: grpc.Channel,
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

    def _new_channel(self) -> grpc.Channel:
        # With this option, the calling thread reads the replies of a call, without a thread per call. A cancelled call
        # then keeps its connection open. Subscriptions are cancelled often, so their channel has no such option.
        single_threaded = (ChannelOptions.SingleThreadedUnaryStream, 1)
        return self._channel_with([single_threaded])

    def _new_subscription_channel(self) -> grpc.Channel:
        return self._channel_with([])

    def _channel_with(self, options: list[tuple[str, int | str]]) -> grpc.Channel:
        target, credentials = self._route.target, self._route.credentials
        if credentials is None:
            return grpc.insecure_channel(target, options=[*options_of(target), *options])
        return grpc.secure_channel(target, credentials, options=[*options_of(target), *options])
