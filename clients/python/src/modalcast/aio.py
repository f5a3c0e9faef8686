"""The client for asyncio: the calls of `modalcast` as coroutines and asynchronous iterators."""

from modalcast._async.client import Client, SceneList, connect, spawn
from modalcast._async.drive import Drive
from modalcast._async.modeling import make_model
from modalcast._async.scene import Scene
from modalcast._async.streams import FrameBatchStream, FrameStream, Stream
from modalcast._async.views import ViewBatchStream, Views

__all__ = [
    "Client",
    "Drive",
    "FrameBatchStream",
    "FrameStream",
    "Scene",
    "SceneList",
    "Stream",
    "ViewBatchStream",
    "Views",
    "connect",
    "make_model",
    "spawn",
]
