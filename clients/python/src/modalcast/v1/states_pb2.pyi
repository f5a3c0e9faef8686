from modalcast.v1 import common_pb2 as _common_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class StateContent(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    STATE_CONTENT_UNSPECIFIED: _ClassVar[StateContent]
    STATE_CONTENT_Q_DOMAINS: _ClassVar[StateContent]
    STATE_CONTENT_Q: _ClassVar[StateContent]
    STATE_CONTENT_TRANSFORM_DOMAINS: _ClassVar[StateContent]
    STATE_CONTENT_TRANSFORMS: _ClassVar[StateContent]
    STATE_CONTENT_ORIGINS: _ClassVar[StateContent]
STATE_CONTENT_UNSPECIFIED: StateContent
STATE_CONTENT_Q_DOMAINS: StateContent
STATE_CONTENT_Q: StateContent
STATE_CONTENT_TRANSFORM_DOMAINS: StateContent
STATE_CONTENT_TRANSFORMS: StateContent
STATE_CONTENT_ORIGINS: StateContent

class GetStateRequest(_message.Message):
    __slots__ = ("scene", "step", "deadline_ms")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    DEADLINE_MS_FIELD_NUMBER: _ClassVar[int]
    scene: str
    step: _common_pb2.StepSelector
    deadline_ms: int
    def __init__(self, scene: _Optional[str] = ..., step: _Optional[_Union[_common_pb2.StepSelector, _Mapping]] = ..., deadline_ms: _Optional[int] = ...) -> None: ...

class GetStateResponse(_message.Message):
    __slots__ = ("chunk",)
    CHUNK_FIELD_NUMBER: _ClassVar[int]
    chunk: StateChunk
    def __init__(self, chunk: _Optional[_Union[StateChunk, _Mapping]] = ...) -> None: ...

class StreamStatesRequest(_message.Message):
    __slots__ = ("scene", "delivery", "max_hz", "steps", "stages_every")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    DELIVERY_FIELD_NUMBER: _ClassVar[int]
    MAX_HZ_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    STAGES_EVERY_FIELD_NUMBER: _ClassVar[int]
    scene: str
    delivery: _common_pb2.Delivery
    max_hz: float
    steps: int
    stages_every: int
    def __init__(self, scene: _Optional[str] = ..., delivery: _Optional[_Union[_common_pb2.Delivery, str]] = ..., max_hz: _Optional[float] = ..., steps: _Optional[int] = ..., stages_every: _Optional[int] = ...) -> None: ...

class StreamStatesResponse(_message.Message):
    __slots__ = ("settings", "chunk")
    SETTINGS_FIELD_NUMBER: _ClassVar[int]
    CHUNK_FIELD_NUMBER: _ClassVar[int]
    settings: StateStreamSettings
    chunk: StateChunk
    def __init__(self, settings: _Optional[_Union[StateStreamSettings, _Mapping]] = ..., chunk: _Optional[_Union[StateChunk, _Mapping]] = ...) -> None: ...

class StateStreamSettings(_message.Message):
    __slots__ = ("delivery", "max_hz", "steps", "stages_every")
    DELIVERY_FIELD_NUMBER: _ClassVar[int]
    MAX_HZ_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    STAGES_EVERY_FIELD_NUMBER: _ClassVar[int]
    delivery: _common_pb2.Delivery
    max_hz: float
    steps: int
    stages_every: int
    def __init__(self, delivery: _Optional[_Union[_common_pb2.Delivery, str]] = ..., max_hz: _Optional[float] = ..., steps: _Optional[int] = ..., stages_every: _Optional[int] = ...) -> None: ...

class StateChunk(_message.Message):
    __slots__ = ("head", "offset", "data")
    HEAD_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    head: StateHead
    offset: int
    data: bytes
    def __init__(self, head: _Optional[_Union[StateHead, _Mapping]] = ..., offset: _Optional[int] = ..., data: _Optional[bytes] = ...) -> None: ...

class StateHead(_message.Message):
    __slots__ = ("step", "skipped", "complete", "sections", "total", "stages")
    STEP_FIELD_NUMBER: _ClassVar[int]
    SKIPPED_FIELD_NUMBER: _ClassVar[int]
    COMPLETE_FIELD_NUMBER: _ClassVar[int]
    SECTIONS_FIELD_NUMBER: _ClassVar[int]
    TOTAL_FIELD_NUMBER: _ClassVar[int]
    STAGES_FIELD_NUMBER: _ClassVar[int]
    step: _common_pb2.StepId
    skipped: int
    complete: bool
    sections: _containers.RepeatedCompositeFieldContainer[StateSection]
    total: int
    stages: _containers.RepeatedCompositeFieldContainer[_common_pb2.StageTime]
    def __init__(self, step: _Optional[_Union[_common_pb2.StepId, _Mapping]] = ..., skipped: _Optional[int] = ..., complete: bool = ..., sections: _Optional[_Iterable[_Union[StateSection, _Mapping]]] = ..., total: _Optional[int] = ..., stages: _Optional[_Iterable[_Union[_common_pb2.StageTime, _Mapping]]] = ...) -> None: ...

class StateSection(_message.Message):
    __slots__ = ("content", "offset", "bytes")
    CONTENT_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    BYTES_FIELD_NUMBER: _ClassVar[int]
    content: StateContent
    offset: int
    bytes: int
    def __init__(self, content: _Optional[_Union[StateContent, str]] = ..., offset: _Optional[int] = ..., bytes: _Optional[int] = ...) -> None: ...
