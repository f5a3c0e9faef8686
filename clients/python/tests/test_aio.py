"""The asyncio client: the same calls as coroutines, and cancellation."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Awaitable, Callable

import numpy as np
import pytest
from scenes import SIZE, beam, beam_builder

import modalcast as mc
from modalcast import aio


def run(client: mc.Client, name: str, test: Callable[[aio.Scene], Awaitable[None]]) -> None:
    """Runs a coroutine with a scene of two beams."""

    async def with_scene() -> None:
        async with await aio.connect(client.address) as other:
            scene = await other.upload(beam_builder(name))
            try:
                await asyncio.wait_for(test(scene), 30)
            finally:
                await scene.delete()

    asyncio.run(with_scene())


def test_calls_are_coroutines(client: mc.Client):
    async def use(scene: aio.Scene) -> None:
        async with await scene.drive() as drive:
            step = await drive.step(q={"beam": [0.5, 0, 0]})
        vertices = await scene.vertices(step=step)
        np.testing.assert_allclose(vertices[: len(vertices) // 2], beam()[0] + beam()[2] @ [0.5, 0, 0], atol=1e-6)
        frame = await scene.frame(outputs=("color", "domains"), **SIZE)
        assert frame.array.shape == (90, 160, 3)
        assert (await scene.state()).q_of("beam").tolist() == [0.5, 0, 0]
        description = await scene.describe(["modes"])
        np.testing.assert_array_equal(await scene.modes("beam"), description.shapes[0].arrays["modes"])
        hit = await scene.pick(80, 45, mc.look_at((1, 1, 6), (1, 1, 0)), **SIZE)
        assert hit is not None
        async with await scene.forces() as forces:
            await scene.apply_forces([hit.force((0, 1, 0))])
            received = [await anext(forces), await anext(forces)]
            assert len(received[-1].forces) == 1

    run(client, "aio-calls", use)


def test_streams_are_asynchronous_iterators(client: mc.Client):
    async def use(scene: aio.Scene) -> None:
        async with (
            await scene.drive() as drive,
            await scene.frames(delivery="lossless", count=3, **SIZE) as frames,
            await scene.steps(delivery="lossless", count=3) as steps,
        ):

            async def numbers() -> list[int]:
                return [frame.step.number async for frame in frames]

            reader = asyncio.create_task(numbers())
            for number in range(3):
                await drive.step(q={"copy": [number, 0, 0]}, wait=False)
            assert await reader == [0, 1, 2]
            assert [state.q_of("copy")[0] async for state in steps] == [0, 1, 2]

    run(client, "aio-streams", use)


def test_errors_are_those_of_the_synchronous_client(client: mc.Client):
    async def use(scene: aio.Scene) -> None:
        async with await scene.drive() as drive:
            with pytest.raises(ValueError, match="q of domain 'beam'"):
                await drive.step(q={"beam": [1]})
            with pytest.raises(mc.InvalidRequest) as error:
                await drive.step(q={"beam": [float("nan"), 0, 0]})
            assert error.value.field == "step.q[0]"
            with pytest.raises(mc.AlreadyExists):
                await scene.drive()
            with pytest.raises(mc.DeadlineExceeded):
                await scene.frame(step=mc.StepId(drive.run, 99, 0), timeout=0.2)
        with pytest.raises(mc.NotFound):
            await scene.client.open("three")

    run(client, "aio-errors", use)


def test_cancelled_calls_leave_the_client_usable(client: mc.Client):
    async def use(scene: aio.Scene) -> None:
        async with await scene.drive() as drive:
            await drive.step()
            never = mc.StepId(drive.run, 99, 0)
            for call in (scene.frame(step=never), scene.state(step=never), scene.vertices(step=never)):
                with pytest.raises(TimeoutError):
                    await asyncio.wait_for(call, 0.1)
            async with await scene.steps(delivery="lossless") as steps:
                task = asyncio.create_task(anext(steps))
                await asyncio.sleep(0.05)
                task.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await task
            await drive.step(q={"beam": [1, 2, 3]})
        assert (await scene.state()).q_of("beam").tolist() == [1, 2, 3]

    run(client, "aio-cancel", use)


def test_cancelled_flush_does_not_end_the_drive(client: mc.Client):
    async def use(scene: aio.Scene) -> None:
        async with await scene.drive() as drive:
            for number in range(20):
                await drive.step(q={"beam": [number, 0, 0]}, wait=False)
            flush = asyncio.create_task(drive.flush())
            await asyncio.sleep(0)
            flush.cancel()
            await asyncio.wait([flush])
            await drive.step(q={"copy": [1, 0, 0]})
        assert (await scene.state()).q.tolist() == [19, 0, 0, 1, 0, 0]

    run(client, "aio-flush", use)


def test_20_clients_in_one_loop_leave_no_descriptors(client: mc.Client):
    async def connect_once() -> None:
        async with await aio.connect(client.address) as other:
            await other.scenes()

    async def count() -> tuple[int, int]:
        await connect_once()
        before = len(os.listdir("/proc/self/fd"))  # noqa: PTH208
        await asyncio.gather(*(connect_once() for _ in range(20)))
        for _ in range(100):
            await asyncio.sleep(0.05)
            if len(os.listdir("/proc/self/fd")) <= before:  # noqa: PTH208
                break
        return before, len(os.listdir("/proc/self/fd"))  # noqa: PTH208

    before, after = asyncio.run(count())
    assert after <= before


def test_spawn_starts_a_server(client: mc.Client):
    async def use() -> None:
        async with await aio.spawn(arguments=["--backend", "cpu", "--renderer", "software"]) as spawned:
            assert spawned.address != client.address
            assert (await spawned.open("tree")).domains["trunk"].rank > 0

    asyncio.run(use())
