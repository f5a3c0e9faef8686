"""Item 6 of `prove.py`: slow loads of one client do not delay other clients."""

import contextlib
import tempfile
import threading
import time
from pathlib import Path

import grpc
from client import NOT_SERVING, SERVING, Client, health
from report import Result
from scenes import write_grid, write_thin_arcs
from server import Server

ITEM = 6

# The attacker opens FILES files at a time. Each has POLYGONS polygons with 256 corners.
FILES = 4
POLYGONS = 4000

# Seconds within which a small file is open for another client meanwhile.
MAX_SMALL_SECONDS = 2.0

# Seconds within which the built-in scene is open for another client, and within which one file is loaded.
MAX_SECONDS = 2.0
MAX_LOAD_SECONDS = 10.0

# Seconds after which the check gives up.
GIVE_UP = 30.0


def time_to_open(server, source, name):
    """Seconds until a scene is open for a new client, at most GIVE_UP."""
    with Client(server) as client:
        return time_to_open_for(client, source, name)


def time_to_open_for(client, source, name):
    start = time.monotonic()
    with contextlib.suppress(grpc.RpcError):
        client.open_scene(source, name, timeout=GIVE_UP)
    return time.monotonic() - start


def restart(program, folder):
    """Restarts a server with open scenes.

    Returns the seconds until it answers, whether its health is SERVING while that of the scenes is NOT_SERVING until
    all are open, and the seconds until all scenes are open.
    """
    with tempfile.TemporaryDirectory() as state:
        with Server(program, scenes=folder, state=state) as server:
            time_to_open(server, "tree", "tree")
            for number in range(FILES):
                time_to_open(server, f"arcs-{number}.obj", f"arcs-{number}")
        start = time.monotonic()
        with Server(program, scenes=folder, state=state) as server, Client(server) as client:
            opening = len(client.list_reply().opening)
            answered = time.monotonic() - start
            is_reported = opening > 0 and health(client, "modalcast.v1.Scenes") == NOT_SERVING
            is_reported &= health(client, "") == SERVING
            while len(client.list_scenes()) <= FILES and time.monotonic() < start + 2 * GIVE_UP:
                time.sleep(0.05)
            opened = time.monotonic() - start
            return answered, is_reported and health(client, "modalcast.v1.Scenes") == SERVING, opened


def run(program):
    with tempfile.TemporaryDirectory() as folder:
        for number in range(FILES):
            write_thin_arcs(Path(folder) / f"arcs-{number}.obj", POLYGONS)
        write_grid(Path(folder) / "grid.obj", 2)
        with Server(program, scenes=folder) as server, Client(server) as attacker:
            threads = [
                threading.Thread(target=time_to_open_for, args=[attacker, f"arcs-{number}.obj", f"arcs-{number}"])
                for number in range(FILES)
            ]
            start = time.monotonic()
            for thread in threads:
                thread.start()
            time.sleep(0.3)
            built_in = time_to_open(server, "tree", "tree")
            small = time_to_open(server, "grid.obj", "grid")
            is_loading = [thread.is_alive() for thread in threads].count(True)
            for thread in threads:
                thread.join()
            all_files = time.monotonic() - start
        with Server(program, scenes=folder) as server:
            load = time_to_open(server, "arcs-0.obj", "arcs-0")
        answered, is_reported, opened = restart(program, folder)
    return [
        Result(
            ITEM,
            f"loads of {FILES} files with {POLYGONS} concave polygons do not delay the built-in scene",
            f"within {MAX_SECONDS:.0f} s; one file within {MAX_LOAD_SECONDS:.0f} s",
            f"built-in scene {built_in:.2f} s, one file {load:.1f} s",
            built_in <= MAX_SECONDS and load <= MAX_LOAD_SECONDS,
            f"opening the {FILES} files takes longer than the limit: {all_files:.1f} s",
            all_files > MAX_SECONDS,
        ),
        Result(
            ITEM,
            f"loads of {FILES} files of one client do not delay a small file of another one",
            f"within {MAX_SMALL_SECONDS:.0f} s, while the files are loaded",
            f"{small:.2f} s, while {is_loading} files were loaded",
            small <= MAX_SMALL_SECONDS and is_loading > 0,
            f"opening the {FILES} files takes longer than the limit: {all_files:.1f} s",
            all_files > MAX_SMALL_SECONDS,
        ),
        Result(
            ITEM,
            f"a server that has {FILES} such scenes is started again",
            f"answers within {MAX_SECONDS:.0f} s, and its health tells when all scenes are open",
            f"{answered:.2f} s, {'told' if is_reported else 'not told'}",
            answered <= MAX_SECONDS and is_reported,
            f"opening all scenes takes longer than the limit: {opened:.1f} s",
            opened > MAX_SECONDS,
        ),
    ]
