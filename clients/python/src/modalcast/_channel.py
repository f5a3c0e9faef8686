"""Settings of connections."""

from __future__ import annotations

import functools
import os

# Bytes. The server sends messages of at most 3 MiB.
_MAX_MESSAGE_BYTES = 4 << 20

CHANNEL_OPTIONS: list[tuple[str, int | str]] = [
    ("grpc.max_receive_message_length", _MAX_MESSAGE_BYTES),
    # The server limits the size of what it receives and rejects with an error that names the limit.
    ("grpc.max_send_message_length", -1),
    # Connections of clients in one process are separate, so that closing a client closes its connection.
    ("grpc.use_local_subchannel_pool", 1),
    # A connection that does not answer a ping for 20 s is closed.
    ("grpc.keepalive_time_ms", 20_000),
    ("grpc.keepalive_timeout_ms", 20_000),
    # Times between two attempts to connect.
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.min_reconnect_backoff_ms", 1_000),
    ("grpc.max_reconnect_backoff_ms", 1_000),
]


# Bytes: a little less than the largest block whose size glibc takes over as its limit.
_LARGE_BLOCK = 31 << 20


@functools.cache
def keep_memory_of_messages() -> None:
    """Lets the allocator reuse the memory of messages.

    glibc returns freed blocks above 128 KiB to the system, and each new one costs a page fault per 4 KiB, which is half
    of the CPU time to receive 8 MB in messages of 1 MiB. When a larger block is freed, glibc raises this limit to its
    size (M_MMAP_THRESHOLD in mallopt(3)). Freeing this one, whose pages are never touched, costs microseconds. The
    process may then hold up to 62 MiB of freed memory. Other allocators ignore it.
    """
    bytes(_LARGE_BLOCK)


# gRPC derives the host name of a Unix socket from its path, which servers in Rust reject.
UNIX_OPTIONS: list[tuple[str, int | str]] = [("grpc.default_authority", "localhost")]


def options_of(target: str) -> list[tuple[str, int | str]]:
    """The settings of connections to a target."""
    return CHANNEL_OPTIONS + (UNIX_OPTIONS if target.startswith("unix:") else [])


def default_address() -> str:
    """The address of the server if the caller names none."""
    return os.environ.get("MODALCAST_SERVER", "127.0.0.1:50051")


def target_of(address: str) -> str:
    """The target of a connection: HOST, HOST:PORT, http://HOST:PORT or unix:PATH. The default port is 50051.

    Raises:
        ValueError: The address has another scheme.
    """
    target = address.removeprefix("http://").rstrip("/")
    if "://" in target:
        raise ValueError(f"address: expected HOST:PORT, http://HOST:PORT or unix:PATH, got '{address}'")
    if not target:
        raise ValueError("address: expected HOST:PORT, http://HOST:PORT or unix:PATH, got an empty text")
    return target if ":" in target else f"{target}:50051"


def deadline_ms(timeout: float) -> int:
    """The deadline of a request in milliseconds, at most ten minutes, the limit of the server."""
    return min(max(int(timeout * 1000), 1), 600_000)
