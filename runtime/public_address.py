"""Where browsers find a viewer that stands behind a proxy."""

from __future__ import annotations

from dataclasses import dataclass
from urllib.parse import urlsplit

import typer


@dataclass(frozen=True)
class PublicAddress:
    """The address of the page in a browser; as text an URL.

    Args:
        host: name, with a port where it is not the scheme's own.
        path: begins and ends with a slash.
        is_secure: whether the browser speaks HTTPS.
    """

    host: str
    path: str = "/"
    is_secure: bool = False

    def __str__(self) -> str:
        """Format as an URL."""
        return f"http{'s' if self.is_secure else ''}://{self.host}{self.path}"

    def below(self, path: str) -> str:
        """Return a request's path without the public path, if the proxy has left it there."""
        if self.path != "/" and path.startswith(self.path):
            return path[len(self.path) - 1 :]
        return path


def public_address(text: str) -> PublicAddress:
    """Parse an URL, such as https://hub.example/user/me/proxy/8080/.

    Raises:
        typer.BadParameter: it has no scheme of the web or no host, or a query.
    """
    try:
        url = urlsplit(text.strip())
        readable = url.scheme in ("http", "https") and bool(url.hostname)
    except ValueError:
        readable = False
    if not readable or url.query or url.fragment or url.username is not None:
        raise typer.BadParameter(
            f"{text!r} is no address of a page, such as https://hub.example/user/me/proxy/8080/"
        )
    path = url.path.strip("/")
    return PublicAddress(
        url.netloc.lower(), f"/{path}/" if path else "/", url.scheme == "https"
    )
