"""Measures how many views per second a client receives: in a closed loop, pipelined, and of many states.

The server runs in a process of its own. The scene is a tube of 152 triangles with 8 modes, or an ellipsoid of 2,072
triangles; each world and each step has other values. Prints one JSON object per case.
"""

from __future__ import annotations

import argparse
import importlib
import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

import modalcast
from modalcast import CameraPoses, Client, SceneBuilder, look_at

MODES = 8
STATES = 4


def tube(sides: int, rings: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """A closed vertical tube of 2 (sides rings - 2) triangles."""
    angles = 2 * np.pi * np.arange(sides) / sides
    heights = np.linspace(0, 2, rings)
    x = np.stack(
        [np.tile(0.12 * np.cos(angles), rings), np.repeat(heights, sides), np.tile(0.12 * np.sin(angles), rings)]
    )
    faces = []
    for vertex in range(sides * (rings - 1)):
        following = vertex // sides * sides + (vertex + 1) % sides
        faces += [(vertex, vertex + sides, following), (following, vertex + sides, following + sides)]
    last = sides * (rings - 1)
    for side in range(1, sides - 1):
        faces += [(0, side, side + 1), (last, last + side + 1, last + side)]
    return x.T, np.array(faces)


def modes(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Modes that bend in x and z with growing wave numbers: 3n x MODES."""
    height = positions[:, 1] / np.ptp(positions[:, 1])
    U = np.zeros((len(positions), 3, MODES))
    for mode in range(MODES):
        wave = mode // 2 + 1
        U[:, 2 * (mode % 2), mode] = np.sin(0.75 * wave * np.pi * height) / wave
    return U.reshape(-1, MODES)


def upload(client: Client, name: str, sides: int, rings: int) -> Any:
    """Uploads a tube, without shadows in its views."""
    positions, faces = tube(sides, rings)
    return client.upload(SceneBuilder(name).add(positions, faces, modes(positions), color=(0.8, 0.45, 0.2)))


def coordinates(count: int, seed: int) -> NDArray[np.float32]:
    """Random coordinates: count x MODES."""
    scale = np.where(np.arange(MODES) < 4, 0.8, 0.25)
    return ((np.random.default_rng(seed).random((count, MODES)) - 0.5) * scale).astype(np.float32)


def transforms(count: int, seed: int) -> NDArray[np.float32]:
    """Random rotations about the vertical axis with small offsets: count x 3 x 4."""
    random = np.random.default_rng(seed)
    angle = 2 * np.pi * random.random(count)
    T = np.zeros((count, 3, 4), np.float32)
    T[:, 0, 0] = T[:, 2, 2] = np.cos(angle)
    T[:, 0, 2] = np.sin(angle)
    T[:, 2, 0] = -np.sin(angle)
    T[:, 1, 1] = 1
    T[:, :, 3] = 0.2 * (random.random((count, 3)) - 0.5)
    return T


def rate(work: Callable[[int], None], views: int, seconds: float) -> dict[str, float]:
    """Calls the work for about this long, after a quarter of that as a warm-up."""
    for limit in (0.25 * seconds, seconds):
        begin, cpu, steps = time.perf_counter(), time.process_time(), 0
        while time.perf_counter() - begin < limit or steps < 3:
            work(steps)
            steps += 1
        elapsed = time.perf_counter() - begin
    return {
        "views_per_s": round(views * steps / elapsed),
        "ms_per_step": round(1e3 * elapsed / steps, 3),
        "client_cpu_ms_per_step": round(1e3 * (time.process_time() - cpu) / steps, 3),
    }


def orbit(count: int, height: float, distance: float) -> CameraPoses:
    """Cameras around the vertical axis."""
    angle = 2 * np.pi * np.arange(count) / count
    T = np.zeros((count, 3, 4))
    T[:, 0, 0] = T[:, 2, 2] = np.cos(angle)
    T[:, 0, 2] = np.sin(angle)
    T[:, 2, 0] = -np.sin(angle)
    T[:, 1, 1] = 1
    T[:, 0, 3], T[:, 1, 3], T[:, 2, 3] = distance * np.sin(angle), height, distance * np.cos(angle)
    return CameraPoses(T)


def measure_tree(client: Client, arguments: argparse.Namespace, cameras: int) -> None:
    """Measures views of the built-in tree, whose coordinates all change, by many cameras."""
    tree = client.open("tree")
    rank = len(tree.state().q)
    q = [np.random.default_rng(seed).normal(0, 0.01, (1, rank)).astype(np.float32) for seed in range(STATES)]
    options: dict[str, Any] = {"device": "cuda"} if arguments.cuda else {}
    with tree.views(orbit(cameras, 5.0, 16.0), **options) as views:
        result = rate(lambda step: drop(views.step(q[step % STATES])), views.view_count, arguments.seconds)
        print(json.dumps({"scene": "tree", "cameras": cameras, **result, "stages": views.stages}), flush=True)


def drop(_: object) -> None:
    """Uses arrays that nobody reads."""


def measure_steps(scene: Any, arguments: argparse.Namespace, worlds: int) -> None:
    """Measures the cost of the values alone: one view of one pixel."""
    q = [coordinates(worlds, seed) for seed in range(STATES)]
    camera = look_at((0.0, 1.3, 4.0), (0.0, 1.0, 0.0))
    with scene.views(camera, worlds=worlds, camera_worlds=[0], size=1) as views:

        def pipelined(step: int) -> None:
            while views.in_flight < 4:
                views.submit(q[step % STATES])
            views.result()

        for case, work in (("closed loop", lambda step: drop(views.step(q[step % STATES]))), ("pipelined", pipelined)):
            result = rate(work, 1, arguments.seconds)
            print(json.dumps({"case": f"steps without pictures, {case}", "worlds": worlds, **result}), flush=True)
        while views.in_flight:
            views.result()


def measure(scene: Any, arguments: argparse.Namespace, worlds: int, size: int, outputs: tuple[str, ...]) -> None:
    """Measures a number of worlds, closed loop and pipelined."""
    q = [coordinates(worlds, seed) for seed in range(STATES)]
    T = [transforms(worlds, seed) for seed in range(STATES)]
    camera = look_at((0.0, 1.3, 4.0), (0.0, 1.0, 0.0))
    options: dict[str, Any] = {"device": "cuda"} if arguments.cuda else {}
    begin = time.perf_counter()
    with scene.views(camera, worlds=worlds, size=size, outputs=outputs, **options) as views:
        opened = time.perf_counter() - begin
        out = None if arguments.cuda else views.step(q[0], T[0])

        def closed_loop(step: int) -> None:
            arrays = views.step(q[step % STATES], T[step % STATES], out=out)
            if arguments.cuda:
                tensor = arguments.torch.from_dlpack(arrays[outputs[0]])
                # The next values depend on the pictures. Depths are infinite where nothing is.
                q[(step + 1) % STATES][0, 0] = 1e-4 * min(float(tensor[0, 0, 0].float().mean()), 255.0)

        def pipelined(step: int) -> None:
            while views.in_flight < 2:
                views.submit(q[step % STATES], T[step % STATES])
            views.result()

        def report(case: str, work: Callable[[int], None]) -> None:
            result = rate(work, views.view_count, arguments.seconds)
            head = {"scene": scene.name, "case": case, "worlds": worlds, "size": size, "outputs": outputs}
            print(json.dumps({**head, "opened_s": round(opened, 3), **result, "stages": views.stages}), flush=True)

        report("closed loop", closed_loop)
        report("pipelined", pipelined)
        while views.in_flight:
            views.result()


def main() -> None:
    """Prints one line per case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--address", help="default: starts a server")
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--worlds", type=int, nargs="+", default=[64, 1024, 4096])
    parser.add_argument("--states", type=int, default=100_000)
    parser.add_argument("--cuda", action="store_true", help="receive the pictures as tensors of torch on the GPU")
    arguments = parser.parse_args()
    if arguments.cuda:
        arguments.torch = importlib.import_module("torch")
    with modalcast.connect(arguments.address) if arguments.address else modalcast.spawn() as client:
        small, large = upload(client, "tube-152", 6, 13), upload(client, "tube-2072", 6, 173)
        for worlds in arguments.worlds:
            measure(small, arguments, worlds, 64, ("color",))
        measure(large, arguments, min(1024, max(arguments.worlds)), 64, ("color",))
        measure(small, arguments, min(1024, max(arguments.worlds)), 128, ("depth", "domains"))
        measure_steps(small, arguments, max(arguments.worlds))
        measure_tree(client, arguments, min(1024, max(arguments.worlds)))
        if arguments.states and not arguments.cuda:
            q = coordinates(arguments.states, 0)
            out = {"color": np.empty((len(q), 1, 64, 64, 3), np.uint8)}
            begin = time.perf_counter()
            small.render_states(q, cameras=look_at((0.0, 1.3, 4.0), (0.0, 1.0, 0.0)), out=out)
            elapsed = time.perf_counter() - begin
            print(json.dumps({"case": "render_states", "states": len(q), "states_per_s": round(len(q) / elapsed)}))


if __name__ == "__main__":
    main()
