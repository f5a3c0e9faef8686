"""The browser viewer of a server."""

from __future__ import annotations

import html
import webbrowser
from dataclasses import dataclass
from urllib.parse import quote

from modalcast._channel import target_of
from modalcast.errors import Unavailable


@dataclass(frozen=True)
class ViewerLink:
    """The viewer of a scene. A notebook shows the viewer itself.

    Attributes:
        url: The URL, with the token of the server. Anyone who has it can use the server through this host and port.
        height: Height in a notebook, in pixels.
    """

    url: str
    height: int = 600

    def open(self) -> bool:
        """Opens the viewer in a browser of this machine. Returns whether there is one."""
        return webbrowser.open(self.url)

    def __str__(self) -> str:
        return self.url

    def _repr_html_(self) -> str:
        url = html.escape(self.url)
        style = f"width: 100%; height: {self.height}px; border: 0"
        return f'<iframe src="{url}" style="{style}" title="modalcast viewer" allow="clipboard-write"></iframe>'


def viewer_link(address: str, url_path: str, scene: str, height: int) -> ViewerLink:
    """The viewer of a scene on the server at an address of a client.

    Raises:
        Unavailable: The viewer of the server is off, or the address is a Unix socket, which browsers cannot use.
    """
    target = target_of(address)
    if target.startswith("unix:"):
        raise Unavailable(f"{address}: expected an address HOST:PORT, which browsers can use, got a Unix socket")
    if not url_path:
        raise Unavailable(f"{address}: the viewer of this server is off (`modalcast serve --no-viewer`)")
    return ViewerLink(f"http://{target}{url_path}#scene={quote(scene)}", height)
