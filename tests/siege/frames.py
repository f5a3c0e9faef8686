"""Item 8 of `prove.py`: large frames of one client do not delay the frames of another one."""

import time

import grpc
import http2
from client import RENDER_FRAME, Client, common_pb2, frames_pb2
from report import Result, mb
from server import Peak, Server

ITEM = 8

# The attacker requests FRAMES frames of SIDE x SIDE pixels at a time.
FRAMES = 8
SIDE = 8192

# Seconds within which another client receives a small frame, during the attack and after it was canceled.
MAX_SECONDS = 2.0

# Limit on the growth of the memory in bytes.
MAX_MEMORY = 2 << 30

# Seconds of the attack before it is canceled.
DURATION = 15.0


def picture(side):
    return frames_pb2.Picture(width=side, height=side, format=frames_pb2.FORMAT_RGBA)


def request(scene, side):
    return frames_pb2.RenderFrameRequest(scene=scene, pictures=[picture(side)], deadline_ms=600_000)


def render(client, scene, side):
    """Seconds until a frame is received."""
    start = time.monotonic()
    for _ in client.frames.RenderFrame(request(scene, side), timeout=120):
        pass
    return time.monotonic() - start


def slowest(client, seconds, memory):
    """The longest `render` of small frames for a time. Samples `memory`."""
    deadline, result = time.monotonic() + seconds, 0.0
    while time.monotonic() < deadline:
        result = max(result, render(client, "viewed", 256))
        memory.sample()
        time.sleep(0.02)
    return result


def accepted_streams(server):
    """How many streams of large frames the server accepts on one connection."""
    with Client(server) as client:
        stream = frames_pb2.StreamFramesRequest(
            scene="viewed", pictures=[picture(SIDE)], delivery=common_pb2.DELIVERY_LOSSLESS
        )
        calls, accepted = [], 0
        for _ in range(FRAMES):
            call = client.frames.StreamFrames(stream, timeout=20)
            calls.append(call)
            try:
                next(call)
                accepted += 1
            except grpc.RpcError as error:
                if error.code() != grpc.StatusCode.RESOURCE_EXHAUSTED:
                    raise
        for call in calls:
            call.cancel()
        return accepted


def attack(program):
    """The slowest small frames alone, during the attack and after it, the number of accepted streams, the growth of the
    memory, and the time of one large frame."""
    with Server(program, renderer="software") as server, Client(server) as client:
        client.open_scene("tree", "viewed")
        client.open_scene("tree", "attacked")
        render(client, "attacked", 256)
        render(client, "viewed", 256)
        streams = accepted_streams(server)
        memory = Peak(server.memory)
        alone = slowest(client, 2, memory)
        # The replies are received, but they are not read. The largest windows let the server send everything.
        attacker = http2.Connection(server.port, initial_window=http2.MAX_WINDOW)
        attacker.send(http2.window_update(0, http2.MAX_WINDOW - http2.FIRST_WINDOW))
        message = http2.grpc_message(request("attacked", SIDE).SerializeToString())
        for _ in range(FRAMES):
            attacker.send_data(attacker.open_call(RENDER_FRAME), message, http2.END_STREAM)
        during = slowest(client, DURATION, memory)
        attacker.close()
        after = slowest(client, 3, memory)
        try:
            large = render(client, "attacked", SIDE)
        except grpc.RpcError:
            large = float("inf")
        return alone, during, after, streams, memory.growth(), large


def run(program):
    alone, during, after, streams, memory, large = attack(program)
    return [
        Result(
            ITEM,
            f"{FRAMES} frames of {SIDE} x {SIDE} pixels of one client do not delay the small frames of another one",
            f"within {MAX_SECONDS:.0f} s, also after the large ones were canceled; memory +{mb(MAX_MEMORY)}; "
            f"one stream of such frames per connection",
            f"alone {alone:.2f} s, during the attack {during:.2f} s, after it {after:.2f} s, +{mb(memory)}; "
            f"{streams} of {FRAMES} streams accepted",
            max(during, after) <= MAX_SECONDS and memory <= MAX_MEMORY and streams == 1,
            f"a large frame itself, {large:.1f} s",
            large > MAX_SECONDS,
        )
    ]
