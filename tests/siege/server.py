"""A server process under test, and its resources."""

import os
import resource
import signal
import subprocess
import tempfile
import time
from pathlib import Path

# Enough for all sockets of the largest attack.
resource.setrlimit(resource.RLIMIT_NOFILE, (resource.getrlimit(resource.RLIMIT_NOFILE)[1],) * 2)


class Server:
    """`modalcast serve` on a free port, with a state folder in a new folder or in `state`, with additional variables in
    its environment, and with a limit on its address space in bytes. The end of the `with` block kills it."""

    def __init__(
        self,
        program,
        *flags,
        scenes=None,
        backend="cpu",
        renderer="off",
        state=None,
        environment=None,
        address_space=resource.RLIM_INFINITY,
        # Most attackers are programs of the owner, against whom credentials do not protect.
        authentication=("--no-auth",),
    ):
        self.folder = tempfile.TemporaryDirectory(prefix="modalcast-siege-")
        self.state = Path(state or self.folder.name) / "state"
        self.log_path = Path(self.folder.name) / "log"
        command = [str(program), "serve", *authentication, "--listen", "127.0.0.1:0", "--backend", backend]
        command += ["--renderer", renderer, "--state", str(self.state)]
        command += ["--scenes", str(scenes)] if scenes else []
        self.process = subprocess.Popen(
            [*command, *flags],
            stdout=subprocess.PIPE,
            stderr=self.log_path.open("w"),
            text=True,
            env=os.environ | (environment or {}),
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (address_space, address_space)),
        )
        line = self.process.stdout.readline()
        if not line.startswith("listening on http://"):
            raise RuntimeError(f"expected the address of the server, got {line!r}: {self.log()}")
        self.address = line.strip().removeprefix("listening on http://")
        self.port = int(self.address.rsplit(":", 1)[1])

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()
        self.folder.cleanup()

    def log(self):
        return self.log_path.read_text()

    def memory(self, key="VmRSS"):
        """A number of /proc/PID/status, in bytes. VmRSS is the resident memory."""
        for line in Path(f"/proc/{self.process.pid}/status").read_text().splitlines():
            if line.startswith(key + ":"):
                return 1024 * int(line.split()[1])
        raise KeyError(key)

    def threads(self):
        return len(os.listdir(f"/proc/{self.process.pid}/task"))

    def terminate(self, timeout):
        """Sends SIGTERM. Returns the seconds until the end and the exit code, or None if it is still running."""
        start = time.monotonic()
        self.process.send_signal(signal.SIGTERM)
        try:
            code = self.process.wait(timeout)
        except subprocess.TimeoutExpired:
            return timeout, None
        return time.monotonic() - start, code


class Peak:
    """The highest value of a function, sampled by `sample`."""

    def __init__(self, function):
        self.function = function
        self.first = function()
        self.highest = self.first

    def sample(self):
        self.highest = max(self.highest, self.function())
        return self.highest

    def growth(self):
        return self.sample() - self.first
