"""Item 10 of `prove.py`: a client that does not read the replies to its steps keeps its connection."""

import struct
import time

import http2
from client import DRIVE_SCENE, LIST_SCENES, Client, common_pb2, steps_pb2
from report import Result
from server import Server

ITEM = 10

# Steps on each of STREAMS streams of one connection. HTTP/2 libraries close a connection with too many unsent small
# frames. If the server does not merge its replies, the replies to 39,000 steps end the connection.
STREAMS = 4
STEPS = 50_000

# Seconds without progress on any stream after which the sender gives up.
BLOCKED = 2.0


class StepSender:
    """Streams of steps on one connection, whose replies are received and never get more flow-control window."""

    def __init__(self, server, deliveries):
        self.connection = http2.Connection(server.port)
        # The streams get no further window for their replies. The connection does, so that other calls are answered.
        self.connection.send(http2.window_update(0, 1 << 30))
        self.windows = {}
        self.is_open = True
        self.goaways = 0
        # Bytes that the server allows on a stream and on the connection.
        self.stream_window, self.connection_window = 2 << 20, 512 << 20
        for index, delivery in enumerate(deliveries):
            drive = steps_pb2.OpenDrive(scene=f"scene-{index}", delivery=delivery, window=256)
            stream = self.connection.open_call(DRIVE_SCENE)
            self.windows[stream] = self.stream_window
            self.send(stream, steps_pb2.DriveSceneRequest(open=drive))

    def send(self, stream, request):
        """Sends a message in a DATA frame of its own, if the window allows it."""
        message = http2.grpc_message(request.SerializeToString())
        if min(self.windows[stream], self.connection_window) < len(message):
            return False
        self.windows[stream] -= len(message)
        self.connection_window -= len(message)
        self.connection.send_data(stream, message)
        return True

    def receive(self, seconds, until=lambda frame: False):
        frames, is_open = self.connection.receive(seconds, until)
        self.is_open &= is_open
        for kind, flags, stream, payload in frames:
            if kind == http2.WINDOW_UPDATE:
                increment = struct.unpack(">I", payload)[0]
                if stream in self.windows:
                    self.windows[stream] += increment
                elif stream == 0:
                    self.connection_window += increment
            self.goaways += kind == http2.GOAWAY
            if kind == http2.RST_STREAM or (kind == http2.HEADERS and flags & http2.END_STREAM):
                self.windows.pop(stream, None)
        return frames

    def send_all(self, steps):
        """Sends steps until each stream has sent all or has ended, or until no stream makes progress. Returns the
        number of sent steps."""
        numbers = dict.fromkeys(self.windows, 0)
        sent, last_progress = 0, time.monotonic()
        while self.is_open and time.monotonic() < last_progress + BLOCKED:
            pending = [stream for stream in self.windows if numbers[stream] < steps]
            if not pending:
                break
            for stream in pending:
                for _ in range(100):
                    step = steps_pb2.Step(number=numbers[stream] + 1)
                    if numbers[stream] == steps or not self.send(stream, steps_pb2.DriveSceneRequest(step=step)):
                        break
                    numbers[stream] += 1
                    sent += 1
                    last_progress = time.monotonic()
            self.receive(0.001)
        return sent

    def is_served(self):
        """Whether another call of the connection is answered."""
        if not self.is_open:
            return False
        stream = self.connection.open_call(LIST_SCENES)
        self.connection.send_data(stream, http2.grpc_message(b""), http2.END_STREAM)
        frames = self.receive(5, lambda frame: frame[2] == stream and frame[1] & http2.END_STREAM)
        return any(frame[0] == http2.DATA and frame[2] == stream for frame in frames)


def attack(program, deliveries, fault=b""):
    """The number of sent steps, and whether the connection still serves another call. `fault` is sent at the end."""
    with Server(program) as server:
        with Client(server) as client:
            for index in range(len(deliveries)):
                client.open_scene("tree", f"scene-{index}")
        sender = StepSender(server, deliveries)
        try:
            sent = sender.send_all(STEPS)
            sender.connection.send(fault)
            is_served = sender.is_served()
        except OSError:
            sent, is_served = 0, False
        return sent, is_served and sender.goaways == 0


def run(program):
    measured, passed = [], True
    for name, delivery in [("lossless", common_pb2.DELIVERY_LOSSLESS), ("latest", common_pb2.DELIVERY_LATEST)]:
        sent, is_served = attack(program, [delivery] * STREAMS)
        measured.append(f"{name}: {sent} steps, connection {'open' if is_served else 'LOST'}")
        passed &= is_served
    # A PING of 7 bytes is a connection error.
    fault = http2.frame(http2.PING, payload=bytes(7))
    _, control = attack(program, [common_pb2.DELIVERY_LATEST], fault)
    return [
        Result(
            ITEM,
            "a client that does not read the replies to its steps keeps its connection",
            f"up to {STEPS} steps on each of {STREAMS} streams, then another call is answered",
            ", ".join(measured),
            passed,
            f"with an invalid PING, connection {'open' if control else 'lost'}",
            not control,
        )
    ]
