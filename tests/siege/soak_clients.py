"""The clients of soak.py: each lives in a process of its own for some seconds, and uses one or more calls."""

import random
import struct
import sys
import time
from pathlib import Path

import websocket
from websocket import WebSocket

# The modules that `deploy/prove` generates from the contract.
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / ".tools/siege/proto"))

from modalcast.v1 import common_pb2, forces_pb2, frames_pb2, scenes_pb2, states_pb2, steps_pb2, vertices_pb2  # noqa: E402

STATUS = 5

# Vertices per side, and modes, of a scene that clients upload.
SIDE = 40
RANK = 4


class Life:
    """A client during its life. `count_steps` is called with the number of steps that the server has acknowledged."""

    def __init__(self, server, scenes, slot, seed, has_renderer, count_steps):
        self.server = server
        self.scenes = scenes
        self.slot = slot
        self.random = random.Random(seed)
        self.has_renderer = has_renderer
        self.count_steps = count_steps
        self.last_call = 0
        self.buffer = b""
        self.socket = WebSocket(server)

    def live(self, seconds):
        """Uses the server in one way for some seconds."""
        kinds = [self.drive, self.drive, self.drive, self.watch, self.stall, self.upload, self.abandon_upload]
        kinds += [self.describe, self.push]
        kinds += [self.draw] if self.has_renderer else []
        self.random.choice(kinds)(time.monotonic() + seconds)
        self.socket.close()

    def start(self, method, *requests, ends=True):
        """Begins a call."""
        self.last_call += 1
        data = websocket.message(self.last_call, websocket.START, struct.pack("<I", 0) + method.encode())
        for request in requests:
            data += websocket.message(self.last_call, websocket.MESSAGE, request.SerializeToString())
        self.socket.send(data + (websocket.message(self.last_call, websocket.END) if ends else b""))
        return self.last_call

    def send(self, call, request):
        self.socket.send(websocket.message(call, websocket.MESSAGE, request.SerializeToString()))

    def receive(self, seconds):
        """The messages (call, kind, payload) that arrive within some seconds."""
        data, is_open = self.socket.receive(seconds)
        if not is_open and not data:
            raise ConnectionError("closed by the server")
        self.buffer += data
        messages = []
        while len(self.buffer) >= 2:
            length, head = self.buffer[1] & 0x7F, 2
            if length == 126 and len(self.buffer) >= 4:
                length, head = struct.unpack(">H", self.buffer[2:4])[0], 4
            elif length == 127 and len(self.buffer) >= 10:
                length, head = struct.unpack(">Q", self.buffer[2:10])[0], 10
            if (length >= 126 and head == 2) or len(self.buffer) < head + length:
                break
            payload = self.buffer[head : head + length]
            self.buffer = self.buffer[head + length :]
            if length >= 5:
                messages.append((*struct.unpack("<IB", payload[:5]), payload[5:]))
        return messages

    def finish(self, call, deadline):
        """Receives until the call has ended. Whether it has succeeded; `None` if the deadline was first."""
        while time.monotonic() < deadline:
            for id, kind, payload in self.receive(0.05):
                if (id, kind) == (call, STATUS):
                    return payload == b"" or not payload.startswith(b"\x08")
        return None

    def scene(self):
        return self.random.choice(self.scenes)

    def drive(self, deadline):
        """Sends steps, and receives their acknowledgments."""
        delivery = self.random.choice([common_pb2.DELIVERY_LOSSLESS, common_pb2.DELIVERY_LATEST])
        drive = steps_pb2.OpenDrive(scene=self.scene(), delivery=delivery, take_over=True, window=64)
        call = self.start("/modalcast.v1.StepService/DriveScene", steps_pb2.DriveSceneRequest(open=drive), ends=False)
        number, acknowledged = 0, 0
        while time.monotonic() < deadline:
            if number - acknowledged < 32:
                for _ in range(16):
                    number += 1
                    q = struct.pack("<4f", *(self.random.uniform(-0.1, 0.1) for _ in range(4)))
                    step = steps_pb2.Step(number=number, time=number / 60, q_domains=[0], q=q)
                    self.send(call, steps_pb2.DriveSceneRequest(step=step))
            for id, kind, payload in self.receive(0.01):
                if (id, kind) == (call, STATUS):
                    return
                response = steps_pb2.DriveSceneResponse.FromString(payload) if kind == websocket.MESSAGE else None
                if response and response.HasField("ack"):
                    self.count_steps(response.ack.step - acknowledged)
                    acknowledged = response.ack.step

    def watch(self, deadline):
        """Receives states and vertices."""
        latest = common_pb2.DELIVERY_LATEST
        states = states_pb2.StreamStatesRequest(scene=self.scene(), delivery=latest)
        self.start("/modalcast.v1.StateService/StreamStates", states)
        self.start(
            "/modalcast.v1.VertexService/StreamVertices",
            vertices_pb2.StreamVerticesRequest(scene=self.scene(), delivery=latest, max_hz=20),
        )
        while time.monotonic() < deadline:
            for call, kind, payload in self.receive(0.1):
                if kind == websocket.MESSAGE:
                    self.socket.send(websocket.message(call, websocket.CREDIT, struct.pack("<I", len(payload))))

    def stall(self, deadline):
        """Starts streams and reads nothing."""
        for _ in range(4):
            request = vertices_pb2.StreamVerticesRequest(scene=self.scene(), delivery=common_pb2.DELIVERY_LATEST)
            self.start("/modalcast.v1.VertexService/StreamVertices", request)
        time.sleep(max(0, deadline - time.monotonic()))

    def upload(self, deadline):
        """Uploads a scene and deletes it, again and again."""
        while time.monotonic() < deadline:
            name = f"upload-{self.slot}"
            delete = scenes_pb2.DeleteSceneRequest(scene=name)
            self.finish(self.start("/modalcast.v1.SceneService/DeleteScene", delete), deadline)
            self.finish(self.start("/modalcast.v1.SceneService/UploadArrays", *upload_parts(name)), deadline + 5)
            self.finish(self.start("/modalcast.v1.SceneService/DeleteScene", delete), deadline + 5)
            time.sleep(0.2)

    def abandon_upload(self, deadline):
        """Uploads a part of a scene."""
        header, domain, chunk = upload_parts(f"upload-{self.slot}")
        chunk.chunk = chunk.chunk[: len(chunk.chunk) // 2]
        self.start("/modalcast.v1.SceneService/UploadArrays", header, domain, chunk, ends=False)
        self.receive(max(0, min(1, deadline - time.monotonic())))

    def describe(self, deadline):
        """Requests the description with all arrays."""
        while time.monotonic() < deadline:
            arrays = [scenes_pb2.ARRAY_REST_POSITIONS, scenes_pb2.ARRAY_MODES, scenes_pb2.ARRAY_INDICES]
            request = scenes_pb2.DescribeSceneRequest(scene=self.scene(), arrays=arrays)
            self.finish(self.start("/modalcast.v1.SceneService/DescribeScene", request), deadline)
            time.sleep(0.1)

    def push(self, deadline):
        """Applies forces and reads those of all clients."""
        self.start("/modalcast.v1.ForceService/StreamForces", forces_pb2.StreamForcesRequest(scene=self.scene()))
        while time.monotonic() < deadline:
            surface = forces_pb2.SurfaceForce(triangle=1, barycentric=[0.25, 0.25, 0.5], vector=[1, 2, 3])
            force = forces_pb2.Force(id=1, domain=0, surface=surface)
            owner = self.random.randbytes(16)
            request = forces_pb2.ApplyForcesRequest(scene=self.scene(), owner=owner, forces=[force], lifetime_ms=200)
            self.start("/modalcast.v1.ForceService/ApplyForces", request)
            self.receive(0.1)

    def draw(self, deadline):
        """Requests small pictures."""
        while time.monotonic() < deadline:
            picture = frames_pb2.Picture(width=96, height=64, format=frames_pb2.FORMAT_PNG)
            request = frames_pb2.RenderFrameRequest(scene=self.scene(), pictures=[picture])
            self.finish(self.start("/modalcast.v1.FrameService/RenderFrame", request), deadline)
            time.sleep(0.2)


def upload_parts(name):
    """The messages of an upload: a square grid with modes."""
    positions = [struct.pack("<3f", column, row, 0) for row in range(SIDE) for column in range(SIDE)]
    corners = [row * SIDE + column for row in range(SIDE - 1) for column in range(SIDE - 1)]
    faces = [struct.pack("<6I", a, a + 1, a + SIDE, a + 1, a + SIDE + 1, a + SIDE) for a in corners]
    modes = struct.pack(f"<{RANK}f", *(0.01 * (mode + 1) for mode in range(RANK))) * (3 * SIDE * SIDE)
    chunk = b"".join([*positions, *faces, modes])
    Request, Domain = scenes_pb2.UploadArraysRequest, scenes_pb2.UploadedDomain
    header = scenes_pb2.UploadArraysHeader(scene=name, domains=1, total_bytes=len(chunk), unit=1, up="y")
    domain = Domain(name="grid", vertices=SIDE * SIDE, triangles=2 * len(corners), rank=RANK)
    return [Request(header=header), Request(domain=domain), Request(chunk=chunk)]
