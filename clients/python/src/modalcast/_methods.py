"""The calls of the contract: paths, and the classes of their messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from google.protobuf.message import Message

from modalcast.v1 import (
    forces_pb2,
    frames_pb2,
    scenes_pb2,
    server_pb2,
    states_pb2,
    steps_pb2,
    vertices_pb2,
    views_pb2,
)

PROTOCOL_VERSION = 2
"""Version of the contract that this client implements."""

RequestT = TypeVar("RequestT", bound=Message)
ReplyT = TypeVar("ReplyT", bound=Message)


@dataclass(frozen=True)
class Method(Generic[RequestT, ReplyT]):
    """A call: its path, and the classes of its messages."""

    path: str
    request: type[RequestT]
    reply: type[ReplyT]


def _method(path: str, request: type[RequestT], reply: type[ReplyT]) -> Method[RequestT, ReplyT]:
    return Method(f"/modalcast.v1.{path}", request, reply)


GET_SERVER_INFO = _method(
    "ServerService/GetServerInfo", server_pb2.GetServerInfoRequest, server_pb2.GetServerInfoResponse
)
CREATE_VIEWER_LINK = _method(
    "ServerService/CreateViewerLink", server_pb2.CreateViewerLinkRequest, server_pb2.CreateViewerLinkResponse
)
LIST_CLIENTS = _method("ServerService/ListClients", server_pb2.ListClientsRequest, server_pb2.ListClientsResponse)
END_CLIENT = _method("ServerService/EndClient", server_pb2.EndClientRequest, server_pb2.EndClientResponse)
OPEN_SCENE = _method("SceneService/OpenScene", scenes_pb2.OpenSceneRequest, scenes_pb2.OpenSceneResponse)
UPLOAD_SCENE = _method("SceneService/UploadScene", scenes_pb2.UploadSceneRequest, scenes_pb2.UploadSceneResponse)
UPLOAD_ARRAYS = _method("SceneService/UploadArrays", scenes_pb2.UploadArraysRequest, scenes_pb2.UploadArraysResponse)
FIND_UPLOADED_FILES = _method(
    "SceneService/FindUploadedFiles", scenes_pb2.FindUploadedFilesRequest, scenes_pb2.FindUploadedFilesResponse
)
LIST_SCENES = _method("SceneService/ListScenes", scenes_pb2.ListScenesRequest, scenes_pb2.ListScenesResponse)
DELETE_SCENE = _method("SceneService/DeleteScene", scenes_pb2.DeleteSceneRequest, scenes_pb2.DeleteSceneResponse)
SHARE_SCENE = _method("SceneService/ShareScene", scenes_pb2.ShareSceneRequest, scenes_pb2.ShareSceneResponse)
DESCRIBE_SCENE = _method(
    "SceneService/DescribeScene", scenes_pb2.DescribeSceneRequest, scenes_pb2.DescribeSceneResponse
)
READ_CONTENT = _method("SceneService/ReadContent", scenes_pb2.ReadContentRequest, scenes_pb2.ReadContentResponse)
READ_MODES = _method("SceneService/ReadModes", scenes_pb2.ReadModesRequest, scenes_pb2.ReadModesResponse)
DRIVE_SCENE = _method("StepService/DriveScene", steps_pb2.DriveSceneRequest, steps_pb2.DriveSceneResponse)
RESET_SCENE = _method("StepService/ResetScene", steps_pb2.ResetSceneRequest, steps_pb2.ResetSceneResponse)
RENDER_FRAME = _method("FrameService/RenderFrame", frames_pb2.RenderFrameRequest, frames_pb2.RenderFrameResponse)
STREAM_FRAMES = _method("FrameService/StreamFrames", frames_pb2.StreamFramesRequest, frames_pb2.StreamFramesResponse)
UPDATE_FRAME_STREAM = _method(
    "FrameService/UpdateFrameStream", frames_pb2.UpdateFrameStreamRequest, frames_pb2.UpdateFrameStreamResponse
)
PICK = _method("FrameService/Pick", frames_pb2.PickRequest, frames_pb2.PickResponse)
GET_VERTICES = _method("VertexService/GetVertices", vertices_pb2.GetVerticesRequest, vertices_pb2.GetVerticesResponse)
STREAM_VERTICES = _method(
    "VertexService/StreamVertices", vertices_pb2.StreamVerticesRequest, vertices_pb2.StreamVerticesResponse
)
GET_STATE = _method("StateService/GetState", states_pb2.GetStateRequest, states_pb2.GetStateResponse)
STREAM_STATES = _method("StateService/StreamStates", states_pb2.StreamStatesRequest, states_pb2.StreamStatesResponse)
APPLY_FORCES = _method("ForceService/ApplyForces", forces_pb2.ApplyForcesRequest, forces_pb2.ApplyForcesResponse)
STREAM_FORCES = _method("ForceService/StreamForces", forces_pb2.StreamForcesRequest, forces_pb2.StreamForcesResponse)
DRAW_VIEWS = _method("ViewService/DrawViews", views_pb2.DrawViewsRequest, views_pb2.DrawViewsResponse)
