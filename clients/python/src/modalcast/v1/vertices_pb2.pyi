from modalcast.v1 import common_pb2 as _common_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Attribute(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ATTRIBUTE_UNSPECIFIED: _ClassVar[Attribute]
    ATTRIBUTE_POSITIONS: _ClassVar[Attribute]
    ATTRIBUTE_NORMALS: _ClassVar[Attribute]
    ATTRIBUTE_DISPLACEMENTS: _ClassVar[Attribute]
    ATTRIBUTE_BOXES: _ClassVar[Attribute]
    ATTRIBUTE_ORIGINS: _ClassVar[Attribute]

class Encoding(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ENCODING_UNSPECIFIED: _ClassVar[Encoding]
    ENCODING_F32: _ClassVar[Encoding]
    ENCODING_F16: _ClassVar[Encoding]
    ENCODING_U16_BOX: _ClassVar[Encoding]
    ENCODING_OCTAHEDRAL_I16: _ClassVar[Encoding]
    ENCODING_F64: _ClassVar[Encoding]
ATTRIBUTE_UNSPECIFIED: Attribute
ATTRIBUTE_POSITIONS: Attribute
ATTRIBUTE_NORMALS: Attribute
ATTRIBUTE_DISPLACEMENTS: Attribute
ATTRIBUTE_BOXES: Attribute
ATTRIBUTE_ORIGINS: Attribute
ENCODING_UNSPECIFIED: Encoding
ENCODING_F32: Encoding
ENCODING_F16: Encoding
ENCODING_U16_BOX: Encoding
ENCODING_OCTAHEDRAL_I16: Encoding
ENCODING_F64: Encoding

class VertexSelection(_message.Message):
    __slots__ = ("domains", "attributes")
    DOMAINS_FIELD_NUMBER: _ClassVar[int]
    ATTRIBUTES_FIELD_NUMBER: _ClassVar[int]
    domains: _containers.RepeatedScalarFieldContainer[int]
    attributes: _containers.RepeatedCompositeFieldContainer[SelectedAttribute]
    def __init__(self, domains: _Optional[_Iterable[int]] = ..., attributes: _Optional[_Iterable[_Union[SelectedAttribute, _Mapping]]] = ...) -> None: ...

class SelectedAttribute(_message.Message):
    __slots__ = ("attribute", "encoding")
    ATTRIBUTE_FIELD_NUMBER: _ClassVar[int]
    ENCODING_FIELD_NUMBER: _ClassVar[int]
    attribute: Attribute
    encoding: Encoding
    def __init__(self, attribute: _Optional[_Union[Attribute, str]] = ..., encoding: _Optional[_Union[Encoding, str]] = ...) -> None: ...

class GetVerticesRequest(_message.Message):
    __slots__ = ("scene", "selection", "step", "deadline_ms")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    SELECTION_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    DEADLINE_MS_FIELD_NUMBER: _ClassVar[int]
    scene: str
    selection: VertexSelection
    step: _common_pb2.StepSelector
    deadline_ms: int
    def __init__(self, scene: _Optional[str] = ..., selection: _Optional[_Union[VertexSelection, _Mapping]] = ..., step: _Optional[_Union[_common_pb2.StepSelector, _Mapping]] = ..., deadline_ms: _Optional[int] = ...) -> None: ...

class GetVerticesResponse(_message.Message):
    __slots__ = ("layout", "chunk")
    LAYOUT_FIELD_NUMBER: _ClassVar[int]
    CHUNK_FIELD_NUMBER: _ClassVar[int]
    layout: VertexLayout
    chunk: VertexChunk
    def __init__(self, layout: _Optional[_Union[VertexLayout, _Mapping]] = ..., chunk: _Optional[_Union[VertexChunk, _Mapping]] = ...) -> None: ...

class StreamVerticesRequest(_message.Message):
    __slots__ = ("scene", "selection", "delivery", "steps", "max_hz")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    SELECTION_FIELD_NUMBER: _ClassVar[int]
    DELIVERY_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    MAX_HZ_FIELD_NUMBER: _ClassVar[int]
    scene: str
    selection: VertexSelection
    delivery: _common_pb2.Delivery
    steps: int
    max_hz: float
    def __init__(self, scene: _Optional[str] = ..., selection: _Optional[_Union[VertexSelection, _Mapping]] = ..., delivery: _Optional[_Union[_common_pb2.Delivery, str]] = ..., steps: _Optional[int] = ..., max_hz: _Optional[float] = ...) -> None: ...

class StreamVerticesResponse(_message.Message):
    __slots__ = ("settings", "layout", "chunk")
    SETTINGS_FIELD_NUMBER: _ClassVar[int]
    LAYOUT_FIELD_NUMBER: _ClassVar[int]
    CHUNK_FIELD_NUMBER: _ClassVar[int]
    settings: VertexStreamSettings
    layout: VertexLayout
    chunk: VertexChunk
    def __init__(self, settings: _Optional[_Union[VertexStreamSettings, _Mapping]] = ..., layout: _Optional[_Union[VertexLayout, _Mapping]] = ..., chunk: _Optional[_Union[VertexChunk, _Mapping]] = ...) -> None: ...

class VertexStreamSettings(_message.Message):
    __slots__ = ("delivery", "max_hz", "steps")
    DELIVERY_FIELD_NUMBER: _ClassVar[int]
    MAX_HZ_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    delivery: _common_pb2.Delivery
    max_hz: float
    steps: int
    def __init__(self, delivery: _Optional[_Union[_common_pb2.Delivery, str]] = ..., max_hz: _Optional[float] = ..., steps: _Optional[int] = ...) -> None: ...

class VertexLayout(_message.Message):
    __slots__ = ("domains", "vertices", "corners", "has_more")
    DOMAINS_FIELD_NUMBER: _ClassVar[int]
    VERTICES_FIELD_NUMBER: _ClassVar[int]
    CORNERS_FIELD_NUMBER: _ClassVar[int]
    HAS_MORE_FIELD_NUMBER: _ClassVar[int]
    domains: _containers.RepeatedScalarFieldContainer[int]
    vertices: _containers.RepeatedScalarFieldContainer[int]
    corners: _containers.RepeatedScalarFieldContainer[int]
    has_more: bool
    def __init__(self, domains: _Optional[_Iterable[int]] = ..., vertices: _Optional[_Iterable[int]] = ..., corners: _Optional[_Iterable[int]] = ..., has_more: bool = ...) -> None: ...

class VertexChunk(_message.Message):
    __slots__ = ("head", "offset", "data", "shared")
    HEAD_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    SHARED_FIELD_NUMBER: _ClassVar[int]
    head: VertexHead
    offset: int
    data: bytes
    shared: _common_pb2.SharedRange
    def __init__(self, head: _Optional[_Union[VertexHead, _Mapping]] = ..., offset: _Optional[int] = ..., data: _Optional[bytes] = ..., shared: _Optional[_Union[_common_pb2.SharedRange, _Mapping]] = ...) -> None: ...

class VertexHead(_message.Message):
    __slots__ = ("step", "sections", "total", "skipped", "stages")
    STEP_FIELD_NUMBER: _ClassVar[int]
    SECTIONS_FIELD_NUMBER: _ClassVar[int]
    TOTAL_FIELD_NUMBER: _ClassVar[int]
    SKIPPED_FIELD_NUMBER: _ClassVar[int]
    STAGES_FIELD_NUMBER: _ClassVar[int]
    step: _common_pb2.StepId
    sections: _containers.RepeatedCompositeFieldContainer[VertexSection]
    total: int
    skipped: int
    stages: _containers.RepeatedCompositeFieldContainer[_common_pb2.StageTime]
    def __init__(self, step: _Optional[_Union[_common_pb2.StepId, _Mapping]] = ..., sections: _Optional[_Iterable[_Union[VertexSection, _Mapping]]] = ..., total: _Optional[int] = ..., skipped: _Optional[int] = ..., stages: _Optional[_Iterable[_Union[_common_pb2.StageTime, _Mapping]]] = ...) -> None: ...

class VertexSection(_message.Message):
    __slots__ = ("attribute", "encoding", "offset", "bytes")
    ATTRIBUTE_FIELD_NUMBER: _ClassVar[int]
    ENCODING_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    BYTES_FIELD_NUMBER: _ClassVar[int]
    attribute: Attribute
    encoding: Encoding
    offset: int
    bytes: int
    def __init__(self, attribute: _Optional[_Union[Attribute, str]] = ..., encoding: _Optional[_Union[Encoding, str]] = ..., offset: _Optional[int] = ..., bytes: _Optional[int] = ...) -> None: ...
