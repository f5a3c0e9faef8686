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
    GET_STATE,
    GET_VERTICES,
    RENDER_FRAME,
    Client,
    common_pb2,
    frames_pb2,
    scenes_pb2,
    states_pb2,
    steps_pb2,
    time_to_serve,
    vertices_pb2,
)
from report import Result, mb
from scenes import write_domains
from server import Peak, Server

ITEM = 4

# Each of CONNECTIONS connections opens CALLS calls and reads nothing.
CONNECTIONS = 20
CALLS = 64

# Limits on the growth of the memory in bytes, and on the number of new threads. Descriptions and states are produced by
# threads of their own, for as many calls at a time as the budget of replies of 256 MiB admits.
MAX_MEMORY = 512 << 20
MAX_THREADS = 200

# Seconds within which another client connects and receives the list of scenes, and seconds after which it gives up.
MAX_SERVICE_SECONDS = 1.0
MAX_WAIT_SECONDS = 20.0

# Seconds of each attack. A control ends earlier if it exceeds the limit on the memory.
DURATION = 8.0

# Flags that raise the budgets to their largest values.
UNLIMITED = ["--connection-reply-bytes", "4000000000", "--reply-bytes", "4000000000"]

# Domains of the scene. Its description, its state and its layout have 0.2 to 1.5 MB. The server produces them for each
# call, unlike the arrays of shapes, which all replies share with the scene.
DOMAINS = 20_000

# All values of the enum `Array` but 0.
ALL_ARRAYS = [1, 2, 3, 4, 5, 6]


def describe():
    return DESCRIBE_SCENE, scenes_pb2.DescribeSceneRequest(scene="scene", arrays=ALL_ARRAYS)


def get_vertices():
    return GET_VERTICES, vertices_pb2.GetVerticesRequest(scene="scene")


def get_state():
    return GET_STATE, states_pb2.GetStateRequest(scene="scene")


def render():
    picture = frames_pb2.Picture(width=640, height=480, format=frames_pb2.FORMAT_RGBA)
    return RENDER_FRAME, frames_pb2.RenderFrameRequest(scene="scene", pictures=[picture])


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
        yield steps_pb2.DriveSceneRequest(open=steps_pb2.OpenDrive(scene="scene", delivery=common_pb2.DELIVERY_LATEST))
        number = 0
        while not is_stopped.wait(0.05):
            number += 1
            yield steps_pb2.DriveSceneRequest(step=steps_pb2.Step(number=number, time=number))

    with Client(server) as client, contextlib.suppress(grpc.RpcError):
        for _ in client.steps.DriveScene(requests()):
            pass


def attack(program, call, flags, renderer, enough=None):
    """Growth of the memory, new threads, and the longest time until another client has the list of scenes. Ends early
    when the memory has grown by more than `enough` bytes."""
    with tempfile.TemporaryDirectory() as folder:
        write_domains(Path(folder), DOMAINS)
        with Server(program, *flags, scenes=folder, renderer=renderer) as server:
            with Client(server) as client:
                client.open_scene("scene.toml", "scene")
            is_stopped = threading.Event()
            writer = threading.Thread(target=drive, args=[server, is_stopped])
            writer.start()
            memory, threads, slowest = Peak(server.memory), Peak(server.threads), 0.0
            with unread_calls(server, *call):
                end = time.monotonic() + DURATION
                while time.monotonic() < end and (enough is None or memory.growth() <= enough):
                    slowest = max(slowest, time_to_serve(server, MAX_WAIT_SECONDS))
                    memory.sample()
                    threads.sample()
                    time.sleep(0.05)
            is_stopped.set()
            writer.join()
            return memory.growth(), threads.growth(), slowest


# Name, call and renderer of each attack, and whether the same call exceeds the limit on the memory without budgets.
ATTACKS = [
    ("descriptions", describe(), "off", True),
    ("states", get_state(), "off", False),
    ("vertices", get_vertices(), "off", False),
    ("frames", render(), "software", False),
]


def run(program):
    measured, controls, passed, controls_failed = [], [], True, True
    for name, call, renderer, has_control in ATTACKS:
        memory, threads, slowest = attack(program, call, [], renderer)
        measured.append(f"{name} +{mb(memory)}, +{threads} threads, {slowest:.2f} s")
        passed &= memory <= MAX_MEMORY and threads <= MAX_THREADS and slowest <= MAX_SERVICE_SECONDS
        if has_control:
            growth, _, _ = attack(program, call, UNLIMITED, renderer, enough=MAX_MEMORY)
            controls.append(f"{name} +{mb(growth)}")
            controls_failed &= growth > MAX_MEMORY
    return [
        Result(
            ITEM,
            f"{CONNECTIONS * CALLS} unread calls use bounded memory, and another client is served",
            f"memory +{mb(MAX_MEMORY)}, +{MAX_THREADS} threads, a list of scenes within {MAX_SERVICE_SECONDS:.0f} s",
            "; ".join(measured),
            passed,
            f"with the largest budgets, {', '.join(controls)}",
            controls_failed,
        )
    ]
