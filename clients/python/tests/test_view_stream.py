"""Streams of views against a server of the tests: steps, arrays, replies that are malformed, and lost connections."""

from __future__ import annotations

import asyncio
import re
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from scenes import RANK
from view_server import FakeViewServer, Reply

import modalcast as mc
from modalcast import aio
from modalcast._async.transport import Transport as AsyncTransport
from modalcast._channel import ConnectOptions
from modalcast._sync.transport import Transport
from modalcast.v1 import views_pb2

DOMAINS = 2
R = DOMAINS * RANK


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeViewServer]:
    """A server that draws the views of all scenes of the test."""
    server = FakeViewServer(DOMAINS, RANK)
    transport = Transport(server.address, ConnectOptions())
    original, original_async = Transport.view_stream, AsyncTransport.view_stream
    monkeypatch.setattr(Transport, "view_stream", lambda _, memory=None: original(transport))
    monkeypatch.setattr(
        AsyncTransport,
        "view_stream",
        lambda _, memory=None: original_async(AsyncTransport(server.address, ConnectOptions())),
    )
    yield server
    transport.close()
    server.stop()


def random_q(count: int) -> np.ndarray:
    """Coordinates whose first one is the index of the state."""
    q = np.random.default_rng(count).random((count, R), np.float32)
    q[:, 0] = np.arange(count)
    return q


def first_depths(depth: np.ndarray) -> list[float]:
    return depth[..., 0, 0].ravel().tolist()


def test_arrays_have_documented_shapes_and_types(server: FakeViewServer, beams: mc.Scene):
    cameras = [mc.look_at((x, 1, 6), (1, 1, 0)) for x in (0, 100)]
    outputs = ("color", "depth", "domains", "normals")
    with beams.views(cameras, worlds=3, size=(6, 4), outputs=outputs) as views:
        assert (views.worlds, views.view_count, views.in_flight) == (3, 6, 0)
        arrays = views.step(random_q(3))
        assert views.stages == {"draw": 2.0}
    assert {name: (array.shape, array.dtype) for name, array in arrays.items()} == {
        "color": ((6, 4, 6, 3), np.uint8),
        "depth": ((6, 4, 6), np.float32),
        "domains": ((6, 4, 6), np.int32),
        "normals": ((6, 4, 6, 3), np.float32),
    }
    assert {name: array.shape for name, array in arrays.items()} == views.shapes
    assert first_depths(arrays["depth"]) == [0, 100, 1, 101, 2, 102]
    assert arrays["domains"][:, 0, 0].tolist() == [0, 0, 1, 1, 2, 2]


def test_states_are_drawn_in_batches_of_equal_size(server: FakeViewServer, beams: mc.Scene):
    q = random_q(11)
    transforms = np.zeros((11, DOMAINS, 4, 4))
    transforms[:, :, 3, 3] = 1
    transforms[:, 0, 0, 3] = 10 * np.arange(11)
    drawn: list[tuple[int, int]] = []
    arrays = beams.render_states(
        q,
        transforms,
        cameras=[mc.look_at((0, 1, 6), (1, 1, 0)), mc.look_at((100, 1, 6), (1, 1, 0))],
        size=4,
        outputs=("depth", "normals"),
        batch_size=4,
        progress=lambda done, total: drawn.append((done, total)),
    )
    assert arrays["depth"].shape == (11, 2, 4, 4)
    assert arrays["normals"].shape == (11, 2, 4, 4, 3)
    np.testing.assert_array_equal(arrays["depth"][:, :, 0, 0], np.arange(11)[:, None] + [0, 100])
    np.testing.assert_array_equal(arrays["normals"][:, 1, 2, 3, 0], 10 * np.arange(11))
    assert drawn == [(4, 11), (8, 11), (11, 11)]
    assert [step[-1].drawn_worlds for step in server.steps] == [0, 0, 3]
    assert not any(step[0].step.q_domains for step in server.steps)


def test_batch_size_bounds_views_and_bytes(server: FakeViewServer, beams: mc.Scene):
    # 64 x 64 x 3 bytes, of which 32 MiB are 2730 views.
    with beams.iter_states(np.zeros((6000, R))) as batches:
        assert batches.batch_size == 2000
    with beams.iter_states(np.zeros((5, R)), size=1024, outputs="normals") as batches:
        assert batches.batch_size == 2
    with beams.iter_states(np.zeros((5, R)), cameras=[None] * 3, size=1024, outputs="normals") as batches:
        assert batches.batch_size == 1
    # Half a message of 16 MiB.
    assert beams.client.info.limits.message_bytes == 16 << 20
    transforms = np.tile(np.eye(4), (100_000, DOMAINS, 1, 1))
    with beams.iter_states(np.zeros((100_000, R)), transforms, size=1) as batches:
        assert batches.batch_size == 50_000
    with pytest.raises(ValueError, match="batch_size: expected 1 to 65536 states, got 0"):
        beams.render_states(np.zeros((6000, R)), batch_size=0)
    assert server.calls == 4


def test_iterator_yields_slices_and_new_arrays(server: FakeViewServer, beams: mc.Scene):
    q = random_q(7)
    kept: list[tuple[slice, dict[str, np.ndarray]]] = list(beams.iter_states(q, size=4, outputs="depth", batch_size=3))
    assert [states for states, _ in kept] == [slice(0, 3), slice(3, 6), slice(6, 7)]
    for states, arrays in kept:
        assert first_depths(arrays["depth"]) == q[states, 0].tolist()
    # A caller that stops early releases the worlds.
    for _ in beams.iter_states(q, size=4, batch_size=1):
        break
    with beams.iter_states(q, size=4, batch_size=1) as batches:
        next(batches)
        batches.close()
        assert list(batches) == []


def test_out_receives_the_pictures(server: FakeViewServer, beams: mc.Scene, tmp_path: Path):
    out = {"depth": np.memmap(tmp_path / "depth", np.float32, "w+", shape=(5, 1, 4, 4))}
    arrays = beams.render_states(random_q(5), size=4, outputs="depth", batch_size=2, out=out)
    assert arrays["depth"] is out["depth"]
    out["depth"].flush()
    assert np.fromfile(tmp_path / "depth", np.float32).reshape(5, 16)[:, 0].tolist() == [0, 1, 2, 3, 4]
    reused = {"color": np.empty((2, 4, 4, 3), np.uint8)}
    with beams.views(worlds=2, size=4) as views:
        assert views.step(random_q(2), out=reused)["color"] is reused["color"]
        assert reused["color"][:, 0, 0, 0].tolist() == [0, 1]


def test_wrong_out_is_rejected(server: FakeViewServer, beams: mc.Scene):
    good = np.empty((2, 4, 4, 3), np.uint8)
    read_only = good.copy()
    read_only.flags.writeable = False
    cases: list[tuple[object, type[Exception], str]] = [
        ({}, ValueError, "out: expected arrays for the outputs ['color'], got []"),
        ({"depth": good}, ValueError, "out: expected arrays for the outputs ['color'], got ['depth']"),
        ({"color": good[:1]}, ValueError, "out['color']: expected shape (2, 4, 4, 3), got (1, 4, 4, 3)"),
        ({"color": good.astype(np.float32)}, ValueError, "array of uint8, got float32"),
        ({"color": np.empty((2, 4, 3, 4), np.uint8).swapaxes(2, 3)}, ValueError, "contiguous False, writable True"),
        ({"color": read_only}, ValueError, "contiguous True, writable False"),
        ({"color": [1]}, TypeError, "out['color']: expected an array of numpy, got list"),
    ]
    with beams.views(worlds=2, size=4) as views:
        for out, error, message in cases:
            with pytest.raises(error, match=re.escape(message)):
                views.step(out=out)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=re.escape("out['color']: expected shape (3, 1, 4, 4, 3), got (2, 4, 4, 3)")):
        beams.render_states(random_q(3), size=4, out={"color": good})


def test_partial_steps_change_the_listed_worlds(server: FakeViewServer, beams: mc.Scene):
    transforms = np.tile(np.eye(4)[:3], (2, DOMAINS, 1, 1))
    transforms[:, 0, 1, 3] = 5, 6
    with beams.views(worlds=4, size=2, outputs=("depth", "normals")) as views:
        views.step(random_q(4))
        arrays = views.step(random_q(2) + 50, transforms, worlds=[3, 1])
        assert first_depths(arrays["depth"]) == [0, 51, 2, 50]
        assert arrays["normals"][:, 0, 0, 1].tolist() == [0, 6, 0, 5]
        # Values that are not sent remain.
        assert first_depths(views.step(transforms=transforms[:1], worlds=np.array([2]))["depth"]) == [0, 51, 2, 50]
        assert first_depths(views.step(worlds=[])["depth"]) == [0, 51, 2, 50]
        for worlds, message in (
            ([1, 1], "worlds: expected each index once, got 1 several times"),
            ([1, 4], "worlds: expected indices of worlds below 4, got 4"),
            ([-1, 2], "worlds: expected indices of worlds below 4, got -1"),
            ([0.5, 1.0], "worlds: expected integers, got the type float64"),
            ([[1, 2]], "worlds: expected shape (n,), got (1, 2)"),
        ):
            with pytest.raises(ValueError, match=re.escape(message)):
                views.step(random_q(2), worlds=worlds)


def test_large_step_is_sent_in_parts(server: FakeViewServer, beams: mc.Scene):
    worlds = 30_000
    q = random_q(worlds)
    transforms = np.tile(np.eye(4), (worlds, DOMAINS, 1, 1))
    transforms[:, 0, 2, 3] = np.arange(worlds)
    cameras = [mc.look_at((7, 1, 6), (1, 1, 0))]
    with beams.views(worlds=worlds, size=1, outputs=("depth", "normals")) as views:
        arrays = views.step(q, transforms, cameras=cameras)
        np.testing.assert_array_equal(arrays["depth"].ravel(), np.arange(worlds) + 7)
        np.testing.assert_array_equal(arrays["normals"][:, 0, 0, 2], np.arange(worlds))
        order = np.random.default_rng(0).permutation(worlds)
        arrays = views.step(q, transforms, worlds=order)
        np.testing.assert_array_equal(arrays["depth"].ravel()[order], np.arange(worlds) + 7)
        np.testing.assert_array_equal(arrays["normals"][order, 0, 0, 2], np.arange(worlds))
    assert [len(step) > 5 for step in server.steps] == [True, True]


def test_rejected_step_changes_nothing_and_views_remain_open(server: FakeViewServer, beams: mc.Scene):
    wrong = random_q(2)
    wrong[1, 2] = np.nan
    with beams.views(worlds=2, size=2, outputs="depth") as views:
        views.step(random_q(2) + 3)
        with pytest.raises(mc.InvalidRequest) as error:
            views.step(wrong)
        assert (error.value.reason, error.value.field, error.value.step) == ("INVALID_FIELD", "step.q[8]", 1)
        assert first_depths(views.step()["depth"]) == [3, 4]
        # The results of the other steps in flight remain.
        views.submit(random_q(2))
        views.submit(wrong)
        views.submit(random_q(2) + 9)
        assert first_depths(views.result()["depth"]) == [0, 1]
        with pytest.raises(mc.InvalidRequest):
            views.result()
        assert first_depths(views.result()["depth"]) == [9, 10]


def test_steps_are_submitted_ahead(server: FakeViewServer, beams: mc.Scene):
    with beams.views(worlds=1, size=2, outputs="depth") as views:
        with pytest.raises(ValueError, match="result: expected a step in flight, got none"):
            views.result()
        q = random_q(1)
        for number in range(4):
            q[:] = number
            views.submit(q)
        assert views.in_flight == 4
        with pytest.raises(ValueError, match="expected less than 4 steps in flight"):
            views.submit(q)
        with pytest.raises(ValueError, match="expected no steps in flight, got 4"):
            views.step(q)
        assert [first_depths(views.result()["depth"]) for _ in range(4)] == [[0], [1], [2], [3]]
        views.submit(q)
    with pytest.raises(ValueError, match="the views are closed"):
        views.result()
    with pytest.raises(ValueError, match="the views are closed"):
        views.submit()
    views.close()
    views.finish()


def test_cameras_see_their_worlds(server: FakeViewServer, beams: mc.Scene):
    def cameras(*positions: float) -> list[mc.Camera | None]:
        return [None if x == 0 else mc.look_at((x, 1, 6), (1, 1, 0)) for x in positions]

    with beams.views(cameras(0, 100, 200), worlds=2, camera_worlds=[1, 1, 0], size=2, outputs="depth") as views:
        assert views.view_count == 3
        assert first_depths(views.step(random_q(2))["depth"]) == [1, 101, 200]
        assert first_depths(views.step(cameras=cameras(300, 0, 0))["depth"]) == [301, 1, 0]
        with pytest.raises(ValueError, match="cameras: expected 3, as at the start, got 1"):
            views.step(cameras=cameras(1))
    pinhole = mc.pinhole(np.eye(3), 8, 4, np.eye(4))
    with beams.views(pinhole) as views:
        assert views.shapes == {"color": (1, 4, 8, 3)}


def test_poses_are_cameras_with_one_lens(server: FakeViewServer, beams: mc.Scene):
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = 1, 2, 3
    poses[:, 2, 3] = 5
    lens = mc.pinhole([[90, 0, 1], [0, 80, 2], [0, 0, 1]], 2, 4, np.eye(4)).clipped(1, 9)
    for cameras, single in (
        (mc.CameraPoses(poses), [mc.at_pose(pose) for pose in poses]),
        (mc.CameraPoses(poses[:, :3], 30), [mc.at_pose(pose, 30) for pose in poses]),
        (
            mc.CameraPoses(poses, lens, "opencv"),
            [mc.pinhole([[90, 0, 1], [0, 80, 2], [0, 0, 1]], 2, 4, pose).clipped(1, 9) for pose in poses],
        ),
    ):
        step = views_pb2.ViewStep.FromString(cameras.encode(views_pb2.ViewStep.CAMERAS_FIELD_NUMBER))
        assert list(step.cameras) == [camera.to_message("y") for camera in single]
    with beams.views(mc.CameraPoses(poses, lens), worlds=3, camera_worlds=range(3), outputs="depth") as views:
        assert views.shapes == {"depth": (3, 4, 2)}
        assert first_depths(views.step(random_q(3))["depth"]) == [1, 3, 5]
        poses[:, 0, 3] = 10, 20, 30
        assert first_depths(views.step(cameras=mc.CameraPoses(poses))["depth"]) == [10, 21, 32]
    invalid: list[tuple[tuple[Any, ...], str]] = [
        ((poses[0],), "world_from_camera: expected shape (n, 3, 4) or (n, 4, 4), got (4, 4)"),
        ((poses, 45, "blender"), "convention: expected 'opencv' or 'opengl', got 'blender'"),
    ]
    for arguments, message in invalid:
        with pytest.raises(ValueError, match=re.escape(message)):
            mc.CameraPoses(*arguments)
    with pytest.raises(ValueError, match=re.escape("cameras[0]: expected a camera of 3 x 3 pixels, got 2 x 4")):
        beams.views(mc.CameraPoses(poses, lens), size=3)
    with pytest.raises(ValueError, match="cameras: expected 1 to 65536, got 0"):
        beams.views(mc.CameraPoses(poses[:0]))


def test_invalid_arguments_name_expected_and_given(server: FakeViewServer, beams: mc.Scene):
    pinhole = mc.pinhole(np.eye(3), 8, 4, np.eye(4))
    opened: list[tuple[dict[str, Any], type[Exception], str]] = [
        ({"worlds": 0}, ValueError, "worlds: expected 1 to 65536, got 0"),
        ({"worlds": 65_537}, ValueError, "worlds: expected 1 to 65536, got 65537"),
        ({"worlds": 1.5}, TypeError, "float"),
        ({"size": 0}, ValueError, "size: expected a width of 1 to 1024 pixels, got 0"),
        ({"size": (64, 1025)}, ValueError, "size: expected a height of 1 to 1024 pixels, got 1025"),
        ({"size": (1, 2, 3)}, ValueError, "size: expected a side, or a width and a height, got 3 numbers"),
        (
            {"size": 64, "cameras": [None, pinhole]},
            ValueError,
            "cameras[1]: expected a camera of 64 x 64 pixels, got 8 x 4",
        ),
        ({"outputs": "colour"}, ValueError, "outputs: expected names from ['color', 'depth', 'depth_with_ground'"),
        ({"outputs": ()}, ValueError, "got none"),
        ({"outputs": ("color", "color")}, ValueError, "outputs: expected each output once"),
        ({"outputs": ("depth", "depth_with_ground")}, ValueError, "expected 'depth' or 'depth_with_ground', got both"),
        ({"cameras": []}, ValueError, "cameras: expected 1 to 65536, got 0"),
        ({"cameras": ["front"]}, TypeError, "cameras[0]: expected a Camera or None, got str"),
        ({"worlds": 40_000, "cameras": [None] * 2}, ValueError, "at most 65536 views in a step, got 40000 worlds x 2"),
        ({"camera_worlds": [0]}, ValueError, "camera_worlds: expected cameras, one for each index, got none"),
        (
            {"camera_worlds": [0], "cameras": [None] * 2},
            ValueError,
            "camera_worlds: expected 2 indices, one per camera",
        ),
        (
            {"camera_worlds": [1], "cameras": [None]},
            ValueError,
            "camera_worlds: expected indices of worlds below 1, got 1",
        ),
    ]
    for arguments, error, message in opened:
        with pytest.raises(error, match=re.escape(message)):
            beams.views(**arguments)
    rendered: list[tuple[dict[str, Any], str]] = [
        ({}, "expected q or transforms, got none of them"),
        ({"q": np.zeros(R)}, f"q: expected shape (n, {R}), got ({R},)"),
        ({"q": np.zeros((3, R + 1))}, f"q: expected shape (n, {R}), got (3, {R + 1})"),
        ({"q": [["a"] * R]}, "q: expected an array of real numbers"),
        ({"q": np.full((3, R), 1e39)}, "3.4e38"),
        ({"q": [[0] * R, [0, np.inf, *[0] * (R - 2)]]}, "q: expected finite numbers, got others in state 1"),
        ({"transforms": np.eye(4)}, "transforms: expected shape (4, 2, 3, 4) or (4, 2, 4, 4), got (4, 4)"),
        ({"transforms": np.full((3, 2, 3, 4), np.nan)}, "transforms: expected finite numbers, got others in state 0"),
        ({"transforms": np.zeros((3, 2, 4, 4))}, "expected the last row 0 0 0 1"),
        (
            {"q": np.zeros((3, R)), "transforms": np.zeros((2, 2, 3, 4))},
            "transforms: expected shape (3, 2, 3, 4) or (3, 2, 4, 4), got (2, 2, 3, 4)",
        ),
    ]
    for arguments, message in rendered:
        with pytest.raises(ValueError, match=re.escape(message)):
            beams.render_states(**arguments)
    with beams.views(worlds=2) as views:
        with pytest.raises(ValueError, match=re.escape(f"q: expected shape (2, {R}), got (1, {R})")):
            views.step(np.zeros((1, R)))
        with pytest.raises(ValueError, match=re.escape("transforms: expected shape (2, 2, 3, 4)")):
            views.step(transforms=np.zeros((2, 3, 4)))


def test_no_states_are_empty_arrays_without_a_call(server: FakeViewServer, tree: mc.Scene):
    arrays = tree.render_states(np.empty((0, tree.coordinate_count)), size=(6, 4), outputs=("color", "depth"))
    assert {name: array.shape for name, array in arrays.items()} == {"color": (0, 1, 4, 6, 3), "depth": (0, 1, 4, 6)}
    assert list(tree.iter_states(np.empty((0, tree.coordinate_count)))) == []
    assert server.calls == 0


def test_progress_bar_needs_tqdm(server: FakeViewServer, beams: mc.Scene, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "tqdm.auto", None)
    with pytest.raises(ImportError, match="progress=True: expected the package tqdm, or a function"):
        beams.render_states(random_q(3), size=2, progress=True)

    class Bar:
        def __init__(self, total: int, unit: str) -> None:
            self.total, self.n = total, 0

        def update(self, count: int) -> None:
            self.n += count
            shown.append((self.n, self.total))

        def __enter__(self) -> Bar:
            return self

        def __exit__(self, *_: object) -> None:
            shown.append((-1, -1))

    shown: list[tuple[int, int]] = []
    module = types.ModuleType("tqdm.auto")
    module.tqdm = Bar  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setitem(sys.modules, "tqdm", types.ModuleType("tqdm"))
    monkeypatch.setitem(sys.modules, "tqdm.auto", module)
    beams.render_states(random_q(3), size=2, progress=True, batch_size=2)
    assert shown == [(2, 3), (3, 3), (-1, -1)]


def test_malformed_replies_are_errors(server: FakeViewServer, beams: mc.Scene):
    def replaced(**fields: object) -> Reply:
        chunk = views_pb2.ViewChunk(step=0, output="OUTPUT_COLOR", data=bytes(24))  # pyright: ignore
        for name, value in fields.items():
            setattr(chunk, name, value)
        return Reply(chunk=chunk)

    for replies, field in (
        ([replaced(step=1)], "views.step"),
        ([replaced(output=2)], "views.output"),
        ([replaced(offset=1)], "views.color.offset"),
        ([replaced(data=bytes(25))], "views.color.data"),
        ([replaced(), replaced()], "no message without a step"),
        ([Reply(opened=views_pb2.ViewsOpened())], "a chunk or a rejection"),
        ([Reply(rejection={"step": 7})], "views.rejection.step"),
    ):
        server.edit = lambda number, original, replies=replies: iter(replies) if number == 0 else original
        views = beams.views(worlds=2, size=2)
        views.submit(random_q(2))
        if len(replies) > 1:
            views.result()
            views._stream.finish(5)
            with pytest.raises(mc.MalformedReply, match=field):
                views.step()
        else:
            with pytest.raises(mc.MalformedReply, match=field):
                views.result()
        views.close()


def test_lost_connection_ends_views_but_not_a_batch(server: FakeViewServer, beams: mc.Scene):
    def break_once(number: int, replies: Iterator[Reply]) -> Iterator[Reply]:
        nonlocal breaks
        if number == 2 and breaks > 0:
            breaks -= 1
            raise ConnectionError
        return replies

    server.edit = break_once
    breaks = 1
    q = random_q(9)
    with beams.views(size=2, outputs="depth") as views:
        views.step(q[:1])
        views.step(q[:1])
        with pytest.raises(mc.ConnectionLost):
            views.step(q[:1])
    breaks, server.calls = 1, 0
    # The client of the tests has no time to reconnect.
    with pytest.raises(mc.ConnectionLost):
        beams.render_states(q, size=2, outputs="depth", batch_size=2)
    breaks, beams._reconnect = 2, 5.0
    depth = beams.render_states(q, size=2, outputs="depth", batch_size=2)["depth"]
    assert first_depths(depth) == list(range(9))
    assert (breaks, server.calls) == (0, 4)


def test_silent_server_exceeds_the_timeout(server: FakeViewServer, beams: mc.Scene):
    import threading

    release = threading.Event()

    def wait(number: int, replies: Iterator[Reply]) -> Iterator[Reply]:
        release.wait(10)
        yield from replies

    server.edit = wait
    with beams.views(size=2, outputs="depth") as views:
        with pytest.raises(mc.DeadlineExceeded, match=r"no reply to a step within 0\.2 s"):
            views.step(random_q(1) + 5, timeout=0.2)
        assert views.in_flight == 1
        release.set()
        assert first_depths(views.result()["depth"]) == [5]


def test_asyncio_has_the_same_calls(server: FakeViewServer, beams: mc.Scene):
    async def use() -> None:
        async with await aio.connect(beams.client.address) as client:
            scene = await client.scene(beams.name)
            async with await scene.views(worlds=2, size=2, outputs="depth") as views:
                await views.submit(random_q(2))
                await views.submit(random_q(2) + 5)
                assert first_depths((await views.result())["depth"]) == [0, 1]
                # A cancelled wait does not lose the step.
                task = asyncio.create_task(views.result())
                await asyncio.sleep(0)
                task.cancel()
                await asyncio.wait([task])
                assert first_depths((await views.result())["depth"]) == [5, 6]
                with pytest.raises(mc.InvalidRequest):
                    await views.step(np.full((2, R), np.nan))
                assert first_depths((await views.step())["depth"]) == [5, 6]
            depths = (await scene.render_states(random_q(5), size=2, outputs="depth", batch_size=2))["depth"]
            assert first_depths(depths) == [0, 1, 2, 3, 4]
            async for states, arrays in await scene.iter_states(random_q(3), size=2, outputs="depth", batch_size=2):
                assert first_depths(arrays["depth"]) == list(range(states.start, states.stop))

    asyncio.run(asyncio.wait_for(use(), 30))


def test_older_server_is_named(beams: mc.Scene, monkeypatch: pytest.MonkeyPatch):
    empty = grpc.server(__import__("concurrent.futures").futures.ThreadPoolExecutor(1))
    address = f"127.0.0.1:{empty.add_insecure_port('127.0.0.1:0')}"
    empty.start()
    transport = Transport(address, ConnectOptions())
    original = Transport.view_stream
    monkeypatch.setattr(Transport, "view_stream", lambda _, memory=None: original(transport))
    with pytest.raises(mc.Unavailable, match="expected a server that draws views, got an older one") as error:
        beams.render_states(np.zeros((1, R)))
    assert error.value.code == "UNIMPLEMENTED"

    async def use() -> None:
        original_async = AsyncTransport.view_stream
        async with await aio.connect(beams.client.address) as client:
            older = AsyncTransport(address, ConnectOptions())
            monkeypatch.setattr(AsyncTransport, "view_stream", lambda _, memory=None: original_async(older))
            with pytest.raises(mc.Unavailable, match="got an older one"):
                await (await client.scene(beams.name)).views()

    asyncio.run(use())
    transport.close()
    empty.stop(None)
