"""A well-behaved client, and the times that it sees."""

import hashlib
import http.client
import sys
import time
from pathlib import Path

import grpc

# The modules that `deploy/prove` generates from the contract.
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / ".tools/siege/proto"))

from modalcast.v1 import (  # noqa: E402
    common_pb2,
    forces_pb2,
    forces_pb2_grpc,
    frames_pb2,
    frames_pb2_grpc,
    scenes_pb2,
    scenes_pb2_grpc,
    states_pb2,
    steps_pb2,
    steps_pb2_grpc,
    vertices_pb2,
    vertices_pb2_grpc,
)

__all__ = ["common_pb2", "forces_pb2", "forces_pb2_grpc", "frames_pb2", "scenes_pb2", "states_pb2", "steps_pb2", "vertices_pb2"]

LIST_SCENES = "/modalcast.v1.SceneService/ListScenes"
DESCRIBE_SCENE = "/modalcast.v1.SceneService/DescribeScene"
OPEN_SCENE = "/modalcast.v1.SceneService/OpenScene"
DRIVE_SCENE = "/modalcast.v1.StepService/DriveScene"
RENDER_FRAME = "/modalcast.v1.FrameService/RenderFrame"
GET_STATE = "/modalcast.v1.StateService/GetState"
GET_VERTICES = "/modalcast.v1.VertexService/GetVertices"
STREAM_VERTICES = "/modalcast.v1.VertexService/StreamVertices"
HEALTH_WATCH = "/grpc.health.v1.Health/Watch"


# Statuses of the health service.
SERVING = 1
NOT_SERVING = 2


class Client:
    """A connection of its own."""

    def __init__(self, server):
        options = [("grpc.use_local_subchannel_pool", 1), ("grpc.max_receive_message_length", 64 << 20)]
        self.channel = grpc.insecure_channel(server.address, options)
        self.scenes = scenes_pb2_grpc.SceneServiceStub(self.channel)
        self.steps = steps_pb2_grpc.StepServiceStub(self.channel)
        self.frames = frames_pb2_grpc.FrameServiceStub(self.channel)
        self.vertices = vertices_pb2_grpc.VertexServiceStub(self.channel)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.channel.close()

    def open_scene(self, source, name="", timeout=30, metadata=()):
        request = scenes_pb2.OpenSceneRequest(source=source, scene=name)
        return self.scenes.OpenScene(request, timeout=timeout, metadata=metadata).scene

    def list_reply(self, timeout=30):
        return self.scenes.ListScenes(scenes_pb2.ListScenesRequest(), timeout=timeout)

    def list_scenes(self, timeout=30):
        return self.list_reply(timeout).scenes


class Writer:
    """A step stream of a scene."""

    def __init__(self, client, scene, metadata=()):
        self.number = 0
        self.requests = []
        self.replies = client.steps.DriveScene(self.send(scene), metadata=metadata)
        next(self.replies)

    def send(self, scene):
        drive = steps_pb2.OpenDrive(scene=scene, delivery=common_pb2.DELIVERY_LOSSLESS)
        yield steps_pb2.DriveSceneRequest(open=drive)
        while True:
            while not self.requests:
                time.sleep(0.001)
            yield self.requests.pop()

    def send_step(self, **fields):
        """Sends a step and returns the reply."""
        self.number += 1
        self.requests.append(steps_pb2.DriveSceneRequest(step=steps_pb2.Step(number=self.number, **fields)))
        return next(self.replies)

    def step(self):
        """Sends a step. Returns the durable step of the acknowledgment, 0 if there is none."""
        return self.send_step().ack.durable_step


def health(client, service):
    """The status of a service of the health service."""
    request = b"\x0a" + bytes([len(service)]) + service.encode()
    reply = client.channel.unary_unary("/grpc.health.v1.Health/Check")(request, timeout=10)
    return reply[1] if len(reply) > 1 else 0


def upload_parts(name, files):
    """The messages of an upload of files, by their paths."""
    total = sum(map(len, files.values()))
    header = scenes_pb2.UploadHeader(scene=name, files=len(files), total_bytes=total)
    yield scenes_pb2.UploadSceneRequest(header=header)
    for path, data in files.items():
        sha256 = hashlib.sha256(data).digest()
        yield scenes_pb2.UploadSceneRequest(file=scenes_pb2.UploadFile(path=path, bytes=len(data), sha256=sha256))
        for start in range(0, len(data), 1 << 20):
            yield scenes_pb2.UploadSceneRequest(chunk=data[start : start + (1 << 20)])


def upload_files(client, name, files, timeout=60, metadata=()):
    """Uploads files and opens them as a scene."""
    return client.scenes.UploadScene(upload_parts(name, files), timeout=timeout, metadata=metadata).scene


def bearer(token):
    """The metadata of calls with a token."""
    return [("authorization", f"Bearer {token}")]


def time_to_serve(server, timeout, metadata=()):
    """Seconds until a new client has connected and has the list of scenes. `timeout` if it takes longer."""
    start = time.monotonic()
    while (remaining := start + timeout - time.monotonic()) > 0:
        with Client(server) as client:
            try:
                request = scenes_pb2.ListScenesRequest()
                client.scenes.ListScenes(request, timeout=remaining, wait_for_ready=True, metadata=metadata)
                return time.monotonic() - start
            except grpc.RpcError:
                # The connection was closed before its first request was received. A client tries again.
                time.sleep(0.01)
    return timeout


def service_times(server, seconds, timeout, pause=0.2, metadata=()):
    """The `time_to_serve` of clients that arrive one after another for a time."""
    deadline = time.monotonic() + seconds
    times = []
    while time.monotonic() < deadline:
        times.append(time_to_serve(server, timeout, metadata))
        time.sleep(pause)
    return times


def slowest_service(server, seconds, timeout, pause=0.2):
    """The longest of `service_times`."""
    return max(service_times(server, seconds, timeout, pause))


def health_time(server, timeout):
    """Seconds until a new connection has an answer of /healthz. `timeout` if it takes longer."""
    start = time.monotonic()
    while (remaining := start + timeout - time.monotonic()) > 0:
        connection = http.client.HTTPConnection(server.address, timeout=remaining)
        try:
            connection.request("GET", "/healthz")
            if connection.getresponse().status == 200:
                return time.monotonic() - start
        except (OSError, http.client.HTTPException):
            time.sleep(0.01)
        finally:
            connection.close()
    return timeout
