"""Rarely changed choices of commands: keys of the settings file, not options."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from flexdt.runtime.process_settings import memory_size
from flexdt.runtime.settings import Settings, option
from flexdt.twin.algorithms import PLAIN, WINDOWS

if TYPE_CHECKING:
    Window = str
else:
    Window = Literal[tuple(WINDOWS)]


@dataclass(frozen=True, kw_only=True)
class CalibrateSettings(Settings):
    """`flexdt calibrate`.

    Attributes:
        bound: Refuse a sigma above this (mm, deg).
    """

    command = "calibrate"
    bound: float = option(5.0)


@dataclass(frozen=True, kw_only=True)
class MachineNewSettings(Settings):
    """`flexdt machine new`.

    Attributes:
        scanner: Name the scanner so in data sets.
    """

    command = "machine new"
    scanner: str | None = option(None)


@dataclass(frozen=True, kw_only=True)
class PhantomMakeSettings(Settings):
    """`flexdt phantom make`.

    Attributes:
        bead: Make the beads of this material.
    """

    command = "phantom make"
    bead: str = option("steel")


@dataclass(frozen=True, kw_only=True)
class ReconstructSettings(Settings):
    """`flexdt reconstruct`.

    Attributes:
        window: Filter FDK with this window.
        memory: Let FDK use this much, e.g. 8GiB; default: half of what is free.
    """

    command = "reconstruct"
    window: Window = option(PLAIN)  # noqa: RUF009
    memory: int | None = option(None, metavar="SIZE", parser=memory_size)


@dataclass(frozen=True, kw_only=True)
class SampleSettings(Settings):
    """`flexdt sample`.

    Attributes:
        place: Stand a mesh so: keep (as its file has it), centered (on the axis).
    """

    command = "sample"
    place: Literal["keep", "centred"] = option("keep")


@dataclass(frozen=True, kw_only=True)
class ScriptNewSettings(Settings):
    """`flexdt script new`.

    Attributes:
        height: Set the height of source and detector center [mm].
    """

    command = "script new"
    height: float | None = option(None)
