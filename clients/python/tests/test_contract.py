"""Every call and every message of the contract occurs between this client and a server."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from google.protobuf.descriptor import Descriptor, FileDescriptor
from google.protobuf.message import Message
from scenes import SIZE, beam_builder
from test_scenes import MTL, OBJ

import modalcast as mc
from modalcast import _methods
from modalcast._sync.transport import Transport
from modalcast.v1 import (
    common_pb2,
    errors_pb2,
    forces_pb2,
    frames_pb2,
    scenes_pb2,
    server_pb2,
    states_pb2,
    steps_pb2,
    vertices_pb2,
    views_pb2,
)

FILES: list[FileDescriptor] = [
    module.DESCRIPTOR
    for module in (
        common_pb2,
        errors_pb2,
        forces_pb2,
        frames_pb2,
        scenes_pb2,
        server_pb2,
        states_pb2,
        steps_pb2,
        vertices_pb2,
        views_pb2,
    )
]
METHODS = {value.path: value for value in vars(_methods).values() if isinstance(value, _methods.Method)}


class Recorder(
    grpc.UnaryUnaryClientInterceptor,
    grpc.UnaryStreamClientInterceptor,
    grpc.StreamUnaryClientInterceptor,
    grpc.StreamStreamClientInterceptor,
):
    """Records the names of calls and of messages that are sent or received."""

    def __init__(self) -> None:
        self.paths: set[str] = set()
        self.messages: set[str] = set()

    def record(self, message: Message) -> None:
        self.messages.add(message.DESCRIPTOR.full_name)
        for field, value in message.ListFields():
            message_type = field.message_type
            if message_type is None or message_type.GetOptions().map_entry:
                continue
            for item in [value] if isinstance(value, Message) else value:
                self.record(item)

    def _sent(self, path: str, requests: Iterator[Message | bytes]) -> Iterator[Message | bytes]:
        for request in requests:
            self.record(METHODS[path].request.FromString(request) if isinstance(request, bytes) else request)
            yield request

    def _received(self, path: str, replies: Any) -> Any:
        recorder = self

        class Call:
            def __iter__(self) -> Any:
                return self

            def __next__(self) -> Any:
                reply = next(replies)
                recorder.record(METHODS[path].reply.FromString(reply) if isinstance(reply, bytes) else reply)
                return reply

            def cancel(self) -> None:
                replies.cancel()

        return Call()

    def intercept_unary_unary(self, continuation: Any, client_call_details: Any, request: Any) -> Any:
        self.paths.add(client_call_details.method)
        self.record(request)
        call = continuation(client_call_details, request)
        if call.code() == grpc.StatusCode.OK:
            self.record(call.result())
        return call

    def intercept_stream_unary(self, continuation: Any, client_call_details: Any, request_iterator: Any) -> Any:
        self.paths.add(client_call_details.method)
        call = continuation(client_call_details, self._sent(client_call_details.method, request_iterator))
        if call.code() == grpc.StatusCode.OK:
            self.record(call.result())
        return call

    def intercept_unary_stream(self, continuation: Any, client_call_details: Any, request: Any) -> Any:
        self.paths.add(client_call_details.method)
        self.record(request)
        return self._received(client_call_details.method, continuation(client_call_details, request))

    def intercept_stream_stream(self, continuation: Any, client_call_details: Any, request_iterator: Any) -> Any:
        self.paths.add(client_call_details.method)
        replies = continuation(client_call_details, self._sent(client_call_details.method, request_iterator))
        return self._received(client_call_details.method, replies)


def use_files(client: mc.Client, folder: Path) -> None:
    (folder / "two.obj").write_text(OBJ)
    (folder / "two.mtl").write_text(MTL)
    client.upload_files(folder, "contract-files", "two.obj").delete()


def use_pictures(scene: mc.Scene) -> None:
    camera = mc.pinhole(np.array([[90.0, 0, 80], [0, 90, 45], [0, 0, 1]]), 160, 90, np.eye(4))
    scene.frame_batch([camera, None], outputs=("color", "depth"), **SIZE)
    with scene.frames(mc.look_at((1, 1, 6), (1, 1, 0)), **SIZE) as frames:
        next(frames)
        frames.move_camera(camera)
    hits = scene.pick_rectangle(60, 25, (40, 40), mc.look_at((1, 1, 6), (1, 1, 0), field_of_view=30), **SIZE).hits
    with scene.forces() as forces:
        scene.apply_forces([hits[0].force((0, 1, 0)), mc.modal_force("copy", [1, 2, 3])])
        assert len(next(received for received in forces if received.forces).forces) == 2


def use_steps(scene: mc.Scene) -> None:
    with (
        scene.drive() as drive,
        scene.vertex_sets(delivery="lossless") as vertex_sets,
        scene.steps(delivery="lossless") as steps,
    ):
        step = drive.step(q={"beam": [1, 2, 3]})
        assert next(vertex_sets).step == next(steps).step == step
        with pytest.raises(mc.InvalidRequest):
            drive.step(q={"beam": [np.nan, 2, 3]})
    scene.vertex_set(step=step)
    scene.state(step=step)


def use_views(scene: mc.Scene) -> None:
    with scene.views(worlds=2, size=8) as views:
        views.step(np.zeros((2, scene.coordinate_count)))
        with pytest.raises(mc.InvalidRequest):
            views.step(np.full((2, scene.coordinate_count), np.nan))


def use_every_call(client: mc.Client, folder: Path) -> None:
    assert "tree" in client.scenes().sources
    assert any(listed.is_caller for listed in client.clients())
    with pytest.raises(mc.InvalidRequest):
        client.end_client("nobody/*")
    tree = client.open("tree")
    tree.describe(["uvs"], textures=True)
    tree.modes("trunk", [0])
    tree.view()
    tree.share()
    use_files(client, folder)
    scene = client.upload(beam_builder("contract"))
    scene.describe(["modes"], cache=str(folder / "cache"))
    use_steps(scene)
    use_pictures(scene)
    use_views(scene)
    scene.reset()
    scene.delete()


def test_every_call_and_message_of_the_contract_is_used(
    client: mc.Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    recorder = Recorder()

    def record(name: str) -> None:
        original = getattr(Transport, name)
        monkeypatch.setattr(Transport, name, lambda transport: grpc.intercept_channel(original(transport), recorder))

    record("_new_channel")
    record("_new_subscription_channel")
    with mc.connect(client.address) as recorded:
        use_every_call(recorded, tmp_path)

    services = [service for file in FILES for service in file.services_by_name.values()]
    expected_paths = {f"/{service.full_name}/{method.name}" for service in services for method in service.methods}
    assert recorder.paths == expected_paths == set(METHODS)

    def names(messages: dict[str, Descriptor]) -> set[str]:
        return {message.full_name for message in messages.values()}

    expected_messages = set[str]().union(*(names(dict(file.message_types_by_name)) for file in FILES))
    # The pictures of this test are too small for shared memory, the server has no GPU, this client ends no other one,
    # and no scene of the server fails.
    unused = {"SharedRange", "DeviceSlots", "DeviceViews", "FailedScene", "EndClientResponse"}
    assert expected_messages - recorder.messages == {f"modalcast.v1.{name}" for name in unused}
