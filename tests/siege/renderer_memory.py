"""Item 9 of `prove.py`: the memory of a large frame is given back."""

import time

from client import Client, frames_pb2
from report import Result, mb
from server import Server

ITEM = 9

SIDE = 8192

# Limit on the growth of the memory in bytes, after WAIT seconds in which only small frames are drawn.
MAX_GROWTH = 256 << 20
WAIT = 14.0


def render(client, side):
    picture = frames_pb2.Picture(width=side, height=side, format=frames_pb2.FORMAT_RGBA)
    request = frames_pb2.RenderFrameRequest(scene="tree", pictures=[picture], deadline_ms=600_000)
    for _ in client.frames.RenderFrame(request, timeout=120):
        pass


def attack(program):
    """Growth of the memory right after a large frame, and some time later."""
    with Server(program, renderer="software") as server, Client(server) as client:
        client.open_scene("tree", "tree")
        render(client, 256)
        before = server.memory()
        render(client, SIDE)
        large = server.memory() - before
        deadline = time.monotonic() + WAIT
        while time.monotonic() < deadline:
            render(client, 256)
            time.sleep(0.2)
        return large, server.memory() - before


def run(program):
    large, later = attack(program)
    return [
        Result(
            ITEM,
            f"the memory of a frame of {SIDE} x {SIDE} pixels is given back",
            f"+{mb(MAX_GROWTH)} after {WAIT:.0f} s of small frames",
            f"+{mb(later)}",
            later <= MAX_GROWTH,
            f"right after the frame, +{mb(large)}",
            large > MAX_GROWTH,
        )
    ]
