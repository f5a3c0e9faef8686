from modalcast.v1 import common_pb2 as _common_pb2
from modalcast.v1 import errors_pb2 as _errors_pb2
from modalcast.v1 import frames_pb2 as _frames_pb2
from modalcast.v1 import steps_pb2 as _steps_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class DrawViewsRequest(_message.Message):
    __slots__ = ("open", "step")
    OPEN_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    open: OpenViews
    step: ViewStep
    def __init__(self, open: _Optional[_Union[OpenViews, _Mapping]] = ..., step: _Optional[_Union[ViewStep, _Mapping]] = ...) -> None: ...

class OpenViews(_message.Message):
    __slots__ = ("scene", "worlds", "width", "height", "outputs", "cameras", "camera_worlds", "device_slots")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    WORLDS_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    CAMERAS_FIELD_NUMBER: _ClassVar[int]
    CAMERA_WORLDS_FIELD_NUMBER: _ClassVar[int]
    DEVICE_SLOTS_FIELD_NUMBER: _ClassVar[int]
    scene: str
    worlds: int
    width: int
    height: int
    outputs: _containers.RepeatedScalarFieldContainer[_frames_pb2.Output]
    cameras: _containers.RepeatedCompositeFieldContainer[_frames_pb2.Camera]
    camera_worlds: _containers.RepeatedScalarFieldContainer[int]
    device_slots: int
    def __init__(self, scene: _Optional[str] = ..., worlds: _Optional[int] = ..., width: _Optional[int] = ..., height: _Optional[int] = ..., outputs: _Optional[_Iterable[_Union[_frames_pb2.Output, str]]] = ..., cameras: _Optional[_Iterable[_Union[_frames_pb2.Camera, _Mapping]]] = ..., camera_worlds: _Optional[_Iterable[int]] = ..., device_slots: _Optional[int] = ...) -> None: ...

class ViewStep(_message.Message):
    __slots__ = ("step", "cameras", "drawn_worlds")
    STEP_FIELD_NUMBER: _ClassVar[int]
    CAMERAS_FIELD_NUMBER: _ClassVar[int]
    DRAWN_WORLDS_FIELD_NUMBER: _ClassVar[int]
    step: _steps_pb2.Step
    cameras: _containers.RepeatedCompositeFieldContainer[_frames_pb2.Camera]
    drawn_worlds: int
    def __init__(self, step: _Optional[_Union[_steps_pb2.Step, _Mapping]] = ..., cameras: _Optional[_Iterable[_Union[_frames_pb2.Camera, _Mapping]]] = ..., drawn_worlds: _Optional[int] = ...) -> None: ...

class DrawViewsResponse(_message.Message):
    __slots__ = ("opened", "chunk", "rejection", "device")
    OPENED_FIELD_NUMBER: _ClassVar[int]
    CHUNK_FIELD_NUMBER: _ClassVar[int]
    REJECTION_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    opened: ViewsOpened
    chunk: ViewChunk
    rejection: _errors_pb2.Rejection
    device: DeviceViews
    def __init__(self, opened: _Optional[_Union[ViewsOpened, _Mapping]] = ..., chunk: _Optional[_Union[ViewChunk, _Mapping]] = ..., rejection: _Optional[_Union[_errors_pb2.Rejection, _Mapping]] = ..., device: _Optional[_Union[DeviceViews, _Mapping]] = ...) -> None: ...

class ViewsOpened(_message.Message):
    __slots__ = ("worlds", "width", "height", "outputs", "views", "coordinates", "transforms", "device_slots")
    WORLDS_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    VIEWS_FIELD_NUMBER: _ClassVar[int]
    COORDINATES_FIELD_NUMBER: _ClassVar[int]
    TRANSFORMS_FIELD_NUMBER: _ClassVar[int]
    DEVICE_SLOTS_FIELD_NUMBER: _ClassVar[int]
    worlds: int
    width: int
    height: int
    outputs: _containers.RepeatedScalarFieldContainer[_frames_pb2.Output]
    views: int
    coordinates: int
    transforms: int
    device_slots: DeviceSlots
    def __init__(self, worlds: _Optional[int] = ..., width: _Optional[int] = ..., height: _Optional[int] = ..., outputs: _Optional[_Iterable[_Union[_frames_pb2.Output, str]]] = ..., views: _Optional[int] = ..., coordinates: _Optional[int] = ..., transforms: _Optional[int] = ..., device_slots: _Optional[_Union[DeviceSlots, _Mapping]] = ...) -> None: ...

class DeviceSlots(_message.Message):
    __slots__ = ("device", "bytes", "offsets")
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    BYTES_FIELD_NUMBER: _ClassVar[int]
    OFFSETS_FIELD_NUMBER: _ClassVar[int]
    device: bytes
    bytes: _containers.RepeatedScalarFieldContainer[int]
    offsets: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, device: _Optional[bytes] = ..., bytes: _Optional[_Iterable[int]] = ..., offsets: _Optional[_Iterable[int]] = ...) -> None: ...

class DeviceViews(_message.Message):
    __slots__ = ("step", "slot", "stages")
    STEP_FIELD_NUMBER: _ClassVar[int]
    SLOT_FIELD_NUMBER: _ClassVar[int]
    STAGES_FIELD_NUMBER: _ClassVar[int]
    step: int
    slot: int
    stages: _containers.RepeatedCompositeFieldContainer[_common_pb2.StageTime]
    def __init__(self, step: _Optional[int] = ..., slot: _Optional[int] = ..., stages: _Optional[_Iterable[_Union[_common_pb2.StageTime, _Mapping]]] = ...) -> None: ...

class ViewChunk(_message.Message):
    __slots__ = ("step", "output", "offset", "stages", "data", "shared")
    STEP_FIELD_NUMBER: _ClassVar[int]
    OUTPUT_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    STAGES_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    SHARED_FIELD_NUMBER: _ClassVar[int]
    step: int
    output: _frames_pb2.Output
    offset: int
    stages: _containers.RepeatedCompositeFieldContainer[_common_pb2.StageTime]
    data: bytes
    shared: _common_pb2.SharedRange
    def __init__(self, step: _Optional[int] = ..., output: _Optional[_Union[_frames_pb2.Output, str]] = ..., offset: _Optional[int] = ..., stages: _Optional[_Iterable[_Union[_common_pb2.StageTime, _Mapping]]] = ..., data: _Optional[bytes] = ..., shared: _Optional[_Union[_common_pb2.SharedRange, _Mapping]] = ...) -> None: ...
