"""Measures the rates of this client, and of the Rust client in the same run.

Usage: rates.py --rust PATH [--scene tree] [--rounds 5]. Needs a server: --address, by default 127.0.0.1:50051.
`cargo build --release -p modalcast-client --example rates` builds the program for --rust.

The clients take turns, so that other load on the machine affects both. Each number is the median of the medians of all
rounds, in milliseconds:

- frames: a step, its acknowledgment and a raw frame of 1280x720 as an array
- vertices: the positions of all vertices as an array
- stream: the mean time per step of a lossless stream of positions, while another process sends steps
- chunk (data), chunk (protobuf): the time to read a chunk of 1 MiB into an array without and with protobuf
"""

from __future__ import annotations

import argparse
import multiprocessing
import statistics
import subprocess
import time
from collections.abc import Callable, Iterator

import numpy as np

import modalcast as mc
from modalcast._decoders import FrameDecoder
from modalcast.v1 import frames_pb2

COUNTS = {"frames": 20, "vertices": 50, "stream": 300}


def median_of(times: Iterator[float]) -> float:
    """The median in milliseconds of times in seconds."""
    return 1e3 * statistics.median(times)


def frame_times(scene: mc.Scene, count: int) -> Iterator[float]:
    """Times of a step, its acknowledgment and a frame, in seconds."""
    q = np.zeros(scene.domains[0].rank)
    with scene.drive(joints=False) as drive:
        for number in range(count):
            q[0] = number * 1e-3
            start = time.perf_counter()
            drive.step(q={0: q})
            frame = scene.frame(width=1280, height=720)
            assert frame.array.shape == (720, 1280, 3)
            yield time.perf_counter() - start


def vertex_times(scene: mc.Scene, count: int) -> Iterator[float]:
    """Times of a call that returns all positions, in seconds."""
    for _ in range(count):
        start = time.perf_counter()
        assert len(scene.vertices()) == scene.vertex_count
        yield time.perf_counter() - start


def stream_times(scene: mc.Scene, count: int) -> Iterator[float]:
    """The mean time per step of a stream of positions, in seconds."""
    with scene.vertex_sets(delivery="lossless") as vertex_sets:
        next(vertex_sets)
        start = time.perf_counter()
        for _ in range(count):
            assert next(vertex_sets).positions is not None
        yield (time.perf_counter() - start) / count


def send_steps(address: str, name: str) -> None:
    """Sends steps as fast as the server accepts them."""
    with mc.connect(address) as client:
        scene = client.scene(name)
        q = np.zeros(scene.domains[0].rank)
        with scene.drive(joints=False, take_over=True, window=8) as drive:
            while True:
                q[0] += 1e-4
                drive.step(q={0: q}, wait=False)


def chunk_times(count: int) -> dict[str, float]:
    """Median times to read a frame of one chunk of 1 MiB, in milliseconds, without a server."""
    size = 1 << 20
    head = frames_pb2.FrameHead(width=512, height=512, format=frames_pb2.FORMAT_RGBA, total=size)
    chunk = frames_pb2.FrameChunk(head=head, data=bytes(size))
    message = frames_pb2.RenderFrameResponse(chunk=chunk).SerializeToString()
    pixels = np.empty(size, np.uint8)

    def with_protobuf() -> None:
        reply = frames_pb2.RenderFrameResponse.FromString(message)
        pixels[:] = np.frombuffer(reply.chunk.data, np.uint8)

    def without_protobuf() -> None:
        FrameDecoder(["color"], 1, chunk_field=1).add(message)

    def times(read: Callable[[], None]) -> Iterator[float]:
        for _ in range(count):
            start = time.perf_counter()
            read()
            yield time.perf_counter() - start

    return {"chunk (data)": median_of(times(without_protobuf)), "chunk (protobuf)": median_of(times(with_protobuf))}


def rust_median(program: str, address: str, name: str, what: str) -> float:
    """The median of the Rust client in milliseconds."""
    command = [program, f"http://{address}", name, what, str(COUNTS[what])]
    return float(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def main() -> None:
    """Prints a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rust", required=True, help="the program `rates` of modalcast-client")
    parser.add_argument("--address", default="127.0.0.1:50051")
    parser.add_argument("--scene", default="tree")
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    measures = {"frames": frame_times, "vertices": vertex_times, "stream": stream_times}
    print(f"{'measurement':18} {'Python':>8} {'Rust':>8}")
    with mc.connect(arguments.address) as client:
        scene = client.open(arguments.scene)
        for what, measure in measures.items():
            sender = multiprocessing.get_context("spawn").Process(
                target=send_steps, args=(arguments.address, scene.name), daemon=True
            )
            if what == "stream":
                sender.start()
            medians: dict[str, list[float]] = {"python": [], "rust": []}
            for _ in range(arguments.rounds):
                medians["python"].append(median_of(measure(scene, COUNTS[what])))
                medians["rust"].append(rust_median(arguments.rust, arguments.address, scene.name, what))
            if what == "stream":
                sender.terminate()
            of_python, of_rust = statistics.median(medians["python"]), statistics.median(medians["rust"])
            print(f"{what:18} {of_python:8.2f} {of_rust:8.2f}")
    for name, milliseconds in chunk_times(200).items():
        print(f"{name:18} {milliseconds:8.3f}")


if __name__ == "__main__":
    main()
