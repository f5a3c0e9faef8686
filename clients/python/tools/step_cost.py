"""Measures the CPU time of this process per step, with all threads of gRPC, on a scene of many domains.

Usage: step_cost.py [--program target/release/modalcast] [--domains 4096] [--rank 8] [--steps 3000] [--rounds 5]

The server is a process of its own. The rows take turns, and each number is the median of the rounds in milliseconds:

- all q, all T: `drive.step` with an array of all coordinates or of all transforms
- one q: the coordinates of one domain
- "waits": with `wait=True`, which includes waking up for the acknowledgment

`wall` is the time per step, which the server bounds.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable

import numpy as np

import modalcast as mc

WARM_UP_STEPS = 50


def many_domains(domains: int, rank: int) -> mc.SceneBuilder:
    """Tetrahedra with random modes in a grid."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    builder = mc.SceneBuilder("many")
    builder.add(positions, faces, 0.1 * np.random.default_rng(0).normal(size=(12, rank)), name="0")
    placement = np.eye(4)
    for index in range(1, domains):
        placement[[0, 2], 3] = 2 * (index % 64), 2 * (index // 64)
        builder.add_copy("0", name=str(index), placement=placement)
    return builder


def cost(drive: mc.Drive, step: Callable[[], object], steps: int) -> tuple[float, float]:
    """CPU and wall milliseconds per step."""
    for _ in range(WARM_UP_STEPS):
        step()
    drive.flush()
    wall, cpu = time.perf_counter(), time.process_time()
    for _ in range(steps):
        step()
    drive.flush()
    return 1e3 * (time.process_time() - cpu) / steps, 1e3 * (time.perf_counter() - wall) / steps


def main() -> None:
    """Prints a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", help="path of `modalcast`")
    parser.add_argument("--domains", type=int, default=4096)
    parser.add_argument("--rank", type=int, default=8)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    with mc.spawn(program=arguments.program) as client:
        scene = client.upload(many_domains(arguments.domains, arguments.rank))
        q = np.random.default_rng(1).random(scene.coordinate_count, np.float32)
        transforms = scene.state().transforms
        with scene.drive() as drive:
            rows: dict[str, Callable[[], object]] = {
                "all q": lambda: drive.step(q, wait=False),
                "all T": lambda: drive.step(transforms=transforms, wait=False),
                "one q": lambda: drive.step({0: q[: arguments.rank]}, wait=False),
                "all q, waits": lambda: drive.step(q),
                "one q, waits": lambda: drive.step({0: q[: arguments.rank]}),
            }
            costs: dict[str, list[tuple[float, float]]] = {name: [] for name in rows}
            for _ in range(arguments.rounds):
                for name, step in rows.items():
                    costs[name].append(cost(drive, step, arguments.steps))
    print(
        f"{arguments.domains} domains of {arguments.rank} modes, {client.info.backend}, load {os.getloadavg()[0]:.1f}"
    )
    print(f"{'milliseconds per step':22} {'CPU':>7} {'least':>7} {'wall':>7}")
    for name, times in costs.items():
        cpu, wall = zip(*times, strict=True)
        print(f"{name:22} {statistics.median(cpu):7.3f} {min(cpu):7.3f} {statistics.median(wall):7.3f}")


if __name__ == "__main__":
    main()
