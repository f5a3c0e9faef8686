"""Item 13 of `prove.py`: panics, errors, losses and endless calls of devices, in a program with planned faults."""

import contextlib
import struct
import subprocess
import tempfile
import threading
import time

import grpc
from client import HEALTH_WATCH, NOT_SERVING, SERVING, Client, Writer, frames_pb2, upload_files
from report import Result
from server import Server

ITEM = 13

OBJ = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"

# A transform that moves the triangle, as the rows of a 3 x 4 matrix.
MOVED = struct.pack("<12f", 1, 0, 0, 0.3, 0, 1, 0, 0.2, 0, 0, 1, 0)

# Seconds between the error of a call, or the limit on the time of a call, and NOT_SERVING.
MAX_SECONDS = 0.1

# The limit on the time of a call of the device, in seconds.
WORK_LIMIT = 2.0

# Exit code of a server whose device is lost.
EXIT_CODE = 7

# Seconds after which the check gives up.
GIVE_UP = 60.0

# Faults after which the device works: only the call fails.
FAILED_CALLS = ["frame:error:2", "pixels:error:2", "target:out-of-memory:2"]
# Losses of the renderer, and failed steps. The renderer is opened and all scenes are loaded again.
RECOVERIES = ["frame:lost:2", "pixels:lost:2", "target:lost:2", "deform:error:3", "deform:out-of-memory:3"]
# Losses of the device, which end the process.
LOST_DEVICES = ["deform:lost:3", "frame:endless:2", "pixels:endless:2", "deform:endless:3"]


class HealthLog:
    """The changes of the server's health and their times."""

    def __init__(self, server):
        self.client = Client(server)
        self.changes = []
        self.call = self.client.channel.unary_stream(HEALTH_WATCH)(b"")
        self.thread = threading.Thread(target=self.read)
        self.thread.start()

    def read(self):
        with contextlib.suppress(grpc.RpcError):
            for reply in self.call:
                self.changes.append((time.monotonic(), reply[1] if len(reply) > 1 else 0))

    def close(self):
        self.call.cancel()
        self.thread.join()
        self.client.channel.close()

    def first(self, status, start=0.0):
        """When the health was first `status` after a time; None if it never was."""
        return next((moment for moment, value in self.changes if value == status and moment >= start), None)

    def wait(self, status, start):
        deadline = time.monotonic() + GIVE_UP
        while self.first(status, start) is None and time.monotonic() < deadline:
            time.sleep(0.005)
        return self.first(status, start)


def frame(client, side):
    """The pixels of the scene, and the number of the step that they show."""
    # The second target of a server is that of another size.
    picture = frames_pb2.Picture(width=side, height=side, format=frames_pb2.FORMAT_RGBA)
    request = frames_pb2.RenderFrameRequest(scene="sent", pictures=[picture], deadline_ms=60_000)
    chunks = [reply.chunk for reply in client.frames.RenderFrame(request, timeout=120)]
    return b"".join(chunk.data for chunk in chunks), chunks[0].head.step.number


def move(writer, transform):
    """Sends a step. Returns whether it is rejected or the stream fails."""
    try:
        reply = writer.send_step(transform_domains=[0], transforms=transform, transform_format=1)
    except (grpc.RpcError, StopIteration):
        return True
    return reply.HasField("rejection")


def fails(call):
    try:
        return bool(call())
    except grpc.RpcError:
        return True


@contextlib.contextmanager
def moved_scene(program, plan, state, *flags):
    """A server with a planned fault, and a scene with two steps."""
    limit = ["--device-work-limit-ms", str(int(1000 * WORK_LIMIT))]
    environment = {"MODALCAST_INJECT": plan}
    with Server(program, *limit, *flags, renderer="software", state=state, environment=environment) as server:
        with Client(server) as client:
            upload_files(client, "sent", {"a.obj": OBJ})
            writer = Writer(client, "sent")
            assert not move(writer, MOVED)
            yield server, client, writer


def act(client, writer, plan, side):
    """The call that has the fault. Returns whether it fails."""
    if plan.startswith("deform"):
        return move(writer, struct.pack("<12f", 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0))
    return fails(lambda: frame(client, side) and False)


def fail_call(program, plan):
    """Whether a call fails, and the next frames and steps are right, without a change of the health."""
    with tempfile.TemporaryDirectory() as state, moved_scene(program, plan, state) as (server, client, writer):
        expected = frame(client, 256)
        log = HealthLog(server)
        has_failed = act(client, writer, plan, 320 if plan.startswith("target") else 256)
        is_right = frame(client, 256) == expected
        log.close()
        return has_failed and is_right and log.first(NOT_SERVING) is None


def recover(program, plan):
    """Whether a call fails, seconds until NOT_SERVING, seconds until SERVING, and whether the next frame is right."""
    with tempfile.TemporaryDirectory() as state, moved_scene(program, plan, state) as (server, client, writer):
        expected = frame(client, 256)
        log = HealthLog(server)
        has_failed = act(client, writer, plan, 320 if plan.startswith("target") else 256)
        error = time.monotonic()
        if not has_failed:
            log.close()
            return False, GIVE_UP, GIVE_UP, False
        lost = log.wait(NOT_SERVING, 0.0)
        open_again = log.wait(SERVING, lost or 0.0)
        is_right = frame(client, 256) == expected
        log.close()
        return True, (lost or error + GIVE_UP) - error, (open_again or error + GIVE_UP) - error, is_right


def lose_device(program, plan):
    """Whether a call fails, seconds until NOT_SERVING after the error or the limit, the exit code, and whether the next
    server has the scene and its last durable step."""
    with tempfile.TemporaryDirectory() as state:
        with moved_scene(program, plan, state) as (server, client, writer):
            expected = frame(client, 256)
            durable = 0
            deadline = time.monotonic() + GIVE_UP
            while durable < 1 and not plan.startswith("deform") and time.monotonic() < deadline:
                durable = writer.step()
            log = HealthLog(server)
            start = time.monotonic()
            has_failed = act(client, writer, plan, 256)
            error = start + WORK_LIMIT if "endless" in plan else time.monotonic()
            if not has_failed:
                log.close()
                return False, GIVE_UP, None, False
            lost = log.wait(NOT_SERVING, 0.0) or error + GIVE_UP
            try:
                code = server.process.wait(GIVE_UP)
            except subprocess.TimeoutExpired:
                code = None
            log.close()
        with Server(program, renderer="software", state=state) as server, Client(server) as client:
            deadline = time.monotonic() + GIVE_UP
            while client.list_reply().opening and time.monotonic() < deadline:
                time.sleep(0.05)
            is_right = frame(client, 256)[0] == expected[0]
        return True, lost - error, code, is_right


def run(program, fault_program):
    """`program` has no planned faults, whatever the environment says."""
    kept = [plan for plan in FAILED_CALLS if fail_call(fault_program, plan)]
    control_kept = [plan for plan in FAILED_CALLS[:1] if fail_call(program, plan)]
    recoveries = {plan: recover(fault_program, plan) for plan in RECOVERIES}
    control_recovery = recover(program, RECOVERIES[0])
    devices = {plan: lose_device(fault_program, plan) for plan in LOST_DEVICES}
    control_device = lose_device(program, LOST_DEVICES[0])
    slowest = max(seconds for _, seconds, _, _ in recoveries.values())
    reopened = max(seconds for _, _, seconds, _ in recoveries.values())
    recovered = [plan for plan, (failed, _, _, is_right) in recoveries.items() if failed and is_right]
    slowest_device = max(seconds for _, seconds, _, _ in devices.values())
    ended = [plan for plan, (failed, _, code, is_right) in devices.items() if failed and code == EXIT_CODE and is_right]
    return [
        Result(
            ITEM,
            f"errors of a device that affect one call: {', '.join(FAILED_CALLS)}",
            "the call fails, the next frame is right, and the health remains SERVING",
            f"right after {len(kept)} of {len(FAILED_CALLS)}",
            kept == FAILED_CALLS,
            f"a program without planned faults, {len(control_kept)} of 1",
            not control_kept,
        ),
        Result(
            ITEM,
            f"losses of the renderer, and failed steps: {', '.join(RECOVERIES)}",
            f"the call fails, NOT_SERVING within {1e3 * MAX_SECONDS:.0f} ms, then SERVING with the right frame",
            f"right after {len(recovered)} of {len(RECOVERIES)}, NOT_SERVING after at most {1e3 * slowest:.0f} ms, "
            f"SERVING after at most {reopened:.1f} s",
            recovered == RECOVERIES and slowest <= MAX_SECONDS and reopened < GIVE_UP,
            f"a program without planned faults, {'recovered' if control_recovery[0] else 'no error'}",
            not control_recovery[0],
        ),
        Result(
            ITEM,
            f"losses of the device and endless calls: {', '.join(LOST_DEVICES)}",
            f"the call fails, NOT_SERVING within {1e3 * MAX_SECONDS:.0f} ms of the error or of the limit of "
            f"{WORK_LIMIT:.0f} s, exit code {EXIT_CODE}, the next server shows the last step",
            f"right after {len(ended)} of {len(LOST_DEVICES)}, NOT_SERVING after at most {1e3 * slowest_device:.0f} ms",
            ended == LOST_DEVICES and slowest_device <= MAX_SECONDS,
            f"a program without planned faults, {'ended' if control_device[0] else 'no error'}",
            not control_device[0],
        ),
    ]
