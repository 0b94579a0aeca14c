"""Who may connect: bind addresses, tokens, TLS, and the limits of a connection.

A server on the loopback needs no token; on any other address it does not start without
one. Tokens are compared in constant time.
"""

from __future__ import annotations

import hmac
import ipaddress
import math
import os
import ssl
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final, TypeVar
from urllib.parse import urlsplit

from flexdt.message_words import reason_of


class AccessError(ValueError):
    """A configuration that would admit anybody; the message names the missing part."""


class AccessFileError(AccessError):
    """A token file or TLS file is missing or invalid."""


@dataclass(frozen=True)
class ConnectionLimits:
    """Limits on the cost of one connection, and of all of them. Sizes in bytes,
    times in real seconds.

    Attributes:
        max_message: largest line or frame received (MessagePack: below 16 MiB anyway);
            larger ones get error -32008, and the connection stays open.
        max_batch: messages in a batch; beyond it -32008.
        max_clients: maximum number of connections; with a token, only those that have
            presented it count. Beyond it the 16 newest clients can still call hello, stop,
            emergency stop, ping and abort; all other requests get -32003.
        max_waiting: when a connection has this many queued requests, the server stops
            reading from it.
        max_events: ordered events (job, log) queued for a client that does not read;
            beyond it the client is disconnected.
        max_unsent: bytes of replies queued for a client, above which its next request
            waits.
        send_timeout_s: a client that reads nothing for this long is disconnected.
        message_timeout_s: a message must be complete within this time after it begins.
        hello_timeout_s: with a token, session.hello must come within this.
        end_timeout_s: after the client's end of file, replies may take this long.
        requests_per_s: rate above which requests are refused with -32003, but never
            stops, emergency stops, aborts and pings; None is any rate.
        malformed: broken messages in a row after which the connection is closed.
    """

    max_message: int = 2**24 - 1
    max_batch: int = 1000
    max_clients: int = 512
    max_waiting: int = 4096
    max_events: int = 10_000
    max_unsent: int = 4 * 2**20
    send_timeout_s: float = 20.0
    message_timeout_s: float = 60.0
    hello_timeout_s: float = 10.0
    end_timeout_s: float = 30.0
    requests_per_s: float | None = None
    malformed: int = 100


MAX_LIMIT: Final = 999_999_999
"""Largest value of a limit in days or seconds: the most days that a duration can have."""
MAX_WHOLE_LIMIT: Final = 2**53
"""Largest value of a limit that counts or is in bytes."""


@dataclass(frozen=True)
class TwinLimits:
    """Limits on the cost of all clients of a twin together.

    Attributes:
        max_jobs: jobs in the queue; beyond it error -32003.
        max_ended_jobs: ended jobs that are known; beyond them the oldest is forgotten.
        ended_job_days: age at which an ended job is forgotten [days].
        max_upload: size of an uploaded sample; beyond it -32008.
        max_samples: maximum number of uploads; beyond it, -32001 until some are deleted.
        max_observer_samples: maximum number of uploads that came while another client had
            control; beyond it, -32001.
        max_observer_bytes: size of these together.
        max_corrections: maximum number of corrections; beyond it, -32001 until some are
            deleted.
        disk_quota: size of the data directory, checked before a scan or an upload begins
            (-32001); None is what the disk holds, less 16 MiB.
        max_subscriptions: topics that all connections together follow; beyond it -32003.
        max_views: maximum number of distinct combinations of kind and binning that
            subscribers may request; beyond it, -32003. An image is rendered and encoded
            once for each.
        control_idle_s: a controller idle for this long loses control to the next client
            that requests it [s].
    """

    max_jobs: int = 1000
    max_ended_jobs: int = 1000
    ended_job_days: float = 365.0
    max_upload: int = 512 << 20
    max_samples: int = 10_000
    max_observer_samples: int = 100
    max_observer_bytes: int = 1 << 30
    max_corrections: int = 10_000
    disk_quota: int | None = None
    max_subscriptions: int = 2048
    max_views: int = 16
    control_idle_s: float = 300.0


@dataclass(frozen=True)
class ViewerLimits:
    """Limits on the cost of all pages of a viewer together.

    Attributes:
        max_pages: maximum number of open pages; each uses one connection to the twin and
            up to four views.
    """

    max_pages: int = 64


_L = TypeVar("_L", ConnectionLimits, TwinLimits, ViewerLimits)


def with_limits(words: Sequence[str], default: _L, others: Collection[str] = ()) -> _L:
    """Return `default` with the limits that `NAME=VALUE` words set.

    Of a limit given twice the last counts. Values of whole limits are cut to whole
    numbers.

    Args:
        words: as on the command line.
        default: limits to start from; not changed itself.
        others: names of other limits, which are skipped unchecked.

    Raises:
        AccessError: no such limit (lists the limits), or not a number above 0 that what
            it limits can have.
    """
    names: tuple[str, ...] = limit_names(default)
    out: _L = default
    for word in words:
        name, _, text = word.partition("=")
        if name in others:
            continue
        if name not in names:
            known = ", ".join(sorted({*names, *others}))
            raise AccessError(f"no limit called {name!r}; there are: {known}")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not 0.0 < value < math.inf:
            raise AccessError(f"--limit {word!r}: {name} must be a number above 0")
        is_integer = isinstance(getattr(out, name), int) or name == "disk_quota"
        most = MAX_WHOLE_LIMIT if is_integer else MAX_LIMIT
        if value > most:
            raise AccessError(f"--limit {word!r}: {name} must be at most {most:g}")
        changed: dict[str, Any] = {name: int(value) if is_integer else value}
        out = replace(out, **changed)
    return out


def limit_names(limits: ConnectionLimits | TwinLimits | ViewerLimits) -> tuple[str, ...]:
    """List the names that `with_limits` takes."""
    return tuple(f.name for f in fields(limits))


def is_loopback(host: str) -> bool:
    """Return whether an address to listen on is for this machine only.

    Names are not looked up.
    """
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def is_rebound(host: str) -> bool:
    """Return whether a request to a loopback port is that of a page whose site's name was
    rebound to it.

    A page may send requests to its own site without permission, and its site may claim
    that its name is now 127.0.0.1 (DNS rebinding). Its browser sends that name as the
    request's Host.

    Args:
        host: the request's Host, with or without a port; "" where there is none.

    Returns:
        True unless the Host is "localhost" or a loopback address; True for "".

    Raises:
        ValueError: no Host that can be read.
    """
    return not is_loopback(urlsplit(f"//{host}").hostname or "")


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


def check_bind(host: str, token: str | None) -> None:
    """Check that a token has at least 16 characters, and that an address that others can reach
    has one.

    Args:
        host: where a server is to listen.
        token: that clients must bring; None for none.

    Raises AccessError: no token for a non-loopback address, or one too short.
    """
    if token is not None and len(token) < 16:
        raise AccessError(
            f"the token has {len(token)} characters; at least 16 are needed"
        )
    if token is None and not is_loopback(host):
        raise AccessError(
            f"listening on {host!r}, which others can reach, needs a token (--token-file); "
            "without one only 127.0.0.1, ::1 and localhost are allowed"
        )


def token_matches(given: str | None, token: str) -> bool:
    """Compare a client's token with the server's in constant time."""
    return given is not None and hmac.compare_digest(given.encode(), token.encode())


def read_token(file: Path | None) -> str | None:
    """Read the token that a server requires or a client brings.

    Spaces around a file's token are removed.

    Args:
        file: whose first line it is; None: the environment's FLEXDT_TOKEN.

    Returns:
        The token; None without a file if the variable is empty or missing.

    Raises:
        AccessFileError: the file cannot be read or its first line is empty.
    """
    if file is None:
        return os.environ.get("FLEXDT_TOKEN") or None
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        why = reason_of(error, str(error))
        raise AccessFileError(f"token file {file}: {why}") from None
    token = text.split("\n", 1)[0].strip()
    if not token:
        raise AccessFileError(
            f"token file {file} is empty; its first line must be the token"
        )
    return token


def client_tls(
    authority: Path | None, *, any_name: bool = False
) -> ssl.SSLContext | None:
    """Make a client's TLS context that trusts the certificates of a PEM file alone; None without
    one.

    TLS 1.2 or newer; the system's own authorities are not trusted.

    `authority`: the file; `any_name`: do not compare the server's name with that in its
    certificate.
    Raises AccessFileError: the file is missing or holds no certificates.
    """
    if authority is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.check_hostname = not any_name
    try:
        context.load_verify_locations(authority)
    except (OSError, ssl.SSLError) as error:
        raise AccessFileError(f"TLS certificates {authority}: {error}") from None
    return context


def server_tls(certificate: Path | None, key: Path | None) -> ssl.SSLContext | None:
    """Make a server's TLS context from PEM files.

    TLS 1.2 or newer; clients need no certificate.

    Args:
        certificate, key: the files; both or none.

    Returns the context; None if no files are given.
    Raises AccessError: only one of the two is given; AccessFileError: a file is missing or
    invalid.
    """
    if certificate is None and key is None:
        return None
    if certificate is None or key is None:
        raise AccessError("--tls-cert and --tls-key go together")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(certificate, key)
    except (OSError, ssl.SSLError) as error:
        raise AccessFileError(f"TLS files {certificate}, {key}: {error}") from None
    return context
