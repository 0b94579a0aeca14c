"""The user's own defaults: a configuration file, and environment variables that override it.

The file is TOML: `$XDG_CONFIG_HOME/flexdt/config.toml`, `~/.config/flexdt/config.toml` where that
variable is not set, or the one that FLEXDT_CONFIG names. Options of commands override both.

    server = "scanner-room:55000"     # FLEXDT_SERVER
    token_file = "~/.flexdt-token"    # FLEXDT_TOKEN_FILE; or token = "...", FLEXDT_TOKEN
    tls_ca = "~/scanner-room.pem"     # FLEXDT_TLS_CA
    data = "~/scans"                  # FLEXDT_DATA: of `flexdt up` and `flexdt twin`
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Final

from flexdt.clients.failure import CommandError

PREFIX: Final = "FLEXDT_"
PATHS: Final = ("token_file", "tls_ca", "data")


@dataclass(frozen=True, kw_only=True)
class Configuration:
    """Defaults of commands; None where neither file nor environment says anything.

    Attributes:
        server: HOST:PORT of the twin.
        token: shown to it.
        token_file: file whose first line is the token.
        tls_ca: certificates (PEM) to trust; speaks TLS.
        data: directory that a twin started here writes to.
    """

    server: str | None = None
    token: str | None = None
    token_file: str | None = None
    tls_ca: str | None = None
    data: str | None = None


KEYS: Final = tuple(f.name for f in fields(Configuration))


def config_file(environ: Mapping[str, str]) -> Path:
    """Where the configuration file is, or would be."""
    named = environ.get(f"{PREFIX}CONFIG")
    if named:
        return Path(named).expanduser()
    base = environ.get("XDG_CONFIG_HOME")
    return (Path(base) if base else Path("~/.config").expanduser()) / "flexdt" / "config.toml"


def configuration(environ: Mapping[str, str] | None = None) -> Configuration:
    """The defaults in force.

    Args:
        environ: the environment; this process's if left out.

    Raises:
        CommandError: the file is not TOML, or a key or value does not hold; names file and key.
    """
    env = os.environ if environ is None else environ
    path = config_file(env)
    found = _of_file(path, required=bool(env.get(f"{PREFIX}CONFIG")))
    own = {key: env[name] for key in KEYS if (name := f"{PREFIX}{key.upper()}") in env}
    if {"token", "token_file"} & set(own):  # one stands for both
        found.pop("token", None)
        found.pop("token_file", None)
    found |= own
    if "token" in found and "token_file" in found:
        where = "FLEXDT_TOKEN and FLEXDT_TOKEN_FILE" if own else f"{path}: token and token_file"
        raise CommandError(f"{where} are both set; allowed: one of them")
    given = {key: value for key, value in found.items() if value}
    for key in PATHS:
        if key in given:
            given[key] = str(Path(given[key]).expanduser())
    return Configuration(**given)


def _of_file(path: Path, *, required: bool) -> dict[str, str]:
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        if required:
            raise CommandError(f"{path}: no such file (FLEXDT_CONFIG names it)") from None
        return {}
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "not UTF-8 text"
        raise CommandError(f"{path}: {why}") from None
    except tomllib.TOMLDecodeError as error:
        raise CommandError(f"{path}: not valid TOML: {error}") from None
    for key, value in document.items():
        if key not in KEYS:
            raise CommandError(f"{path}: unknown key {key!r}; allowed: {', '.join(KEYS)}")
        if not isinstance(value, str) or not value:
            raise CommandError(f"{path}: {key} is {value!r}; allowed: a text that is not empty")
    return dict(document)
