"""Item 1 of `prove.py`: connections without a request do not lock out new clients."""

import http2
import swarm
from client import HEALTH_WATCH, LIST_SCENES, slowest_service
from report import Result
from server import Server

ITEM = 1

# The limit on connections of the server.
CONNECTIONS = 1024

# Seconds within which a new client must be served, and after which the check gives up.
MAX_SECONDS = 1.0
GIVE_UP = 4.0

# Seconds of each attack after all of its connections are open.
DURATION = 5.0

HELLO = http2.PREFACE + http2.settings()


def call(path):
    """A complete request without content."""
    data = http2.frame(http2.DATA, http2.END_STREAM, 1, http2.grpc_message(b""))
    return HELLO + http2.grpc_headers(path, 1) + data


# Name, bytes that each connection sends, whether it answers PINGs, and the maximum number of connections in all, None
# without a maximum: a new connection replaces each one that the server closes.
ATTACKS = [
    ("one byte", b"P", False, None),
    ("preface", HELLO, False, None),
    ("preface, answered PINGs", HELLO, True, None),
    ("10,000 silent sockets", b"", False, 10_000),
    ("headers without data", HELLO + http2.grpc_headers(LIST_SCENES, 1), True, None),
    ("idle after a request", call(LIST_SCENES), True, None),
]


def attack(program, greeting, answers, total):
    """The slowest service during an attack, the codes of the GOAWAY frames, and whether an older stream survived."""
    with Server(program) as server:
        watcher = http2.Connection(server.port)
        watcher.send(call(HEALTH_WATCH).removeprefix(HELLO))
        watcher.receive(0.2)
        with swarm.Swarm(server.port, CONNECTIONS, greeting, answers, total) as attackers:
            attackers.wait_until_open(CONNECTIONS, 10)
            slowest = slowest_service(server, DURATION, GIVE_UP)
        _, is_open = watcher.receive(0.2)
        return slowest, set(attackers.goaways), is_open


def run(program):
    measured, passed = [], True
    for name, greeting, answers, total in ATTACKS:
        slowest, codes, is_open = attack(program, greeting, answers, total)
        measured.append(f"{name} {slowest:.2f} s")
        passed &= slowest <= MAX_SECONDS and is_open and codes <= {http2.NO_ERROR}
        if not is_open:
            measured.append("an open stream was closed")
    # Connections with an open stream are never closed for new ones, so this attack locks clients out.
    slowest, _, _ = attack(program, call(HEALTH_WATCH), True, None)
    return [
        Result(
            ITEM,
            "connections without a request do not lock out a new client, and an open stream survives",
            f"served within {MAX_SECONDS:.0f} s",
            ", ".join(measured),
            passed,
            f"{CONNECTIONS} connections with an open stream each, {slowest:.2f} s",
            slowest > MAX_SECONDS,
        )
    ]
