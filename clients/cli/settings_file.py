"""The settings file: defaults of commands and processes.

Environment variables override the file, options of commands override both. The file is
TOML: `$XDG_CONFIG_HOME/flexdt/config.toml`, `~/.config/flexdt/config.toml` where that
variable is not set, or the one that FLEXDT_CONFIG names.

    server = "scanner-room:55000"     # FLEXDT_SERVER
    token_file = "~/.flexdt-token"    # FLEXDT_TOKEN_FILE; or token = "...", FLEXDT_TOKEN
    tls_ca = "~/scanner-room.pem"     # FLEXDT_TLS_CA
    data = "~/scans"                  # FLEXDT_DATA: of `flexdt up` and `flexdt twin`

    [twin]                            # also [up], [projector], [viewer], [gateway]
    http_port = 9101                  # any option of `flexdt twin --help`

    [reconstruct]                     # a command's rarely changed choices, see `TABLES`
    window = "hann"
    memory = "8GiB"
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Final, TypeVar

from flexdt.clients.cli.command_settings import (
    CalibrateSettings,
    MachineNewSettings,
    PhantomMakeSettings,
    ReconstructSettings,
    SampleSettings,
    ScriptNewSettings,
)
from flexdt.library.failure import CommandError
from flexdt.message_words import reason_of
from flexdt.runtime.process_settings import (
    GatewaySettings,
    ProjectorSettings,
    TwinSettings,
    UpSettings,
    ViewerSettings,
)
from flexdt.runtime.settings import Settings, option, read, words

S = TypeVar("S", bound=Settings)

PREFIX: Final = "FLEXDT_"
PATHS: Final = ("FILE", "DIR")
"""Kinds of values that may begin with ~."""


@dataclass(frozen=True, kw_only=True)
class Configuration(Settings):
    """Defaults of commands; None where neither file nor environment has a value.

    Attributes:
        server: HOST:PORT of the twin.
        token: shown to it.
        token_file: file whose first line is the token.
        tls_ca: certificates (PEM) to trust; speaks TLS.
        data: directory that a twin started here writes to.
        tables: options of processes and commands, by the names of their tables.
    """

    server: str | None = option(None, metavar="HOST:PORT")
    token: str | None = option(None, metavar="TEXT")
    token_file: str | None = option(None, metavar="FILE")
    tls_ca: str | None = option(None, metavar="FILE")
    data: str | None = option(None, metavar="DIR")
    tables: Mapping[str, Mapping[str, object]] = field(default_factory=dict)


TABLES: Final[Mapping[str, type[Settings]]] = {
    kind.command.replace(" ", "_"): kind
    for kind in (
        UpSettings,
        TwinSettings,
        ProjectorSettings,
        ViewerSettings,
        GatewaySettings,
        CalibrateSettings,
        MachineNewSettings,
        PhantomMakeSettings,
        ReconstructSettings,
        SampleSettings,
        ScriptNewSettings,
    )
}
"""Tables of the file, and the settings of their keys."""
SHARED_TABLES: Final[Mapping[str, str]] = {"doctor": "up"}
"""Commands that read the table of another one."""
KEYS: Final = {
    f.name: f.metadata["details"]["metavar"] for f in fields(Configuration) if f.metadata
}
"""Keys outside the file's tables -> their meaning; `FLEXDT_` and a key is a variable."""


def config_file(environ: Mapping[str, str]) -> Path:
    """Return the path of the configuration file, which need not exist.

    FLEXDT_CONFIG, else flexdt/config.toml in XDG_CONFIG_HOME or ~/.config.
    """
    named = environ.get(f"{PREFIX}CONFIG")
    if named:
        return Path(_expanded(named))
    base = environ.get("XDG_CONFIG_HOME") or _expanded("~/.config")
    return Path(base) / "flexdt" / "config.toml"


def _expanded(path: str) -> str:
    """Return a path with ~ expanded, or as it is for a user without a home."""
    try:
        return str(Path(path).expanduser())
    except RuntimeError:  # neither HOME nor an entry among the users, as in containers
        return path


def configuration(environ: Mapping[str, str] | None = None) -> Configuration:
    """Read the defaults in force.

    The environment's values replace the file's; token and token file replace each other,
    but both together in one place are an error. Empty values count as not given. A
    missing file counts as empty unless FLEXDT_CONFIG names it. Values that are paths have
    ~ expanded; the tables stay unread but for their keys.

    Args:
        environ: the environment; this process's if left out.

    Raises:
        CommandError: the file is not TOML, or a key or value does not hold; names file and key.
    """
    env = os.environ if environ is None else environ
    path = config_file(env)
    found = _of_file(path, required=bool(env.get(f"{PREFIX}CONFIG")))
    own = {key: env[name] for key in KEYS if (name := f"{PREFIX}{key.upper()}") in env}
    if {"token", "token_file"} & set(own):  # each replaces the other
        found.pop("token", None)
        found.pop("token_file", None)
    found |= own
    if "token" in found and "token_file" in found:
        if own:
            where = "FLEXDT_TOKEN and FLEXDT_TOKEN_FILE"
        else:
            where = f"{path}: token and token_file"
        raise CommandError(f"{where} are both set; allowed: one of them")
    tables = {name: found.pop(name) for name in TABLES if name in found}
    given = {key: value for key, value in found.items() if value}
    paths = {key: _expanded(value) for key, value in given.items() if KEYS[key] in PATHS}
    return Configuration(**given | paths, tables=tables)


def _of_file(path: Path, *, required: bool) -> dict[str, Any]:
    """Read the configuration file and check its keys and plain values.

    A table without a dictionary as its value counts as a plain key. The values of tables
    are not checked here.

    Args:
        path: of the TOML file.
        required: whether a missing file is an error; else it is empty.

    Returns:
        Key -> text, and table -> its keys.

    Raises:
        CommandError: unreadable, not TOML, an unknown key, or a value that is no text.
    """
    from flexdt.runtime.files.limited_files import limited_text
    from flexdt.twin.input_limits import InputLimitError, parse_toml

    try:
        document = parse_toml(limited_text(path, "toml", "utf-8-sig"), str(path))
    except (FileNotFoundError, NotADirectoryError):
        if required:
            raise CommandError(f"{path}: no such file (FLEXDT_CONFIG names it)") from None
        return {}
    except (OSError, UnicodeDecodeError) as error:
        why = reason_of(error, "not UTF-8 text")
        raise CommandError(f"{path}: {why}") from None
    except InputLimitError as error:
        raise CommandError(error.message) from None
    except ValueError as error:
        raise CommandError(f"{path}: not valid TOML: {error}") from None
    tables = {key: value for key, value in document.items() if key in TABLES}
    for key, table in tables.items():
        if isinstance(table, dict):
            _require_known(
                f"{path}: [{key}]", table, [f.name for f in fields(TABLES[key])]
            )
    plain = {k: v for k, v in document.items() if not isinstance(tables.get(k), dict)}
    _require_known(f"{path}:", plain, KEYS, [f"[{name}]" for name in TABLES])
    for key, value in plain.items():
        if not isinstance(value, str) or not value:
            raise CommandError(
                f"{path}: {key} is {value!r}; allowed: a text that is not empty"
            )
    return dict(document)


def _require_known(
    where: str, given: Iterable[str], known: Collection[str], tables: Sequence[str] = ()
) -> None:
    """Check the keys of a table, or those outside all tables.

    Raises CommandError for the first unknown one, listing `known` and `tables`; `where`
    begins the message.
    """
    for key in given:
        if key not in known:
            from flexdt.twin.errors import UnknownNameError

            problem = f"{where} unknown key {key!r}; allowed"
            error = UnknownNameError.among(problem, key, (*known, *tables))
            raise CommandError(str(error))


def settings_of(kind: type[S], more: Sequence[str] = ()) -> S | None:
    """Read a table of the file as settings; None if `more` requests the help, which is
    shown.

    The words come last. The data directory is that of the file only for `up` and `twin`.

    Args:
        kind: of a process or command.
        more: words of the command line, which override the file.

    Raises:
        CommandError: a value of the file does not hold; names file, table and key.
        Exception: typer's usage errors of `more`.
    """
    own = configuration()
    if issubclass(kind, UpSettings | TwinSettings):
        data = {"data": own.data or TwinSettings.data}
    else:
        data = {}
    name = kind.command.replace(" ", "_")
    given = words({**data, **own.tables.get(name, {})})
    try:
        found = read(kind, given)
    except Exception as error:
        if not hasattr(error, "format_message"):
            raise
        where = f"{config_file(os.environ)}: [{name}]"
        raise CommandError(f"{where} {_problem(error)}") from None
    return read(kind, [*given, *more]) if more else found


def _problem(error: Any) -> str:
    """Return a usage error of typer's, named by the file's key instead of the option."""
    option_of = getattr(error, "param", None)
    if option_of is None:
        return str(error.format_message())
    return f"{option_of.name}: {error.message.removeprefix('Value error, ')}"


def chosen(kind: type[S]) -> S:
    """Read the settings of a command from its table of the file; errors as `settings_of`.

    Never None."""
    found = settings_of(kind)
    assert found is not None
    return found


def home_of(command: str, flag: str) -> str | None:
    """Return the place in the file of a former option `flag`; None without such a key.

    The words are "`key` in [table] of FILE"; the table is that of the command. `command`
    is the whole path, e.g. "flexdt twin"; `flag` may begin with dashes. The file need not
    exist.
    """
    name = "_".join(command.split()[1:])
    table = SHARED_TABLES.get(name, name)
    key = flag.lstrip("-").replace("-", "_")
    if table not in TABLES or key not in {f.name for f in fields(TABLES[table])}:
        return None
    return f"`{key}` in [{table}] of {config_file(os.environ)}"
