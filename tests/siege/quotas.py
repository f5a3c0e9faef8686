"""Item 11: one client cannot take all places for scenes and uploads, and the built-in scene always has one."""

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

# Limit on scenes, of all clients and of one.
SCENES = 4
CLIENT_SCENES = 2

# Connections of the attacker that begin uploads without an end.
UPLOADS = 16


def try_to_open(client, source, name):
    try:
        client.open_scene(source, name)
    except grpc.RpcError as error:
        return error.code()
    return grpc.StatusCode.OK


def attack_scenes(program, client_scenes):
    """Scenes that one connection opens, whether another client has a place, and whether `tree` opens at the end."""
    with tempfile.TemporaryDirectory() as folder:
        write_grid(Path(folder) / "grid.obj", 2)
        flags = ["--open-scenes", str(SCENES), "--client-scenes", str(client_scenes)]
        with Server(program, *flags, scenes=folder) as server, Client(server) as attacker, Client(server) as client:
            opened = sum(
                try_to_open(attacker, "grid.obj", f"a{number}") == grpc.StatusCode.OK for number in range(2 * SCENES)
            )
            is_admitted = try_to_open(client, "grid.obj", "b0") == grpc.StatusCode.OK
            for number in range(SCENES):
                try_to_open(client, "grid.obj", f"b{number}")
            return opened, is_admitted, try_to_open(client, "tree", "tree") == grpc.StatusCode.OK


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
    opened, is_admitted, has_tree = attack_scenes(program, CLIENT_SCENES)
    control_opened, control_admitted, _ = attack_scenes(program, SCENES)
    is_upload_admitted = attack_uploads(program, 1)
    control_upload_admitted = attack_uploads(program, 4)
    return [
        Result(
            ITEM,
            f"one connection opens scenes until {SCENES} places are taken",
            f"at most {CLIENT_SCENES}, another client is admitted, and `tree` opens when all places are taken",
            f"{opened}, {'admitted' if is_admitted else 'rejected'}, {'opened' if has_tree else 'rejected'}",
            opened == CLIENT_SCENES and is_admitted and has_tree,
            f"without a limit of one client: {control_opened}, {'admitted' if control_admitted else 'rejected'}",
            control_opened == SCENES and not control_admitted,
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
