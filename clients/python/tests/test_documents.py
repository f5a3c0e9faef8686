"""The code of the documents runs, each block in an empty folder: Python, and the shell commands of the recipes."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

import modalcast as mc
from modalcast._server_process import find_program

ROOT = Path(__file__).parents[3]
DOCUMENTS = [ROOT / name for name in ("README.md", "clients/python/README.md", "clients/recipes.md")]
OPTIONAL_PACKAGES = ("mujoco", "torch", "webdataset")


def blocks(language: str) -> Iterator[object]:
    for document in DOCUMENTS:
        found = re.findall(rf"^```{language}\n(.*?)^```$", document.read_text(), re.DOTALL | re.MULTILINE)
        for number, block in enumerate(found):
            yield pytest.param(block, id=f"{document.parent.name}-{document.stem}-{number}")


PYTHON, SHELL = list(blocks("python")), list(blocks("bash"))


@pytest.fixture
def programs() -> str:
    """The folder of the programs, of which a build of the server alone has only one."""
    folder = Path(find_program(None)).parent
    names = ("modalcast-sim", "modalcast-fetch", "modalcast-record", "modalcast-modes")
    missing = [name for name in names if not (folder / name).exists()]
    if missing:
        pytest.skip(f"{folder} has no {', '.join(missing)}")
    return str(folder)


def test_documents_have_code():
    assert len(PYTHON) >= 14
    assert len(SHELL) >= 2


@pytest.mark.parametrize("block", PYTHON)
def test_python_runs(
    block: str,
    client: mc.Client,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
):
    for package in OPTIONAL_PACKAGES:
        if f"import {package}\n" in block:
            pytest.importorskip(package)
    if "import subprocess" in block or "make_model" in block:
        monkeypatch.setenv("PATH", request.getfixturevalue("programs"), prepend=os.pathsep)
    monkeypatch.chdir(tmp_path)
    # The server of the tests in place of the one that the reader has started.
    monkeypatch.setenv("MODALCAST_SERVER", client.address)
    exec(compile(block, "document.md", "exec"), {"__name__": "document"})
    if "save(" in block:
        pictures = [path for path in Path().iterdir() if path.suffix in {".png", ".jpg"}]
        assert pictures
        assert all(picture.stat().st_size > 5_000 for picture in pictures)
    check_files(block)


@pytest.mark.parametrize("block", SHELL)
def test_shell_commands_run(
    block: str, client: mc.Client, programs: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", programs, prepend=os.pathsep)
    monkeypatch.setenv("MODALCAST_SERVER", f"http://{client.address}")
    with Path("errors").open("w+") as errors:
        # A process group, so that programs in the background end with the commands.
        shell = subprocess.Popen(["bash", "-euc", block], stdout=errors, stderr=errors, start_new_session=True)
        try:
            code = shell.wait(300)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(shell.pid, signal.SIGTERM)
        errors.seek(0)
        assert code == 0, errors.read()
    check_files(block)


def check_files(block: str) -> None:
    """The block has written every file that it names as output."""
    for name in re.findall(r"--out[\", ]+([\w.]+)", block):
        assert Path(name).stat().st_size > 1000, name
