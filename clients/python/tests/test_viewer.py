"""Links to the browser viewer."""

from __future__ import annotations

import gzip
import re
import urllib.error
import urllib.request

import pytest
from conftest import SERVER_ARGUMENTS

import modalcast as mc
from modalcast.viewer import viewer_link


def test_link_leads_to_the_viewer(tree: mc.Scene):
    link = tree.view(height=400)
    assert link.url.startswith(f"http://{tree.client.address}/?token=")
    assert link.url.endswith("#scene=tree")
    with urllib.request.urlopen(link.url) as reply:
        assert b"<html" in gzip.decompress(reply.read())
    assert re.fullmatch(r'<iframe src="http://[^"]*" style="[^"]*height: 400px[^"]*".*></iframe>', link._repr_html_())
    # Negative control: another token.
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(re.sub("token=.", "token=x", link.url))


def test_server_without_viewer_is_unavailable():
    with mc.spawn(arguments=[*SERVER_ARGUMENTS, "--no-viewer"]) as client:
        tree = client.open("tree")
        with pytest.raises(mc.Unavailable, match="the viewer of this server is off"):
            tree.view()


def test_unix_socket_is_rejected():
    with pytest.raises(mc.Unavailable, match="got a Unix socket"):
        viewer_link("unix:/run/modalcast", "/?token=0", "tree", 600)
