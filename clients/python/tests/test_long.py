"""Long tests: servers that die again and again, many cancelled calls, and long runs without growth."""

from __future__ import annotations

import asyncio
import gc
import os
import random
import signal
import threading
from collections.abc import Awaitable, Callable
from pathlib import Path

import numpy as np
import pytest
from scenes import SIZE, beam_builder
from test_connections import RestartableServer

import modalcast as mc
from modalcast import aio

pytestmark = pytest.mark.long

CAMERA = mc.look_at((1, 1, 6), (1, 1, 0))


def open_descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_values_survive_20_deaths_of_the_server(tmp_path: Path):
    """A drive, three streams and calls, while the server is killed and started 20 times."""
    server = RestartableServer(tmp_path / "state")
    with mc.connect(server.address, reconnect=30) as client:
        scene = client.upload(beam_builder("killed"))
        runs = {"frames": 0, "steps": 0, "vertices": 0}
        with (
            scene.drive(timeout=60) as drive,
            scene.frames(CAMERA, **SIZE) as frames,
            scene.steps() as steps,
            scene.vertex_sets() as vertices,
        ):

            def read(name: str, stream: mc.FrameStream | mc.Stream) -> None:
                for reply in stream:
                    runs[name] = reply.step.run

            streams = {"frames": frames, "steps": steps, "vertices": vertices}
            readers = [threading.Thread(target=read, args=item, daemon=True) for item in streams.items()]
            for reader in readers:
                reader.start()
            expected = np.zeros(6, np.float32)
            for death in range(20):
                domain = ("beam", "copy")[death % 2]
                values = np.random.default_rng(death).uniform(-1, 1, 3).astype(np.float32)
                expected[3 * (death % 2) :][:3] = values
                drive.step(q={domain: values})
                server.stop(signal.SIGKILL if death % 3 else signal.SIGTERM)
                threading.Timer(0.1 * (death % 4), server.start).start()
                # The drive sends all values again to the new server, where it has a larger run.
                run = drive.run
                while drive.run == run or set(runs.values()) != {drive.run}:
                    drive.step()
                assert scene.state().q.tolist() == expected.tolist(), f"death {death}"
                assert scene.vertices().shape == (scene.vertex_count, 3)
            for stream in streams.values():
                stream.close()
            for reader in readers:
                reader.join(10)
                assert not reader.is_alive()
    server.stop()


def test_500_cancellations_leave_the_client_usable(client: mc.Client):
    """Calls of every kind are cancelled at random times. The drive then has all values, and nothing is left open."""

    async def use(scene: aio.Scene) -> None:
        random_times = random.Random(7)
        async with await scene.drive() as drive:
            await drive.step()
            never = mc.StepId(drive.run, 1 << 40, 0)

            async def next_of(stream: Awaitable[aio.Stream]) -> None:
                async with await stream as opened:
                    await anext(opened)

            async def next_frame() -> None:
                async with await scene.frames(delivery="lossless", **SIZE) as frames:
                    await anext(frames)

            calls: list[Callable[[], Awaitable[object]]] = [
                lambda: scene.frame(step=never, **SIZE),
                lambda: scene.frame(**SIZE),
                scene.vertices,
                lambda: scene.state(step=never),
                lambda: scene.describe(["modes"]),
                lambda: scene.modes("beam"),
                lambda: scene.pick(80, 45, CAMERA, **SIZE),
                scene.client.scenes,
                lambda: next_of(scene.steps(delivery="lossless")),
                lambda: next_of(scene.vertex_sets(delivery="lossless")),
                lambda: next_of(scene.forces()),
                next_frame,
                drive.flush,
            ]
            cancelled, descriptors = 0, open_descriptors()
            for number in range(500):
                task = asyncio.ensure_future(calls[number % len(calls)]())
                await asyncio.sleep(random_times.choice([0, 0.001, 0.003, 0.01]))
                task.cancel()
                await asyncio.wait([task], timeout=10)
                assert task.done()
                cancelled += task.cancelled()
                if not task.cancelled():
                    task.result()
                await drive.step(q={"beam": [number, 0, 0]}, wait=number % 10 == 0)
            await drive.flush()
            assert cancelled > 100, "control: expected calls that were still waiting"
            assert (await scene.state()).q_of("beam").tolist() == [499, 0, 0]
            for _ in range(100):
                gc.collect()
                if open_descriptors() <= descriptors + 2:
                    break
                await asyncio.sleep(0.05)
            assert open_descriptors() <= descriptors + 2  # the connection of subscriptions
            others = {task for task in asyncio.all_tasks() if task is not asyncio.current_task()}
            reading = {task for task in others if "_read_replies" in repr(task.get_coro())}
            assert len(reading) == 1, "the reader of the drive"

    async def with_scene() -> None:
        async with await aio.connect(client.address) as other:
            scene = await other.upload(beam_builder("aio-cancellations"))
            try:
                await use(scene)
            finally:
                await scene.delete()

    asyncio.run(with_scene())


def test_3000_steps_with_frames_need_no_more_memory(beams: mc.Scene):
    with beams.drive() as drive, beams.frames(CAMERA, **SIZE) as frames, beams.steps() as states:

        def run(count: int) -> int:
            for number in range(count):
                step = drive.step(q={"beam": [np.sin(number), 0, 0]})
                assert next(state for state in states if state.step == step).q[0] == np.float32(np.sin(number))
                assert next(frame for frame in frames if frame.step == step).array.shape == (90, 160, 3)
                assert beams.vertices(step=step).shape == (beams.vertex_count, 3)
            gc.collect()
            return resident_bytes()

        run(500)
        before, descriptors = resident_bytes(), open_descriptors()
        after = run(2500)
        # A frame has 57,600 bytes, so that every frame that is not freed would add 137 MB.
        assert after - before < 20 << 20
        assert open_descriptors() <= descriptors
        kept = [b"x" * (57_600 + number) for number in range(2500)]
        assert resident_bytes() - after > 100 << 20, "control: memory that is not freed is measured"
        del kept
