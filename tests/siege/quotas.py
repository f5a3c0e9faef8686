"""Item 11: one client cannot take all places for scenes and uploads, and the built-in scene always has one."""

import contextlib
import tempfile
import threading
import time
from pathlib import Path

import grpc
from client import Client, scenes_pb2
from report import Result
from scenes import write_grid
from server import Server

ITEM = 11

# Limit on scenes, and connections of the attacker that open as many as they can.
SCENES = 16
ATTACKERS = 2

# Connections of the attacker that begin uploads without an end.
UPLOADS = 16


def try_to_open(client, source, name):
    try:
        client.open_scene(source, name)
    except grpc.RpcError as error:
        return error.code()
    return grpc.StatusCode.OK


def attack_scenes(program):
    """Scenes that the attackers open, whether another client has one, whether one more of an attacker is refused, and
    whether `tree` opens at the end."""
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        write_grid(Path(folder) / "grid.obj", 2)
        server = stack.enter_context(Server(program, "--open-scenes", str(SCENES), scenes=folder))
        *attackers, client = [stack.enter_context(Client(server)) for _ in range(ATTACKERS + 1)]
        opened = [
            try_to_open(attacker, "grid.obj", f"a{index}-{number}")
            for index, attacker in enumerate(attackers)
            for number in range(SCENES)
        ].count(grpc.StatusCode.OK)
        is_admitted = try_to_open(client, "grid.obj", "b0") == grpc.StatusCode.OK
        refusal = try_to_open(attackers[0], "grid.obj", "a")
        return opened, is_admitted, refusal, try_to_open(client, "tree", "tree") == grpc.StatusCode.OK


def begin_upload(client, name, stop):
    """Begins an upload, and sends nothing more until `stop` is set. Returns the status code."""

    def parts():
        header = scenes_pb2.UploadHeader(scene=name, files=1, total_bytes=10)
        yield scenes_pb2.UploadSceneRequest(header=header)
        stop.wait()

    try:
        client.scenes.UploadScene(parts(), timeout=60)
    except grpc.RpcError as error:
        return error.code()
    return grpc.StatusCode.OK


def attack_uploads(program, connections):
    """Whether a client can upload while the attacker has begun `UPLOADS` uploads on so many connections."""
    stop = threading.Event()
    with Server(program) as server, Client(server) as client:
        attackers = [Client(server) for _ in range(connections)]
        threads = [
            threading.Thread(target=begin_upload, args=[attackers[number % connections], f"a{number}", stop])
            for number in range(UPLOADS)
        ]
        for thread in threads:
            thread.start()
        time.sleep(2)
        # A rejected upload ends at once. An admitted one waits until `stop` is set, and then lacks its file.
        answers = []
        upload = threading.Thread(target=lambda: answers.append(begin_upload(client, "b", stop)))
        upload.start()
        upload.join(2)
        is_admitted = upload.is_alive()
        stop.set()
        upload.join()
        for thread in threads:
            thread.join()
        for attacker in attackers:
            attacker.channel.close()
        return is_admitted


def run(program):
    opened, is_admitted, refusal, has_tree = attack_scenes(program)
    is_upload_admitted = attack_uploads(program, 1)
    control_upload_admitted = attack_uploads(program, 4)
    return [
        Result(
            ITEM,
            f"{ATTACKERS} connections open as many of {SCENES} scenes as they can",
            "another client is admitted, and `tree` opens in any case",
            f"{opened} opened, {'admitted' if is_admitted else 'rejected'}, {'opened' if has_tree else 'rejected'}",
            is_admitted and has_tree,
            f"one more scene of an attacker: {refusal.name}",
            refusal == grpc.StatusCode.RESOURCE_EXHAUSTED,
        ),
        Result(
            ITEM,
            f"{UPLOADS} uploads of one connection begin and do not go on",
            "another client can upload",
            "admitted" if is_upload_admitted else "rejected",
            is_upload_admitted,
            f"the same from four connections: {'admitted' if control_upload_admitted else 'rejected'}",
            not control_upload_admitted,
        ),
    ]
