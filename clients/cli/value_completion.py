"""Propose values of options and arguments to a shell that completes a word.

Each function takes the part of the word that was typed and returns the values that begin with
it. An empty list leaves the word to the shell, which proposes files.
"""

from __future__ import annotations

from collections.abc import Iterable

AXIS_VALUE = "="
"""Separates an axis from its value in words such as rot_obj=90."""
UNKNOWN_MARKERS = "unknown"
"""Word for beads at unknown places, instead of a phantom."""


def machine_names(typed: str) -> list[str]:
    """List machines that ship with flexdt, as completions."""
    from flexdt.twin.machine.description import builtin_machines

    return _beginning(typed, builtin_machines())


def profile_names(typed: str) -> list[str]:
    """List profiles of zero offsets that ship with flexdt, as completions."""
    from flexdt.twin.machine.description import builtin_profiles

    return _beginning(typed, builtin_profiles())


def sample_names(typed: str) -> list[str]:
    """List phantoms that ship with flexdt, as completions."""
    from flexdt.phantoms import phantom_names

    return _beginning(typed, phantom_names())


def bead_phantom_names(typed: str) -> list[str]:
    """List shipped phantoms that have beads, as completions."""
    from flexdt.phantoms import load_phantom

    return [name for name in sample_names(typed) if len(load_phantom(name).beads)]


def calibration_targets(typed: str) -> list[str]:
    """List completions: phantoms with beads, and the word for unknown markers."""
    return [*bead_phantom_names(typed), *_beginning(typed, [UNKNOWN_MARKERS])]


def material_names(typed: str) -> list[str]:
    """List materials of the table, as completions."""
    from flexdt.twin.attenuation.materials import materials

    return _beginning(typed, materials())


def axis_names(typed: str) -> list[str]:
    """List axes of the configured machine, as completions."""
    return _beginning(typed, _axes())


def axis_values(typed: str) -> list[str]:
    """List the machine's axes, each with the sign before its value."""
    return _beginning(typed, (name + AXIS_VALUE for name in _axes()))


def mode_names(typed: str) -> list[str]:
    """List camera modes of the configured machine, as completions."""
    from flexdt.library.machines import machine

    return _beginning(typed, machine(None).detector.mode_names)


def _axes() -> list[str]:
    """List the default machine's axes, also virtual ones."""
    from flexdt.library.machines import machine

    found = machine(None)
    return [*found.axes, *found.virtual_axes]


def _beginning(typed: str, names: Iterable[str]) -> list[str]:
    """List the names that begin with the typed letters, in upper or lower case."""
    return [name for name in names if name.lower().startswith(typed.lower())]
