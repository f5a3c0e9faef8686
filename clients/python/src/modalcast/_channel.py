"""Settings of connections."""

from __future__ import annotations

import functools
import os
import socket
import stat
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import grpc

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
    """The target of a connection: HOST, HOST:PORT, http://HOST:PORT, https://HOST:PORT or unix:PATH.

    The default port is 50051, and 443 for https.

    Raises:
        ValueError: The address has another scheme.
    """
    default_port = 443 if is_encrypted(address) else 50051
    target = address.removeprefix("http://").removeprefix("https://").rstrip("/")
    if "://" in target:
        raise ValueError(f"address: expected {_ADDRESSES}, got '{address}'")
    if not target:
        raise ValueError(f"address: expected {_ADDRESSES}, got an empty text")
    return target if ":" in target else f"{target}:{default_port}"


_ADDRESSES = "HOST:PORT, http://HOST:PORT, https://HOST:PORT or unix:PATH"


def is_encrypted(address: str) -> bool:
    """Whether connections to an address are encrypted."""
    return address.startswith("https://")


@dataclass(frozen=True, repr=False)
class ConnectOptions:
    """What a caller gives to connect to a server; see `connect`."""

    token: str | None = None
    ca: str | Path | None = None
    certificate: str | Path | None = None
    key: str | Path | None = None
    metadata: Mapping[str, str] = field(default_factory=dict[str, str])


@dataclass(frozen=True, repr=False)
class Route:
    """The way to a server.

    Attributes:
        target: The target of connections.
        metadata: Sent with every call: the token, if there is one, and the metadata of the caller.
        credentials: The certificates of an encrypted connection; None: it is plain.
        memory_socket: The socket at which a server of this user on this machine offers shared memory; None: there is
            none.
    """

    target: str
    metadata: tuple[tuple[str, str], ...] = ()
    credentials: grpc.ChannelCredentials | None = None
    memory_socket: Path | None = None


def route_to(address: str, options: ConnectOptions) -> Route:
    """The way to the server at an address.

    Without a token, a plain server of this user on this machine is reached at its Unix socket, where the user is the
    credential. The environment variable MODALCAST_TOKEN_FILE names a file with a token, and MODALCAST_CA_FILE one with
    the certificates of authorities.

    Raises:
        ValueError: The address or an option is invalid.
        OSError: A file cannot be read.
    """
    target = target_of(address)
    credentials = _credentials(address, options)
    metadata = tuple(options.metadata.items())
    for name, value in metadata:
        if not (_is_text(name) and name == name.lower() and value.isascii() and value.isprintable()):
            raise ValueError(f"metadata: expected lower-case names and values of visible ASCII letters, got '{name}'")
    memory_socket = _local_socket(target, "memory.sock", probe=False)
    token = options.token
    path = os.environ.get("MODALCAST_TOKEN_FILE")
    if token is None and path and not target.startswith("unix:"):
        token = Path(path).read_text().strip()
    if token is None:
        socket_path = None if credentials else _local_socket(target, "sock", probe=True)
        path = target if socket_path is None else f"unix:{socket_path}"
        return Route(path, metadata, credentials, memory_socket)
    if not _is_text(token):
        raise ValueError("token: expected visible ASCII letters, got another text")
    return Route(target, (*metadata, ("authorization", f"Bearer {token}")), credentials, memory_socket)


def _is_text(text: str) -> bool:
    return bool(text) and text.isascii() and text.isprintable() and " " not in text


def _credentials(address: str, options: ConnectOptions) -> grpc.ChannelCredentials | None:
    """The certificates of an encrypted connection.

    Raises:
        ValueError: Certificates are given for a plain connection, or a certificate without its key.
        OSError: A file cannot be read.
    """
    if (options.certificate is None) != (options.key is None):
        raise ValueError("certificate, key: expected both or none, got one")
    if not is_encrypted(address):
        if options.ca is not None or options.certificate is not None:
            raise ValueError(f"address: expected https://HOST:PORT with certificates, got '{address}'")
        return None
    ca = options.ca if options.ca is not None else os.environ.get("MODALCAST_CA_FILE") or None
    contents = [None if path is None else Path(path).read_bytes() for path in (ca, options.key, options.certificate)]
    return grpc.ssl_channel_credentials(*contents)


def _local_socket(target: str, extension: str, *, probe: bool) -> Path | None:
    """A socket of a running server of this user at HOST:PORT: "sock" for calls, "memory.sock" for shared memory.

    Others cannot create one in a folder of this user. With `probe`, only a socket that is answered.
    """
    host, _, port = target.rpartition(":")
    if host not in ("localhost", "[::1]") and not host.startswith("127."):
        return None
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local/state")
    folder = Path(runtime) / "modalcast" if runtime else state / "modalcast/run"
    path = folder / f"{port}.{extension}"
    try:
        of_folder, of_socket = folder.lstat(), path.lstat()
    except OSError:
        return None
    is_private = stat.S_ISDIR(of_folder.st_mode) and of_folder.st_mode & 0o022 == 0
    is_own = is_private and of_folder.st_uid == of_socket.st_uid and stat.S_ISSOCK(of_socket.st_mode)
    return path if is_own and (not probe or _is_answered(path)) else None


def _is_answered(path: Path) -> bool:
    """Whether a server listens on a socket. A killed server leaves its socket."""
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(5.0)
        try:
            connection.connect(str(path))
        except OSError:
            return False
    return True


def deadline_ms(timeout: float) -> int:
    """The deadline of a request in milliseconds, at most ten minutes, the limit of the server."""
    return min(max(int(timeout * 1000), 1), 600_000)
