"""Volumes back from projections.

Names are looked up on first use: a module of this folder costs no more than it imports itself.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from flexdt.twin.projection.volume import Accuracy as Accuracy
    from flexdt.twin.projection.volume import Grid as Grid
    from flexdt.twin.reconstruction.acquisition.coverage import LostVoxels as LostVoxels
    from flexdt.twin.reconstruction.acquisition.rectify import (
        field_of_view as field_of_view,
    )
    from flexdt.twin.reconstruction.acquisition.truncation import Truncation as Truncation
    from flexdt.twin.reconstruction.acquisition.truncation import (
        truncation_of as truncation_of,
    )
    from flexdt.twin.reconstruction.beam_hardening import Hardening as Hardening
    from flexdt.twin.reconstruction.beam_hardening import Polychromatic as Polychromatic
    from flexdt.twin.reconstruction.beam_hardening import hardening as hardening
    from flexdt.twin.reconstruction.bias import Bias as Bias
    from flexdt.twin.reconstruction.bias import bias_of as bias_of
    from flexdt.twin.reconstruction.checked_fdk import bias_warnings as bias_warnings
    from flexdt.twin.reconstruction.checked_fdk import checked_fdk as checked_fdk
    from flexdt.twin.reconstruction.checked_fdk import fdk as fdk
    from flexdt.twin.reconstruction.consistency.ring_pattern import (
        ring_errors as ring_errors,
    )
    from flexdt.twin.reconstruction.feldkamp.fdk import fdk_parts as fdk_parts
    from flexdt.twin.reconstruction.iterative import cgls as cgls
    from flexdt.twin.reconstruction.iterative import em as em
    from flexdt.twin.reconstruction.iterative import sart as sart
    from flexdt.twin.reconstruction.iterative import sirt as sirt
    from flexdt.twin.reconstruction.linear_system import Step as Step
    from flexdt.twin.reconstruction.scatter_correction import (
        without_scatter as without_scatter,
    )
    from flexdt.twin.reconstruction.total_variation import Minimised as Minimised
    from flexdt.twin.reconstruction.total_variation import minimise_tv as minimise_tv
    from flexdt.twin.reconstruction.total_variation import tv as tv
    from flexdt.twin.reconstruction.volume_errors import with_errors as with_errors

_HOMES: Final = {
    "Accuracy": "flexdt.twin.projection.volume",
    "Bias": "flexdt.twin.reconstruction.bias",
    "bias_of": "flexdt.twin.reconstruction.bias",
    "bias_warnings": "flexdt.twin.reconstruction.checked_fdk",
    "cgls": "flexdt.twin.reconstruction.iterative",
    "checked_fdk": "flexdt.twin.reconstruction.checked_fdk",
    "em": "flexdt.twin.reconstruction.iterative",
    "fdk": "flexdt.twin.reconstruction.checked_fdk",
    "fdk_parts": "flexdt.twin.reconstruction.feldkamp.fdk",
    "field_of_view": "flexdt.twin.reconstruction.acquisition.rectify",
    "Grid": "flexdt.twin.projection.volume",
    "Hardening": "flexdt.twin.reconstruction.beam_hardening",
    "hardening": "flexdt.twin.reconstruction.beam_hardening",
    "LostVoxels": "flexdt.twin.reconstruction.acquisition.coverage",
    "minimise_tv": "flexdt.twin.reconstruction.total_variation",
    "Minimised": "flexdt.twin.reconstruction.total_variation",
    "Polychromatic": "flexdt.twin.reconstruction.beam_hardening",
    "ring_errors": "flexdt.twin.reconstruction.consistency.ring_pattern",
    "sart": "flexdt.twin.reconstruction.iterative",
    "sirt": "flexdt.twin.reconstruction.iterative",
    "Step": "flexdt.twin.reconstruction.linear_system",
    "Truncation": "flexdt.twin.reconstruction.acquisition.truncation",
    "truncation_of": "flexdt.twin.reconstruction.acquisition.truncation",
    "tv": "flexdt.twin.reconstruction.total_variation",
    "with_errors": "flexdt.twin.reconstruction.volume_errors",
    "without_scatter": "flexdt.twin.reconstruction.scatter_correction",
}

__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
