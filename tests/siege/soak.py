"""Item 16 of `prove.py`: with clients that come and go, the resources of a server do not grow.

As a program, it runs for a time and prints the samples and trends as JSON."""

import argparse
import dataclasses
import datetime
import json
import mmap
import multiprocessing
import os
import random
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import trend
from report import Result
from server import Server

ITEM = 16

CLIENTS = 16
SCENES = ["scene-0", "scene-1", "scene-2"]

# Seconds of a client's life.
MIN_LIFE, MAX_LIFE = 1.0, 10.0

# The share of the time that is the warm-up, whose samples are not used. The bytes in use on the heap are constant after
# one minute. The resident memory grows longer, because the arenas of the allocator keep the most that they have had in
# use at once.
WARM_UP = 1 / 3

# Growth in 15 minutes that is the resolution of the test: bytes in use on the heap, bytes of resident memory,
# descriptors and threads. Growth is a failure if its 95 % confidence interval is above zero and the resolution.
PERIOD = 900
RESOLUTION = {"heap": 1 << 20, "rss": 8 << 20, "fds": 4, "threads": 4, "gpu": 1 << 20}

# Samples that the record keeps.
CURVE = 20

# The planted leak of the negative control, and the largest leak that the measured run may contain by its confidence
# interval: otherwise the noise could hide a leak of this size.
LEAKED_BYTES_PER_STEP = 1024


class StepCounter:
    """The acknowledged steps of all clients, in a file that is mapped into their processes and, for the negative
    control, into the server."""

    def __init__(self, path):
        path.write_bytes(bytes(8 * CLIENTS))
        with path.open("r+b") as file:
            self.memory = mmap.mmap(file.fileno(), 8 * CLIENTS)

    def add(self, slot, steps):
        count = struct.unpack_from("<Q", self.memory, 8 * slot)[0]
        struct.pack_into("<Q", self.memory, 8 * slot, count + steps)

    def total(self):
        return sum(struct.unpack(f"<{CLIENTS}Q", self.memory))


class Population:
    """Clients that come and go. Half of them are killed, also while they send."""

    def __init__(self, server, counter, has_renderer, seed=1):
        self.server = server
        self.counter = counter
        self.has_renderer = has_renderer
        self.random = random.Random(seed)
        # The clients are forked, because new interpreters take too much time.
        self.context = multiprocessing.get_context("fork")
        # For each slot, the process of its client and when it is killed.
        self.clients = [None] * CLIENTS
        self.lives = 0
        self.kills = 0

    def update(self):
        """Starts a client in each free slot, and kills those whose time has come."""
        for slot, client in enumerate(self.clients):
            if client is not None:
                process, kill_time = client
                if process.exitcode is None and time.monotonic() >= kill_time:
                    process.kill()
                    self.kills += 1
                process.join(0)
                if process.exitcode is None:
                    continue
                process.close()
            self.clients[slot] = self.start(slot)

    def start(self, slot):
        life = self.random.uniform(MIN_LIFE, MAX_LIFE)
        seed = self.random.random()
        process = self.context.Process(target=self.live, args=(slot, life, seed), daemon=True)
        process.start()
        self.lives += 1
        # Killed before the end, or long after it if it does not end.
        is_killed = self.random.random() < 0.5
        kill_time = time.monotonic() + (life * self.random.random() if is_killed else life + 30)
        return process, kill_time

    def live(self, slot, life, seed):
        from soak_clients import Life

        try:
            add = lambda steps: self.counter.add(slot, steps)  # noqa: E731
            Life(self.server, SCENES, slot, seed, self.has_renderer, add).live(life)
        except OSError:
            # The server may close the connection of a client that does not read.
            pass

    def stop(self):
        for client in self.clients:
            if client is not None and client[0].exitcode is None:
                client[0].kill()


def gpu_memory(pid):
    """GPU memory of a process in bytes. `None` without a GPU."""
    if not shutil.which("nvidia-smi"):
        return None
    query = ["nvidia-smi", "--query-compute-apps=pid,used_memory", "--format=csv,noheader,nounits"]
    lines = subprocess.run(query, capture_output=True, text=True, check=False).stdout.splitlines()
    used = [int(line.split(",")[1]) for line in lines if line.split(",")[0] == str(pid)]
    return sum(used) << 20


def sample(server, heap):
    descriptors = len(os.listdir(f"/proc/{server.process.pid}/fd"))
    (heap_bytes,) = struct.unpack("<Q", heap.read_bytes())
    values = {"heap": heap_bytes, "rss": server.memory(), "fds": descriptors, "threads": server.threads()}
    gpu = gpu_memory(server.process.pid)
    return values if gpu is None else values | {"gpu": gpu}


def build_heap_library(folder):
    library = folder / "heap.so"
    source = Path(__file__).with_name("heap.c")
    subprocess.run(["cc", "-O1", "-shared", "-fPIC", "-o", library, source, "-lpthread"], check=True)
    return library


def soak(program, seconds, leaks=False, renderer="software", backend="cpu", heap_library=None):
    """Runs clients for a time. Returns the samples and the trends after the warm-up."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scenes = folder / "scenes"
        scenes.mkdir()
        write_model(scenes)
        counter = StepCounter(folder / "steps")
        heap = folder / "heap"
        heap.write_bytes(bytes(8))
        environment = {"LD_PRELOAD": str(heap_library or build_heap_library(folder)), "SOAK_HEAP": str(heap)}
        environment |= {"SOAK_STEPS": str(folder / "steps")} if leaks else {}
        with Server(
            program, scenes=scenes, backend=backend, renderer=renderer, environment=environment
        ) as server:
            open_scenes(server)
            return observe(server, heap, counter, seconds, renderer != "off")


def observe(server, heap, counter, seconds, has_renderer):
    population = Population(server, counter, has_renderer)
    start = time.monotonic()
    samples, is_running = [], True
    try:
        while is_running and (elapsed := time.monotonic() - start) < seconds:
            population.update()
            if not samples or elapsed >= samples[-1]["time"] + 0.5:
                samples.append({"time": elapsed, "steps": counter.total()} | sample(server, heap))
            is_running = server.process.poll() is None
            time.sleep(0.02)
    finally:
        population.stop()
    measured = [entry for entry in samples if entry["time"] >= WARM_UP * seconds]
    duration = measured[-1]["time"] - measured[0]["time"]
    step_rate = (measured[-1]["steps"] - measured[0]["steps"]) / duration
    trends = {}
    for key in RESOLUTION.keys() & measured[0].keys():
        slope = trend.fit([(entry["time"], entry[key]) for entry in measured])
        trends[key] = {"slope": slope.slope, "uncertainty": slope.uncertainty, "grows": grows(key, slope)}
    return {
        "seconds": round(seconds),
        "is_running": is_running,
        "clients": CLIENTS,
        "lives": population.lives,
        "kills": population.kills,
        "steps": counter.total(),
        "steps_per_second": step_rate,
        "samples": len(measured),
        # Evenly spaced samples, also of the warm-up.
        "curve": samples[:: max(1, len(samples) // CURVE)],
        "trends": trends,
        # Fitted over the number of steps, because their rate varies.
        "heap_bytes_per_step": dataclasses.asdict(trend.fit([(entry["steps"], entry["heap"]) for entry in measured])),
    }


def grows(key, slope):
    """Whether a quantity grows by more than noise and resolution."""
    return slope.low() * PERIOD > RESOLUTION[key]


def write_model(folder):
    """A grid with the modes of an upload, as an OBJ file with a NumPy file."""
    from soak_clients import RANK, SIDE, upload_parts

    chunk = upload_parts("grid")[2].chunk
    positions, faces = 12 * SIDE * SIDE, 24 * (SIDE - 1) ** 2
    lines = [f"v {x} {y} {z}" for x, y, z in struct.iter_unpack("<3f", chunk[:positions])]
    for face in struct.iter_unpack("<3I", chunk[positions : positions + faces]):
        lines.append("f " + " ".join(str(vertex + 1) for vertex in face))
    (folder / "grid.obj").write_text("\n".join(lines) + "\n")
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({3 * SIDE * SIDE}, {RANK}), }}"
    modes = chunk[positions + faces :]
    (folder / "grid.npy").write_bytes(b"\x93NUMPY\x01\x00\x76\x00" + f"{header:<117}\n".encode() + modes)


def open_scenes(server):
    from soak_clients import Life, scenes_pb2

    client = Life(server, SCENES, 0, 0, False, None)
    for name in SCENES:
        request = scenes_pb2.OpenSceneRequest(source="grid.obj", scene=name)
        call = client.start("/modalcast.v1.SceneService/OpenScene", request)
        if not client.finish(call, time.monotonic() + 60):
            raise RuntimeError(f"expected an open scene: {server.log()}")
    client.socket.close()


def describe(run):
    """The trends of a run as text: growth in 15 minutes with its 95 % confidence interval."""
    units = {
        "heap": (1e6, " MB of heap"),
        "rss": (1e6, " MB resident"),
        "fds": (1, " fds"),
        "threads": (1, " threads"),
        "gpu": (1e6, " MB of the GPU"),
    }
    parts = []
    for key, entry in sorted(run["trends"].items()):
        scale, unit = units[key]
        parts.append(f"{PERIOD * entry['slope'] / scale:+.1f} ± {PERIOD * entry['uncertainty'] / scale:.1f}{unit}")
    return ", ".join(parts)


def start(program, seconds, *flags):
    """Runs this program, because clients must not be forked from a process with threads of gRPC."""
    command = [sys.executable, __file__, "--program", str(program), "--seconds", str(seconds), *flags]
    return json.loads(subprocess.run(command, stdout=subprocess.PIPE, check=True, text=True).stdout)


def run(program, seconds=1800):
    """The check. The negative control takes at most 5 minutes."""
    plain = start(program, seconds)
    leaking = start(program, min(seconds, 300), "--leak")
    growth, planted = (trend.Trend(**run["heap_bytes_per_step"]) for run in (plain, leaking))
    result = Result(
        ITEM,
        f"{CLIENTS} clients that come, go and are killed for {seconds / 60:.0f} min leave nothing behind",
        "growth in 15 min within noise, or below 1 MiB in use on the heap, 8 MiB of resident memory, 4 descriptors and 4 "
        f"threads; less than {LEAKED_BYTES_PER_STEP} bytes per step; the server runs",
        f"{describe(plain)}; {growth.slope:.0f} ± {growth.uncertainty:.0f} bytes per step; {plain['lives']} clients, "
        f"{plain['kills']} killed, {plain['steps']} steps",
        plain["is_running"]
        and not any(entry["grows"] for entry in plain["trends"].values())
        and growth.high() < LEAKED_BYTES_PER_STEP,
        f"a planted leak of {LEAKED_BYTES_PER_STEP} bytes per step, measured {planted.slope:.0f} ± {planted.uncertainty:.0f}",
        leaking["trends"]["heap"]["grows"] and planted.high() >= LEAKED_BYTES_PER_STEP,
    )
    return [result]


def prove(program, seconds):
    """Prints the result of the check. Ends with exit code 1 if it is not good."""
    results = run(program, seconds)
    for result in results:
        print(result.line())
    # The last line of the output is shown by `deploy/prove --full`.
    print(f"{results[0].measured}; control: {results[0].control}")
    sys.exit(0 if all(result.is_good() for result in results) else 1)


def main():
    parser = argparse.ArgumentParser(description="Runs clients that come and go, and measures the growth of a server.")
    parser.add_argument("--program", type=Path, required=True, help="the server, `modalcast`")
    parser.add_argument("--seconds", type=float, default=1800)
    parser.add_argument("--renderer", default="software", help="as of `modalcast serve`; default software")
    parser.add_argument("--backend", default="cpu", help="as of `modalcast serve`; default cpu")
    parser.add_argument("--heap-library", type=Path, help="heap.c as a shared library; default: compiled with cc")
    parser.add_argument("--leak", action="store_true", help="plants a leak of 1 KiB per step in the server")
    parser.add_argument("--prove", action="store_true", help="also plants a leak in a second run, and checks both")
    parser.add_argument("--record", type=Path, help="also writes the result to this file")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    if arguments.prove:
        prove(arguments.program.resolve(), arguments.seconds)
    result = soak(
        arguments.program.resolve(),
        arguments.seconds,
        arguments.leak,
        arguments.renderer,
        arguments.backend,
        arguments.heap_library,
    )
    result["date"] = datetime.date.today().isoformat()
    text = json.dumps(result, indent=2)
    if arguments.record:
        arguments.record.write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
