"""A scan as a CTSimU scenario (file format 1.2): nominal geometry, deviations, drifts.

The scenario's world is (x, y, z) = our (y, -x, z) with the first nominal source at the origin,
as CTSimU's own examples have it. Nominal motion is the stage's rotation and, where motors move
otherwise, drifts of centers. Each offset of the correction is a deviation that reconstruction
knows; any further misalignment is a deviation that reconstruction does not know. The
orientation of the panel must be the same in all frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from flexdt import DataSet
from flexdt.library.datasets.exchange import geometry_of
from flexdt.twin.exchange import SAME_MM, ExchangeError, require_panel
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import NOMINAL, UNITS, Offsets
from flexdt.twin.geometry.poses import Poses

TO_CTSIMU: Final = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Our world's (x, y, z) to the scenario's; a turn, no mirror."""
FORMAT: Final = {"major": 1, "minor": 2}


@dataclass(frozen=True, eq=False)
class Scenario:
    """Data of a scenario to write.

    Attributes:
        poses: nominal, of the projections.
        shape: detector (rows, cols), binned.
        known: the correction in force, which a reconstruction knows.
        real: true offsets; None: as known.
        name, description, date: for people; date as YYYY-MM-DD.
        kV, power_W: of the tube.
        exposure_s: of one exposure.
        averages: exposures averaged to a projection.
        bits: of the detector.
        detector_model, machine: names.
        darks, flats: images of each.
        smooth: taken in motion.
    """

    poses: Poses
    shape: tuple[int, int]
    known: Offsets = NOMINAL
    real: Offsets | None = None
    name: str = ""
    description: str = ""
    date: str | None = None
    kV: float | None = None
    power_W: float | None = None
    exposure_s: float | None = None
    averages: int = 1
    bits: int | None = None
    detector_model: str | None = None
    machine: str | None = None
    darks: int = 0
    flats: int = 0
    smooth: bool = False


def scenario_of(
    dataset: DataSet, parameters: Offsets | None = None, real: Offsets | None = None
) -> dict[str, Any]:
    """Convert a data set to a CTSimU scenario.

    Tube, exposure, date and machine are None where the data set does not know them.

    Args:
        dataset: from `load_dataset`.
        parameters: correction, known to reconstruction; None is the one in force, if any.
        real: true offsets, unknown to reconstruction where they differ; None: as
            `parameters`.

    Returns:
        The scenario's JSON object.

    Raises:
        TwinError: frames of several shapes.
        ExchangeError: as `scenario_document`.
    """
    if parameters is None:
        if dataset.correction is None:
            parameters = NOMINAL
        else:
            parameters = dataset.correction.parameters
    doc = dataset.document
    machine = dataset.machine
    geometry_of(dataset, NOMINAL)  # raises for frames of several shapes
    scan = Scenario(
        dataset.poses,
        dataset.shape,
        parameters,
        real,
        name=dataset.name,
        description="written by flexdt; deviations are named after its parameters",
        date=None if doc is None else f"{doc.started:%Y-%m-%d}",
        kV=None if doc is None else doc.tube.kV,
        power_W=None if doc is None else doc.tube.power_W,
        exposure_s=None if doc is None else doc.detector.exposure_ms / 1000.0,
        averages=1 if doc is None else doc.detector.averages,
        bits=None if machine is None else machine.detector.bits,
        detector_model=None if machine is None else machine.detector.model,
        machine=None if machine is None else machine.name,
        darks=len(dataset.darks),
        flats=len(dataset.flats),
        smooth=False if doc is None else doc.smooth,
    )
    return scenario_document(scan)


def scenario_document(scan: Scenario) -> dict[str, Any]:
    """Make the scenario's JSON object.

    Args:
        scan: its data.

    Returns:
        Tables of file format 1.2: file, geometry, detector, source, acquisition, and so
        on.

    Raises:
        ExchangeError: a panel whose steps turn by more than `SAME_MM` at its edge, or
            that is no panel of CTSimU.
    """
    poses = scan.poses
    pitch_u, pitch_v = require_panel(poses.cone_vec(), "CTSimU")
    for what, steps in (("u", poses.u), ("v", poses.v)):
        turned = np.abs(steps - steps[0]).max(axis=1)
        if turned.max() * max(scan.shape) > SAME_MM:
            view = int(np.argmax(turned))
            raise ExchangeError(
                f"CTSimU: the panel's {what} in frame {view} is not that of frame 0; "
                "only panels that keep their orientation are written",
                {"row": view},
            )
    origin = poses.source[0]
    rows, cols = scan.shape
    start, stop, direction, uneven = _stage_motion(np.degrees(poses.angle))
    real = scan.known if scan.real is None else scan.real
    pairs = _Deviations(scan.known, real)
    u = TO_CTSIMU @ poses.u[0]
    v = TO_CTSIMU @ poses.v[0]
    ahead = TO_CTSIMU @ [0.0, 1.0, 0.0]
    right = TO_CTSIMU @ [1.0, 0.0, 0.0]
    return {
        "file": {
            "name": scan.name,
            "description": scan.description,
            "contact": None,
            "date_created": scan.date,
            "date_changed": scan.date,
            "version": {"major": 1, "minor": 0},
            "file_type": "CTSimU Scenario",
            "file_format_version": dict(FORMAT),
        },
        "environment": {"material_id": None, "temperature": None},
        "geometry": {
            "detector": _part(
                poses.detector - origin, u / pitch_u, np.cross(u, v), pairs.of(_DETECTOR)
            ),
            "source": {
                "type": "cone",
                "beam_divergence": None,
                **_part(poses.source - origin, right, ahead, pairs.of(_SOURCE)),
            },
            "stage": _part(
                poses.axis - origin,
                right,
                np.array([0.0, 0.0, 1.0]),
                pairs.stage(uneven, np.degrees(poses.angle)),
            ),
        },
        "detector": {
            "model": scan.detector_model,
            "manufacturer": None,
            "type": "real",
            "columns": {"value": cols, "unit": "px"},
            "rows": {"value": rows, "unit": "px"},
            "pixel_pitch": {"u": _mm(pitch_u), "v": _mm(pitch_v)},
            "bit_depth": {"value": scan.bits},
            "integration_time": {"value": scan.exposure_s, "unit": "s"},
            "dead_time": {"value": 0.0, "unit": "s"},
        },
        "source": {
            "model": None,
            "manufacturer": None,
            "voltage": {"value": scan.kV, "unit": "kV"},
            "current": {
                "value": None
                if not scan.kV or scan.power_W is None
                else scan.power_W / scan.kV,
                "unit": "mA",
            },
        },
        "samples": [],
        "acquisition": {
            "start_angle": _deg(start),
            "stop_angle": _deg(stop),
            "direction": direction,
            "scan_mode": "continuous" if scan.smooth else "stop+go",
            "scan_speed": None,
            "number_of_projections": len(poses),
            "include_final_angle": True,
            "frame_average": scan.averages,
            "dark_field": _fields(scan.darks),
            "flat_field": _fields(scan.flats),
            "pixel_binning": {"u": 1, "v": 1},
            "scattering": False,
        },
        "materials": [],
        "simulation": {"flexdt": {"machine": scan.machine}},
    }


def _stage_motion(
    angles_deg: FloatArray,
) -> tuple[float, float, str, list[dict[str, Any]]]:
    """Determine the stage's motion from the angles.

    Directions are as seen from above: growing angles are CW; falling ones are CCW with
    start and stop negated. Deviations of 1e-12 deg or more from equal steps become a
    drift of a turn about the stage's own axis.

    Args:
        angles_deg: (n,) of the views.

    Returns:
        Start and stop angle [deg], direction (CW or CCW), and the drifting turn, or []
        without one.
    """
    first = float(angles_deg[0])
    last = float(angles_deg[-1])
    forward = first <= last
    start, stop = (first, last) if forward else (-first, -last)
    # Growing angles turn the object clockwise seen from above: negative about the stage's w.
    sign, direction = (-1.0, "CW") if forward else (1.0, "CCW")
    count = len(angles_deg)
    steps = np.arange(count) / max(1, count - 1) * (stop - start) + start
    rest = -angles_deg - sign * steps
    uneven = np.abs(rest).max() >= 1e-12
    return (
        start,
        stop,
        direction,
        [_drifting_turn(rest, True, "motors")] if uneven else [],
    )


_SOURCE: Final = "-y dS_x, z dS_y"
_DETECTOR: Final = "-y dD_x, z dD_y, x dD_z, v det_yaw, u det_pitch, w det_roll"
_STAGE: Final = ("-y dO_x, z dO_y, x dO_z, -y tau_x, x tau_z", "-w alpha")
_OBJECT: Final = "-y axis_tilt_x, x axis_tilt_z, -u tau_x, -v tau_z"
"""Axis of the scenario along or about which each parameter acts, in their order. A
tilt is about our +x, which is the scenario's -y, then about our +y, its +x; the
object's own frame is offset by tau from the axis it turns about."""


class _Deviations:
    """Deviations of all parameters: the known amount, then the unknown addition to it."""

    def __init__(self, known: Offsets, real: Offsets) -> None:
        self._known = known.to_edge()
        self._real = real.to_edge()

    def stage(
        self, motion: list[dict[str, Any]], angles_deg: FloatArray
    ) -> list[dict[str, Any]]:
        """List the deviations of the stage: its place, its motion's drifts, turns, angle scale,
        and the object's.
        """
        scale = [
            _drifting_turn(-amount * angles_deg, known, "angle_scale")
            for known, amount in self._amounts("angle_scale", 1.0)
        ]
        moved, turned = (self.of(part) for part in _STAGE)
        return [*moved, *motion, *turned, *scale, *self.of(_OBJECT)]

    def _amounts(self, name: str, nominal: float = 0.0) -> list[tuple[bool, float]]:
        """List known and unknown part of an offset beyond `nominal`: (known, amount), without
        zeros.
        """
        known = self._known[name] - nominal
        return [
            (k, a)
            for k, a in ((True, known), (False, self._real[name] - self._known[name]))
            if a != 0.0
        ]

    def of(self, parameters: str) -> list[dict[str, Any]]:
        """List the deviations of a table "axis parameter, ...": rotations [deg] or
        translations [mm], by each parameter's unit.

        A minus before the axis turns the sign. A parameter may give a known and an
        unknown deviation.
        """
        out = []
        for axis, name in (pair.split() for pair in parameters.split(", ")):
            turn = UNITS[name] == "deg"
            sign = -1.0 if axis.startswith("-") else 1.0
            kind, amount = ("rotation", _deg) if turn else ("translation", _mm)
            for known, value in self._amounts(name):
                out.append(_deviation(kind, axis[-1], amount(sign * value), known, name))
        return out


def _deviation(
    kind: str, axis: str, amount: dict[str, Any], known: bool, comment: str
) -> dict[str, Any]:
    """Make a deviation (rotation or translation about or along an axis) for the
    scenario's document.
    """
    return {
        "comment": comment,
        "type": kind,
        "axis": axis,
        "amount": amount,
        "known_to_reconstruction": known,
    }


def _drifting_turn(turns_deg: FloatArray, known: bool, comment: str) -> dict[str, Any]:
    """Make a turn about the stage's w that differs from frame to frame."""
    amount = _deg(0.0) | {"drifts": [_drift(turns_deg, "deg", known)]}
    return _deviation("rotation", "w", amount, known, comment)


def _drift(values: FloatArray, unit: str, known: bool) -> dict[str, Any]:
    return {"value": values.tolist(), "unit": unit, "known_to_reconstruction": known}


def _part(
    places: FloatArray, u: FloatArray, w: FloatArray, deviations: list[dict[str, Any]]
) -> dict[str, Any]:
    """Make a part's object: center (with drifts where it moves), orientation, deviations.

    Only a coordinate that changes has drifts.

    Args:
        places: (n, 3) of its center in our world [mm].
        u, w: directions (3,) in the scenario's world.
        deviations: of `_Deviations`.
    """
    at = places @ TO_CTSIMU.T
    center: dict[str, Any] = {}
    for i, axis in enumerate("xyz"):
        center[axis] = _mm(float(at[0, i]))
        moves = at[:, i] - at[0, i]
        if np.abs(moves).max() > 0.0:
            center[axis]["drifts"] = [_drift(moves, "mm", True)]
    return {
        "center": center,
        "vector_u": _direction(u),
        "vector_w": _direction(w / np.linalg.norm(w)),
        "deviations": deviations,
    }


def _direction(vector: FloatArray) -> dict[str, Any]:
    return {
        axis: {"value": float(x) + 0.0} for axis, x in zip("xyz", vector, strict=True)
    }


def _mm(value: float) -> dict[str, Any]:
    return {"value": value + 0.0, "unit": "mm"}


def _deg(value: float) -> dict[str, Any]:
    return {"value": value, "unit": "deg"}


def _fields(number: int) -> dict[str, Any]:
    return {"number": number, "frame_average": 1, "ideal": False, "correction": False}
