"""Item 5 of `prove.py`: SIGTERM ends the server in time, whatever it is doing."""

import contextlib
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import http2
from client import HEALTH_WATCH, OPEN_SCENE, RENDER_FRAME, Client, frames_pb2, scenes_pb2
from report import Result
from scenes import write_thin_arcs
from server import Server

ITEM = 5

# Limit in seconds, and time after which the check gives up.
MAX_SECONDS = 10.0
GIVE_UP = 40.0

# So many polygons that loading them takes longer than the limit.
POLYGONS = 20_000


def unread_call(server, path, request=None):
    """Opens a call of which nothing is read."""
    connection = http2.Connection(server.port)
    message = http2.grpc_message(request.SerializeToString() if request else b"")
    connection.send_data(connection.open_call(path), message, http2.END_STREAM)
    return connection


def load(server):
    """Begins to load a scene."""
    calls = [unread_call(server, OPEN_SCENE, scenes_pb2.OpenSceneRequest(source="concave.obj", scene="concave"))]
    time.sleep(1)
    return calls


def draw(server):
    """Begins to draw a large frame."""
    with Client(server) as client:
        client.open_scene("tree", "tree")
    picture = frames_pb2.Picture(width=8192, height=8192)
    request = frames_pb2.RenderFrameRequest(scene="tree", pictures=[picture], deadline_ms=600_000)
    calls = [unread_call(server, RENDER_FRAME, request)]
    time.sleep(1)
    return calls


def watch(server):
    """Opens 64 streams and reads nothing."""
    return [unread_call(server, HEALTH_WATCH) for _ in range(64)]


def send_half(server):
    """Sends a part of a message on each of 64 connections."""
    connections = [http2.Connection(server.port) for _ in range(64)]
    for connection in connections:
        connection.send_data(connection.open_call(OPEN_SCENE), http2.grpc_message(b"half", 1 << 20))
    return connections


# Name, function that creates the situation and returns the connections to close, and the renderer.
SITUATIONS = [
    ("idle", lambda server: [], "off"),
    ("load", load, "off"),
    ("large frame", draw, "software"),
    ("64 streams", watch, "off"),
    ("64 half-sent messages", send_half, "off"),
]


def terminate(program, situation, renderer, scenes):
    """Seconds from SIGTERM to the end of the server, and its exit code."""
    with Server(program, scenes=scenes, renderer=renderer) as server:
        connections = situation(server)
        seconds, code = server.terminate(GIVE_UP)
        for connection in connections:
            connection.close()
        return seconds, code


def terminate_ignoring_process():
    """Seconds that a process which ignores SIGTERM runs after the signal. The wait ends after MAX_SECONDS + 1."""
    code = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(flush=True); time.sleep(99)"
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    process.stdout.readline()
    process.send_signal(signal.SIGTERM)
    start = time.monotonic()
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(MAX_SECONDS + 1)
    process.kill()
    process.wait()
    return time.monotonic() - start


def run(program):
    measured, passed = [], True
    with tempfile.TemporaryDirectory() as folder:
        write_thin_arcs(Path(folder) / "concave.obj", POLYGONS)
        for name, situation, renderer in SITUATIONS:
            seconds, code = terminate(program, situation, renderer, folder)
            measured.append(f"{name} {seconds:.1f} s" + (f" (exit code {code})" if code else ""))
            passed &= seconds <= MAX_SECONDS and code == 0
    control = terminate_ignoring_process()
    return [
        Result(
            ITEM,
            "SIGTERM ends the server, whatever it is doing",
            f"within {MAX_SECONDS:.0f} s, exit code 0",
            ", ".join(measured),
            passed,
            f"a process that ignores SIGTERM, {control:.1f} s",
            control > MAX_SECONDS,
        )
    ]
