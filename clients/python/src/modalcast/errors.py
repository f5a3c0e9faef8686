"""Errors of the client. An error of the server names the field, the expected value and the given value."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, cast

import grpc
from google.protobuf.message import DecodeError
from google.rpc import error_details_pb2, status_pb2  # pyright: ignore[reportMissingTypeStubs]

from modalcast.v1 import errors_pb2

_DETAILS_KEY = "grpc-status-details-bin"


class Error(Exception):
    """Base class of the errors of this package.

    Arguments that the client itself rejects raise ValueError or TypeError.
    """


class ConnectionLost(Error, ConnectionError):
    """No server answers at the address, or the connection broke."""


class ProtocolVersionError(Error):
    """The server has another version of the contract than this client."""


class MalformedReply(Error):
    """A reply of the server contradicts itself or the contract."""


class ServerStartError(Error):
    """`spawn` could not start a server."""


class ModelingError(Error):
    """`make_model` could not compute modes; the message is that of the program."""


class ServerError(Error):
    """The server rejected a call, a step or a stream.

    Attributes:
        code: Name of the gRPC status code, such as "INVALID_ARGUMENT"; empty for a rejected step.
        reason: Name of the reason without prefix, such as "INVALID_FIELD"; empty if the status has no details.
            `errors.proto` documents the reasons.
        field: Path of the invalid field in the request; empty if no field is invalid.
        expected: The expected value or condition.
        given: The actual value or condition.
        retry_after: Seconds after which the same request may succeed; None if the server does not say so.
        metadata: Further texts that the reason defines, such as "queue", "limit", "location" and "remedy".
        step: Number of the rejected step; None if the error does not concern a step.
    """

    def __init__(
        self,
        message: str,
        *,
        code: str = "",
        reason: str = "",
        field: str = "",
        expected: str = "",
        given: str = "",
        retry_after: float | None = None,
        metadata: Mapping[str, str] | None = None,
        step: int | None = None,
    ) -> None:
        super().__init__(message)
        self.code = code
        self.reason = reason
        self.field = field
        self.expected = expected
        self.given = given
        self.retry_after = retry_after
        self.metadata = dict(metadata or {})
        self.step = step


class InvalidRequest(ServerError, ValueError):
    """A field of the request, a file or a message is invalid."""


class NotFound(ServerError, LookupError):
    """No scene, scene source, stream or content has the requested name."""


class AlreadyExists(ServerError):
    """Another scene has the name, or another writer drives the scene."""


class StepPassed(ServerError):
    """The scene has already passed the requested step."""


class LimitReached(ServerError):
    """A queue or a limit of the server is exhausted, this client read too slowly, or an administrator has ended it."""


class DeadlineExceeded(ServerError, TimeoutError):
    """The reply was not complete in time."""


class Unavailable(ServerError):
    """The server lacks a program, a device or memory, or is shutting down."""


class ShuttingDown(Unavailable, ConnectionLost):
    """The server is shutting down. Calls and streams that reconnect treat this as a lost connection."""


class LeaseLost(ServerError):
    """Another writer has taken over the scene."""


class Unauthenticated(ServerError):
    """The server does not know the caller: a token is missing, wrong, or no longer valid."""


class PermissionDenied(ServerError, PermissionError):
    """The role of the caller does not permit the call."""


class InternalError(ServerError):
    """The server, a library or the device failed."""


_CLASS_OF_CODE: dict[str, type[ServerError]] = {
    "INVALID_ARGUMENT": InvalidRequest,
    "OUT_OF_RANGE": InvalidRequest,
    "NOT_FOUND": NotFound,
    "ALREADY_EXISTS": AlreadyExists,
    "FAILED_PRECONDITION": StepPassed,
    "RESOURCE_EXHAUSTED": LimitReached,
    "DEADLINE_EXCEEDED": DeadlineExceeded,
    "UNAVAILABLE": Unavailable,
    "ABORTED": LeaseLost,
    "UNAUTHENTICATED": Unauthenticated,
    "PERMISSION_DENIED": PermissionDenied,
    "INTERNAL": InternalError,
}

# A rejection on a stream has no status code. The comments of `Reason` name the code of each reason.
_CODE_OF_REJECTION = {
    "INVALID_FIELD": "INVALID_ARGUMENT",
    "UNEXPECTED_MESSAGE": "INVALID_ARGUMENT",
    "SCENE_NOT_FOUND": "NOT_FOUND",
    "WRITER_LEASE_TAKEN": "ALREADY_EXISTS",
    "WINDOW_FULL": "RESOURCE_EXHAUSTED",
    "QUEUE_FULL": "RESOURCE_EXHAUSTED",
    "LIMIT_REACHED": "RESOURCE_EXHAUSTED",
    "MESSAGE_TOO_LARGE": "RESOURCE_EXHAUSTED",
    "RESOURCE_MISSING": "UNAVAILABLE",
    "SHUTTING_DOWN": "UNAVAILABLE",
    "DEVICE_LOST": "UNAVAILABLE",
    "INTERNAL": "INTERNAL",
}


class RpcStatus(Protocol):
    """What `grpc.RpcError` and `grpc.aio.AioRpcError` have in common."""

    def code(self) -> grpc.StatusCode:
        """The status code."""
        ...

    def details(self) -> str | None:
        """The message for people."""
        ...

    def trailing_metadata(self) -> object:
        """Pairs of keys and values."""
        ...


def from_rpc_error(error: grpc.RpcError, address: str) -> Error:
    """Converts the status of a call to an `Error`."""
    status = cast(RpcStatus, error)
    code, message = status.code().name, status.details() or ""
    details = _status_details(status)
    if details is None:
        # The server adds details to every status. A status without them comes from gRPC itself or from a proxy, which
        # ends streams with INTERNAL.
        if code in ("UNAVAILABLE", "UNKNOWN", "INTERNAL"):
            return ConnectionLost(f"{address}: no connection: {message}")
        return _CLASS_OF_CODE.get(code, ServerError)(f"{address}: {message} ({code})", code=code)
    info, field, retry_after = details
    metadata = dict(info.metadata)
    reason = info.reason.removeprefix("REASON_")
    return _error_class(code, reason)(
        message,
        code=code,
        reason=reason,
        field=field,
        expected=metadata.pop("expected", ""),
        given=metadata.pop("given", ""),
        retry_after=retry_after,
        metadata=metadata,
    )


def connection_remedy(message: str) -> str:
    """What a user can do after `connect` has failed with a message of gRPC."""
    if "CERTIFICATE_VERIFY_FAILED" in message or "Peer name" in message or "Hostname Verification" in message:
        return (
            "The certificate of the server is not accepted: name the file of its authority, or of the certificate "
            "itself if it is self-signed, by ca= or MODALCAST_CA_FILE, and use a host name of the certificate"
        )
    if "WRONG_VERSION_NUMBER" in message:
        return "The server does not speak TLS: use http:// in its address"
    if "http1.x server" in message:
        return "The server expects TLS: use https:// in its address"
    return "Start a server with `modalcast serve`, or use `spawn`"


def from_rejection(rejection: errors_pb2.Rejection) -> ServerError:
    """Converts a rejection on a step stream."""
    try:
        reason = errors_pb2.Reason.Name(rejection.reason).removeprefix("REASON_")
    except ValueError:  # a reason of a newer server
        reason = ""
    step = rejection.step if rejection.HasField("step") else None
    prefix = "" if step is None else f"step {step}: "
    field = f"{rejection.field}: " if rejection.field else ""
    return _error_class(_CODE_OF_REJECTION.get(reason, ""), reason)(
        f"{prefix}{field}expected {rejection.expected}, got {rejection.given}",
        reason=reason,
        field=rejection.field,
        expected=rejection.expected,
        given=rejection.given,
        step=step,
    )


def _error_class(code: str, reason: str) -> type[ServerError]:
    return ShuttingDown if reason == "SHUTTING_DOWN" else _CLASS_OF_CODE.get(code, ServerError)


def _status_details(status: RpcStatus) -> tuple[error_details_pb2.ErrorInfo, str, float | None] | None:
    """The error info, the path of the invalid field, and the seconds until the next attempt."""
    pairs = cast("tuple[tuple[str, bytes], ...]", status.trailing_metadata() or ())
    encoded = next((value for key, value in pairs if key == _DETAILS_KEY), None)
    if encoded is None:
        return None
    info: error_details_pb2.ErrorInfo | None = None
    field, retry_after = "", None
    try:
        details = status_pb2.Status.FromString(encoded).details
        for detail in details:
            error_info = error_details_pb2.ErrorInfo()
            bad_request, retry_info = error_details_pb2.BadRequest(), error_details_pb2.RetryInfo()
            if detail.Unpack(error_info):
                info = error_info
            elif detail.Unpack(bad_request) and bad_request.field_violations:
                field = bad_request.field_violations[0].field
            elif detail.Unpack(retry_info):
                retry_after = retry_info.retry_delay.ToTimedelta().total_seconds()
    except DecodeError:
        return None
    if info is None or info.domain != "modalcast":
        return None
    return info, field, retry_after
