"""Lost connections, dead servers, deadlines and open descriptors."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import SERVER_ARGUMENTS
from scenes import SIZE, beam, beam_builder

import modalcast as mc
from modalcast._channel import default_address
from modalcast._methods import PROTOCOL_VERSION
from modalcast._server_process import find_program


class RestartableServer:
    """A server on a fixed port that keeps its state over restarts."""

    def __init__(self, folder: Path) -> None:
        with socket.create_server(("127.0.0.1", 0)) as probe:
            port = probe.getsockname()[1]
        self.address = f"127.0.0.1:{port}"
        self.command = [find_program(None), "serve", "--listen", self.address, "--state", str(folder)]
        self.command += SERVER_ARGUMENTS
        self.start()

    def start(self) -> None:
        self.process = subprocess.Popen(self.command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        assert self.process.stdout is not None
        assert self.process.stdout.readline().startswith(b"listening on")

    def stop(self, number: int = signal.SIGTERM) -> None:
        self.process.send_signal(number)
        self.process.wait(10)
        assert self.process.stdout is not None
        self.process.stdout.close()


@pytest.fixture
def server(tmp_path: Path) -> Iterator[RestartableServer]:
    server = RestartableServer(tmp_path / "state")
    yield server
    if server.process.poll() is None:
        server.stop()


def test_connect_to_no_server_says_how_to_start_one():
    start = time.monotonic()
    with pytest.raises(mc.ConnectionLost, match=r"127\.0\.0\.1:1: no connection.*modalcast serve"):
        mc.connect("127.0.0.1:1")
    assert time.monotonic() - start < 5


def test_invalid_addresses_are_rejected():
    for address in ("ftp://127.0.0.1:1", ""):
        with pytest.raises(ValueError, match="expected HOST:PORT, http://HOST:PORT, https://HOST:PORT or unix:PATH"):
            mc.connect(address)


def test_environment_names_the_server(client: mc.Client, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("MODALCAST_SERVER", f"http://{client.address}")
    with mc.connect() as connected:
        assert connected.info == client.info
    # An address of the caller comes first.
    with pytest.raises(mc.ConnectionLost, match=r"127\.0\.0\.1:1: no connection"):
        mc.connect("127.0.0.1:1", connect_timeout=0.1)
    monkeypatch.setenv("MODALCAST_SERVER", "")
    with pytest.raises(ValueError, match=r"expected HOST:PORT.*got an empty text"):
        mc.connect()
    monkeypatch.delenv("MODALCAST_SERVER")
    assert default_address() == "127.0.0.1:50051"


def test_connect_over_unix_socket(tmp_path: Path):
    path = tmp_path / "socket"
    with mc.spawn(arguments=[*SERVER_ARGUMENTS, "--listen", f"unix:{path}"]), mc.connect(f"unix:{path}") as client:
        assert client.info.backend == "cpu"


def test_spawn_reports_why_a_server_does_not_start(tmp_path: Path):
    with pytest.raises(mc.ServerStartError, match="found no program 'modalcats'"):
        mc.spawn(program="modalcats")
    with pytest.raises(mc.ServerStartError, match=r"exit code .*--no-such-option"):
        mc.spawn(arguments=["--no-such-option"])


def refuses_connections(address: str) -> bool:
    host, port = address.split(":")
    with socket.socket() as probe:
        return probe.connect_ex((host, int(port))) != 0


def test_spawned_server_ends_with_its_client():
    client = mc.spawn(arguments=SERVER_ARGUMENTS)
    assert not refuses_connections(client.address)
    client.close()
    assert refuses_connections(client.address)


@pytest.mark.parametrize("end", ["", "import os; os.kill(os.getpid(), 9)"])
def test_spawned_server_ends_with_its_process(end: str):
    script = f"import modalcast as mc; c = mc.spawn(arguments={SERVER_ARGUMENTS}); print(c.address, flush=True); {end}"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    deadline = time.monotonic() + 5
    while not refuses_connections(result.stdout.strip()) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert refuses_connections(result.stdout.strip())


def test_interrupt_of_the_process_group_does_not_end_a_spawned_server():
    script = f"""
import os, signal, time
import modalcast as mc
signal.signal(signal.SIGINT, signal.SIG_IGN)
with mc.spawn(arguments={SERVER_ARGUMENTS}) as client:
    os.killpg(os.getpgrp(), signal.SIGINT)
    time.sleep(0.1)
    print(client.scenes().sources)
"""
    command = [sys.executable, "-c", script]
    result = subprocess.run(command, capture_output=True, text=True, check=False, start_new_session=True)
    assert "tree" in result.stdout, result.stderr


def test_lost_connection_is_an_error_without_reconnect(server: RestartableServer):
    with mc.connect(server.address, reconnect=0) as client:
        scene = client.upload(beam_builder("lost"))
        drive, frames = scene.drive(), scene.frames(**SIZE)
        drive.step()
        next(frames)
        server.stop(signal.SIGKILL)
        with pytest.raises(mc.ConnectionLost, match=server.address):
            next(frames)
        with pytest.raises(mc.ConnectionLost):
            drive.step()
        with pytest.raises(mc.ConnectionLost):
            scene.vertices()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_drive_stream_and_calls_continue_after_restart(server: RestartableServer, number: int):
    with mc.connect(server.address) as client:
        scene = client.upload(beam_builder("resumed"))
        with scene.drive() as drive, scene.steps() as steps:
            first = drive.step(q={"beam": [1, 2, 3]})
            assert next(steps).step == first
            server.stop(number)
            restart = threading.Timer(0.5, server.start)
            restart.start()
            second = drive.step(q={"copy": [4, 5, 6]})
            assert second.run > first.run
            state = next(state for state in steps if state.step == second)
            assert state.q.tolist() == [1, 2, 3, 4, 5, 6]
            drive.step(q={"copy": [7, 8, 9]})
        assert scene.state().q.tolist() == [1, 2, 3, 7, 8, 9]
        restart.join()


def test_world_poses_are_sent_again_after_restart(server: RestartableServer):
    with mc.connect(server.address) as client:
        scene = client.upload(beam_builder("poses"))
        with scene.drive() as drive:
            drive.step(q={"beam": [1, 2, 3]}, transforms={"copy": mc.WorldPose((0, 0, 0, 1), (7, 8, 9))})
            with pytest.raises(ValueError, match="expected world poses, as in earlier steps"):
                drive.step(transforms={"copy": np.eye(4)})
            server.stop(signal.SIGKILL)
            server.start()
            drive.step(q={"copy": [4, 5, 6]})
        state = scene.state()
        assert state.q.tolist() == [1, 2, 3, 4, 5, 6]
        assert (state.transform_of("copy")[:, 3] + state.origins[1]).tolist() == [7, 8, 9]


def test_lossless_stream_reports_a_lost_connection(server: RestartableServer):
    with mc.connect(server.address) as client:
        scene = client.upload(beam_builder("lossless"))
        with scene.steps(delivery="lossless") as steps:
            server.stop(signal.SIGKILL)
            server.start()
            with pytest.raises(mc.ConnectionLost):
                next(steps)
        assert scene.vertices().shape == (scene.vertex_count, 3)


def send_until_full(drive: mc.Drive) -> int:
    """Sends steps to a stopped server until its connection is full. Returns the number of sent steps."""
    for number in range(100_000):
        try:
            drive.step(q={"beam": np.full(512, number)}, wait=False, timeout=0.3)
        except mc.DeadlineExceeded:
            return number
    pytest.fail("expected a full connection")


def test_stopped_server_exceeds_the_deadline(server: RestartableServer):
    with mc.connect(server.address, reconnect=0) as client:
        positions, faces, _ = beam()
        # Steps of 2 KiB fill the connection quickly.
        builder = mc.SceneBuilder("stopped").add(positions, faces, np.zeros((3 * len(positions), 512)), name="beam")
        scene = client.upload(builder.add(positions, faces, np.ones((3 * len(positions), 1)), name="copy"))
        drive = scene.drive()
        server.process.send_signal(signal.SIGSTOP)
        # Until one of its threads has taken the signal, the others still answer.
        os.waitpid(server.process.pid, os.WUNTRACED)
        try:
            with pytest.raises(mc.DeadlineExceeded):
                scene.vertices(timeout=0.3)
            with pytest.raises(TimeoutError):
                drive.step(timeout=0.3)
            last = send_until_full(drive)
        finally:
            server.process.send_signal(signal.SIGCONT)
        drive.flush()
        # The values that were not sent are part of the next step.
        drive.step(q={"copy": [1]})
        assert scene.state().q.tolist() == [last] * 512 + [1]
        drive.close()


def test_waiting_for_a_step_ends_with_the_deadline_or_the_step(beams: mc.Scene):
    with beams.drive() as drive:
        step = drive.step()
        with pytest.raises(mc.DeadlineExceeded) as error:
            beams.frame(step=mc.StepId(step.run, 5, 0), timeout=0.2)
        assert error.value.code == "DEADLINE_EXCEEDED"
        later = threading.Timer(0.2, lambda: [drive.step() for _ in range(5)])
        later.start()
        assert beams.frame(step=5, **SIZE).step.number == 5
        later.join()
        with pytest.raises(mc.StepPassed):
            beams.vertices(step=2, exact=True)
    with pytest.raises(ValueError, match="timeout: expected a number of seconds above 0, got 0"):
        beams.frame(timeout=0)


def test_unread_streams_do_not_block_calls(client: mc.Client, tree: mc.Scene):
    """Opens 20 streams of 2.5 MB per step that nothing reads."""
    with tree.drive(joints=False) as drive:
        drive.step()
        streams = [tree.vertex_sets(("positions", "normals")) for _ in range(20)]
        for _ in range(10):
            drive.step()
        assert len(tree.vertices(timeout=10)) == tree.vertex_count
        for stream in streams:
            stream.close()
        drive.reset()


def test_100_reconnects_leave_no_descriptors(client: mc.Client, beams: mc.Scene):
    def connect_once() -> None:
        with mc.connect(client.address) as other:
            scene = other.scene(beams.name)
            with scene.drive() as drive:
                drive.step()
            with scene.frames(**SIZE) as frames, scene.steps() as steps:
                assert next(frames).step == next(steps).step

    def open_descriptors() -> int:
        return len(os.listdir("/proc/self/fd"))  # noqa: PTH208

    connect_once()
    before, threads_before = open_descriptors(), threading.active_count()
    for _ in range(100):
        connect_once()
    end = time.monotonic() + 5
    while (open_descriptors() > before or threading.active_count() > threads_before) and time.monotonic() < end:
        time.sleep(0.05)
    assert open_descriptors() <= before
    assert threading.active_count() <= threads_before


def test_close_ends_a_blocked_reader(beams: mc.Scene):
    steps = beams.steps(delivery="lossless")
    received: list[mc.SceneState] = []
    reader = threading.Thread(target=lambda: received.extend(steps))
    reader.start()
    time.sleep(0.1)
    steps.close()
    reader.join(5)
    assert not reader.is_alive()
    assert received == []


def test_another_protocol_version_is_rejected(client: mc.Client, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("modalcast._sync.client.PROTOCOL_VERSION", 99)
    expected = f"expected a server of protocol version 99, got version {PROTOCOL_VERSION}"
    with pytest.raises(mc.ProtocolVersionError, match=expected):
        mc.connect(client.address)


def test_malformed_chunks_are_errors():
    from modalcast._decoders import FrameDecoder
    from modalcast.v1 import frames_pb2

    def message(offset: int, data: bytes, total: int | None = None) -> bytes:
        head = None if total is None else frames_pb2.FrameHead(total=total, width=1, height=1, format="FORMAT_RGBA")
        chunk = frames_pb2.FrameChunk(head=head, offset=offset, data=data)
        return frames_pb2.RenderFrameResponse(chunk=chunk).SerializeToString()

    for messages, field in (
        ([message(0, b"1234")], "frame.head"),
        ([message(0, b"12", 4), message(3, b"4")], "frame.offset"),
        ([message(0, b"12345", 4)], "frame.data"),
        ([message(0, b"", 1 << 40)], "frame.total"),
        ([message(0, b"12", 4), message(0, b"", 4)], "frame.head"),
        ([message(0, b"1234", 4)[:-1]], "frame message"),
    ):
        decoder = FrameDecoder(["color"], 1, chunk_field=1)
        for received in messages[:-1]:
            assert decoder.add(received) is None
        with pytest.raises(mc.MalformedReply, match=field):
            decoder.add(messages[-1])
    complete = FrameDecoder(["color"], 1, chunk_field=1)
    assert complete.add(message(0, b"12", 4)) is None
    with pytest.raises(mc.MalformedReply, match="after 2"):
        complete.check_end()
    frames = complete.add(message(2, b"34"))
    assert frames is not None
    np.testing.assert_array_equal(frames[0].rgba, np.frombuffer(b"1234", np.uint8).reshape(1, 1, 4))
