"""Variables of the experiments: scenarios, phantoms, bead counts, damping, placements,
noise.

A `WorkUnit` is one unit of work that can run in any process: one setting in one scenario,
for all numbers of projections.

The thesis's figures as printed, those of its author's public code and logs, and the
assumed placements come from the package's data files.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import resources
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration import EIGHT, SIX
from flexdt.twin.errors import LimitError, UnknownNameError
from flexdt.twin.geometry.conventions import FloatArray, from_unity
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses


@lru_cache
def thesis() -> Mapping[str, Any]:
    """Load all copied figures; `source` gives their origin."""
    loaded: dict[str, Any] = json.loads(_text("thesis.json"))
    return loaded


@lru_cache
def author() -> Mapping[str, Any]:
    """Load phantoms, scenarios and costs of the author's public code and logs."""
    return tomllib.loads(_text("author.toml"))


@lru_cache
def placements() -> Mapping[str, Any]:
    """Load object placements of experiment 6.6, labeled assumed."""
    return tomllib.loads(_text("placements.toml"))


def projection_counts() -> tuple[int, ...]:
    """List the fourteen N of experiments 1 to 3."""
    return tuple(int(n) for n in thesis()["projection_counts"])


def thesis_row(experiment: str, setting: str) -> Mapping[str, float] | None:
    """Return what the thesis reports for a setting.

    Args:
        experiment: name.
        setting: name of the row.

    Returns:
        MAE, cost reduction and iterations by name; None if it reports nothing.
    """
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


SHAPE: Final = (760, 956)
"""Detector (rows, cols) of the thesis's experiments."""
PIXEL_MM: Final = 0.1496
RENDERED: Final = ("clean", "images")
"""Rendered images without noise; rendered noisy images. The beads' identities are unknown in
both."""
FIDELITIES: Final = ("points", "noisy", *RENDERED)
"""Exact points; points with noise; rendered images."""
NOISE_PX: Final = 0.1
"""Noise of `noisy` points [px]."""
EXPERIMENTS: Final = ("beads", "phantoms", "damping", "detector")
VARIANTS: Final = ("printed", "author")
"""Phantoms and scenarios as the thesis prints them, or as its author's public code has them."""
DAMPING: Final = {"GN": 0.0, "LM_low": 1e-4, "LM_normal": 1e-2, "LM_high": 1.0}


@dataclass(frozen=True)
class WorkUnit:
    """One setting in one scenario, all numbers of projections.

    Attributes:
        experiment: name of the study.
        setting: bare name: "1" to "7", the phantom's name, the damping's name, G.
        scenario: G0 to G4.
        phantom: name of the phantom, with its number of beads.
        free: parameters to estimate.
        damping: lambda of Algorithm 2.
        counts: numbers of projections.
        fidelity: one of FIDELITIES.
        seed: of the noise; unused for exact points.
        limit: MAE below which a run is a success (thesis 6.1.3 and 6.6).
        variant: one of VARIANTS.
    """

    experiment: str
    setting: str
    scenario: str
    phantom: str
    free: tuple[str, ...]
    damping: float
    counts: tuple[int, ...]
    fidelity: str
    seed: int
    limit: float
    variant: str = "printed"


def require_counts(counts: Sequence[int], rendered: bool) -> None:
    """Check numbers of projections before a study runs.

    Args:
        counts: numbers of projections of the runs.
        rendered: the largest number is rendered, and every so many of these images serve
            the smaller ones, which divide it for that.

    Raises:
        LimitError: no count, one below 1, or some that do not divide the largest of
            rendered images; names the divisors.
    """
    asked = list(counts)
    if not asked or min(asked) < 1:
        raise LimitError(
            f"counts {asked}: allowed are one or more numbers of projections from 1 on",
            {"asked": asked, "allowed": ">= 1"},
        )
    most = max(asked)
    uneven = [n for n in asked if most % n]
    if rendered and uneven:
        divisors = [n for n in range(1, most + 1) if most % n == 0]
        raise LimitError(
            f"counts {uneven} are no even part of the {most} images that are rendered; "
            f"allowed beside {most}: {', '.join(map(str, divisors[:-1]))}",
            {"asked": uneven, "allowed": divisors},
        )


def unity_poses(
    source: npt.ArrayLike, axis: npt.ArrayLike, detector: npt.ArrayLike, angle: FloatArray
) -> Poses:
    """Make poses of the thesis's detector: places in Unity's axes (3,) [mm], stage
    angles (n,) [rad]."""
    source, axis, detector = (from_unity(place) for place in (source, axis, detector))
    return Poses.upright(source, axis, detector, PIXEL_MM, angle)


def scenario(name: str, frames: int, variant: str = "printed") -> tuple[Poses, Offsets]:
    """Make nominal poses (the thesis's "Unity object", angles 360 n / N) and the true
    offsets of a scenario.

    Args:
        name: of the scenario.
        frames: N, number of poses.
        variant: "author" takes the author's code, others the thesis.

    Raises:
        UnknownNameError: lists the scenarios.
    """
    table = (author() if variant == "author" else thesis())["scenarios"]
    if name not in table:
        raise UnknownNameError.among(f"no scenario {name!r}; there are", name, table)
    row = table[name]
    angle = 2.0 * math.pi * np.arange(frames) / frames
    poses = unity_poses(row["source"], row["object_start"], row["detector"], angle)
    x, y, z = row["dO"]
    truth = Offsets.from_edge(
        {"dO_x": x, "dO_y": y, "dO_z": z, "alpha": row["alpha_deg"]}
    )
    return poses, truth


def placement_scenario(setting: str, frames: int) -> tuple[list[Poses], Offsets]:
    """Make the poses of each placement of experiment 6.6 in a setting (1, 2 or 8
    placements), and the true offsets.

    Raises:
        KeyError: there is no such setting.
    """
    table = placements()
    poses, _ = scenario(table["scenario"], frames)
    out = []
    for name in table["sets"][setting]:
        x, z = table["placements"][name]
        out.append(replace(poses, axis=poses.axis + from_unity([x, 0.0, z])))
    return out, Offsets.from_edge(thesis()["table_6_8_truth"])


def tasks(
    experiment: str,
    fidelity: str,
    *,
    counts: Sequence[int] | None = None,
    seed: int = 1,
    variant: str = "printed",
) -> list[WorkUnit]:
    """List all tasks of an experiment.

    Each is a setting in a scenario; those of "damping" go scenario by scenario, so that
    rendered images serve all dampings.

    Args:
        experiment: one of EXPERIMENTS.
        fidelity: one of FIDELITIES.
        counts: numbers of projections; None is the thesis's fourteen. Of rendered images
            each divides the largest.
        seed: of all noise.
        variant: one of VARIANTS; `detector` is printed in both.

    Raises:
        UnknownNameError: an experiment, fidelity or variant that does not exist.
        LimitError: counts that no run can have.
    """
    for value, allowed, what in (
        (experiment, EXPERIMENTS, "experiment"),
        (fidelity, FIDELITIES, "fidelity"),
        (variant, VARIANTS, "variant"),
    ):
        if value not in allowed:
            raise UnknownNameError.among(
                f"no {what} {value!r}; there are", value, allowed
            )
    if counts is None:
        n = projection_counts()
    else:
        n = tuple(counts)
    require_counts(n, fidelity in RENDERED)
    scenarios = tuple(thesis()["scenarios"])

    def six(setting: str, phantom: str, damping: float) -> list[WorkUnit]:
        """List the units of work of a setting, one for each scenario, with all six
        parameters free and `damping`.
        """
        return [
            WorkUnit(
                experiment,
                setting,
                g,
                phantom,
                SIX,
                damping,
                n,
                fidelity,
                seed,
                0.2,
                variant,
            )
            for g in scenarios
        ]

    match experiment:
        case "beads":
            return [t for k in range(1, 8) for t in six(str(k), f"normal-{k}", 1e-2)]
        case "phantoms":
            names = thesis()["table_6_4_phantoms"]
            return [t for name in names for t in six(name, f"{name}-3", 0.0)]
        case "damping":
            # Scenario by scenario, so that rendered images serve all dampings.
            rows = [six(name, "small-3", lam) for name, lam in DAMPING.items()]
            return [t for same in zip(*rows, strict=True) for t in same]
        case "detector":
            home = placements()["scenario"]
            return [
                WorkUnit(
                    experiment, g, home, "normal-3", EIGHT, 1e-2, n, fidelity, seed, 1.0
                )
                for g in placements()["sets"]
            ]
    raise AssertionError(f"{experiment} is in EXPERIMENTS and has no tasks")
