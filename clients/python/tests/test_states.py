"""Streams of states: changes, stage times on request, and the bytes of a step."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import beam_builder

import modalcast as mc
from modalcast._decoders import SceneStateDecoder
from modalcast._methods import STREAM_STATES
from modalcast.v1 import common_pb2, states_pb2


def test_stream_has_the_state_of_each_step(beams: mc.Scene):
    random = np.random.default_rng(5)
    with beams.drive() as drive, beams.steps(delivery="lossless", count=12) as states:
        for number in range(12):
            # Both domains, one of them, or none.
            names = ["beam", "copy"][number % 3 // 2 : 2 - number % 3]
            q = {name: random.uniform(-1, 1, 3) for name in names}
            pose = np.eye(4)
            pose[:3, 3] = random.uniform(-1, 1, 3)
            step = drive.step(q=q, transforms=dict.fromkeys(names[number % 2 :], pose))
            expected, state = beams.state(), next(states)
            assert state.step == expected.step == step
            np.testing.assert_array_equal(state.q, expected.q)
            np.testing.assert_array_equal(state.transforms, expected.transforms)
        assert next(states, None) is None


@pytest.mark.parametrize(("stages_every", "expected"), [(0, []), (1, [0, 1, 2, 3, 4]), (2, [0, 2, 4])])
def test_stage_times_arrive_on_request(beams: mc.Scene, stages_every: int, expected: list[int]):
    with beams.drive() as drive, beams.steps(delivery="lossless", stages_every=stages_every) as states:
        for number in range(5):
            drive.step(q={"beam": [number, 0, 0]})
        received = [next(states).stages for _ in range(5)]
    assert [number for number, stages in enumerate(received) if stages] == expected
    assert all(stages["deform"] >= 0 for stages in received if stages)
    assert "deform" in beams.state().stages


def test_step_of_all_domains_has_no_list_of_domains(client: mc.Client, beams: mc.Scene):
    """A step of a small scene is little more than its numbers."""
    request = states_pb2.StreamStatesRequest(scene=beams.name, delivery=common_pb2.DELIVERY_LOSSLESS)
    stream = beams._transport.subscribe(STREAM_STATES, request, wait_for_ready=False)
    assert stream.read() is not None  # the settings
    decoder = SceneStateDecoder(beams._layout, chunk_field=2)
    pose = np.eye(4)
    messages: list[bytes] = []
    with beams.drive() as drive:
        for number, domains in enumerate((["beam", "copy"], ["beam", "copy"], ["copy"])):
            pose[0, 3] = number
            drive.step(q={name: [1 + number, 2, 3] for name in domains}, transforms=dict.fromkeys(domains, pose))
            message = stream.read()
            assert message is not None
            messages.append(message)
            state = decoder.add(message)
            assert state is not None
            np.testing.assert_array_equal(state.q, beams.state().q)
            np.testing.assert_array_equal(state.transforms, beams.state().transforms)
    stream.cancel()
    contents = [
        {section.content for section in states_pb2.StreamStatesResponse.FromString(message).chunk.head.sections}
        for message in messages
    ]
    values = {states_pb2.STATE_CONTENT_Q, states_pb2.STATE_CONTENT_TRANSFORMS}
    lists = {states_pb2.STATE_CONTENT_Q_DOMAINS, states_pb2.STATE_CONTENT_TRANSFORM_DOMAINS}
    assert contents == [values | {states_pb2.STATE_CONTENT_ORIGINS}, values, values | lists]
    # 6 numbers of q and 24 of T; then the head: step, sections, sizes.
    assert len(messages[1]) <= 120 + 45


def test_malformed_lists_are_errors(client: mc.Client):
    scene = client.upload(beam_builder("malformed-states"))
    for content, size in ((states_pb2.STATE_CONTENT_Q, 20), (states_pb2.STATE_CONTENT_TRANSFORMS, 48)):
        section = states_pb2.StateSection(content=content, offset=0, bytes=size)
        head = states_pb2.StateHead(sections=[section], total=size, complete=True)
        chunk = states_pb2.StateChunk(head=head, data=bytes(size))
        message = states_pb2.GetStateResponse(chunk=chunk).SerializeToString()
        with pytest.raises(mc.MalformedReply, match=r"states\.sections"):
            SceneStateDecoder(scene._layout, chunk_field=1).add(message)
    scene.delete()
