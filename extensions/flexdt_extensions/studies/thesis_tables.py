"""The thesis's figures as printed, those of its author's public code and logs, and the assumed
placements, from the package's data files."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from functools import lru_cache
from importlib import resources
from typing import Any


@lru_cache
def thesis() -> Mapping[str, Any]:
    """All copied figures; `source` gives their origin."""
    loaded: dict[str, Any] = json.loads(_text("thesis.json"))
    return loaded


@lru_cache
def author() -> Mapping[str, Any]:
    """Phantoms, scenarios and costs of the author's public code and logs, as the file says."""
    return tomllib.loads(_text("author.toml"))


@lru_cache
def placements() -> Mapping[str, Any]:
    """Object placements of experiment 6.6, labelled assumed."""
    return tomllib.loads(_text("placements.toml"))


def projection_counts() -> tuple[int, ...]:
    """The fourteen N of experiments 1 to 3."""
    return tuple(int(n) for n in thesis()["projection_counts"])


def thesis_row(experiment: str, setting: str) -> Mapping[str, float] | None:
    """MAE, cost reduction and iterations the thesis reports for a setting, or None."""
    table = {
        "beads": "table_6_3_beads",
        "phantoms": "table_6_4_phantoms",
        "damping": "table_6_5_damping",
        "detector": "table_6_8_detector",
    }.get(experiment)
    if table is None:
        return None
    row: Mapping[str, float] | None = thesis()[table].get(setting)
    return row


def _text(name: str) -> str:
    path = resources.files("flexdt_extensions.studies") / "data" / name
    return path.read_text(encoding="utf-8")
