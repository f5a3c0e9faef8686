"""Item 1 of `prove.py`: connections that do not work do not lock out new clients, nor those that work."""

import contextlib
import os
import signal
import statistics
import tempfile
import threading
import time
from pathlib import Path

import grpc
import http2
import swarm
from client import DRIVE_SCENE, HEALTH_WATCH, LIST_SCENES, Client, Writer, health_time, service_times, steps_pb2
from report import Result
from scenes import write_grid
from server import Server

ITEM = 1

# The limit on connections of the server.
CONNECTIONS = 1024

# Seconds within which half of the new clients, and all of them, must be served, and after which the check gives up.
MEDIAN_SECONDS = 0.1
MAX_SECONDS = 1.0
GIVE_UP = 4.0

# Seconds of each attack after all of its connections are open.
DURATION = 5.0

HELLO = http2.PREFACE + http2.settings()


def call(path, message=b"", flags=http2.END_STREAM):
    """A request of one message, without flags on a stream that stays open."""
    data = http2.frame(http2.DATA, flags, 1, http2.grpc_message(message))
    return HELLO + http2.grpc_headers(path, 1) + data


# A step stream for a scene that does not exist.
REJECTED_OPEN = steps_pb2.DriveSceneRequest(open=steps_pb2.OpenDrive(scene="none")).SerializeToString()

# Name, bytes that each connection sends, whether it answers PINGs, the maximum number of connections in all, None
# without a maximum: a new connection replaces each one that the server closes, and whether the server requires a
# credential, which the attacker lacks.
ATTACKS = [
    ("one byte", b"P", False, None, False),
    ("preface", HELLO, False, None, False),
    ("preface, answered PINGs", HELLO, True, None, False),
    ("10,000 silent sockets", b"", False, 10_000, False),
    ("headers without data", HELLO + http2.grpc_headers(LIST_SCENES, 1), True, None, False),
    ("idle after a request", call(LIST_SCENES), True, None, False),
    ("Health.Watch", call(HEALTH_WATCH), True, None, False),
    ("rejected DriveScene", call(DRIVE_SCENE, REJECTED_OPEN, 0), True, None, False),
    ("no credential", call(LIST_SCENES), True, None, True),
]


class Worker(threading.Thread):
    """A client that sends steps all the time."""

    def __init__(self, server, metadata):
        super().__init__(daemon=True)
        self.client = Client(server)
        self.client.open_scene("grid.obj", "grid", metadata=metadata)
        self.writer = Writer(self.client, "grid", metadata)
        self.is_stopped, self.steps, self.error = False, 0, None
        self.start()

    def run(self):
        try:
            while not self.is_stopped:
                self.writer.step()
                self.steps += 1
                time.sleep(0.01)
        except grpc.RpcError as error:
            self.error = error

    def stop(self):
        """Returns the number of steps, and whether the connection was never lost."""
        self.is_stopped = True
        self.join()
        self.client.channel.close()
        return self.steps, self.error is None


class Measured:
    """What clients saw during an attack."""

    def __init__(self, times, health, steps, is_kept, codes):
        self.median, self.slowest = statistics.median(times), max(times)
        self.health, self.steps, self.is_kept, self.codes = health, steps, is_kept, codes

    def is_good(self):
        is_fast = self.median <= MEDIAN_SECONDS and self.slowest <= MAX_SECONDS and self.health <= MAX_SECONDS
        return is_fast and self.is_kept and self.steps > 0 and self.codes <= {http2.NO_ERROR}

    def __str__(self):
        text = f"median {1e3 * self.median:.0f} ms, worst {self.slowest:.2f} s, /healthz {self.health:.2f} s"
        return text + ("" if self.is_kept else ", a working client was closed")


@contextlib.contextmanager
def attacked(program, greeting, answers, total, needs_credential):
    """A server under attack, its attackers, a client that works, and the metadata of clients."""
    with tempfile.TemporaryDirectory() as folder:
        write_grid(Path(folder) / "grid.obj", 2)
        authentication = () if needs_credential else ("--no-auth",)
        with Server(program, scenes=folder, authentication=authentication) as server:
            token = (server.state / "token").read_text().strip()
            metadata = [("authorization", f"Bearer {token}")] if needs_credential else []
            worker = Worker(server, metadata)
            with swarm.Swarm(server.port, CONNECTIONS, greeting, answers, total) as attackers:
                attackers.wait_until_open(CONNECTIONS, 10)
                yield server, attackers, worker, metadata


def attack(program, *arguments):
    with attacked(program, *arguments) as (server, attackers, worker, metadata):
        before, times, health = worker.steps, [], 0.0
        end = time.monotonic() + DURATION
        while time.monotonic() < end:
            times += service_times(server, 0.5, GIVE_UP, 0.1, metadata)
            health = max(health, health_time(server, GIVE_UP))
        steps, is_kept = worker.stop()
        return Measured(times, health, steps - before, is_kept, set(attackers.goaways))


def stopped_server(program):
    """The slowest service of a server that does not run."""
    with Server(program) as server:
        os.kill(server.process.pid, signal.SIGSTOP)
        return max(service_times(server, 0.5, GIVE_UP))


def run(program):
    results = {name: attack(program, *arguments) for name, *arguments in ATTACKS}
    control = stopped_server(program)
    return [
        Result(
            ITEM,
            f"{CONNECTIONS} connections that do not work lock out neither new clients nor one that sends steps",
            f"new clients served within {1e3 * MEDIAN_SECONDS:.0f} ms (median) and {MAX_SECONDS:.0f} s (worst), "
            f"/healthz within {MAX_SECONDS:.0f} s",
            "; ".join(f"{name}: {measured}" for name, measured in results.items()),
            all(measured.is_good() for measured in results.values()),
            f"a server that is stopped: {control:.2f} s",
            control > MAX_SECONDS,
        )
    ]
