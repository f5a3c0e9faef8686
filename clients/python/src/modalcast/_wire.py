"""Messages with large data, without the copies that protobuf makes.

protobuf copies the bytes of a field into its arena, and between the arena and a `bytes` object. Here, received data are
a view of the message as gRPC has received it, and data to send are copied once, into the message that gRPC sends.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from google.protobuf.message import DecodeError

_LENGTH_DELIMITED = 2
_FIXED_BYTES = {1: 8, 5: 4}


def length_prefix(field: int, length: int) -> bytes:
    """What precedes the content of a field of `length` bytes: its key and its length."""
    return _encode_varint(field << 3 | _LENGTH_DELIMITED) + _encode_varint(length)


def message_of_field(field: int, content: Sequence[bytes | memoryview]) -> bytes:
    """A message with one field, whose content is copied once."""
    return b"".join([length_prefix(field, sum(len(piece) for piece in content)), *content])


def _encode_varint(value: int) -> bytes:
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    encoded.append(value)
    return bytes(encoded)


def _varint(buffer: memoryview, position: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = buffer[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
        shift += 7
        if shift > 63:
            raise DecodeError("a number has more than 64 bits")


def _fields(buffer: memoryview) -> Iterator[tuple[int, int, int, int]]:
    """The fields of a message: number, start of the tag, start of the content, end."""
    position = 0
    while position < len(buffer):
        start = position
        tag, position = _varint(buffer, position)
        wire_type = tag & 7
        content = position
        if wire_type == _LENGTH_DELIMITED:
            length, content = _varint(buffer, position)
            position = content + length
        elif wire_type == 0:
            _, position = _varint(buffer, position)
        elif wire_type in _FIXED_BYTES:
            position += _FIXED_BYTES[wire_type]
        else:
            raise DecodeError(f"wire type {wire_type}")
        if position > len(buffer):
            raise DecodeError("a field exceeds its message")
        yield tag >> 3, start, content, position


def split_data(chunk: memoryview, data_field: int) -> tuple[bytes, memoryview]:
    """Separates the data of a chunk from its other fields."""
    for number, start, content, end in _fields(chunk):
        if number == data_field:
            return bytes(chunk[:start]) + bytes(chunk[end:]), chunk[content:end]
    return bytes(chunk), memoryview(b"")


def submessage(message: bytes, field: int) -> memoryview | None:
    """The content of a message field; None if it is not set."""
    view = memoryview(message)
    for number, _, content, end in _fields(view):
        if number == field:
            return view[content:end]
    return None
