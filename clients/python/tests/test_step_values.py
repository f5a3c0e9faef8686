"""Messages of steps, without a server: what they contain, and that partial steps add up to whole ones."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import modalcast as mc
from modalcast._step_message import StepMessage
from modalcast.kinematics import AttachmentPoints, Kinematics, has_fit
from modalcast.scene_description import Domain, Domains
from modalcast.states import StateLayout
from modalcast.step_values import StepValues, rest_values
from modalcast.v1 import steps_pb2

FRAME = np.eye(4, dtype=np.float32)[:3]


def domain(index: int, rank: int = 2, **fields: Any) -> Domain:
    defaults: dict[str, Any] = {
        "name": f"domain {index}",
        "vertex_count": 4,
        "eigenvalues": np.empty(0),
        "notes": {},
        "placement": FRAME,
        "rest_q": np.zeros(rank, np.float32),
        "parent": None,
        "attachment_frame": None,
        "attachment_vertices": np.empty(0, np.uint32),
        "follows": None,
        "follow_frame": None,
        "shares_q_with": None,
        "shape": 0,
        "material": 0,
        "material_ranges": (),
    }
    return Domain(index=index, rank=rank, **(defaults | fields))


def layout_of(*domains: Domain, has_packed_q: bool = True) -> StateLayout:
    return StateLayout(Domains(domains), has_packed_q=has_packed_q)


def attached(index: int, parent: int, rank: int = 2, **fields: Any) -> Domain:
    frame = FRAME + np.array([[0, 0, 0, 1 + 0.1 * index], [0] * 4, [0] * 4], np.float32)
    return domain(
        index, rank, parent=parent, attachment_frame=frame, attachment_vertices=np.arange(4, dtype=np.uint32), **fields
    )


def tree() -> tuple[StateLayout, Kinematics]:
    """Two trees: chains and branches of joints, a follower with a child, and domains that share coordinates."""
    layout = layout_of(
        domain(0, 3),
        attached(1, 0),
        domain(2, 2),
        attached(3, 1, 1),
        attached(4, 2, shares_q_with=2),
        attached(5, 1, 0),
        domain(6, 2, follows=3, follow_frame=FRAME, shares_q_with=4),
        attached(7, 6),
        attached(8, 4, 3),
        attached(9, 5, 1),
        attached(10, 8),
    )
    random = np.random.default_rng(3)
    points: dict[int, AttachmentPoints] = {}
    for joint in layout.domains:
        if has_fit(joint, layout) and joint.parent is not None:
            rest = random.uniform(-1, 1, (4, 3))
            modes = 0.2 * random.uniform(-1, 1, (12, layout.domains[joint.parent].rank)).astype(np.float32)
            points[joint.index] = AttachmentPoints(rest, modes)
    return layout, Kinematics(layout, points)


def decode(message: StepMessage) -> steps_pb2.Step:
    """The step that the server receives."""
    step = steps_pb2.Step()
    for index, encoded in enumerate(requests := message.encode()):
        part = steps_pb2.DriveSceneRequest.FromString(encoded).step
        assert part.has_more == (index < len(requests) - 1)
        q, transforms = step.q + part.q, step.transforms + part.transforms
        step.MergeFrom(part)
        step.q, step.transforms, step.has_more = q, transforms, False
    return step


class Receiver:
    """The values of a server that receives steps."""

    def __init__(self, layout: StateLayout) -> None:
        self.layout = layout
        self.q, self.transforms = rest_values(layout)

    def receive(self, message: StepMessage) -> None:
        step = decode(message)
        q = np.frombuffer(step.q, "<f4")
        if q.size > 0 and not step.q_domains:
            self.q[:] = q
        else:
            for index in step.q_domains:
                place = self.layout.q_slice(self.layout.domains[index])
                self.q[place], q = q[: place.stop - place.start], q[place.stop - place.start :]
            assert q.size == 0
        transforms = np.frombuffer(step.transforms, "<f4").reshape(-1, 3, 4)
        if len(transforms) > 0:
            self.transforms[list(step.transform_domains) or self.layout.roots] = transforms


def test_arrays_of_scene_are_sent_without_lists():
    layout = layout_of(domain(0), domain(1, 3), domain(2, 0), domain(3, follows=1, follow_frame=FRAME))
    q, matrices = np.arange(7.0), np.tile(np.eye(4), (4, 1, 1))
    matrices[:, 0, 3] = [5, 6, 7, 8]
    for transforms in (matrices, matrices[:, :3].tolist(), matrices.astype(np.float32)):
        values = StepValues(layout, None, *rest_values(layout))
        step = decode(values.step(4, 0.5, q, transforms))
        assert (step.number, step.time, list(step.q_domains), list(step.transform_domains)) == (4, 0.5, [], [])
        assert np.frombuffer(step.q, "<f4").tolist() == q.tolist()
        # Domain 3 follows another one.
        np.testing.assert_array_equal(np.frombuffer(step.transforms, "<f4").reshape(-1, 3, 4), matrices[:3, :3])
        assert decode(values.complete_step(4, 0.5)) == step
    # Few transforms of the array have changed.
    matrices[1, 1, 3] = 3
    step = decode(values.step(5, 0.5, None, matrices))
    assert (step.q, list(step.transform_domains), len(step.transforms)) == (b"", [1], 48)
    assert not decode(values.step(6, 0.5, None, matrices)).transforms
    values = StepValues(layout, None, *rest_values(layout))
    poses = mc.WorldPose(np.tile([0.0, 0, 0, 1], (4, 1)), 1e7 * np.arange(12.0).reshape(4, 3))
    step = decode(values.step(5, 0.5, None, poses))
    expected = [mc.WorldPose((0, 0, 0, 1), 1e7 * np.arange(3 * k, 3 * k + 3.0)).to_rows("", ()) for k in range(3)]
    assert (step.q, list(step.transform_domains), step.transforms) == (b"", [], np.array(expected).tobytes())
    assert step.transform_format == steps_pb2.TRANSFORM_FORMAT_QUATERNION_XYZW_F64
    assert decode(values.complete_step(6, 1.0)).transforms == step.transforms


@pytest.mark.parametrize(("has_packed_q", "listed"), [(True, []), (False, [0, 2])])
def test_shared_coordinates_are_sent_once(has_packed_q: bool, listed: list[int]):
    domains = [domain(0), domain(1, shares_q_with=0), domain(2), domain(3, shares_q_with=1)]
    layout = layout_of(*domains, has_packed_q=has_packed_q)
    values = StepValues(layout, None, *rest_values(layout))
    for message in (values.step(0, 0.0, [1, 2, 3, 4], None), values.complete_step(1, 0.0)):
        step = decode(message)
        assert list(step.q_domains) == listed
        assert np.frombuffer(step.q, "<f4").tolist() == [1, 2, 3, 4]


def test_step_of_one_domain_has_nothing_of_the_others():
    layout = layout_of(*(domain(index) for index in range(50)))
    values = StepValues(layout, None, *rest_values(layout))
    moved = FRAME + 1
    step = decode(values.step(0, 0.0, {"domain 7": [1, 2]}, {9: moved, 8: FRAME}))
    assert (list(step.q_domains), np.frombuffer(step.q, "<f4").tolist()) == ([7], [1, 2])
    # The transform of domain 8 is the one that the server has.
    assert (list(step.transform_domains), step.transforms) == ([9], moved.tobytes())


# f32 rounds it by 0.2.
FAR = 4_649_776.2


def translated(y: float) -> Any:
    placement = FRAME.astype(np.float64)
    placement[1, 3] = y
    return placement


def far(y: float = FAR) -> dict[str, Any]:
    """The placement of a domain, as descriptions have it."""
    return {"placement": translated(y).astype(np.float32), "exact_placement": translated(y)}


def listed(message: StepMessage) -> dict[int, float]:
    """The translations along y in a message that lists domains."""
    step = decode(message)
    transforms = np.frombuffer(step.transforms, "<f4").reshape(-1, 3, 4)
    return dict(zip(step.transform_domains, transforms[:, 1, 3].tolist(), strict=True))


def test_rest_values_have_exact_placements():
    _, transforms = rest_values(layout_of(domain(0), domain(1, **far())))
    assert transforms.dtype == np.float64
    np.testing.assert_array_equal(transforms, [FRAME, translated(FAR)])


def test_complete_step_sends_far_domains_once_moved():
    layout = layout_of(domain(0), domain(1, **far()), domain(2, **far(FAR + 1)))
    values = StepValues(layout, None, *rest_values(layout))
    receiver = Receiver(layout)
    assert listed(values.complete_step(0, 0.0)) == {0: 0}
    # The server has this transform already, in f64.
    assert listed(values.step(1, 0.0, None, {1: translated(FAR)})) == {}
    receiver.receive(values.complete_step(2, 0.0))
    np.testing.assert_array_equal(receiver.transforms, rest_values(layout)[1])
    assert listed(values.step(3, 0.0, None, {1: translated(FAR + 2)})) == {1: np.float32(FAR + 2)}
    assert listed(values.complete_step(4, 0.0)) == {0: 0, 1: np.float32(FAR + 2)}
    values.step(5, 0.0, None, {2: translated(FAR + 3)})
    step = decode(values.complete_step(6, 0.0))
    assert (list(step.transform_domains), len(step.transforms)) == ([], 3 * 48)
    # Control: f32 represents all first transforms.
    rounded = StepValues(layout, None, receiver.q, receiver.transforms.astype(np.float32))
    step = decode(rounded.complete_step(0, 0.0))
    assert (list(step.transform_domains), len(step.transforms)) == ([], 3 * 48)


def test_array_of_scene_leaves_far_domains_that_it_only_rounds():
    layout = layout_of(domain(0), domain(1), domain(2, **far()))
    values = StepValues(layout, None, *rest_values(layout))
    matrices = np.stack([translated(1), translated(2), translated(FAR)])
    assert listed(values.step(0, 0.0, None, matrices)) == {0: 1, 1: 2}
    matrices[2] = translated(5)
    matrices[:2] += 1
    assert not decode(values.step(1, 0.0, None, matrices)).transform_domains


def test_reset_sends_far_domains_that_have_moved():
    layout = layout_of(domain(0), *(domain(index, **far(FAR + index)) for index in range(1, 4)))
    values = StepValues(layout, None, *rest_values(layout))
    assert listed(values.at_rest().complete_step(0, 0.0)) == {0: 0}
    values.step(1, 0.0, None, {2: translated(7)})
    values = values.at_rest()
    rest = {0: 0, 2: np.float32(FAR + 2)}
    assert listed(values.complete_step(2, 0.0)) == rest
    assert listed(values.at_rest().complete_step(3, 0.0)) == rest
    # Domains with world poses return to rest too.
    values = StepValues(layout, None, *rest_values(layout))
    values.step(4, 0.0, None, {3: mc.WorldPose((0, 0, 0, 1), (0, 1e7, 0))})
    assert listed(values.at_rest().complete_step(5, 0.0)) == {0: 0, 3: np.float32(FAR + 3)}


def test_reset_sends_far_domains_that_an_earlier_drive_moved():
    # f32 rounds a placement halfway between two f32 in either direction.
    layout = layout_of(domain(0), *(domain(index, **far(4_649_776.25)) for index in range(1, 4)))
    q, transforms = rest_values(layout)
    transforms[1, 1, 3] += 1e-8
    transforms[2, 1, 3] += 0.7
    transforms[3, :, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    values = StepValues(layout, None, q, transforms)
    assert listed(values.complete_step(0, 0.0)) == {0: 0}
    expected = float(np.float32(4_649_776.25))
    assert listed(values.at_rest().complete_step(1, 0.0)) == {0: 0, 2: expected, 3: expected}


def test_joints_start_at_exact_placements():
    """Control: transforms that f32 rounds move the attached domain with them."""

    def child() -> Domain:
        frame = FRAME + np.array([[0] * 4, [0, 0, 0, 0.1], [0] * 4], np.float32)
        return domain(1, 0, parent=0, attachment_frame=frame, **far(FAR + 0.1))

    layout = layout_of(domain(0, 0, **far()), child(), domain(2))
    kinematics = Kinematics(layout, {})
    q, transforms = rest_values(layout)
    # 0.3 is above 0.25, where f32 rounds up.
    assert (np.float32(FAR), np.float32(FAR + 0.1)) == (4_649_776.0, 4_649_776.5)
    values = StepValues(layout, kinematics, q, transforms)
    assert listed(values.step(0, 0.0, {2: [1, 2]}, None)) == {}
    # The parent remains where it is, and so does its child.
    assert listed(values.step(1, 0.0, None, {0: translated(FAR)})) == {}
    assert listed(values.complete_step(2, 0.0)) == {2: 0}
    rounded = StepValues(layout, kinematics, q, transforms.astype(np.float32))
    assert listed(rounded.step(0, 0.0, {2: [1, 2]}, None)) == {1: 4_649_776.0}
    # The joint moves the child.
    assert listed(values.step(3, 0.0, None, {0: translated(8)})) == {0: 8, 1: np.float32(8.1)}
    # After a reset, the parent is at its placement in f32, and the joint follows it.
    values = values.at_rest()
    assert not decode(values.complete_step(4, 0.0)).transform_domains
    assert listed(values.step(5, 0.0, {2: [1, 2]}, None)) == {1: 4_649_776.0}


@pytest.mark.parametrize("rank", [4, 200_000])
def test_large_steps_are_sent_in_parts(rank: int):
    layout = layout_of(domain(0, rank), domain(1, rank))
    values = StepValues(layout, None, *rest_values(layout))
    q = np.random.default_rng(2).random(2 * rank, np.float32)
    message = values.step(6, 1.5, {1: q[:rank], 0: q[rank:]}, {1: FRAME + 1})
    sizes = [len(request) for request in message.encode()]
    assert max(sizes) <= (512 << 10) + 100
    assert (len(sizes) > 1) == (rank > 4)
    step = decode(message)
    assert (step.number, step.time, list(step.q_domains), list(step.transform_domains)) == (6, 1.5, [1, 0], [1])
    assert (step.q, step.transforms) == (q.tobytes(), (FRAME + 1).tobytes())


def random_step(random: np.random.Generator, layout: StateLayout) -> tuple[Any, Any]:
    """Values of no, some or all domains."""
    owners = random.permutation(layout.owners)[: random.integers(0, 3)]
    q: Any = {index: random.uniform(-1, 1, layout.domains[index].rank) for index in owners.tolist()}
    transforms: Any = {index: FRAME + random.uniform(-1, 1) for index in [0, 2][: random.integers(0, 3)]}
    match random.integers(0, 8):
        case 0:
            q = random.uniform(-1, 1, layout.coordinate_count)
        case 1:
            transforms = FRAME + random.uniform(-1, 1, (len(layout.domains), 1, 1))
        case _:
            pass
    return q, transforms


def test_partial_steps_move_all_attached_domains():
    layout, kinematics = tree()
    receiver = Receiver(layout)
    values = StepValues(layout, kinematics, *rest_values(layout))
    random = np.random.default_rng(11)
    sizes: set[int] = set()
    for number in range(200):
        message = values.step(number, 0.0, *random_step(random, layout))
        sizes.add(len(decode(message).transforms) // 48)
        receiver.receive(message)
        # The transforms of a drive that begins with these coordinates.
        whole = StepValues(layout, kinematics, receiver.q, receiver.transforms)
        expected = Receiver(layout)
        expected.receive(whole.step(0, 0.0, receiver.q, None))
        expected.receive(whole.complete_step(1, 0.0))
        np.testing.assert_array_equal(receiver.q, expected.q)
        if number > 0:
            np.testing.assert_array_equal(receiver.transforms, expected.transforms)
    assert min(sizes) == 0
    assert max(sizes) == len(layout.roots)


def test_step_computes_only_what_depends_on_it(monkeypatch: pytest.MonkeyPatch):
    layout, kinematics = tree()
    computed: list[list[int]] = []
    update = kinematics.update

    def count(world: Any, q: Any, dependents: Any) -> None:
        computed.append(sorted(dependents.tolist()))
        update(world, q, dependents)

    monkeypatch.setattr(kinematics, "update", count)
    values = StepValues(layout, kinematics, *rest_values(layout))
    everything = [1, 3, 4, 5, 6, 7, 8, 9, 10]
    steps: list[tuple[Any, Any, list[int]]] = [
        # The first step corrects what the state may have wrong.
        ({8: [1, 2, 3]}, None, everything),
        ({8: [1, 2, 3]}, None, [10]),
        ({5: []}, None, [9]),
        # Domain 4 shares the coordinates of domain 2, and so does domain 6.
        ({2: [1, 2]}, None, [4, 7, 8, 10]),
        (None, {0: FRAME}, [1, 3, 5, 6, 7, 9]),
        ({3: [1], 1: [1, 2]}, None, [3, 5, 6, 7, 9]),
        (np.ones(layout.coordinate_count), None, everything),
    ]
    for number, (q, transforms, expected) in enumerate(steps):
        values.step(number, 0.0, q, transforms)
        assert computed[-1] == expected
    values.step(9, 0.0, None, None)
    assert len(computed) == len(steps)


def test_rejected_numbers_leave_attached_domains_for_the_next_step():
    layout, kinematics = tree()
    values = StepValues(layout, kinematics, *rest_values(layout))
    receiver, expected = Receiver(layout), Receiver(layout)
    receiver.receive(values.step(0, 0.0, {0: [0.1, 0.2, 0.3]}, None))
    assert values.step(1, 0.0, {8: [np.nan, 0, 0]}, None).transforms is None
    receiver.receive(values.step(2, 0.0, {0: [0.3, 0.2, 0.1], 8: [1, 1, 1]}, None))
    whole = StepValues(layout, kinematics, *rest_values(layout))
    expected.receive(whole.step(0, 0.0, {0: [0.3, 0.2, 0.1], 8: [1, 1, 1]}, None))
    np.testing.assert_array_equal(receiver.transforms, expected.transforms)


def test_wrong_arrays_of_scene_name_expected_and_given():
    layout, kinematics = tree()
    values = StepValues(layout, None, *rest_values(layout))
    with_joints = StepValues(layout, kinematics, *rest_values(layout))
    bottom = np.tile(np.eye(4), (11, 1, 1))
    bottom[4, 3, 1] = 2
    poses = mc.WorldPose(np.tile([0.0, 0, 0, 1], (11, 1)), np.zeros((11, 3)))

    def matrices_after_poses() -> None:
        values.step(0, 0.0, None, poses)
        values.step(1, 0.0, None, bottom[:, :3])

    cases: list[tuple[Callable[[], object], str]] = [
        (lambda: values.step(0, 0.0, np.zeros(9), None), "q of the scene: expected shape (16,), got (9,)"),
        (
            lambda: values.step(0, 0.0, None, np.eye(4)),
            "transforms of the scene: expected an array of shape (11, 3, 4) or (11, 4, 4), got (4, 4)",
        ),
        (
            lambda: values.step(0, 0.0, None, bottom),
            "transforms of the scene: expected the last row 0 0 0 1, got [0.0, 2.0, 0.0, 1.0]",
        ),
        (
            lambda: values.step(0, 0.0, None, mc.WorldPose((0, 0, 0, 1), (0, 0, 0))),
            "rotation in transforms of the scene: expected shape (11, 4), got (4,)",
        ),
        (lambda: with_joints.step(0, 0.0, None, poses), "expected world poses only, in a drive with joints=False"),
        (matrices_after_poses, "expected world poses, as in earlier steps of the drive, got matrices"),
    ]
    for call, message in cases:
        with pytest.raises(ValueError, match=re.escape(message)):
            call()
