"""Item 12 of `prove.py`: floods of control frames end their connection, errors name no file, and logs stay short."""

import hashlib
import re
import struct
import time

import grpc
import http2
import swarm
import transforms
from client import Client, common_pb2, scenes_pb2, steps_pb2, time_to_serve
from report import Result, mb
from server import Peak, Server

ITEM = 12

# Each flood sends FLOOD frames. A connection of the negative control sends FEW frames and must stay open.
FLOOD = 100_000
FEW = 1000

# Limits during a flood: growth of the memory in bytes, and seconds until a new client is served.
MAX_MEMORY = 32 << 20
MAX_SERVICE_SECONDS = 1.0

FRAMES = [
    ("PING", http2.frame(http2.PING, payload=bytes(8))),
    ("SETTINGS", http2.frame(http2.SETTINGS)),
    ("PRIORITY", http2.frame(http2.PRIORITY, 0, 1, struct.pack(">IB", 0, 1))),
    ("WINDOW_UPDATE", http2.window_update(0, 1)),
    ("unknown type", http2.frame(99, payload=bytes(8))),
]


def flood(connection, frame, count):
    """Sends a frame many times and reads the answers. Returns whether the connection ends."""
    try:
        batch = frame * 500
        for _ in range(count // 500):
            connection.send(batch)
            _, is_open = connection.receive(0.0005)
            if not is_open:
                return True
        return not connection.receive(0.5)[1]
    except OSError:
        return True
    finally:
        connection.close()


def check_floods(item, promise, server, frames, connect):
    """Floods a server with each of the named frames, on connections that `connect` opens for a frame."""
    measured, passed = [], True
    time_to_serve(server, 10)
    memory = Peak(server.memory)
    for name, frame in frames:
        is_closed = flood(connect(frame), frame, FLOOD)
        seconds = time_to_serve(server, 5)
        memory.sample()
        passed &= is_closed and seconds <= MAX_SERVICE_SECONDS
        measured.append(f"{name} {'closed' if is_closed else 'OPEN'}")
    growth = memory.growth()
    passed &= growth <= MAX_MEMORY
    is_control_closed = any([flood(connect(frame), frame, FEW) for _, frame in frames])
    return Result(
        item,
        promise,
        f"closed before {FLOOD} frames, memory +{mb(MAX_MEMORY)}",
        ", ".join(measured) + f"; +{mb(growth)}",
        passed,
        f"{FEW} frames of each kind, {'closed' if is_control_closed else 'open'}",
        not is_control_closed,
    )


def control_frames(program):
    promise = "floods of control frames end their connection"
    with Server(program) as server:
        return check_floods(ITEM, promise, server, FRAMES, lambda _: http2.Connection(server.port))


def collect_errors(server):
    """The texts of errors that clients can cause."""
    texts = []

    def attempt(call):
        try:
            for _ in call() or []:
                pass
        except grpc.RpcError as error:
            details = [
                value.decode("utf8", "replace") for _, value in error.trailing_metadata() if type(value) is bytes
            ]
            texts.append(" ".join([error.details(), *details]))

    with Client(server) as client:
        for source in ["../secret", "/etc/passwd", "missing.obj", "x" * 10_000, "a\0b", ".."]:
            attempt(lambda source=source: client.open_scene(source) and None)
        client.open_scene("tree", "taken")
        attempt(lambda: client.open_scene("missing.obj", "taken") and None)
        for name, content in [
            ("broken.obj", b"f 1 2 3\n"),
            ("broken.glb", b"glTF" + bytes(8)),
            ("broken.ply", b"ply\n"),
            ("scene.toml", b"[[model]]\nfile = '../../x'\n"),
            ("material.obj", b"mtllib ../../../etc/passwd\nv 0 0 0\n"),
            ("modes.npy", b"\x93NUMPY"),
        ]:
            attempt(lambda name=name, content=content: upload(client, name, content) and None)
        # Another client has the writer lease of the scene.
        with Client(server) as other:
            writer = other.steps.DriveScene(drive_requests("taken"))
            next(writer)
            attempt(lambda: client.steps.DriveScene(drive_requests("taken", keeps_open=False)))
            writer.cancel()
    return texts


def drive_requests(scene, keeps_open=True):
    """Asks for the writer lease of a scene. Keeps the stream open for 3 s, or ends it immediately."""
    yield steps_pb2.DriveSceneRequest(open=steps_pb2.OpenDrive(scene=scene, delivery=common_pb2.DELIVERY_LOSSLESS))
    if keeps_open:
        time.sleep(3)


def upload(client, name, content):
    header = scenes_pb2.UploadHeader(scene=f"upload-{name}", entry=name, files=1, total_bytes=len(content))
    file = scenes_pb2.UploadFile(path=name, bytes=len(content), sha256=hashlib.sha256(content).digest())
    parts = [{"header": header}, {"file": file}, {"chunk": content}]
    client.scenes.UploadScene(iter([scenes_pb2.UploadSceneRequest(**part) for part in parts]), timeout=20)


def find_private_names(text, server):
    """The names of the state folder and its files, and the addresses of clients, that a text contains."""
    names = [str(server.state), server.folder.name, "uploads/", "steps/", "scenes.json"]
    return [name for name in names if name in text] + re.findall(r"127\.0\.0\.1:\d+", text)


def error_texts(program):
    with Server(program) as server:
        texts = collect_errors(server)
        found = sorted({name for text in texts for name in find_private_names(text, server)})
        control_result = find_private_names(f"{server.state}/uploads/1/a.obj of 127.0.0.1:4711", server)
    return Result(
        ITEM,
        "errors name no file of the state folder and no address of a client",
        "none of these names in any error",
        f"{len(texts)} errors, " + (f"names: {found}" if found else "none of these names"),
        # Fewer texts would mean that calls with invalid input succeed.
        not found and len(texts) >= 12,
        f"a text with such names, {len(control_result)} found",
        bool(control_result),
    )


# Frequent records of one kind are written 20 times at once, and then once per second for the few seconds of the attack.
MAX_RECORDS = 35


def count_records(log):
    return sum("without calls is closed" in line for line in log.splitlines())


def log_records(program):
    with Server(program, "--connections", "16") as server:
        # Every new connection closes an older one, of which the server writes a record.
        with swarm.Swarm(server.port, 64, b"P", answers=False) as attackers:
            opened = attackers.wait_until_open(3000, 10)
        records = count_records(server.log())
    control_result = count_records("WARN a connection without calls is closed for a new one\n" * opened)
    return Result(
        ITEM,
        "the log has one record per second of a frequent event",
        f"at most {MAX_RECORDS} records",
        f"{records} records of {opened} connections",
        0 < records <= MAX_RECORDS < opened,
        f"a log with one record per connection, {control_result} records",
        control_result > MAX_RECORDS,
    )


def run(program):
    return [control_frames(program), error_texts(program), log_records(program), transforms.run(program)]
