"""Commands with their run time and their memory.

A process counts the memory of its parent as its own until it executes another program. Therefore a small process, this
file as a program, starts the command: the memory of the attack program, hundreds of MB, would hide that of the command."""

import dataclasses
import json
import resource
import signal
import subprocess
import sys
import tempfile
import time


@dataclasses.dataclass
class Run:
    """Attributes:
    code: The exit code, or the negated number of the signal that ended the command.
    seconds: The run time.
    memory: The largest resident memory in bytes.
    error: The text on standard error.
    """

    code: int
    seconds: float
    memory: int
    error: str


def execute(command, max_seconds):
    """Runs a command, which is ended by SIGABRT after `max_seconds`."""
    measuring = [sys.executable, "-S", __file__, str(max_seconds), *map(str, command)]
    with tempfile.TemporaryFile() as errors:
        result = subprocess.run(measuring, stdout=subprocess.PIPE, stderr=errors, check=True)
        errors.seek(0)
        return Run(**json.loads(result.stdout), error=errors.read().decode(errors="replace"))


def main():
    start = time.monotonic()
    process = subprocess.Popen(sys.argv[2:], stdout=subprocess.DEVNULL)
    try:
        process.wait(float(sys.argv[1]))
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGABRT)
        process.wait()
    memory = 1024 * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    print(json.dumps({"code": process.returncode, "seconds": time.monotonic() - start, "memory": memory}))


if __name__ == "__main__":
    main()
