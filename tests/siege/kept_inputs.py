"""Item 15: the files that `deploy/fuzz/run` keeps crash no program."""

import json
import tempfile
from pathlib import Path

import measured
from report import Result, mb

ITEM = 15

FUZZ = Path(__file__).resolve().parents[2] / "deploy/fuzz"
RECORD = Path(__file__).resolve().parents[1] / "bench/records/fuzz.json"

# Targets whose input is a whole model file. The tests of `cargo test` run all targets.
FORMATS = {"glb": "m.glb", "gltf": "m.gltf", "npz": "m.npz", "obj": "m.obj", "ply": "m.ply", "stl": "m.stl"}

# Files of each target; crash files are in addition.
FILES = 8

# Limits of `modalcast inspect` for one file: seconds and bytes of memory.
MAX_SECONDS = 20
MAX_MEMORY = 1 << 30

# Exit codes of a command that has read a file or refused it with the reason.
ENDED = (0, 2, 3, 4, 5)


def kept_files():
    """Pairs of the name that the file gets, and its path."""
    for target, name in FORMATS.items():
        for kind, limit in [("corpus", FILES), ("crashes", None)]:
            folder = FUZZ / kind / target
            files = sorted(folder.iterdir())[:limit] if folder.is_dir() else []
            yield from ((name, path) for path in files)


def inspect(program, name, content):
    """Reads a file with `modalcast inspect`. Returns the exit code and the largest memory in bytes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(content)
        run = measured.execute([program, "inspect", path], MAX_SECONDS)
    return run.code, run.memory


def run(program):
    count, crashes, largest = 0, [], 0
    for name, path in kept_files():
        code, memory = inspect(program, name, path.read_bytes())
        count, largest = count + 1, max(largest, memory)
        if code not in ENDED or memory > MAX_MEMORY:
            crashes.append(f"{path.parent.name}/{path.name} (code {code}, {mb(memory)})")
    with tempfile.TemporaryDirectory() as folder:
        aborting = Path(folder) / "aborts"
        aborting.write_text("#!/bin/sh\nkill -ABRT $$\n")
        aborting.chmod(0o755)
        control, _ = inspect(aborting, "m.obj", b"")
    executions = json.loads(RECORD.read_text())["executions"] if RECORD.exists() else 0
    return [
        Result(
            ITEM,
            "model files that the fuzzer keeps neither crash `modalcast inspect` nor use much memory",
            f"exit code 0 to 5, within {MAX_SECONDS} s and {mb(MAX_MEMORY)}",
            f"{count} files, at most {mb(largest)}, {len(crashes)} crashes {' '.join(crashes)}; "
            f"{executions} executions of all targets are recorded",
            count > 0 and not crashes,
            f"a program that aborts, exit code {control}",
            control not in ENDED,
        )
    ]
