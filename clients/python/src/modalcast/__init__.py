"""Client of modalcast, a server for modal deformable objects: x = T (x0 + U q).

`connect` or `spawn` returns a `Client`, `Client.open` a `Scene`, and `Scene.drive` a `Drive`. `modalcast.aio` has the
same calls for asyncio.
"""

from modalcast._common import Delivery, StepId
from modalcast._methods import PROTOCOL_VERSION
from modalcast._sync.client import Client, SceneList, connect, spawn
from modalcast._sync.drive import Drive
from modalcast._sync.modeling import make_model
from modalcast._sync.scene import Scene
from modalcast._sync.streams import FrameBatchStream, FrameStream, Stream
from modalcast._sync.views import ViewBatchStream, Views
from modalcast.camera import Camera, CameraPoses, at_pose, look_at, pinhole
from modalcast.errors import (
    AlreadyExists,
    ConnectionLost,
    DeadlineExceeded,
    Error,
    InternalError,
    InvalidRequest,
    LeaseLost,
    LimitReached,
    MalformedReply,
    ModelingError,
    NotFound,
    PermissionDenied,
    ProtocolVersionError,
    ServerError,
    ServerStartError,
    ShuttingDown,
    StepPassed,
    Unauthenticated,
    Unavailable,
)
from modalcast.forces import AppliedForce, Force, ForceSet, Hit, PickResult, modal_force, surface_force
from modalcast.frame import NO_DOMAIN, Frame, Image, Output
from modalcast.modeling import ModalModel
from modalcast.scene_description import Domain, Domains, Material, SceneDescription, Shape, Texture
from modalcast.states import SceneState
from modalcast.step_values import WorldPose
from modalcast.upload import SceneBuilder
from modalcast.vertices import VertexSet
from modalcast.viewer import ViewerLink

__version__ = "0.1.0"

__all__ = [
    "NO_DOMAIN",
    "PROTOCOL_VERSION",
    "AlreadyExists",
    "AppliedForce",
    "Camera",
    "CameraPoses",
    "Client",
    "ConnectionLost",
    "DeadlineExceeded",
    "Delivery",
    "Domain",
    "Domains",
    "Drive",
    "Error",
    "Force",
    "ForceSet",
    "Frame",
    "FrameBatchStream",
    "FrameStream",
    "Hit",
    "Image",
    "InternalError",
    "InvalidRequest",
    "LeaseLost",
    "LimitReached",
    "MalformedReply",
    "Material",
    "ModalModel",
    "ModelingError",
    "NotFound",
    "Output",
    "PermissionDenied",
    "PickResult",
    "ProtocolVersionError",
    "Scene",
    "SceneBuilder",
    "SceneDescription",
    "SceneList",
    "SceneState",
    "ServerError",
    "ServerStartError",
    "Shape",
    "ShuttingDown",
    "StepId",
    "StepPassed",
    "Stream",
    "Texture",
    "Unauthenticated",
    "Unavailable",
    "VertexSet",
    "ViewBatchStream",
    "ViewerLink",
    "Views",
    "WorldPose",
    "at_pose",
    "connect",
    "look_at",
    "make_model",
    "modal_force",
    "pinhole",
    "spawn",
    "surface_force",
]
