"""Arrays at coordinates of a map: what an upload sends, and what a description keeps."""

from __future__ import annotations

import numpy as np
import pytest

import modalcast as mc
from modalcast.scene_description import decode_array, shape_from_message
from modalcast.v1 import scenes_pb2

CENTER = np.array([500_000.3, 4_649_776.2, 12.1])
POSITIONS = np.array([[0, 0, 0], [0.41, 0.03, 0], [0.07, 0.37, 0.011], [0.1, 0.13, 0.43]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


def sent(builder: mc.SceneBuilder) -> tuple[list[scenes_pb2.UploadedDomain], bytes]:
    """The domains and the bytes of all arrays of an upload."""
    messages = list(builder.messages(None))
    domains = [message.domain for message in messages if message.HasField("domain")]
    data = b"".join(message.chunk for message in messages if message.HasField("chunk"))
    assert messages[0].header.total_bytes == len(data)
    return domains, data


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("magnitude", [1e2, 1e4, -1e6, 1e9])
def test_far_positions_are_sent_in_f64(axis: int, magnitude: float) -> None:
    """All bits of the array arrive."""
    x0 = POSITIONS.copy()
    x0[:, axis] += magnitude
    (domain,), data = sent(mc.SceneBuilder("far").add(x0, FACES))
    assert domain.f64_positions
    assert np.array_equal(np.frombuffer(data[:96], "<f8").reshape(4, 3), x0)


def test_near_positions_are_sent_in_f32() -> None:
    """An unused vertex does not matter, wherever it is."""
    for positions in (POSITIONS, POSITIONS + 3, np.vstack((POSITIONS, [1e6, 0, 0]))):
        (domain,), data = sent(mc.SceneBuilder("near").add(positions, FACES))
        assert not domain.f64_positions
        size = 12 * len(positions)
        assert np.array_equal(np.frombuffer(data[:size], "<f4").reshape(-1, 3), positions.astype(np.float32))


def test_only_far_placements_are_sent_in_f64() -> None:
    """A server that knows only f32 placements accepts those of near domains."""
    far, near = np.eye(4), np.eye(4)
    far[:3, 3], near[:3, 3] = CENTER, (0.1, 0.2, 0.3)
    builder = mc.SceneBuilder("placed").add(POSITIONS, FACES, name="a", placement=near)
    (a, b), _ = sent(builder.add_copy("a", name="b", placement=far))
    assert np.array_equal(np.frombuffer(a.placement, "<f4").reshape(3, 4), near[:3].astype(np.float32))
    assert np.array_equal(np.frombuffer(b.placement, "<f8").reshape(3, 4), far[:3])


def test_exact_positions_add_the_origin() -> None:
    """Control: f32 rest positions are wrong by decimeters."""
    message = scenes_pb2.ShapeDescription(vertices=4, triangles=4, origin=CENTER)
    shape = shape_from_message(message)
    centered = POSITIONS.astype("<f4").tobytes()
    shape.arrays["centered_positions"] = decode_array(shape, "centered_positions", np.frombuffer(centered, np.uint8))
    x0 = POSITIONS + CENTER
    assert np.abs(shape.exact_positions - x0).max() < 1e-7
    assert np.abs(x0.astype(np.float32) - x0).max() > 0.1
    without_origin = shape_from_message(scenes_pb2.ShapeDescription(vertices=4))
    assert not without_origin.origin.any()
