"""Measures what a frame costs between the server and an array in this process.

Usage: frame_cost.py [--program target/release/modalcast] [--scene tree] [--size 1920x1080] [--rounds 60]

The server is a process of its own. Each frame is one request; the rows take turns. Numbers are medians in milliseconds:

- raw, png, jpeg: `scene.frame` in the format; a raw frame becomes an array, which is contiguous
- raw, grpcio alone: the messages of the raw frame are received and dropped, the least time of a client on grpcio
- wall: from the request to the frame; beyond stages: without the times of the server's stages (draw, read, encode);
  encode: of these, the time to encode; CPU: of this process with all threads of gRPC; faults: its page faults
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import time
from collections.abc import Callable
from typing import Any

import modalcast as mc
from modalcast._methods import RENDER_FRAME
from modalcast.frame import PictureOptions
from modalcast.v1 import frames_pb2

WARM_UP_ROUNDS = 5


def receive_only(scene: mc.Scene, size: tuple[int, int]) -> dict[str, float]:
    """Receives the messages of a raw frame. Returns the times of the server's stages."""
    options = PictureOptions([None], "color", *size, "raw", 90, has_rgb=True)
    request = frames_pb2.RenderFrameRequest(scene=scene.name, pictures=options.to_messages(scene.info.up))
    stream = scene._transport.stream(RENDER_FRAME, request, 60.0)
    first = stream.read()
    assert first is not None
    while stream.read() is not None:
        pass
    head = frames_pb2.RenderFrameResponse.FromString(first).chunk.head
    return {stage.stage: stage.milliseconds for stage in head.stages}


def measure(request: Callable[[], dict[str, float]]) -> list[float]:
    """The columns of one request."""
    faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    wall, cpu = time.perf_counter(), time.process_time()
    stages = request()
    wall, cpu = 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)
    faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - faults
    return [wall, wall - sum(stages.values()), stages.get("encode", 0.0), cpu, float(faults)]


def main() -> None:
    """Prints a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", help="path of `modalcast`")
    parser.add_argument("--scene", default="tree")
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--rounds", type=int, default=60)
    arguments = parser.parse_args()
    width, height = (int(side) for side in arguments.size.split("x"))
    with mc.spawn(program=arguments.program) as client:
        scene = client.open(arguments.scene)

        def frame(format_: Any) -> Callable[[], dict[str, float]]:
            return lambda: scene.frame(width=width, height=height, format=format_).stages

        rows = {name: frame(name) for name in ("raw", "png", "jpeg")}
        rows["raw, grpcio alone"] = lambda: receive_only(scene, (width, height))
        columns: dict[str, list[list[float]]] = {name: [] for name in rows}
        for number in range(WARM_UP_ROUNDS + arguments.rounds):
            for name, request in rows.items():
                measured = measure(request)
                if number >= WARM_UP_ROUNDS:
                    columns[name].append(measured)
    print(f"{arguments.scene}, {arguments.size}, {client.info.renderer}, load {os.getloadavg()[0]:.1f}")
    print(f"{'':20} {'wall':>8} {'beyond stages':>14} {'encode':>8} {'CPU':>8} {'faults':>8}")
    for name, values in columns.items():
        wall, beyond, encode, cpu, faults = (statistics.median(column) for column in zip(*values, strict=True))
        print(f"{name:20} {wall:8.2f} {beyond:14.2f} {encode:8.2f} {cpu:8.2f} {faults:8.0f}")


if __name__ == "__main__":
    main()
