"""A server on the CPU for all tests. `MODALCAST_PROGRAM` names the program; else `modalcast` is searched in PATH."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from scenes import beam_builder

import modalcast as mc

SERVER_ARGUMENTS = ["--backend", "cpu", "--renderer", "software"]

TOKEN = "token-of-anna"


@pytest.fixture(scope="session")
def client() -> Iterator[mc.Client]:
    with mc.spawn(arguments=SERVER_ARGUMENTS) as client:
        yield client


@pytest.fixture(scope="session")
def tree(client: mc.Client) -> mc.Scene:
    return client.open("tree")


@pytest.fixture
def principals(tmp_path: Path) -> Path:
    """A file with the principal "anna"."""
    path = tmp_path / "principals.toml"
    digits = hashlib.sha256(TOKEN.encode()).hexdigest()
    path.write_text(f'[[principal]]\nname = "anna"\nrole = "upload"\n[[principal.token]]\nsha256 = "{digits}"\n')
    path.chmod(0o600)
    return path


@pytest.fixture
def beams(client: mc.Client, request: pytest.FixtureRequest) -> Iterator[mc.Scene]:
    """Two beams, of which the second one is a copy beside the first."""
    scene = client.upload(beam_builder(request.node.name[:60].replace("[", "_").replace("]", "")))
    yield scene
    scene.delete()
