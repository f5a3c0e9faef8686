"""The long tests of the clients: programs that `deploy/prove --full` runs after the attacks."""

import dataclasses
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LOGS = ROOT / "target" / "prove"


@dataclasses.dataclass(frozen=True)
class LongTest:
    """A program that tests a client, and ends with another exit code than 0 if a test fails.

    Attributes:
        name: Selects the test on the command line, and is the name of its log in `target/prove`.
        subject: What is tested.
        command: Runs in the root folder. `{programs}` is the folder of the programs of this build, and `{out}` an empty
            folder. The environment has MODALCAST_PROGRAM, the server, and MODALCAST_PROGRAMS, the folder.
        minutes: The time limit. A program that exceeds it fails.
    """

    name: str
    subject: str
    command: tuple[str, ...]
    minutes: int


LONG_TESTS = (
    LongTest(
        "python",
        "Python client: all tests and examples with the newest Python; 100 reconnects, a server that dies, cancellation",
        (".tools/newest-python/bin/pytest", "clients/python", "-m", "long or not long", "-rs"),
        30,
    ),
    LongTest(
        "wheels",
        "wheel in an empty environment: the first picture, `modalcast serve`",
        ("deploy/wheels", "--programs", "{programs}", "--out", "{out}"),
        10,
    ),
    LongTest(
        "soak",
        "16 clients that come, go and are killed for 30 minutes leave nothing behind; a planted leak is found",
        (".tools/siege/venv/bin/python", "tests/siege/soak.py", "--program", "{programs}/modalcast", "--prove"),
        45,
    ),
    LongTest(
        "stall",
        "R7: a device that stalls for 30 s ends no connection and no stream in 1,000,000 messages",
        (".tools/siege/venv/bin/python", "tests/siege/stalls.py", "--program", "{programs}/modalcast"),
        10,
    ),
    LongTest(
        "viewer",
        "browser viewer: ten minutes of use without growth of memory, 100 reconnects, a server that is killed",
        ("deploy/web", "--programs", "{programs}", "--long"),
        60,
    ),
)

NAMES = [test.name for test in LONG_TESTS]

# The programs that a control replaces.
PROGRAMS = ("modalcast", "modalcast-sim", "modalcast-fetch", "modalcast-record", "modalcast-modes")


def execute(test, programs, log):
    """Runs a test with the programs of a folder. Returns whether it passed, and the last line of its output."""
    with tempfile.TemporaryDirectory(prefix="modalcast-prove-") as out, log.open("w+b") as output:
        command = [part.format(programs=programs, out=out) for part in test.command]
        environment = os.environ | {
            "MODALCAST_PROGRAM": str(programs / "modalcast"),
            "MODALCAST_PROGRAMS": str(programs),
        }
        process = subprocess.Popen(
            command, cwd=ROOT, env=environment, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
        )
        try:
            code = process.wait(60 * test.minutes)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            return False, f"no end within {test.minutes} minutes"
        output.seek(0)
        lines = [line for line in output.read().decode(errors="replace").splitlines() if line.strip()]
        # Without the colors of a terminal.
        last = re.sub(r"\x1b\[[0-9;]*m", "", lines[-1]) if lines else "no output"
        return code == 0, last


@dataclasses.dataclass
class LongResult:
    """How a long test ended. `reached` is the last line of its output."""

    name: str
    subject: str
    passed: bool
    reached: str
    seconds: int
    control_failed: bool

    def is_good(self):
        return self.passed and self.control_failed

    def line(self):
        control = "fails, as it must" if self.control_failed else "PASSES, so the test proves nothing"
        return (
            f"    {'pass' if self.passed else 'FAIL'}  {self.subject}\n"
            f"      reached: {self.reached}, in {self.seconds} s ({LOGS.relative_to(ROOT)}/{self.name}.log)\n"
            f"      control: programs that do nothing: {control}"
        )


def run(program, names):
    """Runs long tests with the programs beside `program`. Each runs a second time with programs that do nothing, as a
    negative control. Yields the results."""
    LOGS.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="modalcast-prove-") as folder:
        useless = Path(folder)
        for name in PROGRAMS:
            shutil.copy(shutil.which("false"), useless / name)
        for test in (test for test in LONG_TESTS if test.name in names):
            start = time.monotonic()
            passed, last = execute(test, program.parent, LOGS / f"{test.name}.log")
            seconds = round(time.monotonic() - start)
            control_passed, _ = execute(test, useless, LOGS / f"{test.name}-control.log")
            yield LongResult(test.name, test.subject, passed, last, seconds, not control_passed)
