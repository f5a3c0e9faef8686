from __future__ import annotations

import base64
import json
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import RANK, beam

import modalcast as mc
from modalcast.states import StateLayout


def expected_beam(q: np.ndarray) -> np.ndarray:
    positions, _, modes = beam()
    return positions + modes @ q


def test_step_moves_vertices_by_u_q(beams: mc.Scene):
    q = np.array([0.25, -0.5, 0.125])
    with beams.drive() as drive:
        step = drive.step(q={"copy": q})
        vertices = beams.vertices(step=step, exact=True)
    n = len(vertices) // 2
    np.testing.assert_allclose(vertices[:n], expected_beam(np.zeros(RANK)), atol=1e-6)
    np.testing.assert_allclose(vertices[n:], expected_beam(q) + [0, 0, 1], atol=1e-6)
    assert (step.number, step.time) == (0, 0.0)


def test_all_coordinates_of_scene_are_one_array(beams: mc.Scene):
    with beams.drive(dt=0.5) as drive:
        drive.step(np.arange(2 * RANK))
        step = drive.step(q={1: [7, 8, 9]})
    state = beams.state()
    assert state.step == step == mc.StepId(drive.run, 1, 0.5)
    assert state.q.tolist() == [0, 1, 2, 7, 8, 9]
    assert state.q_of("copy").tolist() == [7, 8, 9]


def test_transforms_of_scene_are_one_array(beams: mc.Scene):
    matrices = np.tile(np.eye(4), (2, 1, 1))
    matrices[:, :3, 3] = [[1, 2, 3], [4, 5, 6]]
    with beams.drive() as drive:
        drive.step(transforms=matrices)
        np.testing.assert_array_equal(beams.state().transforms, matrices[:, :3])
        moved = beams.state().transforms + np.float32(1)
        drive.step(np.ones(2 * RANK), transforms=moved)
    state = beams.state()
    np.testing.assert_array_equal(state.transforms, moved)
    assert state.q.tolist() == 2 * RANK * [1]


def test_transforms_of_attached_domains_in_an_array_are_ignored(tree: mc.Scene):
    trunk = tree.domains["trunk"]
    with tree.drive(reset=True) as drive:
        expected = drive.step(transforms={trunk: np.eye(4)}) and tree.state().transforms
        transforms = np.zeros((len(tree.domains), 3, 4))
        transforms[trunk.index] = np.eye(4)[:3]
        drive.step(transforms=transforms)
        np.testing.assert_array_equal(tree.state().transforms, expected)
        drive.reset()


def test_transforms_are_matrices(beams: mc.Scene):
    moved = np.eye(4)
    moved[:3, 3] = 1, 2, 3
    with beams.drive() as drive:
        drive.step(transforms={"beam": moved, "copy": moved[:3]})
    np.testing.assert_array_equal(beams.state().transforms, [moved[:3], moved[:3]])
    np.testing.assert_allclose(beams.vertices()[:4], beam()[0][:4] + [1, 2, 3], atol=1e-6)


def test_world_pose_far_from_origin_keeps_precision(beams: mc.Scene):
    far = 1e7
    poses = {name: mc.WorldPose((0, 0, 0, 1), (far, index, 0)) for index, name in enumerate(("beam", "copy"))}
    with beams.drive() as drive:
        drive.step(transforms=poses)
    vertex_set = beams.vertex_set(("positions",))
    assert vertex_set.positions is not None
    world = vertex_set.origins + vertex_set.positions.astype(np.float64)
    np.testing.assert_allclose(world[0], beam()[0][0] + [far, 0, 0], atol=1e-4)


def test_world_poses_of_scene_are_one_array(beams: mc.Scene):
    translations = np.array([[1e7, 0, 0], [1e7, 1, 0]])
    with beams.drive() as drive:
        drive.step(transforms=mc.WorldPose(np.tile([0.0, 0, 0, 1], (2, 1)), translations))
    state = beams.state()
    world = state.origins + state.transforms[:, :, 3].astype(np.float64)
    np.testing.assert_allclose(world, translations, atol=1e-6)


def test_wrong_arguments_name_expected_and_given(beams: mc.Scene):
    cases: list[tuple[dict[str, object], type[Exception], str]] = [
        ({"q": {"beam": [1.0]}}, ValueError, r"q of domain 'beam': expected shape (3,), got (1,)"),
        ({"q": {"beam": [[1.0, 2, 3]]}}, ValueError, r"expected shape (3,), got (1, 3)"),
        ({"q": np.zeros(5)}, ValueError, r"q of the scene: expected shape (6,), got (5,)"),
        ({"q": {"beam": ["a", "b", "c"]}}, ValueError, "expected an array of real numbers"),
        ({"q": {"beam": [1e39, 0, 0]}}, ValueError, "3.4e38"),
        ({"q": {"bean": [0, 0, 0]}}, KeyError, "near names: ['beam']"),
        ({"q": {7: [0, 0, 0]}}, IndexError, "expected an index of a domain below 2, got 7"),
        ({"transforms": {"beam": np.eye(3)}}, ValueError, "expected a matrix of shape (3, 4) or (4, 4), got (3, 3)"),
        ({"time": float("nan")}, ValueError, "time: expected a finite number"),
    ]
    with beams.drive() as drive:
        for arguments, error, message in cases:
            with pytest.raises(error, match=re.escape(message)):
                drive.step(**arguments)  # pyright: ignore[reportArgumentType]
        drive.step(q={"beam": [1, 2, 3]})
    assert beams.state().q.tolist() == [1, 2, 3, 0, 0, 0]


def test_rejected_step_changes_nothing_and_drive_continues(beams: mc.Scene):
    with beams.drive() as drive:
        drive.step(q={"beam": [1, 2, 3]})
        with pytest.raises(mc.InvalidRequest) as error:
            drive.step(q={"beam": [float("nan"), 0, 0], "copy": [5, 5, 5]})
        assert (error.value.reason, error.value.step, error.value.field) == ("INVALID_FIELD", 1, "step.q[0]")
        drive.step(q={"copy": [4, 5, 6]})
        assert drive.rejected == 1
    assert beams.state().q.tolist() == [1, 2, 3, 4, 5, 6]


def test_steps_without_wait_are_completed_by_flush(beams: mc.Scene):
    with beams.drive(window=4) as drive:
        for number in range(200):
            drive.step(q={"beam": [number, 0, 0]}, wait=False)
        drive.flush()
        assert beams.state().q[0] == 199
        drive.step(q={"beam": [float("inf"), 0, 0]}, wait=False)
        with pytest.raises(mc.InvalidRequest):
            drive.flush()


def test_scene_has_one_writer(beams: mc.Scene):
    with beams.drive() as first:
        with pytest.raises(mc.AlreadyExists, match="writer") as error:
            beams.drive()
        assert error.value.reason == "WRITER_LEASE_TAKEN"
        with beams.drive(take_over=True) as second:
            second.step(q={"beam": [1, 1, 1]})
            assert second.run > first.run
        with pytest.raises(mc.LeaseLost):
            first.step(q={"beam": [2, 2, 2]})
        with pytest.raises(mc.LeaseLost):
            first.flush()
        first.close()


def test_reset_returns_to_rest(beams: mc.Scene):
    moved = np.eye(4)
    moved[0, 3] = 3
    with beams.drive() as drive:
        drive.step(q={"beam": [1, 2, 3]}, transforms={"copy": moved})
        drive.reset()
        np.testing.assert_allclose(beams.vertices()[:4], beam()[0][:4], atol=1e-6)
        drive.step(q={"beam": [1, 2, 3]})
    beams.reset()
    state = beams.state()
    assert not state.q.any()
    np.testing.assert_array_equal(state.transforms[1], beams.domains["copy"].placement)


def test_new_drive_starts_at_rest_and_a_resumed_one_continues(beams: mc.Scene):
    def first_step(**options: Any) -> list[float]:
        with beams.drive(**options) as drive:
            tokens.append(drive.lease_token)
            drive.step(q={"copy": [7, 8, 9]})
            state = beams.state().q.tolist()
            drive.step(q={"beam": [1, 2, 3]})
        return state[:3]

    tokens: list[bytes] = []
    assert first_step() == [0, 0, 0]
    assert first_step() == [0, 0, 0]
    assert first_step(reset=False) == [1, 2, 3]
    assert first_step(lease_token=tokens[-1]) == [1, 2, 3]
    assert first_step(lease_token=tokens[-1], reset=True) == [0, 0, 0]
    assert first_step(lease_token=tokens[0]) == [0, 0, 0]  # another writer has driven the scene since
    drive = beams.drive()
    assert beams.state().q.tolist() == [1, 2, 3, 7, 8, 9], "expected no change before the first step"
    with pytest.raises(mc.AlreadyExists):
        beams.reset()
    assert beams.reset(take_over=True) == beams.state().step
    assert not beams.state().q.any()
    drive.close()


def test_closed_drive_rejects_steps_and_releases_the_scene(beams: mc.Scene):
    drive = beams.drive()
    drive.step()
    drive.finish()
    drive.finish()
    drive.close()
    for use in (drive.step, drive.reset, drive.flush):
        with pytest.raises(ValueError, match="the drive is closed"):
            use()
    assert drive.rejected == 0
    forgotten = beams.drive()
    del forgotten
    deadline = time.monotonic() + 5
    while time.monotonic() < deadline:
        try:
            beams.drive().finish()
            break
        except mc.AlreadyExists:
            time.sleep(0.01)
    else:
        pytest.fail("expected the lease of a collected drive to be released")


def test_delivery_latest_merges_steps(beams: mc.Scene):
    with beams.drive(delivery="latest") as drive:
        for number in range(100):
            drive.step(q={"beam": [number, 0, 0]}, wait=False)
        drive.flush()
        assert beams.state().q[0] == 99


def joint_gap(scene: mc.Scene, vertices: np.ndarray) -> float:
    """Largest change of the distance between the base of a domain and its attachment vertices on the parent."""
    description = scene.describe(["rest_positions"])
    first = np.cumsum([0, *(domain.vertex_count for domain in scene.domains)])
    rest = np.concatenate(
        [
            description.shape_of(domain).arrays["rest_positions"] @ domain.placement[:, :3].T + domain.placement[:, 3]
            for domain in scene.domains
        ]
    )
    gap = 0.0
    for domain in scene.domains:
        if domain.parent is None:
            continue
        base = np.linalg.norm(description.shape_of(domain).arrays["rest_positions"], axis=1).argmin()
        base += first[domain.index]
        attached = first[domain.parent] + domain.attachment_vertices
        distances = [np.linalg.norm(points[attached] - points[base], axis=1) for points in (rest, vertices)]
        gap = max(gap, float(np.abs(distances[1] - distances[0]).max()))
    return gap


def test_branches_move_with_their_parents(tree: mc.Scene):
    trunk = tree.domains["trunk"]
    q = np.zeros(trunk.rank)
    q[0] = 4
    diagonal = np.linalg.norm(np.subtract(tree.info.bounds[3:], tree.info.bounds[:3]))
    gaps: dict[bool, float] = {}
    for joints in (True, False):
        with tree.drive(joints=joints, reset=True) as drive:
            vertices = tree.vertices(step=drive.step(q={"trunk": q}))
        gaps[joints] = joint_gap(tree, vertices)
    assert gaps[True] < 1e-3 * diagonal
    # Negative control: without joints, the branches stay where they are.
    assert gaps[False] > 1e-2 * diagonal
    tree.reset()


def test_step_above_1_mib_is_sent_in_parts(client: mc.Client):
    positions, faces, _ = beam()
    builder = mc.SceneBuilder("large")
    builder.add(positions, faces, np.zeros((3 * len(positions), 512)), name="beam 0")
    for index in range(1, 600):
        builder.add_copy("beam 0", name=f"beam {index}")
    scene = client.upload(builder)
    q = np.random.default_rng(1).random(scene.coordinate_count, np.float32)
    assert q.nbytes > 1 << 20
    with scene.drive() as drive:
        drive.step(q, transforms={domain: np.eye(4) for domain in scene.domains})
        drive.step(q={"beam 7": np.zeros(512)})
    q[7 * 512 : 8 * 512] = 0
    np.testing.assert_array_equal(scene.state().q, q)
    scene.delete()


def test_rejected_step_of_a_scene_with_joints_changes_nothing(tree: mc.Scene):
    with tree.drive() as drive:
        before = tree.vertices()
        with pytest.raises(mc.InvalidRequest):
            drive.step(q={"trunk": np.full(tree.domains["trunk"].rank, np.nan)})
        with pytest.raises(mc.InvalidRequest):
            drive.step(transforms={"trunk": np.full((3, 4), np.inf)})
        drive.step(q={"trunk": np.zeros(tree.domains["trunk"].rank)})
        np.testing.assert_allclose(tree.vertices(), before, atol=1e-5)


@pytest.fixture(params=[True, False], ids=["packed", "listed"])
def shared(client: mc.Client, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[mc.Scene]:
    """A glTF model of two primitives, of which the second one shares the weight of the first one."""
    (tmp_path / "shared.gltf").write_text(json.dumps(model_of_two_primitives()))
    scene = client.upload_files(tmp_path / "shared.gltf", "shared", replace=True)
    if not request.param:
        # As for a server of an earlier version.
        scene._layout = StateLayout(scene.domains, has_packed_q=False)
    yield scene
    scene.delete()


def model_of_two_primitives() -> dict[str, Any]:
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    displacements = np.array([[0, 0, 1]] * 3, "<f4").tobytes()
    data = base64.b64encode(positions + displacements).decode()
    accessor = {"componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 1]}
    primitive = {"attributes": {"POSITION": 0}, "targets": [{"POSITION": 1}]}
    return {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": 72, "uri": f"data:application/octet-stream;base64,{data}"}],
        "bufferViews": [{"buffer": 0, "byteOffset": 36 * index, "byteLength": 36} for index in range(2)],
        "accessors": [{**accessor, "bufferView": index} for index in range(2)],
        "meshes": [{"primitives": [primitive, {**primitive, "material": 0}]}],
        "materials": [{}],
        "nodes": [{"mesh": 0}, {"mesh": 0, "translation": [3, 0, 0]}],
        "scenes": [{"nodes": [0, 1]}],
        "scene": 0,
    }


def test_shared_coordinates_are_in_the_array_once(shared: mc.Scene):
    assert [domain.shares_q_with for domain in shared.domains] == [None, 0, None, 2]
    assert shared.coordinate_count == 2
    with shared.drive() as drive:
        drive.step([0.25, 0.5])
        assert shared.state().q.tolist() == [0.25, 0.5]
        np.testing.assert_allclose(shared.vertices()[:, 2], [0.25] * 6 + [0.5] * 6)
        drive.reset()
        assert not shared.state().q.any()


def test_transform_of_attached_domain_needs_joints_false(tree: mc.Scene):
    attached = next(domain for domain in tree.domains if domain.parent is not None and domain.follows is None)
    with tree.drive() as drive, pytest.raises(ValueError, match="joints=False"):
        drive.step(transforms={attached: np.eye(4)})
    with tree.drive(joints=False) as drive:
        drive.step(transforms={attached: np.eye(4)})
        drive.reset()


def test_stall_budget_is_above_zero_and_at_most_a_day(beams: mc.Scene):
    with beams.drive(stall_budget=3600) as drive:
        drive.step()
    for seconds in (0, -1, 86_401, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="stall_budget: expected seconds above 0 and at most 86400"):
            beams.drive(stall_budget=seconds)
