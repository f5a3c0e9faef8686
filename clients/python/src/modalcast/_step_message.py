"""The messages of a step: one, or several parts of a large step."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from modalcast._types import Rows
from modalcast._wire import length_prefix, message_of_field
from modalcast.v1 import steps_pb2, views_pb2

# In bytes: a step of at most _MAX_SINGLE_BYTES is one message, a larger one is sent in parts of _PART_BYTES.
_MAX_SINGLE_BYTES = 1 << 20
_PART_BYTES = 512 << 10
# The index of a domain is a varint of at most 5 bytes.
_PART_DOMAINS = _PART_BYTES // 5

_DRIVE_REQUEST_STEP = steps_pb2.DriveSceneRequest.STEP_FIELD_NUMBER
_VIEWS_REQUEST_STEP = views_pb2.DrawViewsRequest.STEP_FIELD_NUMBER

_NOTHING = memoryview(b"")


@dataclass
class StepMessage:
    """A step whose coordinates and transforms are arrays, which are copied once, into the encoded message.

    Attributes:
        head: The step without coordinates and transforms.
        q: The field `q`; None: no coordinates.
        transforms: The field `transforms`; None: no transforms.
    """

    head: steps_pb2.Step
    q: Rows | None = None
    transforms: Rows | None = None

    def encode(self) -> list[bytes]:
        """The encoded `DriveSceneRequest` messages: one or, above 1 MiB, several parts."""
        return [message_of_field(_DRIVE_REQUEST_STEP, part) for part in self._parts()]

    def encode_for_views(self, cameras: bytes = b"", drawn_worlds: int = 0) -> list[bytes]:
        """The encoded `DrawViewsRequest` messages: one or, above 1 MiB, several parts.

        Args:
            cameras: The encoded fields `cameras` of the `ViewStep`, which the last part has.
            drawn_worlds: The field `drawn_worlds`, which the last part has.
        """
        *parts, last = [
            [length_prefix(views_pb2.ViewStep.STEP_FIELD_NUMBER, sum(map(len, part))), *part] for part in self._parts()
        ]
        last += [cameras, views_pb2.ViewStep(drawn_worlds=drawn_worlds).SerializeToString()]
        return [message_of_field(_VIEWS_REQUEST_STEP, part) for part in (*parts, last)]

    def _parts(self) -> list[list[bytes | memoryview]]:
        """The fields of the `Step` messages."""
        head, q, transforms = self.head, _bytes_of(self.q), _bytes_of(self.transforms)
        if head.ByteSize() + len(q) + len(transforms) <= _MAX_SINGLE_BYTES:
            return [_fields(head, q, transforms)]
        without_data = [
            steps_pb2.Step(time=head.time, transform_format=head.transform_format),
            *(steps_pb2.Step(q_domains=piece) for piece in _pieces(head.q_domains, _PART_DOMAINS)),
            *(steps_pb2.Step(transform_domains=piece) for piece in _pieces(head.transform_domains, _PART_DOMAINS)),
        ]
        parts = [
            *((part, _NOTHING, _NOTHING) for part in without_data),
            *((steps_pb2.Step(), piece, _NOTHING) for piece in _pieces(q, _PART_BYTES)),
            *((steps_pb2.Step(), _NOTHING, piece) for piece in _pieces(transforms, _PART_BYTES)),
        ]
        for index, (part, _, _) in enumerate(parts):
            part.number = head.number
            part.has_more = index < len(parts) - 1
        return [_fields(*part) for part in parts]


def _bytes_of(rows: Rows | None) -> memoryview:
    return _NOTHING if rows is None else rows.reshape(-1).view(np.uint8).data


def _fields(head: steps_pb2.Step, q: memoryview, transforms: memoryview) -> list[bytes | memoryview]:
    fields: list[bytes | memoryview] = [head.SerializeToString()]
    for number, content in ((steps_pb2.Step.Q_FIELD_NUMBER, q), (steps_pb2.Step.TRANSFORMS_FIELD_NUMBER, transforms)):
        if len(content) > 0:
            fields += [length_prefix(number, len(content)), content]
    return fields


def _pieces(values: Sequence[Any] | memoryview, size: int) -> Iterator[Any]:
    """Splits a list or bytes."""
    for start in range(0, len(values), size):
        yield values[start : start + size]
