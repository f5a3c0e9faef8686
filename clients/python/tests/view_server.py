"""A server that draws views without a scene. A view has the values of its world, so that tests can tell them apart."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent import futures

import grpc
import numpy as np

from modalcast.v1 import errors_pb2, frames_pb2, views_pb2

CHUNK_BYTES = 1 << 20


class FakeWorlds:
    """The values of the worlds of a call, for a scene whose domains have `rank` coordinates each."""

    def __init__(self, message: views_pb2.OpenViews, domains: int, rank: int) -> None:
        self.message = message
        self.domains = domains
        self.rank = rank
        self.q = np.zeros((message.worlds * domains, rank), np.float32)
        self.transforms = np.tile(np.eye(4, dtype=np.float32)[:3], (message.worlds * domains, 1, 1))
        self.eyes = self._eyes(message.cameras) if message.cameras else np.zeros(1)

    @staticmethod
    def _eyes(cameras: Iterable[frames_pb2.Camera]) -> np.ndarray:
        """The x of each camera; 0 for the camera that frames the scene."""
        first = [[*camera.look_at.eye, *camera.pose.world_from_camera[3:4], 0][0] for camera in cameras]
        return np.array(first, np.float32)

    def apply(self, parts: list[views_pb2.ViewStep]) -> errors_pb2.Rejection | None:
        """Applies all values of a step, or none."""
        steps = [part.step for part in parts]
        number = steps[0].number
        assert [step.number for step in steps] == [number] * len(steps)
        assert [step.has_more for step in steps] == [True] * (len(steps) - 1) + [False]
        assert all(part.ByteSize() <= CHUNK_BYTES + (64 << 10) for part in parts[:-1])
        q = np.frombuffer(b"".join(step.q for step in steps), np.float32).reshape(-1, self.rank)
        transforms = np.frombuffer(b"".join(step.transforms for step in steps), np.float32).reshape(-1, 3, 4)
        for name, values, stored, listed in (
            ("q", q, self.q, [domain for step in steps for domain in step.q_domains]),
            (
                "transforms",
                transforms,
                self.transforms,
                [domain for step in steps for domain in step.transform_domains],
            ),
        ):
            assert len(values) == (len(listed) if listed else 0 if len(values) == 0 else len(stored))
            if not np.isfinite(values).all():
                return errors_pb2.Rejection(
                    step=number,
                    reason=errors_pb2.REASON_INVALID_FIELD,
                    field=f"step.{name}[{int(np.argmin(np.isfinite(values)))}]",
                    expected="a finite number",
                    given="NaN",
                )
            if listed or len(values) > 0:
                stored[listed if listed else slice(None)] = values
        if parts[-1].cameras:
            self.eyes = self._eyes(parts[-1].cameras)
        return None

    def pictures(self, drawn_worlds: int) -> dict[int, np.ndarray]:
        """Depth is the first coordinate plus the x of the camera, color the first coordinate, normals a translation."""
        message = self.message
        if message.camera_worlds:
            worlds, cameras = np.array(message.camera_worlds), np.arange(len(self.eyes))
        else:
            count = drawn_worlds or message.worlds
            worlds = np.repeat(np.arange(count), len(self.eyes))
            cameras = np.tile(np.arange(len(self.eyes)), count)
        first = self.q[worlds * self.domains]
        size = message.height, message.width
        # Views that are not uniform.
        x = np.arange(message.width, dtype=np.float32) / 1024
        depth = (first[:, 0] + self.eyes[cameras])[:, None, None] + np.broadcast_to(x, size)
        result: dict[int, np.ndarray] = {}
        for output in message.outputs:
            if output == frames_pb2.OUTPUT_COLOR:
                result[output] = np.broadcast_to(first[:, :1, None, None].astype(np.uint8), (len(worlds), *size, 3))
            elif output == frames_pb2.OUTPUT_DOMAINS:
                result[output] = np.broadcast_to(worlds[:, None, None].astype(np.int32), (len(worlds), *size))
            elif output == frames_pb2.OUTPUT_NORMALS:
                translations = self.transforms[worlds * self.domains, :, 3]
                result[output] = np.broadcast_to(translations[:, None, None], (len(worlds), *size, 3))
            else:
                result[output] = depth.astype(np.float32)
        return result


Reply = views_pb2.DrawViewsResponse


def chunks(number: int, pictures: dict[int, np.ndarray]) -> Iterator[Reply]:
    """The replies to a step. The outputs take turns."""
    data = {output: np.ascontiguousarray(array).tobytes() for output, array in pictures.items()}
    for offset in range(0, max(len(content) for content in data.values()), CHUNK_BYTES):
        for output, content in data.items():
            if offset < len(content):
                piece = content[offset : offset + CHUNK_BYTES]
                chunk = views_pb2.ViewChunk(step=number, output=output, offset=offset, data=piece)  # pyright: ignore
                if offset == 0:
                    chunk.stages.add(stage="draw", milliseconds=0.5)
                yield Reply(chunk=chunk)


class FakeViewServer:
    """The server. `edit` may replace the replies to a step."""

    def __init__(self, domains: int, rank: int) -> None:
        self.domains, self.rank = domains, rank
        self.edit: Callable[[int, Iterator[Reply]], Iterator[Reply]] = lambda _, replies: replies
        self.calls = 0
        self.steps: list[list[views_pb2.ViewStep]] = []
        options: list[tuple[str, int]] = [("grpc.max_receive_message_length", -1)]
        self._server = grpc.server(futures.ThreadPoolExecutor(4), options=options)
        handler = grpc.stream_stream_rpc_method_handler(
            self._draw_views, views_pb2.DrawViewsRequest.FromString, Reply.SerializeToString
        )
        handlers = grpc.method_handlers_generic_handler("modalcast.v1.ViewService", {"DrawViews": handler})
        self._server.add_generic_rpc_handlers((handlers,))
        self.address = f"127.0.0.1:{self._server.add_insecure_port('127.0.0.1:0')}"
        self._server.start()

    def stop(self) -> None:
        self._server.stop(None).wait()

    def _draw_views(self, requests: Iterator[views_pb2.DrawViewsRequest], _: object) -> Iterator[Reply]:
        self.calls += 1
        message = next(requests).open
        worlds = FakeWorlds(message, self.domains, self.rank)
        yield Reply(
            opened=views_pb2.ViewsOpened(
                worlds=message.worlds,
                width=message.width,
                height=message.height,
                outputs=message.outputs,
                views=len(message.camera_worlds) or message.worlds * max(len(message.cameras), 1),
                coordinates=self.domains * self.rank,
                transforms=self.domains,
            )
        )
        parts: list[views_pb2.ViewStep] = []
        for request in requests:
            parts.append(request.step)
            if request.step.step.has_more:
                continue
            step, parts = parts, []
            self.steps.append(step)
            rejection = worlds.apply(step)
            number = step[0].step.number
            replies = iter([Reply(rejection=rejection)])
            if rejection is None:
                replies = chunks(number, worlds.pictures(step[-1].drawn_worlds))
            yield from self.edit(number, replies)
