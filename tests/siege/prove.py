"""Runs the attacks, and prints for each check the requirement and the measured result."""

import argparse
import dataclasses
import datetime
import importlib
import json
import os
import shlex
import shutil
import sys
import time
from pathlib import Path

import long_tests
from report import Result

# The items: numbered subjects of promises, each with the modules of its checks. `None`: a long test checks it.
ITEMS = {
    1: ("connections", "connections without a request"),
    2: ("messages", "half-sent messages"),
    3: ("memory", "budgets of memory per scene and in total, reserved before decoding"),
    4: ("replies", "unread replies"),
    5: ("shutdown", "SIGTERM ends the server within 10 s"),
    6: ("loads", "slow loads do not block other clients or the start"),
    7: ("state", "the state on disk survives damage and full disks"),
    8: ("frames", "a large frame does not delay other clients"),
    9: ("renderer_memory", "the renderer gives memory back"),
    10: ("small_steps", "unread replies to steps"),
    11: ("quotas", "one client does not take all places"),
    12: ("floods", "floods of control frames, log records, names in errors"),
    13: ("faults", "panics, endless kernels and lost devices"),
    14: ("viewer_port recordings forces", "the viewer's port, recordings and forces"),
    15: ("kept_inputs", "fuzzing"),
    16: (None, "soak: 16 clients that come and go"),
    17: ("credentials", "callers without a credential, and guessed tokens"),
    18: ("stall_budget", "readers that do not read stop a writer only within its stall budget"),
    19: ("shares", "one client does not take all streams and requests of a scene"),
}

# For items with checks, the part of the subject that is not claimed.
NOT_CLAIMED = {
    4: "frames count against the budget of replies while they wait for their first byte to be sent",
    6: "loads have a deadline",
    9: "while no other frame is drawn, Mesa keeps the memory of the last one",
    12: "names in the errors of all loaders",
    13: "faults of CUDA here, without a GPU; tests/gpu/faults.rs plans them on one",
    14: "hostile recordings that a page opens in the browser",
    15: "messages of WebSockets; 10^8 executions, and coverage of 90 % of the lines of the loaders",
}

# The rows R of the promises of a robust server: what each promises, and the item that checks it or a part of it, or the
# name of the long test that checks it. Rows with neither are not claimed.
ROWS = {
    1: ("messages above the size limit are refused at the exact boundary", None),
    2: ("a compressed message that expands to 512 MiB is refused", None),
    3: ("claimed lengths of messages reserve at most 1 GiB of address space", 2),
    4: ("limits on connections and streams; others are served meanwhile", 1),
    5: ("floods of resets and control frames end their connection", 12),
    6: ("slow handshakes do not lock out others", 1),
    7: ("a stall of 30 s ends no connection in 1,000,000 small messages", "stall"),
    8: ("an unread stream delays no other stream of its connection", None),
    9: ("a slow viewer is isolated, bounded and never stale", None),
    10: ("frames never mix the values of two steps in 1,000,000 steps", None),
    11: ("every call ends within 50 ms after its deadline", None),
    12: ("1,000 clients that are killed during a step leave nothing", None),
    13: ("half-open connections are closed after 15 s", None),
    14: ("SIGTERM ends the server within 10 s", 5),
    15: ("a scene is replaced 1,000 times without a failed frame", None),
    16: ("a panic costs one call", 13),
    17: ("a fault of the GPU is contained", 13),
    18: ("budget of GPU memory", 3),
    19: ("no growth in long runs", "soak"),
    20: ("loaders never crash", 15),
    21: ("paths are confined, and errors name no private path", 12),
    22: ("numbers that are not finite are refused", 12),
    23: ("all interleavings of the concurrent parts", None),
    24: ("10,000 simulated network faults", None),
    25: ("CUDA kernels are clean under compute-sanitizer", None),
    26: ("interoperation with other gRPC implementations", None),
    27: ("authentication and exposure", 17),
    28: ("shared memory is safe", None),
    29: ("no dependency below a version with a known weakness", None),
    30: ("no slow-down", None),
    31: ("restart and failover behind a proxy", None),
}


def main():
    parser = argparse.ArgumentParser(prog="deploy/prove", description="Attacks a server and checks what it promises.")
    parser.add_argument("--program", type=Path, required=True, help="the server, `modalcast`")
    parser.add_argument("--fault-program", type=Path, help="the server, built with the feature fault-injection")
    parser.add_argument("--items", type=int, nargs="*", default=sorted(ITEMS), help="numbers of the items to check")
    parser.add_argument(
        "--full", nargs="*", choices=long_tests.NAMES, help="then run the long tests of the clients, all or by name"
    )
    parser.add_argument("--record", type=Path, help="also writes all results to this JSON file")
    arguments = parser.parse_args()
    results = []
    for item in sorted(set(arguments.items) & set(ITEMS)):
        modules, subject = ITEMS[item]
        if modules is None:
            print(f"{item:2}. {'not checked' if arguments.full is None else 'below'}: {subject} (--full)", flush=True)
            continue
        programs = [arguments.program.resolve()]
        if modules == "faults":
            if arguments.fault_program is None:
                print(f"{item:2}. not checked: {subject} (--fault-program)", flush=True)
                continue
            programs.append(arguments.fault_program.resolve())
        start = time.monotonic()
        for module in modules.split():
            checks: list[Result] = importlib.import_module(module).run(*programs)
            for result in checks:
                print(result.line(), flush=True)
            results += checks
        if item in NOT_CLAIMED:
            print(f"    not claimed: {NOT_CLAIMED[item]}", flush=True)
        print(f"      took {time.monotonic() - start:.0f} s", flush=True)
    print_rows()
    if arguments.full is not None:
        for result in long_tests.run(arguments.program.resolve(), arguments.full or long_tests.NAMES):
            print(result.line(), flush=True)
            results.append(result)
    if arguments.record:
        write_record(arguments, results)
    sys.exit(0 if all(result.is_good() for result in results) else 1)


def write_record(arguments, results):
    command = ["deploy/prove"]
    if arguments.items != sorted(ITEMS):
        command += ["--items", *map(str, arguments.items)]
    if arguments.full is not None:
        command += ["--full", *arguments.full]
    gpu = "" if shutil.which("nvidia-smi") else ", no GPU"
    record = {
        "what": "the promises of the server and what attacks measured",
        "command": shlex.join(command),
        "machine": f"{os.cpu_count()} cores{gpu}",
        "commit": os.environ.get("MODALCAST_COMMIT", ""),
        "date": datetime.date.today().isoformat(),
        "results": [dataclasses.asdict(result) for result in results],
    }
    arguments.record.write_text(json.dumps(record, indent=1) + "\n")


def print_rows():
    for row, (promise, check) in ROWS.items():
        if check is None:
            claim = "not claimed"
        elif isinstance(check, int):
            claim = f"in part by item {check}"
        else:
            claim = f"by --full {check}"
        print(f"R{row:<2} {claim}: {promise}", flush=True)


if __name__ == "__main__":
    main()
