"""Scenes of other principals."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import SERVER_ARGUMENTS, TOKEN

import modalcast as mc


def test_scene_is_used_by_those_with_whom_it_is_shared(principals: Path):
    with mc.spawn(arguments=[*SERVER_ARGUMENTS, "--principals", str(principals)]) as owner:
        tree = owner.open("tree")
        assert (tree.owner, tree.shared_with) == ("owner", ())
        with mc.connect(owner.address, token=TOKEN) as anna:
            assert anna.scenes().scenes == {}
            with pytest.raises(mc.NotFound):
                anna.scene("tree")
            with pytest.raises(mc.AlreadyExists, match="another principal"):
                anna.open("tree")
            tree.share("anna")
            assert tree.shared_with == ("anna",)
            shared = anna.scene("tree")
            assert (shared.owner, shared.shared_with) == ("owner", ("anna",))
            shared.vertices()
            with pytest.raises(mc.PermissionDenied, match="the owner of the scene 'tree'"):
                shared.reset()
            with pytest.raises(mc.PermissionDenied):
                shared.delete()
            own = anna.open("tree", "tree-of-anna")
            assert own.owner == "anna"
            own.delete()
            tree.share()
            with pytest.raises(mc.NotFound):
                shared.vertices()
            with pytest.raises(mc.InvalidRequest, match=r"principals\[1\]"):
                tree.share("anna", "a b")
