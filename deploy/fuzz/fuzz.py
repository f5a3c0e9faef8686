"""Runs the fuzzers for a time per target, keeps their crashes and corpora, and adds the executions to the record."""

import argparse
import concurrent.futures
import datetime
import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
PROJECT = FOLDER.parent.parent
RECORD = PROJECT / "tests/bench/records/fuzz.json"

# The targets of each fuzzer.
FUZZERS = {
    "files": "glb gltf image manifest mtl npy npz obj plant ply safetensors skeleton sofa stl vega vega_config",
    "recordings": "recording",
    "cubic_forces": "cub",
    "steps": "step",
    "calls": "drive_scene upload_arrays upload_scene",
    "credentials": "principals websocket",
}
TARGETS = {target: fuzzer for fuzzer, targets in FUZZERS.items() for target in targets.split()}

# Bytes of the largest input. Larger ones slow the fuzzer down, and few errors need them.
MAX_INPUT = {"recording": 32768, "image": 8192}
DEFAULT_MAX_INPUT = 4096

# An input that takes more seconds, or more MB of memory, counts as a crash. An image may take 512 MiB.
MAX_SECONDS = 40
MAX_MEMORY_MB = 2048

# Files of a target, and bytes of a file, that are kept in the repository.
MAX_KEPT_FILES = 40
MAX_KEPT_BYTES = 4096


class Target:
    """One target with its program and folders."""

    def __init__(self, programs, target):
        self.target = target
        name = f"modalcast_fuzz_{TARGETS[target]}-"
        self.program = next(program for program in programs if program.name.startswith(name))
        # All inputs with new coverage, outside of the repository.
        self.work = PROJECT / "target/fuzz" / target
        self.kept = FOLDER / "corpus" / target
        self.crashes = FOLDER / "crashes" / target
        for folder in [self.work, self.kept, self.crashes]:
            folder.mkdir(parents=True, exist_ok=True)

    def start(self, *arguments, seeds=None):
        """Runs the program to its end. Returns its output."""
        environment = os.environ | {"MODALCAST_FUZZ_TARGET": self.target, "ASAN_OPTIONS": "detect_leaks=0"}
        if seeds:
            environment["MODALCAST_FUZZ_SEEDS"] = str(seeds)
        command = [str(self.program), *map(str, arguments)]
        run = subprocess.run(command, env=environment, stderr=subprocess.PIPE, text=True, errors="replace", check=False)
        return run.stderr

    def limits(self):
        size = MAX_INPUT.get(self.target, DEFAULT_MAX_INPUT)
        return [f"-timeout={MAX_SECONDS}", f"-rss_limit_mb={MAX_MEMORY_MB}", f"-max_len={size}"]

    def fuzz(self, seconds):
        """Fuzzes until the time has passed, also after crashes. Returns executions, seconds and new crashes."""
        before = set(self.crashes.iterdir())
        start, executions = time.monotonic(), 0
        while (remaining := seconds - (time.monotonic() - start)) > 0.5:
            output = self.start(
                f"-max_total_time={int(remaining) + 1}",
                *self.limits(),
                "-print_final_stats=1",
                "-use_value_profile=1",
                "-report_slow_units=1000",
                f"-artifact_prefix={self.crashes}/",
                self.work,
                self.kept,
                seeds=self.work,
            )
            counted = re.search(r"stat::number_of_executed_units:\s+(\d+)", output)
            if not counted:
                raise RuntimeError(f"{self.target}: expected the statistics of libFuzzer, got:\n{output[-3000:]}")
            executions += int(counted[1])
            if new := set(self.crashes.iterdir()) - before:
                print(output[-3000:], f"{self.target}: crash: {sorted(file.name for file in new)}", sep="\n")
                if len(new) > 3:
                    break
        return executions, time.monotonic() - start, len(set(self.crashes.iterdir()) - before)

    def keep(self):
        """Replaces the kept inputs by the smallest set of inputs with the same coverage, up to a limit."""
        chosen = self.work.parent / f"{self.target}.chosen"
        shutil.rmtree(chosen, ignore_errors=True)
        chosen.mkdir()
        self.start("-set_cover_merge=1", *self.limits(), chosen, self.work, self.kept)
        files = sorted(chosen.iterdir(), key=lambda file: (file.stat().st_size, file.name))
        files = [file for file in files if file.stat().st_size <= MAX_KEPT_BYTES]
        # Evenly from small to large ones.
        step = max(1, len(files) / MAX_KEPT_FILES)
        files = [files[int(index * step)] for index in range(min(len(files), MAX_KEPT_FILES))]
        for file in self.kept.iterdir():
            file.unlink()
        for file in files:
            shutil.copy(file, self.kept / file.name)
        shutil.rmtree(chosen)
        return len(files)


def add_to_record(runs):
    """Adds runs, by target, to the record. A run has the fields of a target in the record."""
    record = json.loads(RECORD.read_text()) if RECORD.exists() else {"targets": {}}
    for target, run in runs.items():
        entry = record["targets"].setdefault(target, {"executions": 0, "seconds": 0, "crashes_found": 0, "date": ""})
        for count in ["executions", "seconds", "crashes_found"]:
            entry[count] += run[count]
        entry["date"] = max(entry["date"], run["date"])
    record["targets"] = dict(sorted(record["targets"].items()))
    record["executions"] = sum(entry["executions"] for entry in record["targets"].values())
    RECORD.parent.mkdir(parents=True, exist_ok=True)
    RECORD.write_text(json.dumps(record, indent=2) + "\n")


def run_target(programs, name, seconds, keep):
    """Fuzzes a target. Returns the run for the record, and a sentence about it."""
    target = Target(programs, name)
    executions, elapsed, crashes = target.fuzz(seconds)
    run = {"executions": executions, "seconds": round(elapsed), "crashes_found": crashes}
    run["date"] = datetime.date.today().isoformat()
    kept = f", {target.keep()} inputs kept" if keep else ""
    return run, f"{name}: {executions} executions in {elapsed:.0f} s, {crashes} crashes{kept}"


def main():
    parser = argparse.ArgumentParser(prog="deploy/fuzz/run", description="Fuzzes what the server and its clients read.")
    parser.add_argument("--seconds", type=float, default=60, help="time per target, default 60")
    parser.add_argument("--jobs", type=int, default=1, help="targets at a time, default 1")
    parser.add_argument("--keep", action="store_true", help="replace the corpora of the repository afterwards")
    parser.add_argument("--add", metavar="RECORD", help="only add the record of another copy of the project")
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"default all: {' '.join(TARGETS)}")
    arguments = parser.parse_args()
    if arguments.add:
        add_to_record(json.loads(Path(arguments.add).read_text())["targets"])
        return
    programs = [Path(program) for program in os.environ["MODALCAST_FUZZERS"].split()]
    if unknown := set(arguments.targets) - set(TARGETS):
        parser.error(f"expected targets of {' '.join(TARGETS)}, got {' '.join(sorted(unknown))}")
    failures = 0
    with concurrent.futures.ThreadPoolExecutor(arguments.jobs) as pool:
        names = arguments.targets or list(TARGETS)
        runs = {pool.submit(run_target, programs, name, arguments.seconds, arguments.keep): name for name in names}
        for finished in concurrent.futures.as_completed(runs):
            if error := finished.exception():
                print(error, flush=True)
                failures += 1
                continue
            run, sentence = finished.result()
            add_to_record({runs[finished]: run})
            print(sentence, flush=True)
            failures += run["crashes_found"]
    sys.exit(1 if failures else 0)


if __name__ == "__main__":
    main()
