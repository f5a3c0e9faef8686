"""Administrators list and end clients."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import SERVER_ARGUMENTS, TOKEN

import modalcast as mc


def test_owner_lists_and_ends_a_client(principals: Path):
    with mc.spawn(arguments=[*SERVER_ARGUMENTS, "--principals", str(principals)]) as owner:
        tree = owner.open("tree")
        tree.share("anna")
        with mc.connect(owner.address, token=TOKEN, reconnect=0.0) as anna:
            with pytest.raises(mc.PermissionDenied):
                anna.clients()
            with anna.scene("tree").steps(delivery="latest") as steps:
                listed = [client for client in owner.clients() if client.principal == "anna"]
                held = {resource.resource: resource.held for client in listed for resource in client.held}
                assert held["subscriptions"] == 1
                assert owner.end_client("anna/*") >= 2
                with pytest.raises(mc.LimitReached, match="an administrator has ended") as error:
                    next(steps)
                assert error.value.reason == "ENDED_BY_ADMINISTRATOR"
        assert any(client.is_caller for client in owner.clients())
