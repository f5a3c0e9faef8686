"""Item 18 of `prove.py`: lossless readers that read nothing stop a writer only within its stall budget.

The writer and the honest reader are processes of their own (`--role`), so that they do not wait for this one."""

import argparse
import json
import queue
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import grpc
import http2
from client import STREAM_VERTICES, Client, common_pb2, steps_pb2, vertices_pb2
from report import Result
from scenes import write_grid
from server import Server

ITEM = 18

# Seconds of a run, and between the arrivals of two readers that read nothing, each on a connection of its own.
DURATION = 30.0
ARRIVAL_INTERVAL = 4.0

# Part of the undisturbed rate that the writer keeps, and the longest wait of a step in seconds: the whole budget.
MIN_RATIO = 0.8
MAX_WAIT = 2.0

# Stall budget in milliseconds of the writer of the control: readers may make it wait for the whole run.
LARGE_BUDGET_MS = 3_600_000

# Seconds after which a process that should have ended is an error.
TIMEOUT = 60.0


def lossless_request():
    return vertices_pb2.StreamVerticesRequest(scene="grid", delivery=common_pb2.DELIVERY_LOSSLESS)


def write(server, budget_ms):
    """Sends one step after another for DURATION, each after the acknowledgment of the one before. Returns the number of
    steps per second and the longest wait. A step that is unacknowledged at the end counts as a wait."""
    requests = queue.SimpleQueue()
    open_drive = steps_pb2.OpenDrive(
        scene="grid", delivery=common_pb2.DELIVERY_LOSSLESS, window=1, stall_budget_ms=budget_ms
    )
    requests.put(steps_pb2.DriveSceneRequest(open=open_drive))
    with Client(server) as client:
        start = time.monotonic()
        replies = client.steps.DriveScene(iter(requests.get, None))
        threading.Timer(DURATION, replies.cancel).start()
        number, longest_wait, sent = 0, 0.0, start
        try:
            for _ in replies:
                now = time.monotonic()
                longest_wait, sent, number = max(longest_wait, now - sent), now, number + 1
                requests.put(steps_pb2.DriveSceneRequest(step=steps_pb2.Step(number=number, time=number)))
        except grpc.RpcError as error:
            if error.code() != grpc.StatusCode.CANCELLED:
                raise
        requests.put(None)
        longest_wait = max(longest_wait, start + DURATION - sent)
    return {"rate": (number - 1) / DURATION, "longest_wait": longest_wait}


def read(server):
    """Receives all steps. Returns their number, how many are missing between them, and why the stream has ended."""
    numbers, end = [], ""
    with Client(server) as client:
        replies = client.vertices.StreamVertices(lossless_request())
        replies.initial_metadata()
        print("ready", flush=True)
        threading.Thread(target=lambda: (sys.stdin.readline(), replies.cancel()), daemon=True).start()
        try:
            for reply in replies:
                if reply.chunk.HasField("head"):
                    numbers.append(reply.chunk.head.step.number)
        except grpc.RpcError as error:
            end = "" if error.code() == grpc.StatusCode.CANCELLED else f"{error.code().name}: {error.details()}"
    missing = numbers[-1] - numbers[0] + 1 - len(numbers) if numbers else 0
    return {"steps": len(numbers), "missing": missing, "end": end}


class Process:
    """A role in a process of its own."""

    def __init__(self, server, role, *arguments):
        command = [sys.executable, __file__, "--role", role, "--address", server.address, *map(str, arguments)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def wait_until_ready(self):
        if self.process.stdout.readline() != "ready\n":
            raise RuntimeError("expected a reader that is ready")

    def is_running(self):
        return self.process.poll() is None

    def finish(self):
        """Ends a reader. Returns the result."""
        output, _ = self.process.communicate("\n", timeout=TIMEOUT)
        return json.loads(output.splitlines()[-1])


class UnreadReaders:
    """Readers of all steps that let the server send nothing. They answer PINGs, so that their connections remain."""

    def __init__(self, server):
        self.server = server
        self.connections = []

    def add(self):
        connection = http2.Connection(self.server.port, initial_window=0)
        stream = connection.open_call(STREAM_VERTICES)
        request = http2.grpc_message(lossless_request().SerializeToString())
        connection.send_data(stream, request, http2.END_STREAM)
        self.connections.append(connection)

    def answer_pings(self):
        for connection in self.connections:
            connection.receive(0.001)

    def close(self):
        for connection in self.connections:
            connection.close()


def run_writer(program, arrival_interval, budget_ms=0):
    """Runs a writer beside an honest reader, and a new unread reader after each interval. Returns the results of the writer
    and of the honest reader."""
    with tempfile.TemporaryDirectory() as folder:
        write_grid(Path(folder) / "grid.obj", 10)
        with Server(program, scenes=folder) as server:
            with Client(server) as client:
                client.open_scene("grid.obj", "grid")
            reader = Process(server, "read")
            reader.wait_until_ready()
            writer = Process(server, "write", "--budget-ms", budget_ms)
            unread, start = UnreadReaders(server), time.monotonic()
            while writer.is_running():
                if time.monotonic() - start >= arrival_interval * (len(unread.connections) + 1):
                    unread.add()
                unread.answer_pings()
                time.sleep(0.02)
            written = writer.finish()
            unread.close()
            # The last step may be on its way.
            time.sleep(0.5)
            return written, reader.finish()


def describe(written, ratio):
    return f"{written['rate']:.0f} steps/s ({ratio:.2f}), longest wait {written['longest_wait']:.2f} s"


def run(program):
    alone, _ = run_writer(program, float("inf"))
    attacked, received = run_writer(program, ARRIVAL_INTERVAL)
    blocked, _ = run_writer(program, ARRIVAL_INTERVAL, LARGE_BUDGET_MS)
    ratio, control_ratio = attacked["rate"] / alone["rate"], blocked["rate"] / alone["rate"]
    is_complete = received["missing"] == 0 and not received["end"] and received["steps"] >= MIN_RATIO * DURATION
    return [
        Result(
            ITEM,
            f"a new unread lossless reader every {ARRIVAL_INTERVAL:.0f} s does not stop the writer or end an honest reader",
            f"{MIN_RATIO} of the rate without them, no wait above {MAX_WAIT:.0f} s, every step at the honest reader",
            f"{describe(attacked, ratio)}, without them {alone['rate']:.0f} steps/s; honest reader: {received['steps']} "
            f"steps, {received['missing']} missing, {'ended by ' + received['end'] if received['end'] else 'not ended'}",
            ratio >= MIN_RATIO and attacked["longest_wait"] <= MAX_WAIT and is_complete,
            f"with a stall budget of an hour, which the writer asks for, {describe(blocked, control_ratio)}",
            control_ratio < MIN_RATIO,
        )
    ]


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--role", choices=["read", "write"], required=True)
    parser.add_argument("--address", required=True)
    parser.add_argument("--budget-ms", type=int, default=0)
    arguments = parser.parse_args()
    is_reader = arguments.role == "read"
    # Both need only the address of the server.
    result = read(arguments) if is_reader else write(arguments, arguments.budget_ms)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
