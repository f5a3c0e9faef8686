"""Row R7: a stall of the device ends no connection and no stream of small steps, each in an HTTP/2 frame of its own.

HTTP/2 libraries end a connection with too many small frames that wait. While steps arrive, the thread of the server that
computes them does not run for 30 s."""

import argparse
import ctypes
import os
import struct
import sys
import tempfile
import time
from pathlib import Path

import http2
from client import DRIVE_SCENE, Client, common_pb2, steps_pb2
from report import Result
from server import Server

# About the bytes of a message with its gRPC header, by the number of modes of its scene.
MESSAGE_BYTES = {1: 20, 26: 120, 295: 1200}

# Connections. Each has one stream with messages of each size.
CONNECTIONS = 3

# Messages per second on each stream, and the seconds between two writes to a connection.
RATE = 1000
TICK = 0.005

# The thread of the server that does not run for a time, and when it stops and continues, in seconds after the first step.
THREAD = "device"
STOP, CONTINUE = 3.0, 33.0

# Seconds without an answer after which the check gives up.
GIVE_UP = 60.0

# Vertices per side of the scenes.
SIDE = 10


def write_scene(folder, rank):
    """A square grid with modes, as an OBJ file with a NumPy file."""
    lines = [f"v {index % SIDE} {index // SIDE} 0" for index in range(SIDE * SIDE)]
    for row in range(SIDE - 1):
        for first in range(row * SIDE + 1, row * SIDE + SIDE):
            lines.append(f"f {first} {first + 1} {first + SIDE + 1} {first + SIDE}")
    (folder / f"rank-{rank}.obj").write_text("\n".join(lines) + "\n")
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({3 * SIDE * SIDE}, {rank}), }}"
    modes = struct.pack(f"<{rank}f", *(0.001 * (mode + 1) for mode in range(rank))) * (3 * SIDE * SIDE)
    array = b"\x93NUMPY\x01\x00\x76\x00" + f"{header:<117}\n".encode() + modes
    (folder / f"rank-{rank}.npy").write_bytes(array)


class StoppedThread:
    """A thread of a child process that does not run until `resume` is called. Its other threads run."""

    # Requests of ptrace, and the option of waitpid that includes threads.
    DETACH, SEIZE, INTERRUPT, WAIT_ALL = 17, 0x4206, 0x4207, 0x40000000

    def __init__(self, pid, name):
        tasks = Path(f"/proc/{pid}/task").iterdir()
        self.thread = next(int(task.name) for task in tasks if (task / "comm").read_text().strip() == name)
        self.request(self.SEIZE)
        self.request(self.INTERRUPT)
        os.waitpid(self.thread, self.WAIT_ALL)

    def request(self, kind):
        library = ctypes.CDLL(None, use_errno=True)
        library.ptrace.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p]
        library.ptrace.restype = ctypes.c_long
        if library.ptrace(kind, self.thread, None, None) != 0:
            raise OSError(ctypes.get_errno(), f"ptrace of thread {self.thread}")

    def resume(self):
        self.request(self.DETACH)


class StepStream:
    """A stream of steps, and the acknowledgments that were received."""

    def __init__(self, stream, rank):
        self.stream = stream
        self.q = struct.pack(f"<{rank}f", *[0.001] * rank)
        self.sent = 0
        self.acknowledged = 0
        self.window = 0
        self.received = b""

    def next_message(self):
        step = steps_pb2.Step(number=self.sent + 1, q_domains=[0], q=self.q)
        return http2.grpc_message(steps_pb2.DriveSceneRequest(step=step).SerializeToString())

    def receive(self, data):
        """Takes the data of a reply."""
        self.received += data
        while len(self.received) >= 5:
            length = int.from_bytes(self.received[1:5], "big")
            if len(self.received) < 5 + length:
                break
            reply = steps_pb2.DriveSceneResponse.FromString(self.received[5 : 5 + length])
            self.received = self.received[5 + length :]
            if reply.HasField("rejection"):
                raise RuntimeError(f"expected an acknowledgment, got {reply.rejection}")
            self.acknowledged = max(self.acknowledged, reply.ack.step)


class StepSender:
    """Several streams of steps on one connection, whose replies are read."""

    def __init__(self, server, scenes):
        self.connection = http2.Connection(server.port)
        self.is_open, self.goaways, self.ended = True, 0, 0
        # Bytes that the server allows on a stream at first, and on the connection.
        first_window, self.window = 2 << 20, 512 << 20
        self.streams = {}
        for scene, rank in scenes:
            stream = self.connection.open_call(DRIVE_SCENE)
            self.streams[stream] = StepStream(stream, rank)
            self.streams[stream].window = first_window
            drive = steps_pb2.OpenDrive(scene=scene, delivery=common_pb2.DELIVERY_LATEST, window=256)
            message = http2.grpc_message(steps_pb2.DriveSceneRequest(open=drive).SerializeToString())
            self.streams[stream].window -= len(message)
            self.window -= len(message)
            self.connection.send_data(stream, message)
        # The time of the last acknowledgment, and the longest time between two of them.
        self.last_answer, self.longest_wait = time.monotonic(), 0.0

    def send(self, count):
        """Sends up to `count` messages on each stream, each in a frame of its own."""
        frames = []
        for stream in self.streams.values():
            for _ in range(count):
                message = stream.next_message()
                if min(stream.window, self.window) < len(message):
                    break
                stream.window -= len(message)
                self.window -= len(message)
                stream.sent += 1
                frames.append(http2.frame(http2.DATA, 0, stream.stream, message))
        self.connection.send(b"".join(frames))

    def receive(self, seconds):
        frames, is_open = self.connection.receive(seconds, lambda frame: frame[0] == http2.DATA)
        self.is_open &= is_open
        updates = b""
        for kind, flags, number, payload in frames:
            stream = self.streams.get(number)
            if kind == http2.WINDOW_UPDATE and number == 0:
                self.window += struct.unpack(">I", payload)[0]
            elif kind == http2.WINDOW_UPDATE and stream:
                stream.window += struct.unpack(">I", payload)[0]
            elif kind == http2.DATA and stream:
                stream.receive(payload)
                now = time.monotonic()
                self.longest_wait, self.last_answer = max(self.longest_wait, now - self.last_answer), now
                updates += http2.window_update(0, len(payload)) + http2.window_update(number, len(payload))
            self.goaways += kind == http2.GOAWAY
            self.ended += kind == http2.RST_STREAM or (kind == http2.HEADERS and bool(flags & http2.END_STREAM))
        if updates and self.is_open:
            self.connection.send(updates)

    def sent(self):
        return sum(stream.sent for stream in self.streams.values())

    def can_continue(self):
        return self.is_open and self.goaways == 0 and time.monotonic() < self.last_answer + GIVE_UP

    def is_answered(self):
        return all(stream.acknowledged == stream.sent for stream in self.streams.values())


def send_steps(server, messages, stalls=True, fault=b""):
    """Sends steps on all connections, during which the device stalls, and waits for the last acknowledgments. `fault` is
    sent after the first ones. Returns the senders."""
    senders = []
    with Client(server) as client:
        for connection in range(CONNECTIONS):
            scenes = [(f"rank-{rank}-{connection}", rank) for rank in MESSAGE_BYTES]
            for scene, rank in scenes:
                client.open_scene(f"rank-{rank}.obj", scene)
            senders.append(StepSender(server, scenes))
    start, stopped, has_stalled = time.monotonic(), None, False
    try:
        while all(sender.can_continue() for sender in senders):
            elapsed = time.monotonic() - start
            if stalls and not has_stalled and elapsed >= STOP:
                stopped, has_stalled = StoppedThread(server.process.pid, THREAD), True
            if stopped and elapsed >= CONTINUE:
                stopped.resume()
                stopped = None
            is_sent = sum(sender.sent() for sender in senders) >= messages
            if is_sent and all(sender.is_answered() for sender in senders):
                break
            for sender in senders:
                # A sender that was too slow for a while sends more, as long as the rate is that of the whole time.
                due = int(RATE * elapsed) - sender.sent() // len(MESSAGE_BYTES)
                if not is_sent:
                    sender.send(min(max(due, 0), 100))
                if fault and sender.sent() > 0:
                    sender.connection.send(fault)
                sender.receive(TICK)
    except OSError:
        for sender in senders:
            sender.is_open = False
    return senders


def is_kept(senders, messages):
    is_whole = all(sender.is_open and sender.goaways == 0 and sender.ended == 0 for sender in senders)
    is_answered = all(sender.is_answered() for sender in senders)
    return is_whole and is_answered and sum(sender.sent() for sender in senders) >= messages


def run(program, messages):
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for rank in MESSAGE_BYTES:
            write_scene(folder, rank)
        with Server(program, scenes=folder) as server:
            senders = send_steps(server, messages)
        with Server(program, scenes=folder) as server:
            # A PING of 7 bytes is a connection error.
            control = send_steps(server, 10_000, stalls=False, fault=http2.frame(http2.PING, payload=bytes(7)))
    unanswered = sum(stream.sent - stream.acknowledged for sender in senders for stream in sender.streams.values())
    sent, goaways, ended = (
        sum(values) for values in zip(*((sender.sent(), sender.goaways, sender.ended) for sender in senders))
    )
    shortest_stall = min(sender.longest_wait for sender in senders)
    return Result(
        "R7",
        f"a stall of {CONTINUE - STOP:.0f} s ends none of {CONNECTIONS} connections and no stream of steps of "
        f"{list(MESSAGE_BYTES.values())} bytes",
        f"no GOAWAY, no lost stream, and no unanswered step in {messages} messages at {RATE} per second and stream",
        f"{goaways} GOAWAY, {ended} lost streams, {unanswered} unanswered steps in {sent} messages; each connection "
        f"waited {shortest_stall:.0f} s for an answer",
        is_kept(senders, messages) and shortest_stall >= 0.8 * (CONTINUE - STOP),
        f"with an invalid PING, connection {'kept' if is_kept(control, 10_000) else 'lost'}",
        not is_kept(control, 10_000),
    )


def main():
    parser = argparse.ArgumentParser(description="Stalls the device of a server while steps arrive.")
    parser.add_argument("--program", type=Path, required=True, help="the server, `modalcast`")
    parser.add_argument("--messages", type=int, default=1_000_000)
    arguments = parser.parse_args()
    result = run(arguments.program.resolve(), arguments.messages)
    print(result.line())
    # The last line of the output is shown by `deploy/prove --full`.
    print(f"{result.measured}; control: {result.control}")
    sys.exit(0 if result.is_good() else 1)


if __name__ == "__main__":
    main()
