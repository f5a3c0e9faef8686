"""HTTP/1.1 and WebSocket over raw sockets, for attacks that a library would not send (see proto/websocket.md)."""

import base64
import select
import socket
import struct
import time

# Opcodes of frames.
CONTINUATION = 0
BINARY = 2
PING = 9

# Kinds of messages.
START = 0
MESSAGE = 1
END = 2
CREDIT = 4

MASK = b"\x01\x02\x03\x04"


def request(server, path, host=None, origin=None, upgrade=False, body=None):
    """A GET request, or a POST request with a body."""
    lines = [f"{'GET' if body is None else 'POST'} {path} HTTP/1.1", f"Host: {server.address if host is None else host}"]
    lines += [f"Origin: {origin}"] if origin else []
    if upgrade:
        key = base64.b64encode(bytes(16)).decode()
        lines += ["Connection: Upgrade", "Upgrade: websocket", "Sec-WebSocket-Version: 13"]
        lines += [f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Protocol: modalcast.v1"]
    lines += [] if body is None else [f"Content-Length: {len(body)}"]
    return ("\r\n".join(lines) + "\r\n\r\n" + (body or "")).encode()


def status_of(server, head):
    """The status of the answer to a request. 0 without an answer."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as connection:
        connection.sendall(head)
        answer = connection.recv(4096)
    return int(answer.split(b" ")[1]) if answer.startswith(b"HTTP/1.1 ") else 0


def frame(opcode, payload, is_last=True, claimed=None):
    """A masked frame, whose header may claim another length than that of its payload."""
    length = len(payload) if claimed is None else claimed
    head = bytes([opcode | (0x80 if is_last else 0), 0xFF]) + struct.pack(">Q", length) + MASK
    masked = int.from_bytes(payload, "little") ^ int.from_bytes(
        (MASK * (len(payload) // 4 + 1))[: len(payload)], "little"
    )
    return head + masked.to_bytes(len(payload), "little")


def message(call, kind, payload=b""):
    """A message of the call with the id `call`, in one frame."""
    return frame(BINARY, struct.pack("<IB", call, kind) + payload)


def start_call(call, path, content):
    """The messages of a call with one request and without a timeout."""
    head = message(call, START, struct.pack("<I", 0) + path.encode())
    return head + message(call, MESSAGE, content) + message(call, END)


class WebSocket:
    """A connection after its handshake. Nothing is read unless `receive` is called."""

    def __init__(self, server, receive_buffer=None):
        self.socket = socket.socket()
        if receive_buffer:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        self.socket.settimeout(10)
        self.socket.connect(("127.0.0.1", server.port))
        self.socket.sendall(request(server, "/websocket", upgrade=True))
        answer = b""
        while not answer.endswith(b"\r\n\r\n"):
            # One byte at a time, so that no frame is read.
            byte = self.socket.recv(1)
            if not byte:
                raise ConnectionError(f"expected an upgrade, got {answer!r}")
            answer += byte
        if not answer.startswith(b"HTTP/1.1 101"):
            raise ConnectionError(f"expected an upgrade, got {answer!r}")

    def send(self, data):
        self.socket.sendall(data)

    def receive(self, seconds):
        """Reads for a time. Returns the bytes, and whether the connection is open."""
        data, end = b"", time.monotonic() + seconds
        # Unlike `select`, it accepts file descriptors above 1023.
        poll = select.poll()
        poll.register(self.socket, select.POLLIN)
        while (remaining := end - time.monotonic()) > 0:
            if not poll.poll(1000 * remaining):
                break
            try:
                part = self.socket.recv(1 << 16)
            except OSError:
                return data, False
            if not part:
                return data, False
            data += part
        return data, True

    def close(self):
        self.socket.close()
