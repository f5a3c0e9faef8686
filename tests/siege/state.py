"""Item 7: the state on disk survives damage, a full disk and `kill -9`."""

import contextlib
import subprocess
import tempfile
import time
from pathlib import Path

from client import NOT_SERVING, SERVING, Client, Writer, health, upload_files
from report import Result
from server import Server

ITEM = 7

OBJ = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"

# Seconds within which a step is durable.
MAX_SECONDS = 0.1

# Size of the file system that is filled.
DISK = 8 << 20


def lag(writer, seconds):
    """Sends steps for a time. Returns the longest time in seconds between the acknowledgment of a step and one that says
    that it is durable, or the end; and the newest durable step."""
    acknowledged = {}
    longest, durable = 0.0, 0
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        durable = max(durable, writer.step())
        now = time.monotonic()
        acknowledged[writer.number] = now
        for number in [number for number in acknowledged if number <= durable]:
            longest = max(longest, now - acknowledged.pop(number))
        time.sleep(0.005)
    now = time.monotonic()
    return max([longest, *(now - moment for moment in acknowledged.values())]), durable


def restart_after_damage(program, damage):
    """Names of the scenes after `kill -9`, damage and a restart, and whether the durable step of one survives."""
    with tempfile.TemporaryDirectory() as folder:
        state = Path(folder) / "state"
        with Server(program, state=folder) as server, Client(server) as client:
            client.open_scene("tree", "tree")
            upload_files(client, "sent", {"a.obj": OBJ})
            writer = Writer(client, "sent")
            _, durable = lag(writer, 1.0)
            server.process.kill()
            server.process.wait()
        damage(state)
        with Server(program, state=folder) as server, Client(server) as client:
            deadline = time.monotonic() + 30
            while (reply := client.list_reply()).opening and time.monotonic() < deadline:
                time.sleep(0.05)
            scenes = {info.scene: info for info in reply.scenes}
            survives = "sent" in scenes and scenes["sent"].last_step.number >= durable > 0
            return sorted(scenes), survives


def remove_catalog(state):
    (state / "scenes.json").unlink()


def damage_catalog(state):
    (state / "scenes.json").write_text("{")


def damage_all(state):
    """Also removes the records from which the catalog is rebuilt."""
    damage_catalog(state)
    for path in [*state.glob("sources/*"), *state.glob("uploads/*/.upload.json")]:
        path.unlink()


def use_disk(program, is_full):
    """A small disk, which is full for a time or not: the durable steps before, at the end of and after this time, the
    health of the storage at its end and afterwards, the longest time until a step was durable, and the log lines."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", folder], check=True)
        try:
            with Server(program, state=folder) as server, Client(server) as client:
                client.open_scene("tree", "tree")
                writer = Writer(client, "tree")
                lag(writer, 0.5)
                filler = Path(folder) / "filler"
                filler.touch()
                with filler.open("wb", buffering=0) as file, contextlib.suppress(OSError):
                    while is_full and file.write(bytes(4096)):
                        pass
                time.sleep(0.5)
                before = writer.step()
                longest, middle = lag(writer, 1.0)
                status = health(client, "modalcast.v1.Storage")
                lines = server.log().count("could not be written")
                filler.unlink()
                time.sleep(1.0)
                _, after = lag(writer, 1.0)
                later_status = health(client, "modalcast.v1.Storage")
                return before, max(middle, before), after, status, later_status, longest, lines
        finally:
            subprocess.run(["umount", "-l", folder], check=False)


def stands_still(before, middle, after, status, later_status):
    return before == middle < after and (status, later_status) == (NOT_SERVING, SERVING)


def run(program):
    missing, missing_steps = restart_after_damage(program, remove_catalog)
    damaged, damaged_steps = restart_after_damage(program, damage_catalog)
    control, _ = restart_after_damage(program, damage_all)
    is_step_kept = missing_steps and damaged_steps
    results = [
        Result(
            ITEM,
            "`scenes.json` is missing or damaged after `kill -9`",
            "both scenes are open again, with a step that was durable or a newer one",
            f"{', '.join(missing)}; {', '.join(damaged)}; {'no step' if is_step_kept else 'steps'} lost",
            missing == damaged == ["sent", "tree"] and is_step_kept,
            f"also without the records of the scenes: {', '.join(control) or 'none'}",
            control != ["sent", "tree"],
        )
    ]
    try:
        *full, full_longest, lines = use_disk(program, True)
        *healthy, longest, _ = use_disk(program, False)
    except (subprocess.CalledProcessError, FileNotFoundError, PermissionError):
        print("      not checked: a full disk, because this user cannot mount a file system", flush=True)
        return results
    before, middle, after, status, later_status = full
    results += [
        Result(
            ITEM,
            "a disk is full for a time",
            "the durable step stands still, Storage is NOT_SERVING, a log line per second; then it goes on",
            f"step {before}, {middle} and then {after}; health {status} and then {later_status}; {lines} lines",
            stands_still(*full) and lines <= 6,
            f"the same disk with room: step {healthy[0]}, {healthy[1]} and then {healthy[2]}",
            not stands_still(*healthy),
        ),
        Result(
            ITEM,
            "a step is durable soon after its acknowledgment",
            f"within {1e3 * MAX_SECONDS:.0f} ms",
            f"{1e3 * longest:.0f} ms at most",
            longest <= MAX_SECONDS,
            f"a full disk, {full_longest:.1f} s",
            full_longest > MAX_SECONDS,
        ),
    ]
    return results
