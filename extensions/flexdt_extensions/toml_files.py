"""TOML files of batches and SLURM jobs; errors name file, key path and value."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from flexdt.extending import CommandError, message_of


def read_toml(path: Path) -> dict[str, Any]:
    """The content of a TOML file.

    Raises:
        CommandError: no TOML.
        OSError: the file cannot be read.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CommandError(f"{path}: no TOML: {error}") from None


def problems_of(name: str, error: ValidationError) -> list[str]:
    """What is wrong in a document, line by line, with key paths."""
    lines = []
    for e in error.errors(include_url=False, include_context=False):
        path = ".".join(str(part) for part in e["loc"]) or "plan"
        message = message_of(e)
        shown = "" if isinstance(e["input"], dict | BaseModel) else f" (got {e['input']!r})"
        lines.append(f"{name}: {path}: {message}{'' if 'got' in message else shown}")
    return lines
