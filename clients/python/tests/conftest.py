"""A server on the CPU for all tests. `MODALCAST_PROGRAM` names the program; else `modalcast` is searched in PATH."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from scenes import beam_builder

import modalcast as mc

SERVER_ARGUMENTS = ["--backend", "cpu", "--renderer", "software"]


@pytest.fixture(scope="session")
def client() -> Iterator[mc.Client]:
    with mc.spawn(arguments=SERVER_ARGUMENTS) as client:
        yield client


@pytest.fixture(scope="session")
def tree(client: mc.Client) -> mc.Scene:
    return client.open("tree")


@pytest.fixture
def beams(client: mc.Client, request: pytest.FixtureRequest) -> Iterator[mc.Scene]:
    """Two beams, of which the second one is a copy beside the first."""
    scene = client.upload(beam_builder(request.node.name[:60].replace("[", "_").replace("]", "")))
    yield scene
    scene.delete()
