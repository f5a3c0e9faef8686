from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Optional as _Optional

DESCRIPTOR: _descriptor.FileDescriptor

class Delivery(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DELIVERY_UNSPECIFIED: _ClassVar[Delivery]
    DELIVERY_LOSSLESS: _ClassVar[Delivery]
    DELIVERY_LATEST: _ClassVar[Delivery]
DELIVERY_UNSPECIFIED: Delivery
DELIVERY_LOSSLESS: Delivery
DELIVERY_LATEST: Delivery

class StepId(_message.Message):
    __slots__ = ("run", "number", "time")
    RUN_FIELD_NUMBER: _ClassVar[int]
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    TIME_FIELD_NUMBER: _ClassVar[int]
    run: int
    number: int
    time: float
    def __init__(self, run: _Optional[int] = ..., number: _Optional[int] = ..., time: _Optional[float] = ...) -> None: ...

class StepSelector(_message.Message):
    __slots__ = ("run", "exact", "minimum")
    RUN_FIELD_NUMBER: _ClassVar[int]
    EXACT_FIELD_NUMBER: _ClassVar[int]
    MINIMUM_FIELD_NUMBER: _ClassVar[int]
    run: int
    exact: int
    minimum: int
    def __init__(self, run: _Optional[int] = ..., exact: _Optional[int] = ..., minimum: _Optional[int] = ...) -> None: ...

class StageTime(_message.Message):
    __slots__ = ("stage", "milliseconds")
    STAGE_FIELD_NUMBER: _ClassVar[int]
    MILLISECONDS_FIELD_NUMBER: _ClassVar[int]
    stage: str
    milliseconds: float
    def __init__(self, stage: _Optional[str] = ..., milliseconds: _Optional[float] = ...) -> None: ...

class SharedRange(_message.Message):
    __slots__ = ("slot", "bytes")
    SLOT_FIELD_NUMBER: _ClassVar[int]
    BYTES_FIELD_NUMBER: _ClassVar[int]
    slot: int
    bytes: int
    def __init__(self, slot: _Optional[int] = ..., bytes: _Optional[int] = ...) -> None: ...
