"""The connection to a server."""

from __future__ import annotations

import logging
import secrets
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from numpy.typing import ArrayLike

from modalcast._async.scene import Scene, open_scene
from modalcast._async.streams import with_reconnect
from modalcast._async.transport import RETRY_SECONDS, Transport, sleep
from modalcast._channel import ConnectOptions, default_address
from modalcast._methods import (
    DELETE_SCENE,
    END_CLIENT,
    FIND_UPLOADED_FILES,
    GET_SERVER_INFO,
    LIST_CLIENTS,
    LIST_SCENES,
    OPEN_SCENE,
    PROTOCOL_VERSION,
    UPLOAD_ARRAYS,
    UPLOAD_SCENE,
)
from modalcast._server_process import ServerProcess
from modalcast._types import Vector
from modalcast.errors import (
    ConnectionLost,
    NotFound,
    ProtocolVersionError,
    ServerError,
    ServerStartError,
    connection_remedy,
)
from modalcast.upload import LocalFile, Progress, SceneBuilder, file_messages, local_files
from modalcast.v1 import scenes_pb2, server_pb2

RequestT = TypeVar("RequestT")

_LOGGER = logging.getLogger("modalcast")

# Number of hashes in one request; the limit of the server.
_FILES_PER_REQUEST = 4096


@dataclass(frozen=True)
class SceneList:
    """Open scenes, and the sources that `Client.open` accepts.

    Attributes:
        scenes: The open scenes by name.
        sources: Names and paths of sources.
    """

    scenes: dict[str, scenes_pb2.SceneInfo]
    sources: list[str]


class Client:
    """A connection to a server, from `connect` or `spawn`. Closing it also ends a server that `spawn` has started.

    Attributes:
        address: The address of the server.
        info: Version, devices, features and limits of the server; `server.proto` documents the fields.
    """

    def __init__(self, transport: Transport, *, timeout: float, reconnect: float, server: ServerProcess | None) -> None:
        """`connect` and `spawn` create clients."""
        self._transport = transport
        self._timeout = timeout
        self._reconnect = reconnect
        self._server = server
        self._force_owner = secrets.token_bytes(16)
        self.address = transport.address
        self.info = server_pb2.GetServerInfoResponse()

    async def check_version(self, timeout: float) -> None:
        """Reads `info`, and checks that the server has the version of the contract that this client implements.

        Raises:
            ConnectionLost: No server answers.
            ProtocolVersionError: The versions differ.
        """
        self.info = await self._transport.unary(GET_SERVER_INFO, server_pb2.GetServerInfoRequest(), timeout)
        if self.info.protocol_version != PROTOCOL_VERSION:
            raise ProtocolVersionError(
                f"{self.address}: expected a server of protocol version {PROTOCOL_VERSION}, "
                f"got version {self.info.protocol_version}"
            )

    async def open(self, source: str = "tree", name: str = "", *, timeout: float | None = None) -> Scene:
        """Opens a scene of the server, or returns the scene that is already open under this name.

        The logger "modalcast" writes the remarks of the scene (`Scene.remarks`) as warnings.

        Args:
            source: A built-in name such as "tree", or a path inside the server's folder of scenes.
            name: The name that the scene gets; empty: the last component of the source without extension.
            timeout: In seconds; None: that of the client.

        Raises:
            NotFound: The source does not exist; the message lists the sources.
            Error: The call failed.
        """
        timeout = self._timeout if timeout is None else timeout
        request = scenes_pb2.OpenSceneRequest(source=source, scene=name)
        try:
            reply = await with_reconnect(
                self._transport, self._reconnect, lambda: self._transport.unary(OPEN_SCENE, request, timeout)
            )
        except NotFound as error:
            sources = (await self.scenes(timeout=timeout)).sources
            error.args = (f"{error}; the server has the sources {sources[:20]}",)
            raise
        return await self._opened_scene(reply.scene)

    async def scene(self, name: str, *, timeout: float | None = None) -> Scene:
        """Returns an open scene by its name, for example an uploaded one.

        Raises:
            NotFound: No open scene has the name; the message lists the names.
            Error: The call failed.
        """
        scenes = (await self.scenes(timeout=timeout)).scenes
        if name not in scenes:
            raise NotFound(f"no open scene is named '{name}'; the server has {list(scenes)}", code="NOT_FOUND")
        return await self._scene(scenes[name])

    async def scenes(self, *, timeout: float | None = None) -> SceneList:
        """Lists the open scenes and the available sources.

        Raises:
            Error: The call failed.
        """
        timeout = self._timeout if timeout is None else timeout
        request = scenes_pb2.ListScenesRequest()
        reply = await with_reconnect(
            self._transport, self._reconnect, lambda: self._transport.unary(LIST_SCENES, request, timeout)
        )
        return SceneList({scene.scene: scene for scene in reply.scenes}, list(reply.sources))

    async def add_scene(
        self,
        name: str,
        positions: ArrayLike,
        faces: ArrayLike,
        modes: ArrayLike | None = None,
        *,
        eigenvalues: ArrayLike | None = None,
        color: Vector | None = None,
        unit: float = 1.0,
        up: str = "y",
        replace: bool = False,
        progress: Progress | None = None,
        timeout: float | None = None,
    ) -> Scene:
        """Opens a scene with one domain of the same name. `SceneBuilder.add` and `upload` document the arguments.

        Raises:
            ValueError: An array has another shape; the message has the expected and the given one.
            AlreadyExists: A scene has the name, and `replace` is false.
            Error: The call failed.
        """
        builder = SceneBuilder(name, unit=unit, up=up)
        builder.add(positions, faces, modes, name=name, eigenvalues=eigenvalues, color=color)
        return await self.upload(builder, replace=replace, progress=progress, timeout=timeout)

    async def upload(
        self,
        builder: SceneBuilder,
        *,
        replace: bool = False,
        progress: Progress | None = None,
        timeout: float | None = None,
    ) -> Scene:
        """Uploads meshes and modes and opens them as a scene, which the server keeps until it is deleted.

        The logger "modalcast" writes the remarks of the scene (`Scene.remarks`) as warnings.

        Args:
            builder: The scene.
            replace: Whether to delete an open scene of this name first.
            progress: Called with the sent bytes and the bytes of the upload.
            timeout: In seconds; None: no limit.

        Raises:
            AlreadyExists: A scene has the name, and `replace` is false.
            InvalidRequest: A field of the upload is invalid; `field` names it, such as "domains[0].rank".
            Error: The call failed.
        """
        if replace:
            await self.delete(builder.name, missing_ok=True)
        reply = await self._transport.upload(UPLOAD_ARRAYS, builder.messages(progress), timeout)
        return await self._opened_scene(reply.scene)

    async def upload_files(
        self,
        path: str | Path,
        name: str,
        entry: str = "",
        *,
        replace: bool = False,
        progress: Progress | None = None,
        timeout: float | None = None,
    ) -> Scene:
        """Uploads a folder or a file and opens it as a scene. Contents that the server already has are not sent.

        The logger "modalcast" writes the remarks of the scene (`Scene.remarks`) as warnings.

        Args:
            path: The folder or the file.
            name: The name that the scene gets.
            entry: The uploaded path to open; empty: the folder or the single file.
            replace: Whether to delete an open scene of this name first.
            progress: Called with the sent bytes and the bytes of the upload.
            timeout: In seconds; None: no limit.

        Raises:
            OSError: A file cannot be read.
            AlreadyExists: A scene has the name, and `replace` is false.
            InvalidRequest: A file is invalid, with its location in `metadata`.
            Error: The call failed.
        """
        path = Path(path)
        files = local_files(path)
        entry = entry or (files[0].path if path.is_file() else "")
        known = await self._known_contents(files)
        if replace:
            await self.delete(name, missing_ok=True)
        try:
            reply = await self._send_files(name, entry, files, known, progress, timeout)
        except ServerError as error:
            if error.reason != "CONTENT_NOT_FOUND":
                raise
            # Another client has deleted a scene with one of these contents in the meantime: send all.
            reply = await self._send_files(name, entry, files, {}, progress, timeout)
        return await self._opened_scene(reply.scene)

    async def delete(self, name: str, *, missing_ok: bool = False, timeout: float | None = None) -> None:
        """Closes a scene, and removes the files of an uploaded one.

        Raises:
            NotFound: No open scene has the name, and `missing_ok` is false.
            Error: The call failed.
        """
        request = scenes_pb2.DeleteSceneRequest(scene=name)
        try:
            await self._transport.unary(DELETE_SCENE, request, self._timeout if timeout is None else timeout)
        except NotFound:
            if not missing_ok:
                raise

    async def clients(self, *, timeout: float | None = None) -> list[server_pb2.ClientInfo]:
        """Lists the clients of the server with what they hold of limited resources, for administrators.

        Those that hold the largest part of a limit come first. `server.proto` documents the fields. A list that would
        be longer than 1 MiB ends before the clients that hold the smallest parts.

        Raises:
            PermissionDenied: Your role is not `admin`.
            Error: The call failed.
        """
        timeout = self._timeout if timeout is None else timeout
        request = server_pb2.ListClientsRequest()
        reply = await with_reconnect(
            self._transport, self._reconnect, lambda: self._transport.unary(LIST_CLIENTS, request, timeout)
        )
        return list(reply.clients)

    async def end_client(self, client_id: str, *, timeout: float | None = None) -> int:
        """Ends the connections, streams and waiting requests of a client, for administrators. Open scenes stay open.

        The client may connect again if its credential is still valid; the session of a browser is not.

        Args:
            client_id: The id of a client in `clients`, or all clients of a principal except this one: "anna/*".
            timeout: In seconds; None: that of the client.

        Returns:
            The number of connections, streams and waiting requests that end.

        Raises:
            InvalidRequest: No client with this id holds anything.
            PermissionDenied: Your role is not `admin`.
            Error: The call failed.
        """
        request = server_pb2.EndClientRequest(id=client_id)
        timeout = self._timeout if timeout is None else timeout
        return (await self._transport.unary(END_CLIENT, request, timeout)).ended

    async def close(self) -> None:
        """Closes the connection, and ends a server that `spawn` has started."""
        await self._transport.close()
        if self._server is not None:
            self._server.stop()

    async def __aenter__(self) -> Client:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    def __repr__(self) -> str:
        return f"<Client of {self.address}: modalcast {self.info.version}, {self.info.backend}, {self.info.renderer}>"

    async def _scene(self, info: scenes_pb2.SceneInfo) -> Scene:
        return await open_scene(
            self, self._transport, info, self._force_owner, timeout=self._timeout, reconnect=self._reconnect
        )

    async def _opened_scene(self, info: scenes_pb2.SceneInfo) -> Scene:
        """The scene that a call has opened. Logs its remarks."""
        scene = await self._scene(info)
        for remark in scene.remarks:
            _LOGGER.warning("scene '%s': %s", scene.name, remark)
        return scene

    async def _known_contents(self, files: Sequence[LocalFile]) -> dict[bytes, bool]:
        hashes = list({file.sha256 for file in files})
        known: dict[bytes, bool] = {}
        for start in range(0, len(hashes), _FILES_PER_REQUEST):
            asked = hashes[start : start + _FILES_PER_REQUEST]
            request = scenes_pb2.FindUploadedFilesRequest(sha256=asked)
            reply = await self._transport.unary(FIND_UPLOADED_FILES, request, self._timeout)
            known.update(zip(asked, reply.found, strict=False))
        return known

    async def _send_files(
        self,
        name: str,
        entry: str,
        files: Sequence[LocalFile],
        known: dict[bytes, bool],
        progress: Progress | None,
        timeout: float | None,
    ) -> scenes_pb2.UploadSceneResponse:
        requests = RecordedErrors(file_messages(name, entry, files, known, progress))
        try:
            return await self._transport.upload(UPLOAD_SCENE, requests, timeout)
        except (ServerError, ConnectionLost):
            # A file that cannot be read aborts the upload: raise the error of the file.
            if requests.error is not None:
                raise requests.error from None
            raise


class RecordedErrors(Iterator[RequestT]):
    """An iterator that records its error, because gRPC does not pass it on."""

    def __init__(self, items: Iterator[RequestT]) -> None:
        self._items = items
        self.error: Exception | None = None

    def __next__(self) -> RequestT:
        try:
            return next(self._items)
        except StopIteration:
            raise
        except Exception as error:
            self.error = error
            raise


async def connect(
    address: str | None = None,
    *,
    token: str | None = None,
    ca: str | Path | None = None,
    certificate: str | Path | None = None,
    key: str | Path | None = None,
    metadata: Mapping[str, str] | None = None,
    timeout: float = 60.0,
    reconnect: float = 10.0,
    connect_timeout: float = 5.0,
) -> Client:
    """Connects to a server.

    A server that you have started on this machine needs no token: it is reached at its Unix socket, and the kernel
    tells it who you are. Other servers need one.

    Args:
        address: HOST:PORT, http://HOST:PORT, https://HOST:PORT or unix:PATH; None: the environment variable
            MODALCAST_SERVER, or 127.0.0.1:50051.
        token: Identifies you to the server; None: the token in the file that the environment variable
            MODALCAST_TOKEN_FILE names, if any. Anyone on the way can read it, unless the connection is encrypted
            (https), stays on this machine or goes through a tunnel.
        ca: PEM file with the authorities whose certificates are accepted from an https server; a self-signed one is its
            own authority. None: the file that the environment variable MODALCAST_CA_FILE names, or else public
            authorities.
        certificate: PEM file with a certificate that identifies you to an https server.
        key: PEM file with the private key of `certificate`.
        metadata: Sent with every call, for a proxy in front of the server.
        timeout: Default time limit of a call, in seconds.
        reconnect: Seconds for which calls without side effects, streams of the latest steps and drives wait for the
            server after a lost connection; 0: they raise `ConnectionLost` at once.
        connect_timeout: Seconds in which the server must answer.

    Raises:
        ConnectionLost: No server answers, or its certificate is not accepted.
        Unauthenticated: The server does not know you.
        ProtocolVersionError: The server has another version of the contract.
        ValueError: The address or an option is invalid.
        OSError: A file cannot be read.
    """
    options = ConnectOptions(token=token, ca=ca, certificate=certificate, key=key, metadata=metadata or {})
    transport = Transport(default_address() if address is None else address, options)
    client = Client(transport, timeout=timeout, reconnect=reconnect, server=None)
    try:
        await client.check_version(connect_timeout)
    except ConnectionLost as error:
        await transport.close()
        raise ConnectionLost(f"{error}. {connection_remedy(str(error))}") from None
    except BaseException:
        await transport.close()
        raise
    return client


async def spawn(
    *,
    program: str | Path | None = None,
    arguments: Sequence[str] = (),
    timeout: float = 60.0,
    start_timeout: float = 60.0,
) -> Client:
    """Starts a server on a free port of this machine and connects to it.

    The server ends when the client is closed or this process exits, and its scenes are not kept.

    Args:
        program: Path of `modalcast`; None: the environment variable MODALCAST_PROGRAM, or `modalcast` in PATH.
        arguments: Further options of `modalcast serve`, such as ["--scenes", "folder", "--backend", "cpu"].
        timeout: Default time limit of a call, in seconds.
        start_timeout: Seconds in which the server must start.

    Raises:
        ServerStartError: The program does not exist, ended, or did not listen in time; with the end of its log.
    """
    server = ServerProcess(program, arguments)
    try:
        waited = 0.0
        while (address := server.address()) is None:
            if waited >= start_timeout:
                raise ServerStartError(f"the server did not listen within {start_timeout:g} s: {server.log()}")
            await sleep(RETRY_SECONDS)
            waited += RETRY_SECONDS
        transport = Transport(address, ConnectOptions(token=server.token()))
        client = Client(transport, timeout=timeout, reconnect=0.0, server=server)
        await client.check_version(timeout)
    except BaseException:
        server.stop()
        raise
    return client
