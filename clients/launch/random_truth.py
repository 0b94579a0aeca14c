"""The hidden misalignment of a demonstration: drawn at random, kept outside the data directory.

The draw comes from the operating system's entropy, never from a seed, so nothing that a data
set records can reveal it. Only the comparison after the calibration reads it.
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from flexdt.library.failure import CommandError
from flexdt.runtime.files.limited_files import limited_text

RANGES: Final[Mapping[str, float]] = {
    "dO_x": 1.0,
    "dO_y": 1.0,
    "dO_z": 2.0,
    "alpha": 5.0,
    "tau_x": 0.5,
    "tau_z": 0.5,
}
"""Parameter -> largest absolute value drawn [mm, deg]: errors of a careful operator."""


def draw() -> dict[str, float]:
    """Draw a misalignment from the operating system's entropy. Returns parameter -> value [mm,
    deg] of an edge, to four decimals, within `RANGES`."""
    entropy = random.SystemRandom()
    return {name: round(entropy.uniform(-most, most), 4) for name, most in RANGES.items()}


def write(truth: Mapping[str, float], path: Path) -> None:
    """Write a truth file: TOML, parameter = value."""
    lines = [f"{name} = {float(value)!r}" for name, value in truth.items()]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read(path: Path) -> dict[str, float]:
    """Read a truth file.

    All problems of the file are in one error. Integers and floats are numbers, booleans
    are not. Parameters may be missing. A file that cannot be opened raises OSError.

    Args:
        path: of a TOML file, parameter = value.

    Returns:
        Parameter -> value [mm, deg].

    Raises:
        CommandError: not TOML, an unknown parameter, or a value that is not a number.
    """
    from flexdt.twin.geometry.offsets import NAMES
    from flexdt.twin.input_limits import InputLimitError, parse_toml

    try:
        content = parse_toml(limited_text(path, "toml"), str(path))
    except InputLimitError as error:
        raise CommandError(error.message) from None
    except ValueError as error:
        raise CommandError(f"{path}: not valid TOML: {error}") from None
    problems = []
    for name, value in content.items():
        if name not in NAMES:
            problems.append(
                f"{path}: unknown parameter {name!r}; allowed: {', '.join(NAMES)}"
            )
        elif type(value) not in (int, float):
            problems.append(f"{path}: {name} = {value!r} is not a number")
    if problems:
        raise CommandError(problems)
    return {name: float(value) for name, value in content.items()}
