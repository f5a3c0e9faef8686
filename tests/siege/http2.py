"""Raw HTTP/2 connections, for clients that break the rules of a library."""

import socket
import struct
import time

from hpack import Encoder

PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
DATA, HEADERS, PRIORITY, RST_STREAM, SETTINGS, PUSH_PROMISE, PING, GOAWAY, WINDOW_UPDATE = range(9)
END_STREAM, ACK, END_HEADERS = 1, 1, 4
INITIAL_WINDOW_SIZE = 4
NO_ERROR = 0

# Size of a frame's header, and the largest payload of a frame by default, in bytes.
HEADER_BYTES, MAX_PAYLOAD = 9, 16384

# The largest flow-control window, and the window that a connection has at first, in bytes.
MAX_WINDOW, FIRST_WINDOW = (1 << 31) - 1, 65535


def frame(kind, flags=0, stream=0, payload=b""):
    """A frame of the type `kind`. Stream 0 is the connection."""
    return struct.pack(">IBI", len(payload) << 8 | kind, flags, stream) + payload


def settings(**values):
    """A SETTINGS frame. `initial_window` is the flow-control window of the streams that the server sends on."""
    ids = {"initial_window": INITIAL_WINDOW_SIZE}
    return frame(SETTINGS, payload=b"".join(struct.pack(">HI", ids[name], value) for name, value in values.items()))


def grpc_headers(path, stream):
    """The HEADERS frame of a gRPC call."""
    fields = [
        (":method", "POST"),
        (":scheme", "http"),
        (":path", path),
        (":authority", "localhost"),
        ("content-type", "application/grpc"),
        ("te", "trailers"),
    ]
    # A new encoder refers to no earlier headers, so the frames of several calls can be sent in any order.
    return frame(HEADERS, END_HEADERS, stream, Encoder().encode(fields, huffman=False))


def grpc_message(payload, length=None):
    """A gRPC message. `length` is the claimed length if it differs from the length of the payload."""
    return struct.pack(">BI", 0, len(payload) if length is None else length) + payload


def window_update(stream, increment):
    """Lets the server send `increment` bytes more. Stream 0 is the connection."""
    return frame(WINDOW_UPDATE, 0, stream, struct.pack(">I", increment))


class FrameReader:
    """Splits received bytes into frames."""

    def __init__(self):
        self.buffer = b""

    def feed(self, data):
        """Adds received bytes. Returns the frames that are complete now, as (kind, flags, stream, payload)."""
        self.buffer += data
        frames = []
        position = 0
        while len(self.buffer) - position >= HEADER_BYTES:
            length = int.from_bytes(self.buffer[position : position + 3], "big")
            begin = position + HEADER_BYTES
            if len(self.buffer) < begin + length:
                break
            kind, flags = self.buffer[position + 3], self.buffer[position + 4]
            stream = int.from_bytes(self.buffer[position + 5 : position + 9], "big") & 0x7FFFFFFF
            frames.append((kind, flags, stream, self.buffer[begin : begin + length]))
            position = begin + length
        self.buffer = self.buffer[position:]
        return frames


def answer(received):
    """The frames with which a polite client answers PINGs and SETTINGS."""
    replies = b""
    for kind, flags, _, payload in received:
        if kind == PING and not flags & ACK:
            replies += frame(PING, ACK, 0, payload)
        elif kind == SETTINGS and not flags & ACK:
            replies += frame(SETTINGS, ACK)
    return replies


class Connection:
    """A blocking connection."""

    def __init__(self, port, timeout=10, **client_settings):
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=timeout)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.reader = FrameReader()
        self.next_stream = 1
        self.socket.sendall(PREFACE + settings(**client_settings))
        # The windows of the server apply when its SETTINGS are acknowledged.
        self.receive(timeout, lambda frame: frame[0] == SETTINGS and not frame[1] & ACK)

    def close(self):
        self.socket.close()

    def open_call(self, path):
        """Sends the headers of a call. Returns its stream."""
        stream = self.next_stream
        self.next_stream += 2
        self.socket.sendall(grpc_headers(path, stream))
        return stream

    def send(self, data):
        self.socket.sendall(data)

    def send_data(self, stream, data, flags=0):
        """Sends data in DATA frames. `flags` are those of the last frame."""
        for first in range(0, len(data), MAX_PAYLOAD):
            end = first + MAX_PAYLOAD
            self.socket.sendall(frame(DATA, flags if end >= len(data) else 0, stream, data[first:end]))

    def receive(self, seconds, until=lambda frame: False):
        """Receives frames for a time, or until one fulfils a condition. Answers PINGs and SETTINGS. Returns the frames,
        and whether the connection is still open."""
        deadline = time.monotonic() + seconds
        received = []
        while (remaining := deadline - time.monotonic()) > 0:
            self.socket.settimeout(remaining)
            try:
                data = self.socket.recv(1 << 16)
            except TimeoutError:
                break
            except OSError:
                return received, False
            if not data:
                return received, False
            frames = self.reader.feed(data)
            received += frames
            reply = answer(frames)
            if reply:
                self.socket.sendall(reply)
            if any(map(until, frames)):
                break
        return received, True
