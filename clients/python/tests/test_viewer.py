"""Links to the browser viewer."""

from __future__ import annotations

import gzip
import re
import urllib.error
import urllib.parse
import urllib.request

import pytest
from conftest import SERVER_ARGUMENTS

import modalcast as mc
from modalcast.v1 import server_pb2
from modalcast.viewer import viewer_link


def test_link_leads_to_the_viewer(tree: mc.Scene):
    link = tree.view(height=400)
    page, _, fragment = link.url.partition("#")
    assert page == f"http://{tree.client.address}/"
    parameters = urllib.parse.parse_qs(fragment)
    assert parameters["scene"] == ["tree"]
    with urllib.request.urlopen(page) as reply:
        assert b"<html" in gzip.decompress(reply.read())
    assert re.fullmatch(r'<iframe src="http://[^"]*" style="[^"]*height: 400px[^"]*".*></iframe>', link._repr_html_())
    (code,) = parameters["code"]
    with urllib.request.urlopen(f"{page}session", code.encode()) as reply:
        assert len(reply.read()) == 64
    # A code is valid once.
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(f"{page}session", code.encode())


def test_server_without_viewer_is_unavailable():
    with mc.spawn(arguments=[*SERVER_ARGUMENTS, "--no-viewer"]) as client:
        tree = client.open("tree")
        with pytest.raises(mc.Unavailable, match="the server has no viewer"):
            tree.view()


def test_link_begins_with_the_public_url():
    arguments = [*SERVER_ARGUMENTS, "--public-url", "https://lab.example/render"]
    with mc.spawn(arguments=arguments) as client:
        link = client.open("tree").view()
        assert link.url.startswith("https://lab.example/render/#code="), link.url
        assert link.url.endswith("&scene=tree"), link.url


def test_unix_socket_is_rejected():
    reply = server_pb2.CreateViewerLinkResponse(url_path="/#code=0")
    with pytest.raises(mc.Unavailable, match="got a Unix socket"):
        viewer_link("unix:/run/modalcast", reply, "tree", 600)
