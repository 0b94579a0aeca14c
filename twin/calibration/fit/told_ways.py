"""Ways and places that are not as told, as deviations of a geometry's frames."""

from __future__ import annotations

import numpy as np

from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.priors import gives_room
from flexdt.twin.geometry.motion import Motion
from flexdt.twin.geometry.told_lengths import (
    AXES,
    PANEL_TRAVEL,
    PLACES,
    TOLD,
    TRAVEL,
    ways,
)


def told_motions(fit: FitResult) -> tuple[Motion, ...]:
    """Return how the told ways and places that a user doubts move sample and panel, in each
    frame of each scan (zeros in a scan of which none is); empty where none is doubted.

    A told length that is freed, or has a wider prior than is assumed, is corrected in the
    geometry of the views; others stay as told, and are in the sigmas alone.

    Args:
        fit: with its told lengths as parameters.
    """
    problem = fit.problem
    layout = problem.layout
    doubted = {
        name: (float(fit.solution.x[i]), fit.sigmas[name])
        for i, name in enumerate(layout.names[: layout.parameter_count])
        if name.split("@")[0] in TOLD
        and gives_room(name.split("@")[0], float(problem.prior_sigma[i]))
    }
    if not doubted:
        return ()
    axis, panel = ways(problem.poses)
    out = []
    for group in range(len(problem.base)):
        mine = problem.group == group
        columns = {}
        for letter, along in AXES.items():
            value, variance = np.zeros((2, int(mine.sum())))
            for name, slope in (
                (TRAVEL[list(AXES).index(letter)], axis[mine, along]),
                (f"{PLACES[list(AXES).index(letter)]}@{group}", np.ones(int(mine.sum()))),
            ):
                if name in doubted:
                    value = value + doubted[name][0] * slope
                    variance = variance + (doubted[name][1] * slope) ** 2
            if value.any():
                columns[f"dO_{letter}"] = value, np.sqrt(variance)
            name = PANEL_TRAVEL[list(AXES).index(letter)]
            if name in doubted:
                slope = panel[mine, along]
                columns[f"dD_{letter}"] = (
                    doubted[name][0] * slope,
                    doubted[name][1] * np.abs(slope),
                )
        if not columns:  # nothing of this scan is doubted, or it goes no way
            columns["dO_x"] = np.zeros(int(mine.sum())), np.zeros(int(mine.sum()))
        out.append(
            Motion(
                tuple(columns),
                np.stack([v for v, _ in columns.values()], axis=1),
                np.stack([s for _, s in columns.values()], axis=1),
                (0.0,) * len(columns),
            )
        )
    return tuple(out)
