from modalcast.v1 import common_pb2 as _common_pb2
from modalcast.v1 import errors_pb2 as _errors_pb2
from modalcast.v1 import scenes_pb2 as _scenes_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Overflow(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    OVERFLOW_UNSPECIFIED: _ClassVar[Overflow]
    OVERFLOW_BLOCK: _ClassVar[Overflow]
    OVERFLOW_REJECT: _ClassVar[Overflow]

class InitialState(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    INITIAL_STATE_UNSPECIFIED: _ClassVar[InitialState]
    INITIAL_STATE_KEEP: _ClassVar[InitialState]
    INITIAL_STATE_RESET: _ClassVar[InitialState]

class TransformFormat(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    TRANSFORM_FORMAT_UNSPECIFIED: _ClassVar[TransformFormat]
    TRANSFORM_FORMAT_AFFINE_F32: _ClassVar[TransformFormat]
    TRANSFORM_FORMAT_QUATERNION_XYZW_F32: _ClassVar[TransformFormat]
    TRANSFORM_FORMAT_QUATERNION_XYZW_F64: _ClassVar[TransformFormat]
OVERFLOW_UNSPECIFIED: Overflow
OVERFLOW_BLOCK: Overflow
OVERFLOW_REJECT: Overflow
INITIAL_STATE_UNSPECIFIED: InitialState
INITIAL_STATE_KEEP: InitialState
INITIAL_STATE_RESET: InitialState
TRANSFORM_FORMAT_UNSPECIFIED: TransformFormat
TRANSFORM_FORMAT_AFFINE_F32: TransformFormat
TRANSFORM_FORMAT_QUATERNION_XYZW_F32: TransformFormat
TRANSFORM_FORMAT_QUATERNION_XYZW_F64: TransformFormat

class ResetSceneRequest(_message.Message):
    __slots__ = ("scene", "take_over")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    TAKE_OVER_FIELD_NUMBER: _ClassVar[int]
    scene: str
    take_over: bool
    def __init__(self, scene: _Optional[str] = ..., take_over: bool = ...) -> None: ...

class ResetSceneResponse(_message.Message):
    __slots__ = ("step",)
    STEP_FIELD_NUMBER: _ClassVar[int]
    step: _common_pb2.StepId
    def __init__(self, step: _Optional[_Union[_common_pb2.StepId, _Mapping]] = ...) -> None: ...

class DriveSceneRequest(_message.Message):
    __slots__ = ("open", "step")
    OPEN_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    open: OpenDrive
    step: Step
    def __init__(self, open: _Optional[_Union[OpenDrive, _Mapping]] = ..., step: _Optional[_Union[Step, _Mapping]] = ...) -> None: ...

class OpenDrive(_message.Message):
    __slots__ = ("scene", "delivery", "overflow", "window", "lease_token", "take_over", "initial_state", "stall_budget_ms")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    DELIVERY_FIELD_NUMBER: _ClassVar[int]
    OVERFLOW_FIELD_NUMBER: _ClassVar[int]
    WINDOW_FIELD_NUMBER: _ClassVar[int]
    LEASE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    TAKE_OVER_FIELD_NUMBER: _ClassVar[int]
    INITIAL_STATE_FIELD_NUMBER: _ClassVar[int]
    STALL_BUDGET_MS_FIELD_NUMBER: _ClassVar[int]
    scene: str
    delivery: _common_pb2.Delivery
    overflow: Overflow
    window: int
    lease_token: bytes
    take_over: bool
    initial_state: InitialState
    stall_budget_ms: int
    def __init__(self, scene: _Optional[str] = ..., delivery: _Optional[_Union[_common_pb2.Delivery, str]] = ..., overflow: _Optional[_Union[Overflow, str]] = ..., window: _Optional[int] = ..., lease_token: _Optional[bytes] = ..., take_over: bool = ..., initial_state: _Optional[_Union[InitialState, str]] = ..., stall_budget_ms: _Optional[int] = ...) -> None: ...

class Step(_message.Message):
    __slots__ = ("number", "time", "q_domains", "q", "transform_domains", "transforms", "transform_format", "has_more", "shared_q", "shared_transforms")
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    TIME_FIELD_NUMBER: _ClassVar[int]
    Q_DOMAINS_FIELD_NUMBER: _ClassVar[int]
    Q_FIELD_NUMBER: _ClassVar[int]
    TRANSFORM_DOMAINS_FIELD_NUMBER: _ClassVar[int]
    TRANSFORMS_FIELD_NUMBER: _ClassVar[int]
    TRANSFORM_FORMAT_FIELD_NUMBER: _ClassVar[int]
    HAS_MORE_FIELD_NUMBER: _ClassVar[int]
    SHARED_Q_FIELD_NUMBER: _ClassVar[int]
    SHARED_TRANSFORMS_FIELD_NUMBER: _ClassVar[int]
    number: int
    time: float
    q_domains: _containers.RepeatedScalarFieldContainer[int]
    q: bytes
    transform_domains: _containers.RepeatedScalarFieldContainer[int]
    transforms: bytes
    transform_format: TransformFormat
    has_more: bool
    shared_q: _common_pb2.SharedRange
    shared_transforms: _common_pb2.SharedRange
    def __init__(self, number: _Optional[int] = ..., time: _Optional[float] = ..., q_domains: _Optional[_Iterable[int]] = ..., q: _Optional[bytes] = ..., transform_domains: _Optional[_Iterable[int]] = ..., transforms: _Optional[bytes] = ..., transform_format: _Optional[_Union[TransformFormat, str]] = ..., has_more: bool = ..., shared_q: _Optional[_Union[_common_pb2.SharedRange, _Mapping]] = ..., shared_transforms: _Optional[_Union[_common_pb2.SharedRange, _Mapping]] = ...) -> None: ...

class DriveSceneResponse(_message.Message):
    __slots__ = ("opened", "ack", "rejection")
    OPENED_FIELD_NUMBER: _ClassVar[int]
    ACK_FIELD_NUMBER: _ClassVar[int]
    REJECTION_FIELD_NUMBER: _ClassVar[int]
    opened: Opened
    ack: Acknowledgment
    rejection: _errors_pb2.Rejection
    def __init__(self, opened: _Optional[_Union[Opened, _Mapping]] = ..., ack: _Optional[_Union[Acknowledgment, _Mapping]] = ..., rejection: _Optional[_Union[_errors_pb2.Rejection, _Mapping]] = ...) -> None: ...

class Opened(_message.Message):
    __slots__ = ("run", "delivery", "overflow", "window", "lease_token", "initial_state", "scene", "stall_budget_ms")
    RUN_FIELD_NUMBER: _ClassVar[int]
    DELIVERY_FIELD_NUMBER: _ClassVar[int]
    OVERFLOW_FIELD_NUMBER: _ClassVar[int]
    WINDOW_FIELD_NUMBER: _ClassVar[int]
    LEASE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    INITIAL_STATE_FIELD_NUMBER: _ClassVar[int]
    SCENE_FIELD_NUMBER: _ClassVar[int]
    STALL_BUDGET_MS_FIELD_NUMBER: _ClassVar[int]
    run: int
    delivery: _common_pb2.Delivery
    overflow: Overflow
    window: int
    lease_token: bytes
    initial_state: InitialState
    scene: _scenes_pb2.SceneInfo
    stall_budget_ms: int
    def __init__(self, run: _Optional[int] = ..., delivery: _Optional[_Union[_common_pb2.Delivery, str]] = ..., overflow: _Optional[_Union[Overflow, str]] = ..., window: _Optional[int] = ..., lease_token: _Optional[bytes] = ..., initial_state: _Optional[_Union[InitialState, str]] = ..., scene: _Optional[_Union[_scenes_pb2.SceneInfo, _Mapping]] = ..., stall_budget_ms: _Optional[int] = ...) -> None: ...

class Acknowledgment(_message.Message):
    __slots__ = ("step", "skipped", "stages", "durable_step")
    STEP_FIELD_NUMBER: _ClassVar[int]
    SKIPPED_FIELD_NUMBER: _ClassVar[int]
    STAGES_FIELD_NUMBER: _ClassVar[int]
    DURABLE_STEP_FIELD_NUMBER: _ClassVar[int]
    step: int
    skipped: int
    stages: _containers.RepeatedCompositeFieldContainer[_common_pb2.StageTime]
    durable_step: int
    def __init__(self, step: _Optional[int] = ..., skipped: _Optional[int] = ..., stages: _Optional[_Iterable[_Union[_common_pb2.StageTime, _Mapping]]] = ..., durable_step: _Optional[int] = ...) -> None: ...
