"""Runs the attacks, and prints for each check the requirement and the measured result."""

import argparse
import importlib
import sys
import time
from pathlib import Path

import long_tests
from report import Result

# The items: numbered subjects of promises, each with the module of its checks. An item without checks is not claimed.
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
    14: ("viewer_port", "HTTP/1.1 and WebSocket of the viewer"),
    15: (None, "fuzzing"),
    16: (None, "soak"),
}

# For items with checks, the part of the subject that is not claimed.
NOT_CLAIMED = {
    4: "frames count against the budget of replies while they wait for their first byte to be sent",
    6: "loads have a deadline and equal shares",
    9: "while no other frame is drawn, Mesa keeps the memory of the last one",
    12: "names in the errors of all loaders",
    13: "faults of CUDA in `deploy/prove`, which runs without a GPU",
    14: "hostile recordings, and enormous forces",
}


def main():
    parser = argparse.ArgumentParser(prog="deploy/prove", description="Attacks a server and checks what it promises.")
    parser.add_argument("--program", type=Path, required=True, help="the server, `modalcast`")
    parser.add_argument("--fault-program", type=Path, help="the server, built with the feature fault-injection")
    parser.add_argument("--items", type=int, nargs="*", default=sorted(ITEMS), help="numbers of the items to check")
    parser.add_argument(
        "--full", nargs="*", choices=long_tests.NAMES, help="then run the long tests of the clients, all or by name"
    )
    arguments = parser.parse_args()
    is_good = True
    for item in sorted(set(arguments.items) & set(ITEMS)):
        module, subject = ITEMS[item]
        if module is None:
            print(f"{item:2}. not claimed: {subject}", flush=True)
            continue
        programs = [arguments.program.resolve()]
        if module == "faults":
            if arguments.fault_program is None:
                print(f"{item:2}. not checked: {subject} (--fault-program)", flush=True)
                continue
            programs.append(arguments.fault_program.resolve())
        start = time.monotonic()
        results: list[Result] = importlib.import_module(module).run(*programs)
        for result in results:
            is_good &= result.is_good()
            print(result.line(), flush=True)
        if item in NOT_CLAIMED:
            print(f"    not claimed: {NOT_CLAIMED[item]}", flush=True)
        print(f"      took {time.monotonic() - start:.0f} s", flush=True)
    if arguments.full is not None:
        is_good &= long_tests.run(arguments.program.resolve(), arguments.full or long_tests.NAMES)
    sys.exit(0 if is_good else 1)


if __name__ == "__main__":
    main()
