"""Item 11: one client cannot take all places for scenes and uploads, and the built-in scene always has one."""

import contextlib
import hashlib
import tempfile
import threading
import time
from pathlib import Path

import grpc
from client import Client, bearer, scenes_pb2, upload_files
from report import Result
from scenes import write_grid
from server import Server

ITEM = 11

# Limit on scenes, and connections of the attacker that open as many as they can.
SCENES = 16
ATTACKERS = 2

# Each of the UPLOADERS connections of the attacker begins UPLOADS uploads and sends CHUNK bytes of each per second, which
# is just above the lowest rate.
UPLOADERS = 4
UPLOADS = 12
CHUNK = 34 << 10

# The limit on uploads in progress.
MAX_UPLOADS = 32

# Clients that upload a scene meanwhile, one after another, and the seconds within which each must have it open.
NEW_CLIENTS = 5
MAX_SECONDS = 2.0


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


class SlowUpload(threading.Thread):
    """An upload that goes on until `stop` is set. `code` is its status at its end."""

    def __init__(self, client, name, stop):
        super().__init__(daemon=True)
        self.client, self.name_of_scene, self.stop, self.code = client, name, stop, None
        self.start()

    def parts(self):
        header = scenes_pb2.UploadHeader(scene=self.name_of_scene, files=1, total_bytes=1 << 30)
        yield scenes_pb2.UploadSceneRequest(header=header)
        file = scenes_pb2.UploadFile(path="a.obj", bytes=1 << 30, sha256=bytes(32))
        yield scenes_pb2.UploadSceneRequest(file=file)
        while not self.stop.wait(1):
            yield scenes_pb2.UploadSceneRequest(chunk=bytes(CHUNK))

    def run(self):
        try:
            self.client.scenes.UploadScene(self.parts(), timeout=120)
        except grpc.RpcError as error:
            self.code = error.code()


def upload_grid(server, name, grid):
    """Seconds in which a new client uploads a scene and has it open. None if it is refused."""
    start = time.monotonic()
    with Client(server) as client:
        try:
            upload_files(client, name, {"grid.obj": grid})
        except grpc.RpcError:
            return None
    return time.monotonic() - start


def attack_uploads(program):
    """The seconds of each new client, the number of slow uploads that go on beside them, and how many of `MAX_UPLOADS` more of
    an attacker are refused."""
    stop = threading.Event()
    with tempfile.TemporaryDirectory() as folder:
        write_grid(Path(folder) / "grid.obj", 40)
        grid = (Path(folder) / "grid.obj").read_bytes()
    with Server(program) as server, contextlib.ExitStack() as stack:
        attackers = [stack.enter_context(Client(server)) for _ in range(UPLOADERS)]
        uploads = [
            SlowUpload(attacker, f"a{index}-{number}", stop)
            for index, attacker in enumerate(attackers)
            for number in range(UPLOADS)
        ]
        time.sleep(3)
        seconds = [upload_grid(server, f"b{number}", grid) for number in range(NEW_CLIENTS)]
        going_on = sum(upload.is_alive() for upload in uploads)
        more = [SlowUpload(attackers[0], f"a-{number}", stop) for number in range(MAX_UPLOADS)]
        time.sleep(2)
        refused = [upload.code for upload in more].count(grpc.StatusCode.RESOURCE_EXHAUSTED)
        stop.set()
        for upload in uploads + more:
            upload.join()
        return seconds, going_on, refused


def write_principals(path):
    """Writes a file with the principals `anna` and `ben`, whose tokens are their names."""
    entries = []
    for name in ["anna", "ben"]:
        token = hashlib.sha256(name.encode()).hexdigest()
        entries.append(f"[[principal]]\nname = '{name}'\nrole = 'upload'\n[[principal.token]]\nsha256 = '{token}'\n")
    path.write_text("".join(entries))
    path.chmod(0o600)


def attack_storage(program, flags):
    """Anna uploads scenes on new connections until she is refused. The number of her scenes, the status of one more of
    hers, and of a first one of Ben."""
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        write_grid(folder / "grid.obj", 40)
        write_principals(folder / "principals.toml")
        files = {"grid.obj": (folder / "grid.obj").read_bytes()}
        # One file is a twentieth of the limit.
        flags = [flag.format(bytes=20 * len(files["grid.obj"])) for flag in flags]
        flags += ["--principals", str(folder / "principals.toml"), "--open-scenes", "64"]

        def upload(server, principal, name):
            with Client(server) as client:
                try:
                    upload_files(client, name, files, metadata=bearer(principal))
                except grpc.RpcError as error:
                    return error.code()
            return grpc.StatusCode.OK

        with Server(program, *flags, authentication=()) as server:
            count = 0
            while count < 40 and upload(server, "anna", f"a{count}") == grpc.StatusCode.OK:
                count += 1
            return count, upload(server, "anna", "a"), upload(server, "ben", "b")


def storage_result(program, resource, flags):
    count, more, of_other = attack_storage(program, flags)
    return Result(
        ITEM,
        f"a principal uploads scenes on new connections until it is refused, for lack of {resource}",
        "another principal can upload a scene",
        f"{count} uploaded, the other principal: {of_other.name}",
        of_other == grpc.StatusCode.OK,
        f"one more scene of the first: {more.name}",
        count > 0 and more == grpc.StatusCode.RESOURCE_EXHAUSTED,
    )


def run(program):
    opened, is_admitted, refusal, has_tree = attack_scenes(program)
    seconds, going_on, refused = attack_uploads(program)
    admitted = [time for time in seconds if time is not None]
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
            f"{UPLOADERS} connections begin {UPLOADS} uploads each, and send {CHUNK >> 10} KiB of each per second",
            f"each of {NEW_CLIENTS} new clients has its upload open within {MAX_SECONDS:.0f} s",
            f"{len(admitted)} admitted, within {max(admitted, default=0):.2f} s; {going_on} slow uploads go on",
            len(admitted) == NEW_CLIENTS and max(admitted) <= MAX_SECONDS,
            f"{MAX_UPLOADS} more uploads of an attacker: {refused} refused",
            refused > 0,
        ),
        storage_result(program, "space on disk", ["--stored-bytes", "{bytes}"]),
        storage_result(program, "memory", ["--scenes-host-bytes", "8000000", "--scene-host-bytes", "4000000"]),
    ]
