"""Compares the rates of this client with those of the Rust client, on one machine and in one run.

Usage: rates.py --programs target/release [--scene tree] [--rounds 40] [--record FILE]

Build the programs with `cargo build --release --workspace --bins` and
`cargo build --release -p modalcast-client --example rates`. This program starts a server of its own. The clients take
turns after every time, so that other load on the machine affects both. A number is the median of all rounds in
milliseconds. `more` is the median difference of the two times of a round, with its 95 % confidence interval:

- sky: a step, its acknowledgment and a raw frame of 1280x720 as an array. The camera sees no domain, so that the time
  to draw, which is the same for both clients, does not hide their own
- frames: the same with a camera that sees the whole scene
- vertices: a request for the positions of all vertices as an array
- stream: the mean time per step of a lossless stream of positions, while `modalcast-sim` sends steps
- grpcio alone: the messages of `vertices` or `stream` are received and dropped, the least time of a client on grpcio
- chunk (data), chunk (protobuf): the time to read a chunk of 1 MiB into an array without and with protobuf
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

import modalcast as mc
from modalcast._decoders import FrameDecoder
from modalcast._methods import GET_VERTICES, STREAM_VERTICES
from modalcast._sync.transport import ReplyStream
from modalcast.v1 import common_pb2, frames_pb2, vertices_pb2
from modalcast.vertices import vertex_selection

MEASUREMENTS = ("sky", "frames", "vertices", "stream")
STREAM_STEPS = 50
"""Steps of a stream per time."""


def median_of(times: Iterable[float]) -> float:
    """The median in milliseconds of times in seconds."""
    return 1e3 * statistics.median(times)


def frame_times(scene: mc.Scene, camera: mc.Camera | None) -> Generator[float, None, None]:
    """A step and a frame."""
    q = np.zeros(scene.domains[0].rank)
    with scene.drive(joints=False) as drive:
        while True:
            q[0] += 1e-3
            start = time.perf_counter()
            drive.step(q={0: q})
            frame = scene.frame(camera, width=1280, height=720)
            seconds = time.perf_counter() - start
            assert frame.array.shape == (720, 1280, 3)
            yield seconds


def vertex_times(scene: mc.Scene) -> Generator[float, None, None]:
    """Positions on request."""
    while True:
        start = time.perf_counter()
        vertices = scene.vertices()
        seconds = time.perf_counter() - start
        assert len(vertices) == scene.vertex_count
        yield seconds


def stream_times(scene: mc.Scene) -> Generator[float, None, None]:
    """Positions in a stream."""
    while True:
        with scene.vertex_sets(delivery="lossless") as vertex_sets:
            next(vertex_sets)
            start = time.perf_counter()
            for _ in range(STREAM_STEPS):
                assert next(vertex_sets).positions is not None
            seconds = (time.perf_counter() - start) / STREAM_STEPS
        # The stream is closed, because a lossless stream without a reader stops the steps.
        yield seconds


def read_bytes(stream: ReplyStream, least: int) -> None:
    """Reads messages of at least so many bytes."""
    received = 0
    while received < least:
        message = stream.read()
        assert message is not None
        received += len(message)


def request_message_times(scene: mc.Scene) -> Generator[float, None, None]:
    """The messages of a request for positions, which are not decoded."""
    request = vertices_pb2.GetVerticesRequest(
        scene=scene.name, selection=vertex_selection(scene.domains, (), ("positions",)), deadline_ms=60_000
    )
    while True:
        start = time.perf_counter()
        stream = scene._transport.stream(GET_VERTICES, request, 60.0)
        while stream.read() is not None:
            pass
        yield time.perf_counter() - start


def stream_message_times(scene: mc.Scene) -> Generator[float, None, None]:
    """The messages of a stream of positions, which are not decoded."""
    request = vertices_pb2.StreamVerticesRequest(
        scene=scene.name,
        selection=vertex_selection(scene.domains, (), ("positions",)),
        delivery=common_pb2.DELIVERY_LOSSLESS,
    )
    step_bytes = 12 * scene.vertex_count
    while True:
        stream = scene._transport.subscribe(STREAM_VERTICES, request, wait_for_ready=False)
        # The first step also has the settings, the layout and the origins.
        read_bytes(stream, step_bytes)
        start = time.perf_counter()
        read_bytes(stream, STREAM_STEPS * step_bytes)
        seconds = (time.perf_counter() - start) / STREAM_STEPS
        stream.cancel()
        yield seconds


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


class Comparison:
    """A server, this client and the Rust client, which take turns. Each drives a scene of its own."""

    def __init__(self, client: mc.Client, source: str, programs: Path, rounds: int) -> None:
        self._url = f"http://{client.address}"
        self.scene = client.open(source, "python")
        client.open(source, "rust")
        self._programs = programs
        self._rounds = rounds

    def compare(self, what: str) -> dict[str, list[float]]:
        """Milliseconds of each round, by client."""
        scene = self.scene
        sky = mc.look_at(eye=(0, 1e3, 0), target=(0, 2e3, 0), up=(0, 0, 1))
        clients = {
            "sky": {"Python": frame_times(scene, sky)},
            "frames": {"Python": frame_times(scene, None)},
            "vertices": {"Python": vertex_times(scene), "grpcio alone": request_message_times(scene)},
            "stream": {"Python": stream_times(scene), "grpcio alone": stream_message_times(scene)},
        }[what]
        times: dict[str, list[float]] = {name: [] for name in ("Python", "Rust", *clients)}
        with contextlib.ExitStack() as stack:
            if what == "stream":
                stack.enter_context(self._steps())
            # Both read the scene that is driven.
            name = "rust" if what in {"sky", "frames"} else scene.name
            clients["Rust"] = stack.enter_context(self._rust_times(name, what))
            for measure in clients.values():
                next(measure)
            for _ in range(self._rounds):
                for client, measure in clients.items():
                    times[client].append(round(1e3 * next(measure), 4))
            for measure in clients.values():
                measure.close()
        return times

    @contextlib.contextmanager
    def _rust_times(self, scene: str, what: str) -> Iterator[Generator[float, None, None]]:
        """The times of the Rust client in seconds."""
        command = [self._programs / "examples" / "rates", self._url, scene, what]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:

            def times() -> Generator[float, None, None]:
                assert process.stdin is not None
                assert process.stdout is not None
                while True:
                    process.stdin.write("\n")
                    process.stdin.flush()
                    yield 1e-3 * float(process.stdout.readline())

            yield times()
            process.communicate()

    @contextlib.contextmanager
    def _steps(self) -> Iterator[None]:
        """Sends steps as fast as the server accepts them."""
        command = [self._programs / "modalcast-sim", "--server", self._url]
        command += ["--scene", self.scene.name, "--steps", "0"]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            before = self.scene.state().step
            while self.scene.state().step == before:
                if process.poll() is not None:
                    raise SystemExit(f"modalcast-sim ended with exit code {process.returncode}")
                time.sleep(0.01)
            yield
            process.terminate()


def median_interval(values: list[float]) -> dict[str, float]:
    """The median of independent values and its 95 % confidence interval, by the sign test.

    With a probability of about 95 %, between n/2 - 0.98 sqrt(n) and n/2 + 0.98 sqrt(n) of n values are below the
    median. With fewer than 6 values, the interval is that of all values, whose probability is lower.
    """
    ordered, count = sorted(values), len(values)
    rank = max(0, int(count / 2 - 0.98 * math.sqrt(count)))
    bounds = {"median": statistics.median(ordered), "lower": ordered[rank], "upper": ordered[count - 1 - rank]}
    return {name: round(value, 4) for name, value in bounds.items()}


def machine() -> dict[str, Any]:
    """The machine and the versions of the packages."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    cpu = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())
    packages = {name: metadata.version(name) for name in ("grpcio", "protobuf", "numpy")}
    return {"cpu": cpu, "threads": os.cpu_count(), "python": platform.python_version(), **packages}


def print_row(name: str, *columns: float | str) -> None:
    """Prints a row of the table."""
    cells = (f"{column:9.3f}" if isinstance(column, float) else f"{column:>9}" for column in columns)
    print(f"{name:22}", *cells, flush=True)


def main() -> None:
    """Prints a table, and writes a record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--programs", type=Path, required=True, help="the folder of the programs")
    parser.add_argument("--scene", default="tree")
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--record", type=Path, help="the JSON file to write")
    arguments = parser.parse_args()
    commit = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False).stdout.strip()
    record: dict[str, Any] = {
        "what": "times of the Python client and of the Rust client in milliseconds; `rates.py` explains the rows",
        "command": " ".join(["clients/python/tools/rates.py", *sys.argv[1:]]),
        "date": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "commit": commit,
        "machine": machine(),
        "rows": [],
    }
    print_row("milliseconds", "Python", "Rust", "more", "rate", "load", "more, 95 %")
    with mc.spawn(program=arguments.programs / "modalcast") as client:
        comparison = Comparison(client, arguments.scene, arguments.programs, arguments.rounds)
        record["server"] = {"version": client.info.version, "renderer": client.info.renderer}
        scene = comparison.scene
        record["scene"] = {"source": arguments.scene, "vertices": scene.vertex_count, "domains": len(scene.domains)}
        for what in MEASUREMENTS:
            loads = [os.getloadavg()[0]]
            rounds = comparison.compare(what)
            loads.append(os.getloadavg()[0])
            medians = {name: round(statistics.median(times), 4) for name, times in rounds.items()}
            python, rust = medians["Python"], medians["Rust"]
            row: dict[str, Any] = {"measurement": what, "medians_ms": medians}
            more = median_interval([p - r for p, r in zip(rounds["Python"], rounds["Rust"], strict=True)])
            row |= {"python_minus_rust_ms": more, "rate_of_rust": round(rust / python, 3)}
            row |= {"load_before_and_after": loads, "rounds_ms": rounds}
            record["rows"].append(row)
            interval = "{lower:.2f} to {upper:.2f}".format(**more)
            print_row(what, python, rust, more["median"], row["rate_of_rust"], loads[-1], interval)
            if "grpcio alone" in medians:
                print_row(f"{what}, grpcio alone", medians["grpcio alone"])
    chunks = chunk_times(200)
    for name, milliseconds in chunks.items():
        print_row(name, milliseconds)
    record["chunk_of_1_mib"] = {name: round(milliseconds, 4) for name, milliseconds in chunks.items()}
    if arguments.record is not None:
        arguments.record.write_text(json.dumps(record) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
