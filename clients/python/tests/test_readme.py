"""The Python code of the documents runs, each block in an empty folder."""

from __future__ import annotations

import functools
import re
from pathlib import Path

import pytest

import modalcast as mc
from modalcast import aio

PACKAGE = Path(__file__).parent.parent
DOCUMENTS = [PACKAGE / "README.md", PACKAGE.parent.parent / "README.md"]
BLOCKS = [
    pytest.param(block, id=f"{document.parent.name}-{number}")
    for document in DOCUMENTS
    for number, block in enumerate(
        re.findall(r"^```python\n(.*?)^```$", document.read_text(), re.DOTALL | re.MULTILINE)
    )
]


def test_readme_has_code():
    assert len(BLOCKS) >= 4


@pytest.mark.parametrize("block", BLOCKS)
def test_code_runs(block: str, client: mc.Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(mc, "connect", functools.partial(mc.connect, client.address))
    monkeypatch.setattr(aio, "connect", functools.partial(aio.connect, client.address))
    exec(compile(block, "README.md", "exec"), {"__name__": "readme"})
    if "save(" in block:
        pictures = list(Path().iterdir())
        assert pictures
        assert all(picture.stat().st_size > 10_000 for picture in pictures)
