"""Pictures of views in memory that the server shares with this client."""

from __future__ import annotations

import gc
import os
import socket
import struct
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scenes import RANK, beam

import modalcast as mc
from modalcast._shared_memory import MemoryConnection
from modalcast._sync.transport import Transport

# Color and normals of a step: 64 views of 64 x 64 pixels are 15 chunks, more than the server has slots.
WORLDS = 64
OUTPUTS = ("color", "normals")


@pytest.fixture(scope="module")
def scene(client: mc.Client) -> Iterator[mc.Scene]:
    """A beam."""
    scene = client.upload(mc.SceneBuilder("shared-memory").add(*beam()))
    yield scene
    scene.delete()


def draw(scene: mc.Scene, seed: int) -> dict[str, np.ndarray]:
    q = np.random.default_rng(seed).normal(0, 0.3, (WORLDS, RANK))
    with scene.views(worlds=WORLDS, outputs=OUTPUTS) as views:
        views.step(-q)
        return views.step(q)


def test_pictures_in_shared_memory_equal_those_in_messages(scene: mc.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    returned = list[int]()
    give_back = MemoryConnection.give_back

    def counted(self: MemoryConnection, slots: list[int]) -> None:
        returned.extend(slots)
        give_back(self, slots)

    monkeypatch.setattr(MemoryConnection, "give_back", counted)
    shared = draw(scene, 1)
    assert len(returned) > 8, "expected more chunks than the server has slots"
    other = draw(scene, 2)
    returned.clear()
    monkeypatch.setattr(Transport, "open_memory", lambda _: None)
    sent = draw(scene, 1)
    assert not returned
    for output in OUTPUTS:
        np.testing.assert_array_equal(shared[output], sent[output])
        assert (shared[output] != other[output]).any(), "control: expected other pictures of other states"


def test_connections_are_released(scene: mc.Scene) -> None:
    descriptors = len(list(Path("/proc/self/fd").iterdir()))
    # A server lets one client have few of them at a time.
    for seed in range(12):
        draw(scene, seed)
    gc.collect()
    assert len(list(Path("/proc/self/fd").iterdir())) <= descriptors + 2


def test_views_without_shared_memory_are_sent(scene: mc.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = draw(scene, 1)
    route = scene._transport._route  # pyright: ignore[reportPrivateUsage]
    monkeypatch.setattr(Transport, "open_memory", lambda _: _failing_connection(route.memory_socket))
    np.testing.assert_array_equal(draw(scene, 1)["color"], expected["color"])


def _failing_connection(path: Path | None) -> MemoryConnection | None:
    """What a client does if the server has no connection left."""
    assert path is not None
    try:
        return MemoryConnection(path.with_name("none.memory.sock"))
    except mc.ConnectionLost:
        return None


@pytest.mark.parametrize("message", [b"", struct.pack("<4I16s", 2, 1 << 20, 8, 0, b""), b"\1" * 32])
def test_server_that_contradicts_the_contract_is_refused(tmp_path: Path, message: bytes) -> None:
    path = tmp_path / "memory.sock"
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))
        server.listen()
        memory = os.memfd_create("test", os.MFD_ALLOW_SEALING)
        # The other side answers as soon as it is accepted, and the client waits for at most five seconds.
        thread = threading.Thread(target=_answer, args=(server, message, memory))
        thread.start()
        with pytest.raises((mc.MalformedReply, mc.ConnectionLost)):
            MemoryConnection(path)
        thread.join()
        os.close(memory)


def _answer(server: socket.socket, message: bytes, memory: int) -> None:
    connection, _ = server.accept()
    with connection:
        if message:
            socket.send_fds(connection, [message], [memory, memory])


def test_gpu_memory_needs_a_server_that_draws_on_a_gpu(scene: mc.Scene) -> None:
    with pytest.raises(mc.Unavailable, match="the server draws views on the CPU"):
        scene.views(worlds=2, device="cuda")
    with pytest.raises(ValueError, match="expected 'cuda' or None, got 'cpu'"):
        scene.views(worlds=2, device="cpu")
    with pytest.raises(ValueError, match="slots: expected 2 to 16, got 1"):
        scene.views(worlds=2, device="cuda", slots=1)
