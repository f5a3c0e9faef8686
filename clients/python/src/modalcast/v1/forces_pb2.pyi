from modalcast.v1 import common_pb2 as _common_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ApplyForcesRequest(_message.Message):
    __slots__ = ("scene", "owner", "forces", "lifetime_ms")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    OWNER_FIELD_NUMBER: _ClassVar[int]
    FORCES_FIELD_NUMBER: _ClassVar[int]
    LIFETIME_MS_FIELD_NUMBER: _ClassVar[int]
    scene: str
    owner: bytes
    forces: _containers.RepeatedCompositeFieldContainer[Force]
    lifetime_ms: int
    def __init__(self, scene: _Optional[str] = ..., owner: _Optional[bytes] = ..., forces: _Optional[_Iterable[_Union[Force, _Mapping]]] = ..., lifetime_ms: _Optional[int] = ...) -> None: ...

class ApplyForcesResponse(_message.Message):
    __slots__ = ("owner", "lifetime_ms", "receivers")
    OWNER_FIELD_NUMBER: _ClassVar[int]
    LIFETIME_MS_FIELD_NUMBER: _ClassVar[int]
    RECEIVERS_FIELD_NUMBER: _ClassVar[int]
    owner: int
    lifetime_ms: int
    receivers: int
    def __init__(self, owner: _Optional[int] = ..., lifetime_ms: _Optional[int] = ..., receivers: _Optional[int] = ...) -> None: ...

class Force(_message.Message):
    __slots__ = ("id", "domain", "surface", "modal")
    ID_FIELD_NUMBER: _ClassVar[int]
    DOMAIN_FIELD_NUMBER: _ClassVar[int]
    SURFACE_FIELD_NUMBER: _ClassVar[int]
    MODAL_FIELD_NUMBER: _ClassVar[int]
    id: int
    domain: int
    surface: SurfaceForce
    modal: ModalForce
    def __init__(self, id: _Optional[int] = ..., domain: _Optional[int] = ..., surface: _Optional[_Union[SurfaceForce, _Mapping]] = ..., modal: _Optional[_Union[ModalForce, _Mapping]] = ...) -> None: ...

class SurfaceForce(_message.Message):
    __slots__ = ("triangle", "barycentric", "vector")
    TRIANGLE_FIELD_NUMBER: _ClassVar[int]
    BARYCENTRIC_FIELD_NUMBER: _ClassVar[int]
    VECTOR_FIELD_NUMBER: _ClassVar[int]
    triangle: int
    barycentric: _containers.RepeatedScalarFieldContainer[float]
    vector: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, triangle: _Optional[int] = ..., barycentric: _Optional[_Iterable[float]] = ..., vector: _Optional[_Iterable[float]] = ...) -> None: ...

class ModalForce(_message.Message):
    __slots__ = ("f_q",)
    F_Q_FIELD_NUMBER: _ClassVar[int]
    f_q: bytes
    def __init__(self, f_q: _Optional[bytes] = ...) -> None: ...

class StreamForcesRequest(_message.Message):
    __slots__ = ("scene", "max_hz", "passive")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    MAX_HZ_FIELD_NUMBER: _ClassVar[int]
    PASSIVE_FIELD_NUMBER: _ClassVar[int]
    scene: str
    max_hz: float
    passive: bool
    def __init__(self, scene: _Optional[str] = ..., max_hz: _Optional[float] = ..., passive: bool = ...) -> None: ...

class StreamForcesResponse(_message.Message):
    __slots__ = ("step", "forces", "receiver_error")
    STEP_FIELD_NUMBER: _ClassVar[int]
    FORCES_FIELD_NUMBER: _ClassVar[int]
    RECEIVER_ERROR_FIELD_NUMBER: _ClassVar[int]
    step: _common_pb2.StepId
    forces: _containers.RepeatedCompositeFieldContainer[AppliedForce]
    receiver_error: str
    def __init__(self, step: _Optional[_Union[_common_pb2.StepId, _Mapping]] = ..., forces: _Optional[_Iterable[_Union[AppliedForce, _Mapping]]] = ..., receiver_error: _Optional[str] = ...) -> None: ...

class AppliedForce(_message.Message):
    __slots__ = ("owner", "force", "f_q", "rest_point")
    OWNER_FIELD_NUMBER: _ClassVar[int]
    FORCE_FIELD_NUMBER: _ClassVar[int]
    F_Q_FIELD_NUMBER: _ClassVar[int]
    REST_POINT_FIELD_NUMBER: _ClassVar[int]
    owner: int
    force: Force
    f_q: bytes
    rest_point: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, owner: _Optional[int] = ..., force: _Optional[_Union[Force, _Mapping]] = ..., f_q: _Optional[bytes] = ..., rest_point: _Optional[_Iterable[float]] = ...) -> None: ...
