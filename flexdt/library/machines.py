"""`--machine` and `--profile` to their values: a shipped name, or a TOML file."""

from __future__ import annotations

from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING

from flexdt.runtime.files.limited_files import limited_text

if TYPE_CHECKING:
    from flexdt.twin.machine.description import Machine, Profile

DEFAULT_MACHINE = "flexray"


def machine(word: str | PathLike[str] | None = None) -> Machine:
    """Return a machine by shipped name or by file; None is the FleX-ray.

    Args:
        word: `flexray` or another shipped name, or the path of a TOML file.

    Raises:
        MachineFileError: the file is invalid.
        UnknownNameError: neither a file nor a shipped name.

    Example:
        >>> flexray = machine("flexray")
        >>> flexray.detector.camera.shape, flexray.axes["rot_obj"].unit
        ((760, 956), 'deg')
    """
    from flexdt.twin.machine.description import builtin_machine

    if word is None:
        name = DEFAULT_MACHINE
    else:
        name = fspath(word)
    if is_file(name):
        return parsed(limited_text(Path(name), "toml"), name)
    return builtin_machine(name)


def parsed(text: str, file: str) -> Machine:
    """Parse a machine from the text of its file, and read the meshes of its parts next to it.

    Raises:
        MachineFileError: the text or a mesh is invalid; names file, part and the allowed
            values.
    """
    from flexdt.phantoms.files.mesh_files import read_part
    from flexdt.twin.collision.outer_hull import outer_hull
    from flexdt.twin.machine.description import Vector3, parse_machine

    def corners(name: str) -> list[Vector3]:
        around = outer_hull(read_part(Path(file).parent / name).vertices)
        return [(x, y, z) for x, y, z in around.vertices.tolist()]

    return parse_machine(text, file, corners)


def profile(
    word: Profile | str | PathLike[str] | None, of: Machine, file: str | None = None
) -> Profile:
    """Return a calibration profile by shipped name or by file; None is the machine's
    default.

    A file comes before a shipped name. A profile that is given is returned, after the
    check that it is for this machine.

    Args:
        word: the requested name or file, or the profile itself.
        of: the machine.
        file: the requested machine, for the error.

    Raises:
        MachineFileError: the file is invalid, or the profile is for another machine.
        UnknownNameError: neither a file nor a shipped name.
    """
    from flexdt.twin.errors import MachineFileError
    from flexdt.twin.machine.description import (
        Profile,
        builtin_profile,
        default_profile,
        parse_profile,
    )

    if word is None:
        name = of.default_profile
    else:
        name = str(word)
    if isinstance(word, Profile):
        chosen = word
    elif is_file(name):
        chosen = parse_profile(limited_text(Path(name), "toml"), name)
    elif word is None:
        chosen = default_profile(of, file or DEFAULT_MACHINE)
    else:
        chosen = builtin_profile(name)
    if chosen.machine != of.name:
        raise MachineFileError(
            f"profile {chosen.name!r} is for machine {chosen.machine!r}, not {of.name!r}",
            {"asked": chosen.name, "machine": of.name},
        )
    return chosen


def is_file(word: str) -> bool:
    """Check whether a word names a file instead of something that ships."""
    return word.endswith(".toml") or "/" in word or "\\" in word or Path(word).is_file()
