"""Item 4 of `prove.py`: unread replies use bounded memory and do not delay other clients."""

import contextlib
import tempfile
import threading
import time
from pathlib import Path

import grpc
import http2
from client import (
    DESCRIBE_SCENE,
    GET_VERTICES,
    RENDER_FRAME,
    Client,
    common_pb2,
    frames_pb2,
    scenes_pb2,
    steps_pb2,
    vertices_pb2,
)
from report import Result, mb
from scenes import write_grid
from server import Peak, Server

ITEM = 4

# Each of CONNECTIONS connections opens CALLS calls and reads nothing.
CONNECTIONS = 6
CALLS = 120

# Limits on the growth of the memory in bytes, and on the number of new threads.
MAX_MEMORY = 384 << 20
MAX_THREADS = 40

# Seconds within which another client receives a whole description.
MAX_SERVICE_SECONDS = 1.0

# Seconds of each attack.
DURATION = 12.0

# Flags that raise the budgets to their largest values.
UNLIMITED = ["--connection-reply-bytes", "4000000000", "--reply-bytes", "4000000000"]

# Vertices along each side of the scene.
SIDE = 400

# All values of the enum `Array` but 0.
ALL_ARRAYS = [1, 2, 3, 4, 5, 6]


def describe():
    return DESCRIBE_SCENE, scenes_pb2.DescribeSceneRequest(scene="grid", arrays=ALL_ARRAYS)


def get_vertices():
    return GET_VERTICES, vertices_pb2.GetVerticesRequest(scene="grid")


def render():
    picture = frames_pb2.Picture(width=640, height=480, format=frames_pb2.FORMAT_RGBA)
    return RENDER_FRAME, frames_pb2.RenderFrameRequest(scene="grid", pictures=[picture])


@contextlib.contextmanager
def unread_calls(server, path, request):
    """Calls with the largest flow-control windows, on connections from which nothing is read."""
    message = http2.grpc_message(request.SerializeToString())
    connections = [http2.Connection(server.port, initial_window=http2.MAX_WINDOW) for _ in range(CONNECTIONS)]
    for connection in connections:
        connection.send(http2.window_update(0, http2.MAX_WINDOW - http2.FIRST_WINDOW))
        for _ in range(CALLS):
            connection.send_data(connection.open_call(path), message, http2.END_STREAM)
    yield connections
    for connection in connections:
        connection.close()


def drive(server, is_stopped):
    """Sends a step every 50 ms."""

    def requests():
        yield steps_pb2.DriveSceneRequest(open=steps_pb2.OpenDrive(scene="grid", delivery=common_pb2.DELIVERY_LATEST))
        number = 0
        while not is_stopped.wait(0.05):
            number += 1
            yield steps_pb2.DriveSceneRequest(step=steps_pb2.Step(number=number, time=number))

    with Client(server) as client, contextlib.suppress(grpc.RpcError):
        for _ in client.steps.DriveScene(requests()):
            pass


def describe_whole(server):
    """Seconds in which a new client receives a description, and its bytes."""
    start = time.monotonic()
    with Client(server) as client:
        size = sum(reply.ByteSize() for reply in client.scenes.DescribeScene(describe()[1], timeout=60))
    return time.monotonic() - start, size


def attack(program, call, flags, renderer):
    """Growth of the memory, new threads, and the slowest description for another client."""
    with tempfile.TemporaryDirectory() as folder:
        write_grid(Path(folder) / "grid.obj", SIDE)
        with Server(program, *flags, scenes=folder, renderer=renderer) as server:
            with Client(server) as client:
                client.open_scene("grid.obj", "grid")
            describe_whole(server)
            is_stopped = threading.Event()
            writer = threading.Thread(target=drive, args=[server, is_stopped])
            writer.start()
            memory, threads, slowest = Peak(server.memory), Peak(server.threads), 0.0
            with unread_calls(server, *call):
                end = time.monotonic() + DURATION
                while time.monotonic() < end:
                    slowest = max(slowest, describe_whole(server)[0])
                    memory.sample()
                    threads.sample()
                    time.sleep(0.05)
            is_stopped.set()
            writer.join()
            return memory.growth(), threads.growth(), slowest


ATTACKS = [("descriptions", describe(), "off"), ("vertices", get_vertices(), "off"), ("frames", render(), "software")]


def run(program):
    measured, passed = [], True
    for name, call, renderer in ATTACKS:
        memory, threads, slowest = attack(program, call, [], renderer)
        measured.append(f"{name} +{mb(memory)}, +{threads} threads, {slowest:.2f} s")
        passed &= memory <= MAX_MEMORY and threads <= MAX_THREADS and slowest <= MAX_SERVICE_SECONDS
    control, _, _ = attack(program, describe(), UNLIMITED, "off")
    return [
        Result(
            ITEM,
            f"{CONNECTIONS * CALLS} unread calls use bounded memory, and another client is served",
            f"memory +{mb(MAX_MEMORY)}, +{MAX_THREADS} threads, a description within {MAX_SERVICE_SECONDS:.0f} s",
            "; ".join(measured),
            passed,
            f"descriptions with the largest budgets +{mb(control)}",
            control > MAX_MEMORY,
        )
    ]
