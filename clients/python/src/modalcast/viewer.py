"""The browser viewer of a server."""

from __future__ import annotations

import html
import json
import os
import tempfile
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from modalcast._channel import is_encrypted, target_of
from modalcast.errors import Unavailable
from modalcast.v1 import server_pb2


@dataclass(frozen=True)
class ViewerLink:
    """The viewer of a scene. A notebook shows the viewer itself.

    Attributes:
        url: The URL, with a code that is valid once: the first page that opens it gets the rights of this client.
            Another `Scene.view` makes another link.
        height: Height in a notebook, in pixels.
    """

    url: str
    height: int = 600

    def open(self) -> bool:
        """Opens the viewer in a browser of this machine. Returns whether there is one."""
        # Other users can read the arguments of a process, so the browser gets a private file that leads to the URL.
        folder = os.environ.get("XDG_RUNTIME_DIR") or None
        with tempfile.NamedTemporaryFile("w", dir=folder, prefix="modalcast-", suffix=".html", delete=False) as file:
            file.write(
                f"<!doctype html><title>modalcast</title><script>location.replace({json.dumps(self.url)})</script>"
            )
        return webbrowser.open(Path(file.name).as_uri())

    def __str__(self) -> str:
        return self.url

    def _repr_html_(self) -> str:
        url = html.escape(self.url)
        style = f"width: 100%; height: {self.height}px; border: 0"
        return f'<iframe src="{url}" style="{style}" title="modalcast viewer" allow="clipboard-write"></iframe>'


def viewer_link(address: str, reply: server_pb2.CreateViewerLinkResponse, scene: str, height: int) -> ViewerLink:
    """The viewer of a scene at the public URL of its server or, without one, at the address of a client.

    Raises:
        Unavailable: The address is a Unix socket, which browsers cannot use.
    """
    separator = "&" if "#" in reply.url_path else "#"
    url_path = f"{reply.url_path}{separator}scene={quote(scene)}"
    if reply.public_url:
        return ViewerLink(reply.public_url + url_path, height)
    target = target_of(address)
    if target.startswith("unix:"):
        raise Unavailable(f"{address}: expected an address HOST:PORT, which browsers can use, got a Unix socket")
    scheme = "https" if is_encrypted(address) else "http"
    return ViewerLink(f"{scheme}://{target}{url_path}", height)
