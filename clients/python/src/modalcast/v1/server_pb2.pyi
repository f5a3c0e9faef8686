from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ClientKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    CLIENT_KIND_UNSPECIFIED: _ClassVar[ClientKind]
    CLIENT_KIND_SERVER: _ClassVar[ClientKind]
    CLIENT_KIND_SESSION: _ClassVar[ClientKind]
    CLIENT_KIND_PROCESS: _ClassVar[ClientKind]
    CLIENT_KIND_CONNECTION: _ClassVar[ClientKind]

class Feature(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    FEATURE_UNSPECIFIED: _ClassVar[Feature]
    FEATURE_FRAMES: _ClassVar[Feature]
    FEATURE_CONTENT_HASHES: _ClassVar[Feature]
    FEATURE_UPLOAD_REUSE: _ClassVar[Feature]
    FEATURE_UPLOAD_ARRAYS: _ClassVar[Feature]
    FEATURE_SHARED_MEMORY: _ClassVar[Feature]
    FEATURE_VIEWER: _ClassVar[Feature]
    FEATURE_PACKED_Q: _ClassVar[Feature]
    FEATURE_RGB_FRAMES: _ClassVar[Feature]
CLIENT_KIND_UNSPECIFIED: ClientKind
CLIENT_KIND_SERVER: ClientKind
CLIENT_KIND_SESSION: ClientKind
CLIENT_KIND_PROCESS: ClientKind
CLIENT_KIND_CONNECTION: ClientKind
FEATURE_UNSPECIFIED: Feature
FEATURE_FRAMES: Feature
FEATURE_CONTENT_HASHES: Feature
FEATURE_UPLOAD_REUSE: Feature
FEATURE_UPLOAD_ARRAYS: Feature
FEATURE_SHARED_MEMORY: Feature
FEATURE_VIEWER: Feature
FEATURE_PACKED_Q: Feature
FEATURE_RGB_FRAMES: Feature

class GetServerInfoRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class CreateViewerLinkRequest(_message.Message):
    __slots__ = ("principal",)
    PRINCIPAL_FIELD_NUMBER: _ClassVar[int]
    principal: str
    def __init__(self, principal: _Optional[str] = ...) -> None: ...

class CreateViewerLinkResponse(_message.Message):
    __slots__ = ("url_path", "urls", "public_url")
    URL_PATH_FIELD_NUMBER: _ClassVar[int]
    URLS_FIELD_NUMBER: _ClassVar[int]
    PUBLIC_URL_FIELD_NUMBER: _ClassVar[int]
    url_path: str
    urls: _containers.RepeatedScalarFieldContainer[str]
    public_url: str
    def __init__(self, url_path: _Optional[str] = ..., urls: _Optional[_Iterable[str]] = ..., public_url: _Optional[str] = ...) -> None: ...

class ListClientsRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ListClientsResponse(_message.Message):
    __slots__ = ("clients", "omitted", "resources")
    CLIENTS_FIELD_NUMBER: _ClassVar[int]
    OMITTED_FIELD_NUMBER: _ClassVar[int]
    RESOURCES_FIELD_NUMBER: _ClassVar[int]
    clients: _containers.RepeatedCompositeFieldContainer[ClientInfo]
    omitted: int
    resources: _containers.RepeatedCompositeFieldContainer[ResourceUse]
    def __init__(self, clients: _Optional[_Iterable[_Union[ClientInfo, _Mapping]]] = ..., omitted: _Optional[int] = ..., resources: _Optional[_Iterable[_Union[ResourceUse, _Mapping]]] = ...) -> None: ...

class ClientInfo(_message.Message):
    __slots__ = ("id", "principal", "kind", "address", "process_id", "process_name", "held", "age_ms", "idle_ms", "is_caller", "driven_scenes")
    ID_FIELD_NUMBER: _ClassVar[int]
    PRINCIPAL_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ADDRESS_FIELD_NUMBER: _ClassVar[int]
    PROCESS_ID_FIELD_NUMBER: _ClassVar[int]
    PROCESS_NAME_FIELD_NUMBER: _ClassVar[int]
    HELD_FIELD_NUMBER: _ClassVar[int]
    AGE_MS_FIELD_NUMBER: _ClassVar[int]
    IDLE_MS_FIELD_NUMBER: _ClassVar[int]
    IS_CALLER_FIELD_NUMBER: _ClassVar[int]
    DRIVEN_SCENES_FIELD_NUMBER: _ClassVar[int]
    id: str
    principal: str
    kind: ClientKind
    address: str
    process_id: int
    process_name: str
    held: _containers.RepeatedCompositeFieldContainer[ResourceUse]
    age_ms: int
    idle_ms: int
    is_caller: bool
    driven_scenes: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, id: _Optional[str] = ..., principal: _Optional[str] = ..., kind: _Optional[_Union[ClientKind, str]] = ..., address: _Optional[str] = ..., process_id: _Optional[int] = ..., process_name: _Optional[str] = ..., held: _Optional[_Iterable[_Union[ResourceUse, _Mapping]]] = ..., age_ms: _Optional[int] = ..., idle_ms: _Optional[int] = ..., is_caller: bool = ..., driven_scenes: _Optional[_Iterable[str]] = ...) -> None: ...

class ResourceUse(_message.Message):
    __slots__ = ("resource", "objects", "scene", "held", "limit")
    RESOURCE_FIELD_NUMBER: _ClassVar[int]
    OBJECTS_FIELD_NUMBER: _ClassVar[int]
    SCENE_FIELD_NUMBER: _ClassVar[int]
    HELD_FIELD_NUMBER: _ClassVar[int]
    LIMIT_FIELD_NUMBER: _ClassVar[int]
    resource: str
    objects: str
    scene: str
    held: int
    limit: int
    def __init__(self, resource: _Optional[str] = ..., objects: _Optional[str] = ..., scene: _Optional[str] = ..., held: _Optional[int] = ..., limit: _Optional[int] = ...) -> None: ...

class EndClientRequest(_message.Message):
    __slots__ = ("id",)
    ID_FIELD_NUMBER: _ClassVar[int]
    id: str
    def __init__(self, id: _Optional[str] = ...) -> None: ...

class EndClientResponse(_message.Message):
    __slots__ = ("ids", "ended")
    IDS_FIELD_NUMBER: _ClassVar[int]
    ENDED_FIELD_NUMBER: _ClassVar[int]
    ids: _containers.RepeatedScalarFieldContainer[str]
    ended: int
    def __init__(self, ids: _Optional[_Iterable[str]] = ..., ended: _Optional[int] = ...) -> None: ...

class GetServerInfoResponse(_message.Message):
    __slots__ = ("version", "backend", "device", "renderer", "software", "limits", "protocol_version", "features", "viewer_url_path")
    VERSION_FIELD_NUMBER: _ClassVar[int]
    BACKEND_FIELD_NUMBER: _ClassVar[int]
    DEVICE_FIELD_NUMBER: _ClassVar[int]
    RENDERER_FIELD_NUMBER: _ClassVar[int]
    SOFTWARE_FIELD_NUMBER: _ClassVar[int]
    LIMITS_FIELD_NUMBER: _ClassVar[int]
    PROTOCOL_VERSION_FIELD_NUMBER: _ClassVar[int]
    FEATURES_FIELD_NUMBER: _ClassVar[int]
    VIEWER_URL_PATH_FIELD_NUMBER: _ClassVar[int]
    version: str
    backend: str
    device: str
    renderer: str
    software: bool
    limits: Limits
    protocol_version: int
    features: _containers.RepeatedScalarFieldContainer[Feature]
    viewer_url_path: str
    def __init__(self, version: _Optional[str] = ..., backend: _Optional[str] = ..., device: _Optional[str] = ..., renderer: _Optional[str] = ..., software: bool = ..., limits: _Optional[_Union[Limits, _Mapping]] = ..., protocol_version: _Optional[int] = ..., features: _Optional[_Iterable[_Union[Feature, str]]] = ..., viewer_url_path: _Optional[str] = ...) -> None: ...

class Limits(_message.Message):
    __slots__ = ("message_bytes", "frame_side", "scenes", "window", "upload_bytes", "deadline_ms", "drives", "connection_receive_bytes", "message_timeout_ms", "connection_reply_bytes", "reply_timeout_ms", "scene_host_bytes", "scene_device_bytes", "render_target_bytes", "client_scenes", "client_upload_bytes", "stall_budget_ms")
    MESSAGE_BYTES_FIELD_NUMBER: _ClassVar[int]
    FRAME_SIDE_FIELD_NUMBER: _ClassVar[int]
    SCENES_FIELD_NUMBER: _ClassVar[int]
    WINDOW_FIELD_NUMBER: _ClassVar[int]
    UPLOAD_BYTES_FIELD_NUMBER: _ClassVar[int]
    DEADLINE_MS_FIELD_NUMBER: _ClassVar[int]
    DRIVES_FIELD_NUMBER: _ClassVar[int]
    CONNECTION_RECEIVE_BYTES_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_TIMEOUT_MS_FIELD_NUMBER: _ClassVar[int]
    CONNECTION_REPLY_BYTES_FIELD_NUMBER: _ClassVar[int]
    REPLY_TIMEOUT_MS_FIELD_NUMBER: _ClassVar[int]
    SCENE_HOST_BYTES_FIELD_NUMBER: _ClassVar[int]
    SCENE_DEVICE_BYTES_FIELD_NUMBER: _ClassVar[int]
    RENDER_TARGET_BYTES_FIELD_NUMBER: _ClassVar[int]
    CLIENT_SCENES_FIELD_NUMBER: _ClassVar[int]
    CLIENT_UPLOAD_BYTES_FIELD_NUMBER: _ClassVar[int]
    STALL_BUDGET_MS_FIELD_NUMBER: _ClassVar[int]
    message_bytes: int
    frame_side: int
    scenes: int
    window: int
    upload_bytes: int
    deadline_ms: int
    drives: int
    connection_receive_bytes: int
    message_timeout_ms: int
    connection_reply_bytes: int
    reply_timeout_ms: int
    scene_host_bytes: int
    scene_device_bytes: int
    render_target_bytes: int
    client_scenes: int
    client_upload_bytes: int
    stall_budget_ms: int
    def __init__(self, message_bytes: _Optional[int] = ..., frame_side: _Optional[int] = ..., scenes: _Optional[int] = ..., window: _Optional[int] = ..., upload_bytes: _Optional[int] = ..., deadline_ms: _Optional[int] = ..., drives: _Optional[int] = ..., connection_receive_bytes: _Optional[int] = ..., message_timeout_ms: _Optional[int] = ..., connection_reply_bytes: _Optional[int] = ..., reply_timeout_ms: _Optional[int] = ..., scene_host_bytes: _Optional[int] = ..., scene_device_bytes: _Optional[int] = ..., render_target_bytes: _Optional[int] = ..., client_scenes: _Optional[int] = ..., client_upload_bytes: _Optional[int] = ..., stall_budget_ms: _Optional[int] = ...) -> None: ...
