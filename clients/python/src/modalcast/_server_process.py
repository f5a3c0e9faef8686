"""Starts and ends a server as a child process."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sysconfig
import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path

from modalcast.errors import ServerStartError

_ADDRESS_PREFIX = "listening on http://"
_STOP_SECONDS = 5.0


# Runs the server until it ends or the standard input closes, which happens when this process ends in any way. The
# server has a session of its own, so that Ctrl-C in the terminal or in a notebook does not end it.
_SCRIPT = 'exec 3<&0; "$@" & server=$!; (cat <&3 >/dev/null; kill "$server" 2>/dev/null) & wait "$server"'


class ServerProcess:
    """A server on a free port of this machine. It ends with `stop`, and at the latest when this process ends."""

    def __init__(self, program: str | Path | None, arguments: Sequence[str]) -> None:
        """Starts the server. As soon as it listens, `address` returns its address; until then, None.

        Raises:
            ServerStartError: The program does not exist or cannot be started.
        """
        path = find_program(program)
        self._folder = tempfile.TemporaryDirectory(prefix="modalcast-", ignore_cleanup_errors=True)
        folder = Path(self._folder.name)
        self._output, self._log = folder / "output", folder / "log"
        command = ["sh", "-c", _SCRIPT, "sh", path, "serve", "--listen", "127.0.0.1:0"]
        command += ["--state", str(folder / "state"), *arguments]
        with self._output.open("wb") as output, self._log.open("wb") as log:
            try:
                self._process = subprocess.Popen(
                    command, stdin=subprocess.PIPE, stdout=output, stderr=log, start_new_session=True
                )
            except OSError as error:
                self._folder.cleanup()
                raise ServerStartError(f"{path}: {error}") from error
        self._finalizer = weakref.finalize(self, _end, self._process, self._folder)

    def address(self) -> str | None:
        """HOST:PORT, or None until the server listens.

        Raises:
            ServerStartError: The server has ended; the message has the end of its log.
        """
        for line in self._output.read_text().splitlines():
            if line.startswith(_ADDRESS_PREFIX):
                return line.removeprefix(_ADDRESS_PREFIX)
        if self._process.poll() is not None:
            raise ServerStartError(f"the server ended with exit code {self._process.returncode}: {self.log()}")
        return None

    def token(self) -> str:
        """The token of the server, once it listens."""
        return (Path(self._folder.name) / "state/token").read_text().strip()

    def log(self) -> str:
        """The last 2000 characters that the server has logged."""
        return self._log.read_text(errors="replace")[-2000:].strip() if self._log.exists() else ""

    def stop(self) -> None:
        """Ends the server and waits for it. Later calls have no effect."""
        self._finalizer()


def find_program(program: str | Path | None) -> str:
    """The path of the program `modalcast`: the given one, that of MODALCAST_PROGRAM, or the one in PATH.

    Raises:
        ServerStartError: It does not exist.
    """
    name = str(program or os.environ.get("MODALCAST_PROGRAM") or "modalcast")
    # A wheel with the programs installs them in the folder of scripts, which need not be in PATH.
    path = shutil.which(name) or shutil.which(name, path=sysconfig.get_path("scripts"))
    if path is None:
        raise ServerStartError(
            f"found no program '{name}': install the server so that 'modalcast' is in PATH, "
            "or set program= or the environment variable MODALCAST_PROGRAM"
        )
    return path


def _end(process: subprocess.Popen[bytes], folder: tempfile.TemporaryDirectory[str]) -> None:
    if process.stdin is not None:
        process.stdin.close()
    try:
        process.wait(_STOP_SECONDS)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    folder.cleanup()
