from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Reason(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    REASON_UNSPECIFIED: _ClassVar[Reason]
    REASON_INVALID_FIELD: _ClassVar[Reason]
    REASON_UNEXPECTED_MESSAGE: _ClassVar[Reason]
    REASON_INVALID_FILE: _ClassVar[Reason]
    REASON_SCENE_NOT_FOUND: _ClassVar[Reason]
    REASON_SCENE_NAME_TAKEN: _ClassVar[Reason]
    REASON_WRITER_LEASE_TAKEN: _ClassVar[Reason]
    REASON_STEP_PASSED: _ClassVar[Reason]
    REASON_WINDOW_FULL: _ClassVar[Reason]
    REASON_QUEUE_FULL: _ClassVar[Reason]
    REASON_LIMIT_REACHED: _ClassVar[Reason]
    REASON_MESSAGE_TOO_LARGE: _ClassVar[Reason]
    REASON_SLOW_READER: _ClassVar[Reason]
    REASON_DEADLINE_EXPIRED: _ClassVar[Reason]
    REASON_RESOURCE_MISSING: _ClassVar[Reason]
    REASON_SHUTTING_DOWN: _ClassVar[Reason]
    REASON_DEVICE_LOST: _ClassVar[Reason]
    REASON_INTERNAL: _ClassVar[Reason]
    REASON_LEASE_LOST: _ClassVar[Reason]
    REASON_STREAM_NOT_FOUND: _ClassVar[Reason]
    REASON_CONTENT_NOT_FOUND: _ClassVar[Reason]
    REASON_OUT_OF_MEMORY: _ClassVar[Reason]
    REASON_UNAUTHENTICATED: _ClassVar[Reason]
    REASON_PERMISSION_DENIED: _ClassVar[Reason]
    REASON_PREEMPTED: _ClassVar[Reason]
    REASON_ENDED_BY_ADMINISTRATOR: _ClassVar[Reason]
REASON_UNSPECIFIED: Reason
REASON_INVALID_FIELD: Reason
REASON_UNEXPECTED_MESSAGE: Reason
REASON_INVALID_FILE: Reason
REASON_SCENE_NOT_FOUND: Reason
REASON_SCENE_NAME_TAKEN: Reason
REASON_WRITER_LEASE_TAKEN: Reason
REASON_STEP_PASSED: Reason
REASON_WINDOW_FULL: Reason
REASON_QUEUE_FULL: Reason
REASON_LIMIT_REACHED: Reason
REASON_MESSAGE_TOO_LARGE: Reason
REASON_SLOW_READER: Reason
REASON_DEADLINE_EXPIRED: Reason
REASON_RESOURCE_MISSING: Reason
REASON_SHUTTING_DOWN: Reason
REASON_DEVICE_LOST: Reason
REASON_INTERNAL: Reason
REASON_LEASE_LOST: Reason
REASON_STREAM_NOT_FOUND: Reason
REASON_CONTENT_NOT_FOUND: Reason
REASON_OUT_OF_MEMORY: Reason
REASON_UNAUTHENTICATED: Reason
REASON_PERMISSION_DENIED: Reason
REASON_PREEMPTED: Reason
REASON_ENDED_BY_ADMINISTRATOR: Reason

class Rejection(_message.Message):
    __slots__ = ("step", "reason", "field", "expected", "given")
    STEP_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    FIELD_FIELD_NUMBER: _ClassVar[int]
    EXPECTED_FIELD_NUMBER: _ClassVar[int]
    GIVEN_FIELD_NUMBER: _ClassVar[int]
    step: int
    reason: Reason
    field: str
    expected: str
    given: str
    def __init__(self, step: _Optional[int] = ..., reason: _Optional[_Union[Reason, str]] = ..., field: _Optional[str] = ..., expected: _Optional[str] = ..., given: _Optional[str] = ...) -> None: ...
