"""Encrypted connections to a server with a self-signed certificate."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
import subprocess
import threading
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import SERVER_ARGUMENTS

import modalcast as mc
import modalcast.aio
from modalcast._server_process import find_program


class EncryptedServer:
    """A server with its certificate and its token."""

    def __init__(self, folder: Path, *options: str) -> None:
        state = folder / "state"
        command = [find_program(None), "serve", "--listen", "127.0.0.1:0", "--tls-self-signed", "--state", str(state)]
        self.process = subprocess.Popen(
            [*command, *SERVER_ARGUMENTS, *options], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert self.process.stdout is not None
        lines = iter(self.process.stdout.readline, "")
        self.address = next(line for line in lines if line.startswith("listening on https://")).split()[-1]
        self.printed = next(line for line in lines if line.startswith("certificate "))
        self.certificate = state / "tls-certificate.pem"
        self.token = (state / "token").read_text().strip()

    def stop(self) -> None:
        self.process.terminate()
        self.process.wait(10)
        assert self.process.stdout is not None
        self.process.stdout.close()


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EncryptedServer]:
    server = EncryptedServer(tmp_path_factory.mktemp("tls"))
    yield server
    server.stop()


def test_calls_steps_and_streams_are_encrypted(server: EncryptedServer):
    with mc.connect(server.address, ca=server.certificate, token=server.token, metadata={"x-scene": "tree"}) as client:
        tree = client.open("tree")
        with tree.drive() as drive, tree.steps() as steps:
            step = drive.step()
            assert next(state for state in steps if state.step == step)
        link = tree.view()
    assert link.url.startswith(f"{server.address}/#code=")
    context = ssl.create_default_context(cafile=str(server.certificate))
    with urllib.request.urlopen(link.url, context=context) as reply:
        assert reply.status == 200


def test_asyncio_client_is_encrypted(server: EncryptedServer, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("MODALCAST_CA_FILE", str(server.certificate))

    async def list_sources() -> list[str]:
        async with await modalcast.aio.connect(server.address, token=server.token) as client:
            return list((await client.scenes()).sources)

    assert "tree" in asyncio.run(list_sources())


def test_printed_fingerprint_is_that_of_the_certificate(server: EncryptedServer):
    host, port = server.address.removeprefix("https://").split(":")
    pem = ssl.get_server_certificate((host, int(port)))
    assert pem == server.certificate.read_text()
    command = ["openssl", "x509", "-noout", "-fingerprint", "-sha256"]
    shown = subprocess.run(command, input=pem, capture_output=True, text=True, check=True).stdout
    assert server.printed.split()[-1] == shown.strip().split("=")[1]


def test_unknown_authority_and_token_are_rejected_at_once(server: EncryptedServer, tmp_path: Path):
    start = time.monotonic()
    # Public authorities have not signed the certificate.
    with pytest.raises(mc.ConnectionLost, match="certificate of the server is not accepted"):
        mc.connect(server.address, token=server.token, connect_timeout=30)
    with pytest.raises(mc.Unauthenticated):
        mc.connect(server.address, ca=server.certificate, connect_timeout=30)
    with pytest.raises(mc.ConnectionLost, match="use https://"):
        mc.connect(server.address.replace("https", "http"), token=server.token, connect_timeout=30)
    assert time.monotonic() - start < 20
    with pytest.raises(OSError, match=r"absent\.pem"):
        mc.connect(server.address, ca=tmp_path / "absent.pem")


def forward(source: socket.socket, target: socket.socket) -> None:
    """Copies one direction of a connection."""
    with contextlib.suppress(OSError):
        while data := source.recv(65536):
            target.sendall(data)
    with contextlib.suppress(OSError):
        target.shutdown(socket.SHUT_WR)


def start_proxy(host: str, port: int) -> str:
    """Forwards connections to a port of this machine. Returns the URL. The threads end with the process."""
    listener = socket.create_server((host, 0))

    def serve() -> None:
        while True:
            client, _ = listener.accept()
            upstream = socket.create_connection(("127.0.0.1", port))
            for pair in ((client, upstream), (upstream, client)):
                threading.Thread(target=forward, args=pair, daemon=True).start()

    threading.Thread(target=serve, daemon=True).start()
    return f"https://{host}:{listener.getsockname()[1]}"


def test_another_host_name_is_rejected_at_once(server: EncryptedServer):
    port = int(server.address.rsplit(":", 1)[1])
    options = {"ca": server.certificate, "token": server.token}
    # An address of this machine that the certificate does not name.
    with pytest.raises(mc.ConnectionLost, match="certificate of the server is not accepted"):
        mc.connect(start_proxy("127.0.0.2", port), connect_timeout=30, **options)
    # Control: the same way to an address that it names.
    mc.connect(start_proxy("127.0.0.1", port), **options).close()


def test_https_at_a_plain_server_is_named(client: mc.Client, server: EncryptedServer):
    with pytest.raises(mc.ConnectionLost, match="use http://"):
        mc.connect(f"https://{client.address}", ca=server.certificate, token="abc", connect_timeout=30)


def test_client_certificate_identifies_its_principal(tmp_path: Path):
    certificate, key, principals = (tmp_path / name for name in ("anna.pem", "anna.key", "principals.toml"))
    command = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    command += ["-subj", "/CN=anna", "-days", "2", "-addext", "basicConstraints=critical,CA:FALSE"]
    command += ["-keyout", str(key), "-out", str(certificate)]
    subprocess.run(command, check=True, capture_output=True)
    principals.write_text("[[principal]]\nname = 'anna'\nrole = 'view'\ncertificates = ['anna']\n")
    principals.chmod(0o600)
    # A self-signed certificate is its own authority.
    server = EncryptedServer(tmp_path, "--tls-client-ca", str(certificate), "--principals", str(principals))
    try:
        with mc.connect(server.address, ca=server.certificate, certificate=certificate, key=key) as client:
            assert not client.scenes().scenes
            with pytest.raises(mc.PermissionDenied):
                client.open("tree")
        with pytest.raises(mc.Unauthenticated):
            mc.connect(server.address, ca=server.certificate)
    finally:
        server.stop()


def test_certificates_need_https():
    with pytest.raises(ValueError, match="expected https://HOST:PORT with certificates"):
        mc.connect("127.0.0.1:1", ca="ca.pem")
    with pytest.raises(ValueError, match="expected https://HOST:PORT with certificates"):
        mc.connect("unix:/run/modalcast.sock", certificate="a.pem", key="a.key")
    with pytest.raises(ValueError, match="expected both or none"):
        mc.connect("https://127.0.0.1:1", certificate="a.pem")
    for metadata in ({"X-Scene": "a"}, {"": "a"}, {"x-scene": "a\n"}):
        with pytest.raises(ValueError, match="metadata"):
            mc.connect("127.0.0.1:1", metadata=metadata)
