"""Item 17 of `prove.py`: callers without a credential get nothing, and guessed tokens do not delay others."""

import threading
import time

import grpc
from client import bearer, common_pb2, forces_pb2, frames_pb2, scenes_pb2, states_pb2, steps_pb2, vertices_pb2
from client import LIST_SCENES
from report import Result, mb
from server import Peak, Server

ITEM = 17

MODULES = [common_pb2, forces_pb2, frames_pb2, scenes_pb2, states_pb2, steps_pb2, vertices_pb2]

# Each of GUESSERS connections sends CALLS calls at a time with wrong tokens, for DURATION seconds.
GUESSERS = 32
CALLS = 64
DURATION = 8.0

# Seconds within which the owner must be served meanwhile, and by how many bytes the memory may grow.
MAX_SECONDS = 0.25
MAX_MEMORY = 256 << 20


def connect(server):
    return grpc.insecure_channel(server.address, [("grpc.use_local_subchannel_pool", 1)])


def call(channel, method, metadata, timeout=10):
    """The status of a call with one empty message."""
    try:
        list(channel.stream_stream(method)(iter([b""]), metadata=metadata, timeout=timeout))
    except grpc.RpcError as error:
        return error.code()
    return grpc.StatusCode.OK


def methods():
    """All methods of the contract."""
    services = [service for module in MODULES for service in module.DESCRIPTOR.services_by_name.values()]
    return [f"/{service.full_name}/{method.name}" for service in services for method in service.methods]


def strangers(program):
    with Server(program, authentication=()) as server, connect(server) as channel:
        token = (server.state / "token").read_text().strip()
        wrong = [[], bearer("0" * 64), bearer(token[:-1]), bearer(""), [("authorization", token)]]
        answers = [call(channel, method, metadata) for method in methods() for metadata in wrong]
        control = call(channel, LIST_SCENES, bearer(token))
    found = {code.name: answers.count(code) for code in answers}
    return Result(
        ITEM,
        "no method answers a caller without a credential or with a wrong token",
        f"UNAUTHENTICATED for {len(answers)} calls",
        ", ".join(f"{count} x {name}" for name, count in found.items()),
        set(answers) == {grpc.StatusCode.UNAUTHENTICATED} and len(answers) > 100,
        f"with the owner's token: {control.name}",
        control == grpc.StatusCode.OK,
    )


class Guesser(threading.Thread):
    """A connection that keeps CALLS calls with wrong tokens open."""

    def __init__(self, server, end):
        super().__init__(daemon=True)
        self.channel = connect(server)
        self.end = end
        self.count = 0

    def run(self):
        while time.monotonic() < self.end:
            list_scenes = self.channel.unary_unary(LIST_SCENES)
            calls = [list_scenes.future(b"", metadata=bearer(f"{i:064x}"), timeout=30) for i in range(CALLS)]
            self.count += sum(guess.exception() is not None for guess in calls)


def guesses(program):
    with Server(program, authentication=()) as server, connect(server) as channel:
        token = (server.state / "token").read_text().strip()
        memory = Peak(server.memory)
        end = time.monotonic() + DURATION
        guessers = [Guesser(server, end) for _ in range(GUESSERS)]
        for guesser in guessers:
            guesser.start()
        times = []
        while time.monotonic() < end:
            start = time.monotonic()
            code = call(channel, LIST_SCENES, bearer(token))
            times.append(time.monotonic() - start if code == grpc.StatusCode.OK else float("inf"))
            memory.sample()
            time.sleep(0.02)
        for guesser in guessers:
            guesser.join()
        start = time.monotonic()
        call(channel, LIST_SCENES, bearer("0" * 64))
        wrong = time.monotonic() - start
    times.sort()
    typical, growth = times[len(times) // 2], memory.highest - memory.first
    return Result(
        ITEM,
        f"guessed tokens of {GUESSERS} connections do not delay the owner, and take bounded memory",
        f"half of the calls within {MAX_SECONDS} s, memory +{mb(MAX_MEMORY)}",
        f"{sum(guesser.count for guesser in guessers)} guesses in {DURATION:.0f} s, median {1e3 * typical:.1f} ms, "
        f"slowest {times[-1]:.2f} s, memory +{mb(growth)}",
        typical <= MAX_SECONDS and growth <= MAX_MEMORY,
        f"a call with a wrong token, {wrong:.2f} s",
        wrong > MAX_SECONDS,
    )


def run(program):
    return [strangers(program), guesses(program)]
