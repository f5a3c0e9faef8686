from modalcast.v1 import common_pb2 as _common_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Output(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    OUTPUT_UNSPECIFIED: _ClassVar[Output]
    OUTPUT_COLOR: _ClassVar[Output]
    OUTPUT_DEPTH: _ClassVar[Output]
    OUTPUT_DOMAINS: _ClassVar[Output]
    OUTPUT_NORMALS: _ClassVar[Output]
    OUTPUT_DISPLACEMENT: _ClassVar[Output]
    OUTPUT_MODE_SHAPE: _ClassVar[Output]
    OUTPUT_DEPTH_WITH_GROUND: _ClassVar[Output]

class Format(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    FORMAT_UNSPECIFIED: _ClassVar[Format]
    FORMAT_PNG: _ClassVar[Format]
    FORMAT_RGBA: _ClassVar[Format]
    FORMAT_F32: _ClassVar[Format]
    FORMAT_U32: _ClassVar[Format]
    FORMAT_F32X3: _ClassVar[Format]
    FORMAT_JPEG: _ClassVar[Format]
    FORMAT_RGB: _ClassVar[Format]

class LookPreset(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    LOOK_PRESET_UNSPECIFIED: _ClassVar[LookPreset]
    LOOK_PRESET_PREVIEW: _ClassVar[LookPreset]
    LOOK_PRESET_STANDARD: _ClassVar[LookPreset]
    LOOK_PRESET_BEST: _ClassVar[LookPreset]

class Antialiasing(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ANTIALIASING_UNSPECIFIED: _ClassVar[Antialiasing]
    ANTIALIASING_NONE: _ClassVar[Antialiasing]
    ANTIALIASING_FXAA: _ClassVar[Antialiasing]
    ANTIALIASING_SAMPLES: _ClassVar[Antialiasing]

class ShadowMethod(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SHADOW_METHOD_UNSPECIFIED: _ClassVar[ShadowMethod]
    SHADOW_METHOD_VARIANCE: _ClassVar[ShadowMethod]
    SHADOW_METHOD_STANDARD: _ClassVar[ShadowMethod]
    SHADOW_METHOD_FILTERED: _ClassVar[ShadowMethod]

class DrawnBy(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DRAWN_BY_UNSPECIFIED: _ClassVar[DrawnBy]
    DRAWN_BY_OPENGL: _ClassVar[DrawnBy]
    DRAWN_BY_CUDA: _ClassVar[DrawnBy]
OUTPUT_UNSPECIFIED: Output
OUTPUT_COLOR: Output
OUTPUT_DEPTH: Output
OUTPUT_DOMAINS: Output
OUTPUT_NORMALS: Output
OUTPUT_DISPLACEMENT: Output
OUTPUT_MODE_SHAPE: Output
OUTPUT_DEPTH_WITH_GROUND: Output
FORMAT_UNSPECIFIED: Format
FORMAT_PNG: Format
FORMAT_RGBA: Format
FORMAT_F32: Format
FORMAT_U32: Format
FORMAT_F32X3: Format
FORMAT_JPEG: Format
FORMAT_RGB: Format
LOOK_PRESET_UNSPECIFIED: LookPreset
LOOK_PRESET_PREVIEW: LookPreset
LOOK_PRESET_STANDARD: LookPreset
LOOK_PRESET_BEST: LookPreset
ANTIALIASING_UNSPECIFIED: Antialiasing
ANTIALIASING_NONE: Antialiasing
ANTIALIASING_FXAA: Antialiasing
ANTIALIASING_SAMPLES: Antialiasing
SHADOW_METHOD_UNSPECIFIED: ShadowMethod
SHADOW_METHOD_VARIANCE: ShadowMethod
SHADOW_METHOD_STANDARD: ShadowMethod
SHADOW_METHOD_FILTERED: ShadowMethod
DRAWN_BY_UNSPECIFIED: DrawnBy
DRAWN_BY_OPENGL: DrawnBy
DRAWN_BY_CUDA: DrawnBy

class Picture(_message.Message):
    __slots__ = ("width", "height", "format", "camera", "output", "mode", "largest", "jpeg_quality", "edge_width", "samples")
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    FORMAT_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    OUTPUT_FIELD_NUMBER: _ClassVar[int]
    MODE_FIELD_NUMBER: _ClassVar[int]
    LARGEST_FIELD_NUMBER: _ClassVar[int]
    JPEG_QUALITY_FIELD_NUMBER: _ClassVar[int]
    EDGE_WIDTH_FIELD_NUMBER: _ClassVar[int]
    SAMPLES_FIELD_NUMBER: _ClassVar[int]
    width: int
    height: int
    format: Format
    camera: Camera
    output: Output
    mode: int
    largest: float
    jpeg_quality: int
    edge_width: float
    samples: int
    def __init__(self, width: _Optional[int] = ..., height: _Optional[int] = ..., format: _Optional[_Union[Format, str]] = ..., camera: _Optional[_Union[Camera, _Mapping]] = ..., output: _Optional[_Union[Output, str]] = ..., mode: _Optional[int] = ..., largest: _Optional[float] = ..., jpeg_quality: _Optional[int] = ..., edge_width: _Optional[float] = ..., samples: _Optional[int] = ...) -> None: ...

class Camera(_message.Message):
    __slots__ = ("look_at", "pose", "field_of_view", "intrinsics", "near", "far")
    LOOK_AT_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    FIELD_OF_VIEW_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    NEAR_FIELD_NUMBER: _ClassVar[int]
    FAR_FIELD_NUMBER: _ClassVar[int]
    look_at: LookAt
    pose: Pose
    field_of_view: float
    intrinsics: Intrinsics
    near: float
    far: float
    def __init__(self, look_at: _Optional[_Union[LookAt, _Mapping]] = ..., pose: _Optional[_Union[Pose, _Mapping]] = ..., field_of_view: _Optional[float] = ..., intrinsics: _Optional[_Union[Intrinsics, _Mapping]] = ..., near: _Optional[float] = ..., far: _Optional[float] = ...) -> None: ...

class LookAt(_message.Message):
    __slots__ = ("eye", "target", "up")
    EYE_FIELD_NUMBER: _ClassVar[int]
    TARGET_FIELD_NUMBER: _ClassVar[int]
    UP_FIELD_NUMBER: _ClassVar[int]
    eye: _containers.RepeatedScalarFieldContainer[float]
    target: _containers.RepeatedScalarFieldContainer[float]
    up: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, eye: _Optional[_Iterable[float]] = ..., target: _Optional[_Iterable[float]] = ..., up: _Optional[_Iterable[float]] = ...) -> None: ...

class Pose(_message.Message):
    __slots__ = ("world_from_camera",)
    WORLD_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    world_from_camera: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, world_from_camera: _Optional[_Iterable[float]] = ...) -> None: ...

class Intrinsics(_message.Message):
    __slots__ = ("fx", "fy", "cx", "cy")
    FX_FIELD_NUMBER: _ClassVar[int]
    FY_FIELD_NUMBER: _ClassVar[int]
    CX_FIELD_NUMBER: _ClassVar[int]
    CY_FIELD_NUMBER: _ClassVar[int]
    fx: float
    fy: float
    cx: float
    cy: float
    def __init__(self, fx: _Optional[float] = ..., fy: _Optional[float] = ..., cx: _Optional[float] = ..., cy: _Optional[float] = ...) -> None: ...

class RenderFrameRequest(_message.Message):
    __slots__ = ("scene", "pictures", "step", "deadline_ms")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    PICTURES_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    DEADLINE_MS_FIELD_NUMBER: _ClassVar[int]
    scene: str
    pictures: _containers.RepeatedCompositeFieldContainer[Picture]
    step: _common_pb2.StepSelector
    deadline_ms: int
    def __init__(self, scene: _Optional[str] = ..., pictures: _Optional[_Iterable[_Union[Picture, _Mapping]]] = ..., step: _Optional[_Union[_common_pb2.StepSelector, _Mapping]] = ..., deadline_ms: _Optional[int] = ...) -> None: ...

class RenderFrameResponse(_message.Message):
    __slots__ = ("chunk",)
    CHUNK_FIELD_NUMBER: _ClassVar[int]
    chunk: FrameChunk
    def __init__(self, chunk: _Optional[_Union[FrameChunk, _Mapping]] = ...) -> None: ...

class StreamFramesRequest(_message.Message):
    __slots__ = ("scene", "pictures", "delivery", "steps", "max_hz")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    PICTURES_FIELD_NUMBER: _ClassVar[int]
    DELIVERY_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    MAX_HZ_FIELD_NUMBER: _ClassVar[int]
    scene: str
    pictures: _containers.RepeatedCompositeFieldContainer[Picture]
    delivery: _common_pb2.Delivery
    steps: int
    max_hz: float
    def __init__(self, scene: _Optional[str] = ..., pictures: _Optional[_Iterable[_Union[Picture, _Mapping]]] = ..., delivery: _Optional[_Union[_common_pb2.Delivery, str]] = ..., steps: _Optional[int] = ..., max_hz: _Optional[float] = ...) -> None: ...

class StreamFramesResponse(_message.Message):
    __slots__ = ("settings", "chunk")
    SETTINGS_FIELD_NUMBER: _ClassVar[int]
    CHUNK_FIELD_NUMBER: _ClassVar[int]
    settings: FrameStreamSettings
    chunk: FrameChunk
    def __init__(self, settings: _Optional[_Union[FrameStreamSettings, _Mapping]] = ..., chunk: _Optional[_Union[FrameChunk, _Mapping]] = ...) -> None: ...

class FrameStreamSettings(_message.Message):
    __slots__ = ("delivery", "max_hz", "steps", "pictures", "stream")
    DELIVERY_FIELD_NUMBER: _ClassVar[int]
    MAX_HZ_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    PICTURES_FIELD_NUMBER: _ClassVar[int]
    STREAM_FIELD_NUMBER: _ClassVar[int]
    delivery: _common_pb2.Delivery
    max_hz: float
    steps: int
    pictures: _containers.RepeatedCompositeFieldContainer[Picture]
    stream: bytes
    def __init__(self, delivery: _Optional[_Union[_common_pb2.Delivery, str]] = ..., max_hz: _Optional[float] = ..., steps: _Optional[int] = ..., pictures: _Optional[_Iterable[_Union[Picture, _Mapping]]] = ..., stream: _Optional[bytes] = ...) -> None: ...

class UpdateFrameStreamRequest(_message.Message):
    __slots__ = ("stream", "cameras")
    STREAM_FIELD_NUMBER: _ClassVar[int]
    CAMERAS_FIELD_NUMBER: _ClassVar[int]
    stream: bytes
    cameras: _containers.RepeatedCompositeFieldContainer[PictureCamera]
    def __init__(self, stream: _Optional[bytes] = ..., cameras: _Optional[_Iterable[_Union[PictureCamera, _Mapping]]] = ...) -> None: ...

class PictureCamera(_message.Message):
    __slots__ = ("picture", "camera")
    PICTURE_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    picture: int
    camera: Camera
    def __init__(self, picture: _Optional[int] = ..., camera: _Optional[_Union[Camera, _Mapping]] = ...) -> None: ...

class UpdateFrameStreamResponse(_message.Message):
    __slots__ = ("camera_version",)
    CAMERA_VERSION_FIELD_NUMBER: _ClassVar[int]
    camera_version: int
    def __init__(self, camera_version: _Optional[int] = ...) -> None: ...

class FrameChunk(_message.Message):
    __slots__ = ("head", "offset", "data", "shared")
    HEAD_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    SHARED_FIELD_NUMBER: _ClassVar[int]
    head: FrameHead
    offset: int
    data: bytes
    shared: _common_pb2.SharedRange
    def __init__(self, head: _Optional[_Union[FrameHead, _Mapping]] = ..., offset: _Optional[int] = ..., data: _Optional[bytes] = ..., shared: _Optional[_Union[_common_pb2.SharedRange, _Mapping]] = ...) -> None: ...

class FrameHead(_message.Message):
    __slots__ = ("step", "width", "height", "format", "total", "skipped", "stages", "shadow_drawn_by", "visibility_drawn_by", "picture", "camera_version", "look", "below_ground", "reframed")
    STEP_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    FORMAT_FIELD_NUMBER: _ClassVar[int]
    TOTAL_FIELD_NUMBER: _ClassVar[int]
    SKIPPED_FIELD_NUMBER: _ClassVar[int]
    STAGES_FIELD_NUMBER: _ClassVar[int]
    SHADOW_DRAWN_BY_FIELD_NUMBER: _ClassVar[int]
    VISIBILITY_DRAWN_BY_FIELD_NUMBER: _ClassVar[int]
    PICTURE_FIELD_NUMBER: _ClassVar[int]
    CAMERA_VERSION_FIELD_NUMBER: _ClassVar[int]
    LOOK_FIELD_NUMBER: _ClassVar[int]
    BELOW_GROUND_FIELD_NUMBER: _ClassVar[int]
    REFRAMED_FIELD_NUMBER: _ClassVar[int]
    step: _common_pb2.StepId
    width: int
    height: int
    format: Format
    total: int
    skipped: int
    stages: _containers.RepeatedCompositeFieldContainer[_common_pb2.StageTime]
    shadow_drawn_by: DrawnBy
    visibility_drawn_by: DrawnBy
    picture: int
    camera_version: int
    look: FrameLook
    below_ground: float
    reframed: bool
    def __init__(self, step: _Optional[_Union[_common_pb2.StepId, _Mapping]] = ..., width: _Optional[int] = ..., height: _Optional[int] = ..., format: _Optional[_Union[Format, str]] = ..., total: _Optional[int] = ..., skipped: _Optional[int] = ..., stages: _Optional[_Iterable[_Union[_common_pb2.StageTime, _Mapping]]] = ..., shadow_drawn_by: _Optional[_Union[DrawnBy, str]] = ..., visibility_drawn_by: _Optional[_Union[DrawnBy, str]] = ..., picture: _Optional[int] = ..., camera_version: _Optional[int] = ..., look: _Optional[_Union[FrameLook, _Mapping]] = ..., below_ground: _Optional[float] = ..., reframed: bool = ...) -> None: ...

class FrameLook(_message.Message):
    __slots__ = ("preset", "antialiasing", "samples", "shadow_method", "shadow_size")
    PRESET_FIELD_NUMBER: _ClassVar[int]
    ANTIALIASING_FIELD_NUMBER: _ClassVar[int]
    SAMPLES_FIELD_NUMBER: _ClassVar[int]
    SHADOW_METHOD_FIELD_NUMBER: _ClassVar[int]
    SHADOW_SIZE_FIELD_NUMBER: _ClassVar[int]
    preset: LookPreset
    antialiasing: Antialiasing
    samples: int
    shadow_method: ShadowMethod
    shadow_size: int
    def __init__(self, preset: _Optional[_Union[LookPreset, str]] = ..., antialiasing: _Optional[_Union[Antialiasing, str]] = ..., samples: _Optional[int] = ..., shadow_method: _Optional[_Union[ShadowMethod, str]] = ..., shadow_size: _Optional[int] = ...) -> None: ...

class PickRequest(_message.Message):
    __slots__ = ("scene", "picture", "step", "deadline_ms", "x", "y", "width", "height", "without_modes")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    PICTURE_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    DEADLINE_MS_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    WITHOUT_MODES_FIELD_NUMBER: _ClassVar[int]
    scene: str
    picture: Picture
    step: _common_pb2.StepSelector
    deadline_ms: int
    x: int
    y: int
    width: int
    height: int
    without_modes: bool
    def __init__(self, scene: _Optional[str] = ..., picture: _Optional[_Union[Picture, _Mapping]] = ..., step: _Optional[_Union[_common_pb2.StepSelector, _Mapping]] = ..., deadline_ms: _Optional[int] = ..., x: _Optional[int] = ..., y: _Optional[int] = ..., width: _Optional[int] = ..., height: _Optional[int] = ..., without_modes: bool = ...) -> None: ...

class PickResponse(_message.Message):
    __slots__ = ("head", "hits")
    HEAD_FIELD_NUMBER: _ClassVar[int]
    HITS_FIELD_NUMBER: _ClassVar[int]
    head: PickHead
    hits: _containers.RepeatedCompositeFieldContainer[Hit]
    def __init__(self, head: _Optional[_Union[PickHead, _Mapping]] = ..., hits: _Optional[_Iterable[_Union[Hit, _Mapping]]] = ...) -> None: ...

class PickHead(_message.Message):
    __slots__ = ("step", "hits", "stages")
    STEP_FIELD_NUMBER: _ClassVar[int]
    HITS_FIELD_NUMBER: _ClassVar[int]
    STAGES_FIELD_NUMBER: _ClassVar[int]
    step: _common_pb2.StepId
    hits: int
    stages: _containers.RepeatedCompositeFieldContainer[_common_pb2.StageTime]
    def __init__(self, step: _Optional[_Union[_common_pb2.StepId, _Mapping]] = ..., hits: _Optional[int] = ..., stages: _Optional[_Iterable[_Union[_common_pb2.StageTime, _Mapping]]] = ...) -> None: ...

class Hit(_message.Message):
    __slots__ = ("x", "y", "domain", "triangle", "vertices", "barycentric", "position", "normal", "depth", "linear", "rank", "modes")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    DOMAIN_FIELD_NUMBER: _ClassVar[int]
    TRIANGLE_FIELD_NUMBER: _ClassVar[int]
    VERTICES_FIELD_NUMBER: _ClassVar[int]
    BARYCENTRIC_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    NORMAL_FIELD_NUMBER: _ClassVar[int]
    DEPTH_FIELD_NUMBER: _ClassVar[int]
    LINEAR_FIELD_NUMBER: _ClassVar[int]
    RANK_FIELD_NUMBER: _ClassVar[int]
    MODES_FIELD_NUMBER: _ClassVar[int]
    x: int
    y: int
    domain: int
    triangle: int
    vertices: _containers.RepeatedScalarFieldContainer[int]
    barycentric: _containers.RepeatedScalarFieldContainer[float]
    position: _containers.RepeatedScalarFieldContainer[float]
    normal: _containers.RepeatedScalarFieldContainer[float]
    depth: float
    linear: _containers.RepeatedScalarFieldContainer[float]
    rank: int
    modes: bytes
    def __init__(self, x: _Optional[int] = ..., y: _Optional[int] = ..., domain: _Optional[int] = ..., triangle: _Optional[int] = ..., vertices: _Optional[_Iterable[int]] = ..., barycentric: _Optional[_Iterable[float]] = ..., position: _Optional[_Iterable[float]] = ..., normal: _Optional[_Iterable[float]] = ..., depth: _Optional[float] = ..., linear: _Optional[_Iterable[float]] = ..., rank: _Optional[int] = ..., modes: _Optional[bytes] = ...) -> None: ...
