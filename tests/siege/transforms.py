"""Item 12 of `prove.py`, transforms: T may have a determinant of zero, and vertices are always finite."""

import math
import queue
import struct

from client import Client, common_pb2, steps_pb2, vertices_pb2
from report import Result
from server import Server

ITEM = 12

# Near the largest f32.
LARGEST = 3e38

# Name, the diagonal of the linear part, the translation along x, and whether the server must accept the transform.
TRANSFORMS = [
    ("zero", 0.0, 0.0, True),
    ("scale of 1e-30", 1e-30, 0.0, True),
    ("scale of 1e30", 1e30, 0.0, False),
    ("scale of 3e38", LARGEST, 0.0, False),
    ("translation of 3e38", 1.0, LARGEST, False),
    ("NaN", math.nan, 0.0, False),
    ("infinity", math.inf, 0.0, False),
    ("identity", 1.0, 0.0, True),
]


class Writer:
    """A step stream whose steps are answered one by one."""

    def __init__(self, connection, scene):
        self.requests = queue.Queue()
        drive = steps_pb2.OpenDrive(scene=scene, delivery=common_pb2.DELIVERY_LOSSLESS)
        self.requests.put(steps_pb2.DriveSceneRequest(open=drive))
        self.replies = connection.steps.DriveScene(iter(self.requests.get, None))
        next(self.replies)
        self.number = 0

    def is_accepted(self, scale, x):
        """Sends T with `scale` on the diagonal and the translation (x, 0, 0). Returns whether the server accepts it."""
        self.number += 1
        transform = struct.pack("<12f", scale, 0, 0, x, 0, scale, 0, 0, 0, 0, scale, 0)
        step = steps_pb2.Step(number=self.number, transform_domains=[0], transforms=transform)
        self.requests.put(steps_pb2.DriveSceneRequest(step=step))
        return next(self.replies).WhichOneof("kind") == "ack"

    def close(self):
        self.requests.put(None)


def count_invalid(data):
    """The number of 32-bit numbers that are not finite."""
    return sum(not math.isfinite(number) for (number,) in struct.iter_unpack("<f", data[: len(data) // 4 * 4]))


def read_vertices(connection):
    request = vertices_pb2.GetVerticesRequest(scene="tree")
    return b"".join(reply.chunk.data for reply in connection.vertices.GetVertices(request, timeout=30))


def run(program):
    wrong, invalid = [], 0
    with Server(program) as server, Client(server) as connection:
        connection.open_scene("tree", "tree")
        writer = Writer(connection, "tree")
        for name, scale, x, expected in TRANSFORMS:
            if writer.is_accepted(scale, x) != expected:
                wrong.append(name)
            invalid += count_invalid(read_vertices(connection))
        writer.close()
    control_count = count_invalid(struct.pack("<3f", 1.0, math.nan, math.inf))
    return Result(
        ITEM,
        "a transform may have a determinant of zero; one that moves a vertex out of range or is not finite is rejected",
        f"{len(TRANSFORMS)} transforms, each accepted or rejected as expected, and only finite vertices after each",
        f"{len(TRANSFORMS) - len(wrong)} as expected{' (wrong: ' + ', '.join(wrong) + ')' if wrong else ''}, "
        f"{invalid} vertex coordinates that are not finite",
        not wrong and invalid == 0,
        f"an array with a NaN and an infinity, {control_count} numbers that are not finite",
        control_count > 0,
    )
