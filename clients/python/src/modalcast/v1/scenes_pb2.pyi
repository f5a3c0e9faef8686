from modalcast.v1 import common_pb2 as _common_pb2
from modalcast.v1 import errors_pb2 as _errors_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ToneMapping(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    TONE_MAPPING_UNSPECIFIED: _ClassVar[ToneMapping]
    TONE_MAPPING_NONE: _ClassVar[ToneMapping]
    TONE_MAPPING_REINHARD: _ClassVar[ToneMapping]
    TONE_MAPPING_ACES: _ClassVar[ToneMapping]

class Array(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ARRAY_UNSPECIFIED: _ClassVar[Array]
    ARRAY_INDICES: _ClassVar[Array]
    ARRAY_CORNER_VERTICES: _ClassVar[Array]
    ARRAY_REST_POSITIONS: _ClassVar[Array]
    ARRAY_UVS: _ClassVar[Array]
    ARRAY_REST_NORMALS: _ClassVar[Array]
    ARRAY_MODES: _ClassVar[Array]
    ARRAY_CENTERED_POSITIONS: _ClassVar[Array]

class AlphaMode(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ALPHA_MODE_UNSPECIFIED: _ClassVar[AlphaMode]
    ALPHA_MODE_OPAQUE: _ClassVar[AlphaMode]
    ALPHA_MODE_MASK: _ClassVar[AlphaMode]
    ALPHA_MODE_BLEND: _ClassVar[AlphaMode]
TONE_MAPPING_UNSPECIFIED: ToneMapping
TONE_MAPPING_NONE: ToneMapping
TONE_MAPPING_REINHARD: ToneMapping
TONE_MAPPING_ACES: ToneMapping
ARRAY_UNSPECIFIED: Array
ARRAY_INDICES: Array
ARRAY_CORNER_VERTICES: Array
ARRAY_REST_POSITIONS: Array
ARRAY_UVS: Array
ARRAY_REST_NORMALS: Array
ARRAY_MODES: Array
ARRAY_CENTERED_POSITIONS: Array
ALPHA_MODE_UNSPECIFIED: AlphaMode
ALPHA_MODE_OPAQUE: AlphaMode
ALPHA_MODE_MASK: AlphaMode
ALPHA_MODE_BLEND: AlphaMode

class OpenSceneRequest(_message.Message):
    __slots__ = ("source", "scene")
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    SCENE_FIELD_NUMBER: _ClassVar[int]
    source: str
    scene: str
    def __init__(self, source: _Optional[str] = ..., scene: _Optional[str] = ...) -> None: ...

class OpenSceneResponse(_message.Message):
    __slots__ = ("scene",)
    SCENE_FIELD_NUMBER: _ClassVar[int]
    scene: SceneInfo
    def __init__(self, scene: _Optional[_Union[SceneInfo, _Mapping]] = ...) -> None: ...

class SceneInfo(_message.Message):
    __slots__ = ("scene", "source", "domains", "vertices", "corners", "triangles", "coordinates", "up", "unit", "origin", "bounds", "affine", "last_step", "remarks", "lighting", "durable_step", "owner", "shared_with", "writer", "streams")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    DOMAINS_FIELD_NUMBER: _ClassVar[int]
    VERTICES_FIELD_NUMBER: _ClassVar[int]
    CORNERS_FIELD_NUMBER: _ClassVar[int]
    TRIANGLES_FIELD_NUMBER: _ClassVar[int]
    COORDINATES_FIELD_NUMBER: _ClassVar[int]
    UP_FIELD_NUMBER: _ClassVar[int]
    UNIT_FIELD_NUMBER: _ClassVar[int]
    ORIGIN_FIELD_NUMBER: _ClassVar[int]
    BOUNDS_FIELD_NUMBER: _ClassVar[int]
    AFFINE_FIELD_NUMBER: _ClassVar[int]
    LAST_STEP_FIELD_NUMBER: _ClassVar[int]
    REMARKS_FIELD_NUMBER: _ClassVar[int]
    LIGHTING_FIELD_NUMBER: _ClassVar[int]
    DURABLE_STEP_FIELD_NUMBER: _ClassVar[int]
    OWNER_FIELD_NUMBER: _ClassVar[int]
    SHARED_WITH_FIELD_NUMBER: _ClassVar[int]
    WRITER_FIELD_NUMBER: _ClassVar[int]
    STREAMS_FIELD_NUMBER: _ClassVar[int]
    scene: str
    source: str
    domains: int
    vertices: int
    corners: int
    triangles: int
    coordinates: int
    up: str
    unit: float
    origin: _containers.RepeatedScalarFieldContainer[float]
    bounds: _containers.RepeatedScalarFieldContainer[float]
    affine: bool
    last_step: _common_pb2.StepId
    remarks: _containers.RepeatedScalarFieldContainer[str]
    lighting: Lighting
    durable_step: _common_pb2.StepId
    owner: str
    shared_with: _containers.RepeatedScalarFieldContainer[str]
    writer: str
    streams: int
    def __init__(self, scene: _Optional[str] = ..., source: _Optional[str] = ..., domains: _Optional[int] = ..., vertices: _Optional[int] = ..., corners: _Optional[int] = ..., triangles: _Optional[int] = ..., coordinates: _Optional[int] = ..., up: _Optional[str] = ..., unit: _Optional[float] = ..., origin: _Optional[_Iterable[float]] = ..., bounds: _Optional[_Iterable[float]] = ..., affine: bool = ..., last_step: _Optional[_Union[_common_pb2.StepId, _Mapping]] = ..., remarks: _Optional[_Iterable[str]] = ..., lighting: _Optional[_Union[Lighting, _Mapping]] = ..., durable_step: _Optional[_Union[_common_pb2.StepId, _Mapping]] = ..., owner: _Optional[str] = ..., shared_with: _Optional[_Iterable[str]] = ..., writer: _Optional[str] = ..., streams: _Optional[int] = ...) -> None: ...

class Lighting(_message.Message):
    __slots__ = ("to_sun", "sunlight", "skylight", "zenith", "horizon", "ground", "shadows", "exposure", "tone_mapping", "ambient_cube", "fill", "ambient_occlusion_radius")
    TO_SUN_FIELD_NUMBER: _ClassVar[int]
    SUNLIGHT_FIELD_NUMBER: _ClassVar[int]
    SKYLIGHT_FIELD_NUMBER: _ClassVar[int]
    ZENITH_FIELD_NUMBER: _ClassVar[int]
    HORIZON_FIELD_NUMBER: _ClassVar[int]
    GROUND_FIELD_NUMBER: _ClassVar[int]
    SHADOWS_FIELD_NUMBER: _ClassVar[int]
    EXPOSURE_FIELD_NUMBER: _ClassVar[int]
    TONE_MAPPING_FIELD_NUMBER: _ClassVar[int]
    AMBIENT_CUBE_FIELD_NUMBER: _ClassVar[int]
    FILL_FIELD_NUMBER: _ClassVar[int]
    AMBIENT_OCCLUSION_RADIUS_FIELD_NUMBER: _ClassVar[int]
    to_sun: _containers.RepeatedScalarFieldContainer[float]
    sunlight: _containers.RepeatedScalarFieldContainer[float]
    skylight: _containers.RepeatedScalarFieldContainer[float]
    zenith: _containers.RepeatedScalarFieldContainer[float]
    horizon: _containers.RepeatedScalarFieldContainer[float]
    ground: _containers.RepeatedScalarFieldContainer[float]
    shadows: bool
    exposure: float
    tone_mapping: ToneMapping
    ambient_cube: _containers.RepeatedScalarFieldContainer[float]
    fill: _containers.RepeatedScalarFieldContainer[float]
    ambient_occlusion_radius: float
    def __init__(self, to_sun: _Optional[_Iterable[float]] = ..., sunlight: _Optional[_Iterable[float]] = ..., skylight: _Optional[_Iterable[float]] = ..., zenith: _Optional[_Iterable[float]] = ..., horizon: _Optional[_Iterable[float]] = ..., ground: _Optional[_Iterable[float]] = ..., shadows: bool = ..., exposure: _Optional[float] = ..., tone_mapping: _Optional[_Union[ToneMapping, str]] = ..., ambient_cube: _Optional[_Iterable[float]] = ..., fill: _Optional[_Iterable[float]] = ..., ambient_occlusion_radius: _Optional[float] = ...) -> None: ...

class UploadSceneRequest(_message.Message):
    __slots__ = ("header", "file", "chunk")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    FILE_FIELD_NUMBER: _ClassVar[int]
    CHUNK_FIELD_NUMBER: _ClassVar[int]
    header: UploadHeader
    file: UploadFile
    chunk: bytes
    def __init__(self, header: _Optional[_Union[UploadHeader, _Mapping]] = ..., file: _Optional[_Union[UploadFile, _Mapping]] = ..., chunk: _Optional[bytes] = ...) -> None: ...

class UploadHeader(_message.Message):
    __slots__ = ("scene", "entry", "files", "total_bytes")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    ENTRY_FIELD_NUMBER: _ClassVar[int]
    FILES_FIELD_NUMBER: _ClassVar[int]
    TOTAL_BYTES_FIELD_NUMBER: _ClassVar[int]
    scene: str
    entry: str
    files: int
    total_bytes: int
    def __init__(self, scene: _Optional[str] = ..., entry: _Optional[str] = ..., files: _Optional[int] = ..., total_bytes: _Optional[int] = ...) -> None: ...

class UploadFile(_message.Message):
    __slots__ = ("path", "bytes", "sha256", "reuse")
    PATH_FIELD_NUMBER: _ClassVar[int]
    BYTES_FIELD_NUMBER: _ClassVar[int]
    SHA256_FIELD_NUMBER: _ClassVar[int]
    REUSE_FIELD_NUMBER: _ClassVar[int]
    path: str
    bytes: int
    sha256: bytes
    reuse: bool
    def __init__(self, path: _Optional[str] = ..., bytes: _Optional[int] = ..., sha256: _Optional[bytes] = ..., reuse: bool = ...) -> None: ...

class UploadSceneResponse(_message.Message):
    __slots__ = ("scene",)
    SCENE_FIELD_NUMBER: _ClassVar[int]
    scene: SceneInfo
    def __init__(self, scene: _Optional[_Union[SceneInfo, _Mapping]] = ...) -> None: ...

class UploadArraysRequest(_message.Message):
    __slots__ = ("header", "domain", "chunk")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    DOMAIN_FIELD_NUMBER: _ClassVar[int]
    CHUNK_FIELD_NUMBER: _ClassVar[int]
    header: UploadArraysHeader
    domain: UploadedDomain
    chunk: bytes
    def __init__(self, header: _Optional[_Union[UploadArraysHeader, _Mapping]] = ..., domain: _Optional[_Union[UploadedDomain, _Mapping]] = ..., chunk: _Optional[bytes] = ...) -> None: ...

class UploadArraysHeader(_message.Message):
    __slots__ = ("scene", "domains", "total_bytes", "unit", "up")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    DOMAINS_FIELD_NUMBER: _ClassVar[int]
    TOTAL_BYTES_FIELD_NUMBER: _ClassVar[int]
    UNIT_FIELD_NUMBER: _ClassVar[int]
    UP_FIELD_NUMBER: _ClassVar[int]
    scene: str
    domains: int
    total_bytes: int
    unit: float
    up: str
    def __init__(self, scene: _Optional[str] = ..., domains: _Optional[int] = ..., total_bytes: _Optional[int] = ..., unit: _Optional[float] = ..., up: _Optional[str] = ...) -> None: ...

class UploadedDomain(_message.Message):
    __slots__ = ("name", "vertices", "triangles", "rank", "shares_shape_with", "placement", "color", "eigenvalues", "crease_angle", "origin", "f64_positions")
    NAME_FIELD_NUMBER: _ClassVar[int]
    VERTICES_FIELD_NUMBER: _ClassVar[int]
    TRIANGLES_FIELD_NUMBER: _ClassVar[int]
    RANK_FIELD_NUMBER: _ClassVar[int]
    SHARES_SHAPE_WITH_FIELD_NUMBER: _ClassVar[int]
    PLACEMENT_FIELD_NUMBER: _ClassVar[int]
    COLOR_FIELD_NUMBER: _ClassVar[int]
    EIGENVALUES_FIELD_NUMBER: _ClassVar[int]
    CREASE_ANGLE_FIELD_NUMBER: _ClassVar[int]
    ORIGIN_FIELD_NUMBER: _ClassVar[int]
    F64_POSITIONS_FIELD_NUMBER: _ClassVar[int]
    name: str
    vertices: int
    triangles: int
    rank: int
    shares_shape_with: int
    placement: bytes
    color: _containers.RepeatedScalarFieldContainer[float]
    eigenvalues: _containers.RepeatedScalarFieldContainer[float]
    crease_angle: float
    origin: _containers.RepeatedScalarFieldContainer[float]
    f64_positions: bool
    def __init__(self, name: _Optional[str] = ..., vertices: _Optional[int] = ..., triangles: _Optional[int] = ..., rank: _Optional[int] = ..., shares_shape_with: _Optional[int] = ..., placement: _Optional[bytes] = ..., color: _Optional[_Iterable[float]] = ..., eigenvalues: _Optional[_Iterable[float]] = ..., crease_angle: _Optional[float] = ..., origin: _Optional[_Iterable[float]] = ..., f64_positions: bool = ...) -> None: ...

class UploadArraysResponse(_message.Message):
    __slots__ = ("scene",)
    SCENE_FIELD_NUMBER: _ClassVar[int]
    scene: SceneInfo
    def __init__(self, scene: _Optional[_Union[SceneInfo, _Mapping]] = ...) -> None: ...

class FindUploadedFilesRequest(_message.Message):
    __slots__ = ("sha256",)
    SHA256_FIELD_NUMBER: _ClassVar[int]
    sha256: _containers.RepeatedScalarFieldContainer[bytes]
    def __init__(self, sha256: _Optional[_Iterable[bytes]] = ...) -> None: ...

class FindUploadedFilesResponse(_message.Message):
    __slots__ = ("found",)
    FOUND_FIELD_NUMBER: _ClassVar[int]
    found: _containers.RepeatedScalarFieldContainer[bool]
    def __init__(self, found: _Optional[_Iterable[bool]] = ...) -> None: ...

class ListScenesRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ListScenesResponse(_message.Message):
    __slots__ = ("scenes", "sources", "opening", "failed")
    SCENES_FIELD_NUMBER: _ClassVar[int]
    SOURCES_FIELD_NUMBER: _ClassVar[int]
    OPENING_FIELD_NUMBER: _ClassVar[int]
    FAILED_FIELD_NUMBER: _ClassVar[int]
    scenes: _containers.RepeatedCompositeFieldContainer[SceneInfo]
    sources: _containers.RepeatedScalarFieldContainer[str]
    opening: _containers.RepeatedScalarFieldContainer[str]
    failed: _containers.RepeatedCompositeFieldContainer[FailedScene]
    def __init__(self, scenes: _Optional[_Iterable[_Union[SceneInfo, _Mapping]]] = ..., sources: _Optional[_Iterable[str]] = ..., opening: _Optional[_Iterable[str]] = ..., failed: _Optional[_Iterable[_Union[FailedScene, _Mapping]]] = ...) -> None: ...

class FailedScene(_message.Message):
    __slots__ = ("scene", "source", "error")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    scene: str
    source: str
    error: _errors_pb2.Rejection
    def __init__(self, scene: _Optional[str] = ..., source: _Optional[str] = ..., error: _Optional[_Union[_errors_pb2.Rejection, _Mapping]] = ...) -> None: ...

class DeleteSceneRequest(_message.Message):
    __slots__ = ("scene",)
    SCENE_FIELD_NUMBER: _ClassVar[int]
    scene: str
    def __init__(self, scene: _Optional[str] = ...) -> None: ...

class DeleteSceneResponse(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ShareSceneRequest(_message.Message):
    __slots__ = ("scene", "principals")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    PRINCIPALS_FIELD_NUMBER: _ClassVar[int]
    scene: str
    principals: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, scene: _Optional[str] = ..., principals: _Optional[_Iterable[str]] = ...) -> None: ...

class ShareSceneResponse(_message.Message):
    __slots__ = ("owner", "shared_with")
    OWNER_FIELD_NUMBER: _ClassVar[int]
    SHARED_WITH_FIELD_NUMBER: _ClassVar[int]
    owner: str
    shared_with: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, owner: _Optional[str] = ..., shared_with: _Optional[_Iterable[str]] = ...) -> None: ...

class DescribeSceneRequest(_message.Message):
    __slots__ = ("scene", "domains", "arrays", "hashes")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    DOMAINS_FIELD_NUMBER: _ClassVar[int]
    ARRAYS_FIELD_NUMBER: _ClassVar[int]
    HASHES_FIELD_NUMBER: _ClassVar[int]
    scene: str
    domains: _containers.RepeatedScalarFieldContainer[int]
    arrays: _containers.RepeatedScalarFieldContainer[Array]
    hashes: bool
    def __init__(self, scene: _Optional[str] = ..., domains: _Optional[_Iterable[int]] = ..., arrays: _Optional[_Iterable[_Union[Array, str]]] = ..., hashes: bool = ...) -> None: ...

class DescribeSceneResponse(_message.Message):
    __slots__ = ("scene", "shapes", "materials", "textures", "domains", "chunk")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    SHAPES_FIELD_NUMBER: _ClassVar[int]
    MATERIALS_FIELD_NUMBER: _ClassVar[int]
    TEXTURES_FIELD_NUMBER: _ClassVar[int]
    DOMAINS_FIELD_NUMBER: _ClassVar[int]
    CHUNK_FIELD_NUMBER: _ClassVar[int]
    scene: SceneInfo
    shapes: ShapeDescriptions
    materials: MaterialDescriptions
    textures: TextureDescriptions
    domains: DomainDescriptions
    chunk: ArrayChunk
    def __init__(self, scene: _Optional[_Union[SceneInfo, _Mapping]] = ..., shapes: _Optional[_Union[ShapeDescriptions, _Mapping]] = ..., materials: _Optional[_Union[MaterialDescriptions, _Mapping]] = ..., textures: _Optional[_Union[TextureDescriptions, _Mapping]] = ..., domains: _Optional[_Union[DomainDescriptions, _Mapping]] = ..., chunk: _Optional[_Union[ArrayChunk, _Mapping]] = ...) -> None: ...

class ShapeDescriptions(_message.Message):
    __slots__ = ("shapes",)
    SHAPES_FIELD_NUMBER: _ClassVar[int]
    shapes: _containers.RepeatedCompositeFieldContainer[ShapeDescription]
    def __init__(self, shapes: _Optional[_Iterable[_Union[ShapeDescription, _Mapping]]] = ...) -> None: ...

class MaterialDescriptions(_message.Message):
    __slots__ = ("materials",)
    MATERIALS_FIELD_NUMBER: _ClassVar[int]
    materials: _containers.RepeatedCompositeFieldContainer[MaterialDescription]
    def __init__(self, materials: _Optional[_Iterable[_Union[MaterialDescription, _Mapping]]] = ...) -> None: ...

class TextureDescriptions(_message.Message):
    __slots__ = ("textures",)
    TEXTURES_FIELD_NUMBER: _ClassVar[int]
    textures: _containers.RepeatedCompositeFieldContainer[TextureDescription]
    def __init__(self, textures: _Optional[_Iterable[_Union[TextureDescription, _Mapping]]] = ...) -> None: ...

class DomainDescriptions(_message.Message):
    __slots__ = ("domains",)
    DOMAINS_FIELD_NUMBER: _ClassVar[int]
    domains: _containers.RepeatedCompositeFieldContainer[DomainDescription]
    def __init__(self, domains: _Optional[_Iterable[_Union[DomainDescription, _Mapping]]] = ...) -> None: ...

class ShapeDescription(_message.Message):
    __slots__ = ("shape", "vertices", "rank", "corners", "triangles", "eigenvalues", "arrays", "origin")
    SHAPE_FIELD_NUMBER: _ClassVar[int]
    VERTICES_FIELD_NUMBER: _ClassVar[int]
    RANK_FIELD_NUMBER: _ClassVar[int]
    CORNERS_FIELD_NUMBER: _ClassVar[int]
    TRIANGLES_FIELD_NUMBER: _ClassVar[int]
    EIGENVALUES_FIELD_NUMBER: _ClassVar[int]
    ARRAYS_FIELD_NUMBER: _ClassVar[int]
    ORIGIN_FIELD_NUMBER: _ClassVar[int]
    shape: int
    vertices: int
    rank: int
    corners: int
    triangles: int
    eigenvalues: _containers.RepeatedScalarFieldContainer[float]
    arrays: _containers.RepeatedCompositeFieldContainer[ArrayDescription]
    origin: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, shape: _Optional[int] = ..., vertices: _Optional[int] = ..., rank: _Optional[int] = ..., corners: _Optional[int] = ..., triangles: _Optional[int] = ..., eigenvalues: _Optional[_Iterable[float]] = ..., arrays: _Optional[_Iterable[_Union[ArrayDescription, _Mapping]]] = ..., origin: _Optional[_Iterable[float]] = ...) -> None: ...

class ArrayDescription(_message.Message):
    __slots__ = ("array", "bytes", "sha256")
    ARRAY_FIELD_NUMBER: _ClassVar[int]
    BYTES_FIELD_NUMBER: _ClassVar[int]
    SHA256_FIELD_NUMBER: _ClassVar[int]
    array: Array
    bytes: int
    sha256: bytes
    def __init__(self, array: _Optional[_Union[Array, str]] = ..., bytes: _Optional[int] = ..., sha256: _Optional[bytes] = ...) -> None: ...

class MaterialDescription(_message.Message):
    __slots__ = ("material", "name", "ambient", "diffuse", "specular", "shininess", "alpha", "alpha_mode", "alpha_cutoff", "double_sided", "color_texture", "normal_texture")
    MATERIAL_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    AMBIENT_FIELD_NUMBER: _ClassVar[int]
    DIFFUSE_FIELD_NUMBER: _ClassVar[int]
    SPECULAR_FIELD_NUMBER: _ClassVar[int]
    SHININESS_FIELD_NUMBER: _ClassVar[int]
    ALPHA_FIELD_NUMBER: _ClassVar[int]
    ALPHA_MODE_FIELD_NUMBER: _ClassVar[int]
    ALPHA_CUTOFF_FIELD_NUMBER: _ClassVar[int]
    DOUBLE_SIDED_FIELD_NUMBER: _ClassVar[int]
    COLOR_TEXTURE_FIELD_NUMBER: _ClassVar[int]
    NORMAL_TEXTURE_FIELD_NUMBER: _ClassVar[int]
    material: int
    name: str
    ambient: _containers.RepeatedScalarFieldContainer[float]
    diffuse: _containers.RepeatedScalarFieldContainer[float]
    specular: _containers.RepeatedScalarFieldContainer[float]
    shininess: float
    alpha: float
    alpha_mode: AlphaMode
    alpha_cutoff: float
    double_sided: bool
    color_texture: int
    normal_texture: int
    def __init__(self, material: _Optional[int] = ..., name: _Optional[str] = ..., ambient: _Optional[_Iterable[float]] = ..., diffuse: _Optional[_Iterable[float]] = ..., specular: _Optional[_Iterable[float]] = ..., shininess: _Optional[float] = ..., alpha: _Optional[float] = ..., alpha_mode: _Optional[_Union[AlphaMode, str]] = ..., alpha_cutoff: _Optional[float] = ..., double_sided: bool = ..., color_texture: _Optional[int] = ..., normal_texture: _Optional[int] = ...) -> None: ...

class TextureDescription(_message.Message):
    __slots__ = ("texture", "name", "width", "height", "bytes", "sha256")
    TEXTURE_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    BYTES_FIELD_NUMBER: _ClassVar[int]
    SHA256_FIELD_NUMBER: _ClassVar[int]
    texture: int
    name: str
    width: int
    height: int
    bytes: int
    sha256: bytes
    def __init__(self, texture: _Optional[int] = ..., name: _Optional[str] = ..., width: _Optional[int] = ..., height: _Optional[int] = ..., bytes: _Optional[int] = ..., sha256: _Optional[bytes] = ...) -> None: ...

class DomainDescription(_message.Message):
    __slots__ = ("domain", "name", "shape", "material", "material_ranges", "placement", "rest_q", "parent", "attachment_frame", "attachment_vertices", "follows", "follow_frame", "shares_q_with", "eigenvalues", "notes", "exact_placement", "inertia")
    class NotesEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    DOMAIN_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    SHAPE_FIELD_NUMBER: _ClassVar[int]
    MATERIAL_FIELD_NUMBER: _ClassVar[int]
    MATERIAL_RANGES_FIELD_NUMBER: _ClassVar[int]
    PLACEMENT_FIELD_NUMBER: _ClassVar[int]
    REST_Q_FIELD_NUMBER: _ClassVar[int]
    PARENT_FIELD_NUMBER: _ClassVar[int]
    ATTACHMENT_FRAME_FIELD_NUMBER: _ClassVar[int]
    ATTACHMENT_VERTICES_FIELD_NUMBER: _ClassVar[int]
    FOLLOWS_FIELD_NUMBER: _ClassVar[int]
    FOLLOW_FRAME_FIELD_NUMBER: _ClassVar[int]
    SHARES_Q_WITH_FIELD_NUMBER: _ClassVar[int]
    EIGENVALUES_FIELD_NUMBER: _ClassVar[int]
    NOTES_FIELD_NUMBER: _ClassVar[int]
    EXACT_PLACEMENT_FIELD_NUMBER: _ClassVar[int]
    INERTIA_FIELD_NUMBER: _ClassVar[int]
    domain: int
    name: str
    shape: int
    material: int
    material_ranges: _containers.RepeatedCompositeFieldContainer[MaterialRange]
    placement: bytes
    rest_q: bytes
    parent: int
    attachment_frame: bytes
    attachment_vertices: _containers.RepeatedScalarFieldContainer[int]
    follows: int
    follow_frame: bytes
    shares_q_with: int
    eigenvalues: Eigenvalues
    notes: _containers.ScalarMap[str, str]
    exact_placement: _containers.RepeatedScalarFieldContainer[float]
    inertia: Inertia
    def __init__(self, domain: _Optional[int] = ..., name: _Optional[str] = ..., shape: _Optional[int] = ..., material: _Optional[int] = ..., material_ranges: _Optional[_Iterable[_Union[MaterialRange, _Mapping]]] = ..., placement: _Optional[bytes] = ..., rest_q: _Optional[bytes] = ..., parent: _Optional[int] = ..., attachment_frame: _Optional[bytes] = ..., attachment_vertices: _Optional[_Iterable[int]] = ..., follows: _Optional[int] = ..., follow_frame: _Optional[bytes] = ..., shares_q_with: _Optional[int] = ..., eigenvalues: _Optional[_Union[Eigenvalues, _Mapping]] = ..., notes: _Optional[_Mapping[str, str]] = ..., exact_placement: _Optional[_Iterable[float]] = ..., inertia: _Optional[_Union[Inertia, _Mapping]] = ...) -> None: ...

class Inertia(_message.Message):
    __slots__ = ("mass", "center", "moments", "modal_momenta", "modal_masses")
    MASS_FIELD_NUMBER: _ClassVar[int]
    CENTER_FIELD_NUMBER: _ClassVar[int]
    MOMENTS_FIELD_NUMBER: _ClassVar[int]
    MODAL_MOMENTA_FIELD_NUMBER: _ClassVar[int]
    MODAL_MASSES_FIELD_NUMBER: _ClassVar[int]
    mass: float
    center: _containers.RepeatedScalarFieldContainer[float]
    moments: _containers.RepeatedScalarFieldContainer[float]
    modal_momenta: _containers.RepeatedScalarFieldContainer[float]
    modal_masses: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, mass: _Optional[float] = ..., center: _Optional[_Iterable[float]] = ..., moments: _Optional[_Iterable[float]] = ..., modal_momenta: _Optional[_Iterable[float]] = ..., modal_masses: _Optional[_Iterable[float]] = ...) -> None: ...

class MaterialRange(_message.Message):
    __slots__ = ("first_triangle", "material")
    FIRST_TRIANGLE_FIELD_NUMBER: _ClassVar[int]
    MATERIAL_FIELD_NUMBER: _ClassVar[int]
    first_triangle: int
    material: int
    def __init__(self, first_triangle: _Optional[int] = ..., material: _Optional[int] = ...) -> None: ...

class Eigenvalues(_message.Message):
    __slots__ = ("values",)
    VALUES_FIELD_NUMBER: _ClassVar[int]
    values: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, values: _Optional[_Iterable[float]] = ...) -> None: ...

class ArrayChunk(_message.Message):
    __slots__ = ("shape", "array", "offset", "total", "data")
    SHAPE_FIELD_NUMBER: _ClassVar[int]
    ARRAY_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    TOTAL_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    shape: int
    array: Array
    offset: int
    total: int
    data: bytes
    def __init__(self, shape: _Optional[int] = ..., array: _Optional[_Union[Array, str]] = ..., offset: _Optional[int] = ..., total: _Optional[int] = ..., data: _Optional[bytes] = ...) -> None: ...

class ReadContentRequest(_message.Message):
    __slots__ = ("scene", "sha256")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    SHA256_FIELD_NUMBER: _ClassVar[int]
    scene: str
    sha256: _containers.RepeatedScalarFieldContainer[bytes]
    def __init__(self, scene: _Optional[str] = ..., sha256: _Optional[_Iterable[bytes]] = ...) -> None: ...

class ReadContentResponse(_message.Message):
    __slots__ = ("item", "offset", "total", "data")
    ITEM_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    TOTAL_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    item: int
    offset: int
    total: int
    data: bytes
    def __init__(self, item: _Optional[int] = ..., offset: _Optional[int] = ..., total: _Optional[int] = ..., data: _Optional[bytes] = ...) -> None: ...

class ReadModesRequest(_message.Message):
    __slots__ = ("scene", "domain", "vertices")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    DOMAIN_FIELD_NUMBER: _ClassVar[int]
    VERTICES_FIELD_NUMBER: _ClassVar[int]
    scene: str
    domain: int
    vertices: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, scene: _Optional[str] = ..., domain: _Optional[int] = ..., vertices: _Optional[_Iterable[int]] = ...) -> None: ...

class ReadModesResponse(_message.Message):
    __slots__ = ("rank", "offset", "total", "data")
    RANK_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    TOTAL_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    rank: int
    offset: int
    total: int
    data: bytes
    def __init__(self, rank: _Optional[int] = ..., offset: _Optional[int] = ..., total: _Optional[int] = ..., data: _Optional[bytes] = ...) -> None: ...
