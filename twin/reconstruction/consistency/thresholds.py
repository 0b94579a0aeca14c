"""Thresholds of what is claimed of a volume, told of its scan and warned of: their sources.

One list, from which the page of thresholds is made. Names and meanings stand beside the code.
"""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from importlib import import_module
from typing import Final


class Source(Enum):
    """Where the size of a threshold comes from."""

    DEFINITION = "a mathematical constant or the format of a number"
    NOISE = "statistics of noise or of rounding"
    LIKELIHOOD = "a probability that is chosen and stated"
    LITERATURE = "literature, in its description"
    WORK = "bounds the work; more costs time"
    ASSUMED = "assumed"


@dataclass(frozen=True)
class Threshold:
    """A number in the code.

    Attributes:
        module: dotted name.
        name: of the constant.
        value: as written.
        meaning: its description.
        source: None where it is not in `SOURCES`.
    """

    module: str
    name: str
    value: str
    meaning: str
    source: Source | None


_BASE: Final = "flexdt.twin.reconstruction"
SOURCES: Final[dict[str, dict[Source, str]]] = {
    "flexdt.twin.projection.volume": {
        Source.LIKELIHOOD: "MIN_DOUBLED_SIGMAS",
        Source.ASSUMED: "WARNING_BOUND MIN_TWO_EDGES_PX MIN_DOUBLED_VOXELS",
    },
    f"{_BASE}.bias": {
        Source.DEFINITION: "REGION_SIGMA PARTS_OF_ERRORS",
        Source.LIKELIHOOD: "SIGMAS",
        Source.WORK: "STREAK_ROWS",
        Source.ASSUMED: "OTHERWISE_FACTOR PRISM_ERROR_SHARE FLOOR MAX_VOXEL_NODES",
    },
    f"{_BASE}.coarse_scan": {
        Source.WORK: "NODES FINE_NODES VIEWS COMPARED_VIEWS COMPARED_ROWS",
        Source.ASSUMED: (
            "MAX_CLIMB MIN_AXIS_COLUMNS PEAK_COLUMNS MAX_FLAT_VIEWS PARALLEL_SOURCE_RADII"
        ),
    },
    f"{_BASE}.uniform_nodes": {
        Source.ASSUMED: (
            "SMOOTHING_NODES EDGE_CHANGE_SHARE MIN_NEIGHBOURHOOD_SHARE MIN_BODY_SHARE "
            "MIN_EVENNESS"
        ),
    },
    f"{_BASE}.iterative_errors": {
        Source.NOISE: "MOST_RMS",
        Source.WORK: "PROBES LEVEL_VIEWS",
        Source.ASSUMED: "NEAR_VOXELS WINDOW FINER_POWER",
    },
    f"{_BASE}.white_noise": {Source.DEFINITION: "MEDIAN_OF_SQUARES"},
    f"{_BASE}.feldkamp.noise": {
        Source.DEFINITION: "NORMAL_MEDIAN",
        Source.WORK: (
            "NODES SHAPE_LAYERS VALUED_VIEWS SHAPE_VIEWS AVERAGED_POINTS BANDS"
        ),
        Source.ASSUMED: "MIN_ROW_DISTANCE WINDOW_NODES",
    },
    f"{_BASE}.feldkamp.noise_by_value": {
        Source.NOISE: "LEAST_SQUARES MOST_SQUARES",
        Source.WORK: "TABLE",
        Source.ASSUMED: "BINS BEYOND",
    },
    f"{_BASE}.consistency.agreement": {
        Source.LIKELIHOOD: "EXCLUDED",
        Source.WORK: "TABLE_VIEWS",
        Source.ASSUMED: "LIKE_THE_BEST CONFIRMING VARIANCE_KNOWN LEAST",
    },
    f"{_BASE}.consistency.cause_table": {
        Source.LIKELIHOOD: "FALSE_ALARMS",
        Source.WORK: "MOST_STEPS TRIED",
        Source.ASSUMED: "ARCS MOST_ERRORS BLURS SHARED_OF_PIXELS FREEDOM",
    },
    f"{_BASE}.consistency.causes": {Source.ASSUMED: "WAVES STEPS"},
    f"{_BASE}.consistency.doubled_edges": {Source.WORK: "AZIMUTHS STEP"},
    f"{_BASE}.consistency.opposed_rays": {Source.ASSUMED: "WIDEST_GAP"},
    f"{_BASE}.consistency.suspects": {
        Source.ASSUMED: "INTERLACED_PASSES MAX_STEP_SCATTER CENTRE_TOLERANCE",
    },
    f"{_BASE}.consistency.view_pairs": {
        Source.DEFINITION: "ROUNDING",
        Source.WORK: "PLANES PARTS",
        Source.ASSUMED: "LEAST_ANGLE SHADOW_SHARE FEWEST_PAIRS NEIGHBOURS",
    },
}
"""Module -> source -> names of its numbers."""


def thresholds() -> Iterator[Threshold]:
    """Yield all numbers of the modules, in the order of `SOURCES` and of the code."""
    for module, listed in SOURCES.items():
        of = {name: source for source, names in listed.items() for name in names.split()}
        body = ast.parse(inspect.getsource(import_module(module))).body
        for place, one in enumerate(body):
            if not isinstance(one, ast.AnnAssign) or one.value is None:
                continue
            target = one.target
            if not isinstance(target, ast.Name) or not _is_number(one.value):
                continue
            meaning = ""
            for after in body[place + 1 :]:
                if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                    meaning = " ".join(str(after.value.value).split())
                    break
                if not isinstance(after, ast.AnnAssign):
                    break
            name = target.id
            yield Threshold(module, name, ast.unparse(one.value), meaning, of.get(name))


def _is_number(value: ast.expr) -> bool:
    """Return whether an expression is a number or several."""
    try:
        found = ast.literal_eval(value)
    except ValueError:
        return False
    several = found if isinstance(found, tuple) else (found,)
    return bool(several) and all(type(one) in (int, float) for one in several)
