"""Views of worlds: small pictures equal frames of the same states, and worlds do not mix."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scenes import RANK, beam

import modalcast as mc
from modalcast import aio

SIDE = 32
R = 2 * RANK
NEAR = mc.look_at((1, 2, 4), (1, 1, 0.5))

# Views have no shadows, no ambient occlusion and one sample per pixel.
SETTINGS = """
shadows = false
ambient_occlusion = false
look = { antialias = "none" }
"""

DOMAINS = """
[[domain]]
name = "beam"
model = "beam.obj"
modes = "beam.npy"
material = { diffuse = [0.1, 0.3, 0.7] }

[[domain]]
name = "copy"
model = "beam.obj"
modes = "beam.npy"
placement = { translation = [0, 0, 1] }
"""


def write_scene(folder: Path, settings: str) -> Path:
    """Two beams in a folder with a scene.toml."""
    positions, faces, modes = beam()
    lines = [f"v {x} {y} {z}" for x, y, z in positions] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    (folder / "beam.obj").write_text("\n".join(lines))
    np.save(folder / "beam.npy", modes)
    (folder / "scene.toml").write_text(settings + DOMAINS)
    return folder


@pytest.fixture(scope="module")
def plain(client: mc.Client, tmp_path_factory: pytest.TempPathFactory) -> Iterator[mc.Scene]:
    """A scene whose frames have no effects that views lack."""
    scene = client.upload_files(write_scene(tmp_path_factory.mktemp("plain"), SETTINGS), "plain")
    yield scene
    scene.delete()


def random_states(count: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(count)
    transforms = np.tile(np.eye(4)[:3], (count, 2, 1, 1))
    transforms[:, 1, 2, 3] = 1
    transforms[:, :, :, 3] += random.normal(0, 0.2, (count, 2, 3))
    return random.normal(0, 0.3, (count, R)), transforms


def frame_of(scene: mc.Scene, q: np.ndarray, transforms: np.ndarray | None, camera: mc.Camera | None) -> mc.Frame:
    """A frame of a state, from a drive."""
    with scene.drive(reset=True) as drive:
        step = drive.step(q, transforms)
        outputs = ("color", "depth_with_ground", "domains", "normals")
        return scene.frame(camera, outputs=outputs, width=SIDE, height=SIDE, step=step)


def different_pixels(view: dict[str, np.ndarray], frame: mc.Frame) -> dict[str, int]:
    """Number of pixels that differ in each output; colors differ from two levels on."""
    color = np.abs(view["color"].astype(int) - frame.array).max(axis=-1) > 1
    with np.errstate(invalid="ignore"):
        depth = ~np.isclose(view["depth_with_ground"], frame["depth_with_ground"], rtol=1e-4)
    normals = np.abs(view["normals"] - frame.normals).max(axis=-1) > 1e-3
    # -1 and NO_DOMAIN have the same bits.
    domains = view["domains"] != frame.domains.view(np.int32)
    differences = {"color": color, "depth": depth, "normals": normals, "domains": domains}
    return {name: int(difference.sum()) for name, difference in differences.items()}


def test_views_equal_frames_of_the_same_state(plain: mc.Scene):
    q, transforms = random_states(4)
    cameras = [NEAR, None]
    outputs = ("color", "depth_with_ground", "domains", "normals")
    arrays = plain.render_states(q, transforms, cameras=cameras, size=SIDE, outputs=outputs)
    mixed = np.zeros(len(q), int)
    for state in range(len(q)):
        for index, camera in enumerate(cameras):
            frame = frame_of(plain, q[state], transforms[state], camera)
            assert (frame.domains != mc.NO_DOMAIN).sum() > 50
            view = {name: array[state, index] for name, array in arrays.items()}
            different = different_pixels(view, frame)
            # Edges between two faces of a domain have the color and the normal of either one.
            assert different["domains"] == 0
            assert max(different.values()) <= 5, different
            # Negative control: the view of another world.
            other = {name: array[state - 1, index] for name, array in arrays.items()}
            mixed[state] += different_pixels(other, frame)["domains"]
    assert (mixed > 20).all(), mixed


def test_arrays_have_documented_shapes_and_types(plain: mc.Scene):
    q, _ = random_states(3)
    arrays = plain.render_states(q, size=(12, 8), outputs=("color", "depth", "domains", "normals"))
    assert {name: (array.shape, array.dtype) for name, array in arrays.items()} == {
        "color": ((3, 1, 8, 12, 3), np.uint8),
        "depth": ((3, 1, 8, 12), np.float32),
        "domains": ((3, 1, 8, 12), np.int32),
        "normals": ((3, 1, 8, 12, 3), np.float32),
    }
    is_surface = arrays["domains"] >= 0
    assert set(np.unique(arrays["domains"])) == {-1, 0, 1}
    np.testing.assert_array_equal(np.isfinite(arrays["depth"]), is_surface)
    np.testing.assert_allclose(np.linalg.norm(arrays["normals"][is_surface], axis=-1), 1, atol=1e-3)
    assert not arrays["normals"][~is_surface].any()


def test_states_of_several_steps_are_in_order(plain: mc.Scene, tmp_path: Path):
    q, transforms = random_states(7)
    together = plain.render_states(q, transforms, cameras=[NEAR, None], size=SIDE)["color"]
    out = {"color": np.memmap(tmp_path / "color", np.uint8, "w+", shape=together.shape)}
    drawn: list[int] = []
    plain.render_states(
        q,
        transforms,
        cameras=[NEAR, None],
        size=SIDE,
        batch_size=3,
        out=out,
        progress=lambda done, _: drawn.append(done),
    )
    np.testing.assert_array_equal(out["color"], together)
    assert drawn == [3, 6, 7]
    for states, arrays in plain.iter_states(q, transforms, cameras=NEAR, size=SIDE, batch_size=2):
        np.testing.assert_array_equal(arrays["color"], together[states, :1])
    assert len({picture.tobytes() for picture in together[:, 0]}) == 7


def test_closed_loop_keeps_values_that_are_not_sent(plain: mc.Scene):
    q, transforms = random_states(6)
    rest = np.zeros((1, R))

    def expected(q: np.ndarray, transforms: np.ndarray | None = None) -> np.ndarray:
        return plain.render_states(q, transforms, cameras=NEAR, size=SIDE, outputs="domains")["domains"][:, 0]

    with plain.views(NEAR, worlds=4, size=SIDE, outputs="domains") as views:
        assert (views.worlds, views.view_count, views.shapes) == (4, 4, {"domains": (4, SIDE, SIDE)})
        np.testing.assert_array_equal(views.step()["domains"], np.repeat(expected(rest), 4, axis=0))
        np.testing.assert_array_equal(views.step(q[:4])["domains"], expected(q[:4]))
        out = {"domains": np.empty((4, SIDE, SIDE), np.int32)}
        assert views.step(q[4:], transforms[4:], worlds=[3, 1], out=out)["domains"] is out["domains"]
        np.testing.assert_array_equal(out["domains"][[0, 2]], expected(q[[0, 2]]))
        np.testing.assert_array_equal(out["domains"][[3, 1]], expected(q[4:], transforms[4:]))
        views.submit(q[2:])
        views.submit(transforms=transforms[:4])
        # World 0 has its transforms at rest, and worlds 1 and 3 those of the last step.
        first = views.result()["domains"]
        np.testing.assert_array_equal(first[0], expected(q[2:3])[0])
        np.testing.assert_array_equal(first[[1, 3]], expected(q[[3, 5]], transforms[[5, 4]]))
        np.testing.assert_array_equal(views.result()["domains"], expected(q[2:], transforms[:4]))
        assert "draw" in views.stages


def test_rejected_step_changes_nothing_and_views_remain_open(plain: mc.Scene):
    q, _ = random_states(2)
    wrong = q.copy()
    wrong[1, 3] = np.nan
    with plain.views(NEAR, worlds=2, size=SIDE) as views:
        before = views.step(q)["color"]
        with pytest.raises(mc.InvalidRequest) as error:
            views.step(wrong)
        assert (error.value.reason, error.value.step) == ("INVALID_FIELD", 1)
        np.testing.assert_array_equal(views.step()["color"], before)
        np.testing.assert_array_equal(views.step(q[::-1])["color"], before[::-1])


def test_views_leave_the_scene_and_its_writer(plain: mc.Scene):
    q, _ = random_states(2)
    with plain.drive(reset=True) as drive, plain.views(worlds=2, size=SIDE) as views:
        step = drive.step(q[0])
        views.step(q[::-1])
        plain.render_states(q, size=SIDE)
        state = plain.state()
        assert state.step == step
        np.testing.assert_array_equal(state.q, q[0].astype(np.float32))
        drive.step(q[1])
        drive.reset()


def test_each_world_has_its_cameras(plain: mc.Scene):
    q, _ = random_states(3)
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, 3] = [(1, 1, 4), (1, 1, 5), (0.5, 1, 4), (1, 1.5, 6)]
    worlds = [2, 0, 0, 1]
    expected = plain.render_states(q, cameras=[mc.at_pose(pose) for pose in poses], size=SIDE)["color"]
    with plain.views(mc.CameraPoses(poses), worlds=3, camera_worlds=worlds, size=SIDE) as views:
        assert views.view_count == 4
        np.testing.assert_array_equal(views.step(q)["color"], expected[worlds, range(4)])
        moved = views.step(cameras=mc.CameraPoses(poses[::-1]))["color"]
        np.testing.assert_array_equal(moved, expected[worlds, [3, 2, 1, 0]])
        np.testing.assert_array_equal(views.step()["color"], moved)


def test_step_of_several_messages_is_applied_as_one(plain: mc.Scene):
    worlds = 12_000
    q, transforms = (np.tile(values, (worlds // 4, *[1] * (values.ndim - 1))) for values in random_states(4))
    assert 4 * q.size + 4 * transforms.size > 1 << 20
    cameras = [mc.look_at((x, 2, 4), (1, 1, 0.5)) for x in (0, 1, 2)]
    seen = [0, 4001, 11_999]
    expected = plain.render_states(q[seen], transforms[seen], cameras=cameras, size=SIDE)["color"]
    with plain.views([NEAR] * 3, worlds=worlds, camera_worlds=seen, size=SIDE) as views:
        color = views.step(q, transforms, cameras=cameras)["color"]
        np.testing.assert_array_equal(color, expected[range(3), range(3)])


def test_attached_domains_move_with_their_parents(tree: mc.Scene):
    q = np.zeros((1, tree.coordinate_count), np.float32)
    q[0, tree._layout.q_slice(tree.domains["trunk"])][0] = 4
    with tree.drive(reset=True) as drive:
        drive.step(q[0])
        frame = tree.frame(outputs="domains", width=SIDE, height=SIDE)
        transforms = tree.state().transforms
        drive.reset()
    np.testing.assert_allclose(tree.joint_transforms(q)[0], transforms, atol=1e-5)
    # Transforms of attached domains are ignored, and others are not.
    moved = tree.joint_transforms(np.zeros_like(q)) + np.float32(1)
    trunk = tree.domains["trunk"].index
    np.testing.assert_array_equal(tree.joint_transforms(q, moved)[0, trunk], moved[0, trunk])
    joined = tree.render_states(q, size=SIDE, outputs="domains")["domains"][0, 0]
    assert (joined != frame.domains.view(np.int32)).sum() <= 5
    # Negative control: without joints, the branches stay where they are.
    apart = tree.render_states(q, size=SIDE, outputs="domains", joints=False)["domains"][0, 0]
    assert (apart != joined).sum() > 50


def test_scene_with_other_settings_is_refused(client: mc.Client, tmp_path: Path):
    scene = client.upload_files(write_scene(tmp_path, "look.edges = { width = 1 }\n"), "edges")
    with pytest.raises(mc.InvalidRequest, match="edges"):
        scene.views()
    scene.delete()
    with pytest.raises(mc.NotFound):
        scene.views()


def test_asyncio_draws_the_same_views(plain: mc.Scene):
    q, transforms = random_states(3)
    expected = plain.render_states(q, transforms, size=SIDE)["color"]

    async def use() -> None:
        async with await aio.connect(plain.client.address) as client:
            scene = await client.scene(plain.name)
            arrays = await scene.render_states(q, transforms, size=SIDE, batch_size=2)
            np.testing.assert_array_equal(arrays["color"], expected)
            async with await scene.views(worlds=3, size=SIDE) as views:
                np.testing.assert_array_equal((await views.step(q, transforms))["color"], expected[:, 0])
            np.testing.assert_array_equal(await scene.joint_transforms(q, transforms), transforms.astype(np.float32))

    asyncio.run(asyncio.wait_for(use(), 60))
