"""Memory that a server on the same machine shares with this client. `SharedRange` in `common.proto` documents it."""

from __future__ import annotations

import contextlib
import mmap
import os
import socket
import struct
from collections.abc import Sequence
from pathlib import Path

from modalcast._chunks import malformed
from modalcast.errors import ConnectionLost

TOKEN_KEY = "modalcast-shared-memory-bin"
"""Metadata key of a call that uses shared memory."""

FIRST_DEVICE_SLOT = 1 << 31
"""Slot n of device memory is returned as this number plus n."""

_HANDSHAKE = struct.Struct("<4I16s")
_VERSION = 1
_ANNOUNCEMENT = struct.Struct("<2I")
_DEVICE_MEMORY = 0xFFFF_FFFF
_MAX_DEVICE_SLOTS = 16

# A server cannot make the client map more.
_MAX_BYTES = 1 << 30

# Seconds within which a server on this machine answers.
_TIMEOUT = 5.0

# From linux/fcntl.h. A file that could shrink would end this process when it reads beyond the new end.
_F_GET_SEALS = 1034
_F_SEAL_SHRINK = 2


class MemoryConnection:
    """A connection for the shared memory of one call. The server fills slots, and this client returns them."""

    def __init__(self, path: Path) -> None:
        """Connects to the socket of a server.

        Raises:
            ConnectionLost: No server answers there, or it has no connection left.
            MalformedReply: The server contradicts the contract.
        """
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.settimeout(_TIMEOUT)
        try:
            self._socket.connect(str(path))
            self._replies, self._slot_bytes, self._slot_count, self.token = _receive_memory(self._socket)
        except OSError as error:
            self._socket.close()
            raise ConnectionLost(f"{path}: no shared memory: {error}") from None
        except BaseException:
            self._socket.close()
            raise

    @property
    def metadata(self) -> tuple[str, bytes]:
        """What a call sends to use this memory."""
        return (TOKEN_KEY, self.token)

    def data(self, slot: int, length: int) -> memoryview:
        """The data in a slot, until `give_back` returns the slot.

        Raises:
            MalformedReply: The range is not in this memory.
        """
        if slot >= self._slot_count or length > self._slot_bytes:
            expected = f"{self._slot_count} slots of {self._slot_bytes} bytes"
            raise malformed("shared", expected, f"{length} bytes in slot {slot}")
        begin = slot * self._slot_bytes
        try:
            return memoryview(self._replies)[begin : begin + length]
        except ValueError:  # closed by another thread
            raise ConnectionLost("the shared memory is closed") from None

    def give_back(self, slots: Sequence[int]) -> None:
        """Returns slots to the server. A server that has ended needs none."""
        with contextlib.suppress(OSError):
            self._socket.sendall(struct.pack(f"<{len(slots)}I", *slots))

    def device_files(self) -> list[int]:
        """Receives the file descriptors of device memory, one per slot. The caller closes them.

        Raises:
            ConnectionLost: The server has closed the connection.
            MalformedReply: The server contradicts the contract.
        """
        try:
            message, files = _receive(self._socket, _ANNOUNCEMENT.size, _MAX_DEVICE_SLOTS)
        except OSError as error:
            raise ConnectionLost(f"no device memory: {error}") from None
        number, count = _ANNOUNCEMENT.unpack(message)
        if number != _DEVICE_MEMORY or count != len(files):
            _close_all(files)
            raise malformed("device memory", f"{count} files", f"{len(files)} files after the number {number}")
        return files

    def close(self) -> None:
        """Ends the connection, and frees the memory. No view of the data may exist."""
        # Ends the connection also if a process that was forked has the socket, too.
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        # A view in an exception that is being handled keeps the mapping until it is gone.
        with contextlib.suppress(BufferError):
            self._replies.close()


def _receive_memory(connection: socket.socket) -> tuple[mmap.mmap, int, int, bytes]:
    import fcntl  # not on every system that has this client

    message, files = _receive(connection, _HANDSHAKE.size, 2)
    try:
        version, slot_bytes, slot_count, _, token = _HANDSHAKE.unpack(message)
        length = slot_bytes * slot_count
        if version != _VERSION or len(files) != 2 or not 0 < length <= _MAX_BYTES:
            given = f"version {version} with {len(files)} files of {length} bytes"
            raise malformed("shared memory", f"version {_VERSION} with 2 files of at most {_MAX_BYTES} bytes", given)
        replies = files[0]
        is_sealed = fcntl.fcntl(replies, _F_GET_SEALS) & _F_SEAL_SHRINK != 0
        if not is_sealed or os.fstat(replies).st_size < length:
            raise malformed("shared memory", f"a sealed file of {length} bytes", f"{os.fstat(replies).st_size} bytes")
        return mmap.mmap(replies, length, mmap.MAP_SHARED, mmap.PROT_READ), slot_bytes, slot_count, token
    finally:
        _close_all(files)


def _receive(connection: socket.socket, length: int, max_files: int) -> tuple[bytes, list[int]]:
    """Receives a message of this length, and the file descriptors that come with it."""
    message, files, _, _ = socket.recv_fds(connection, length, max_files)
    try:
        while len(message) < length:
            more = connection.recv(length - len(message))
            if not more:
                raise OSError("the server has closed the connection")
            message += more
    except BaseException:
        _close_all(files)
        raise
    return message, list(files)


def _close_all(files: Sequence[int]) -> None:
    for file in files:
        os.close(file)
