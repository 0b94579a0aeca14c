"""What is there where a scan's spots are not those of the phantom as it was said to stand.

The balls that turn together (`constellation`) are compared with the phantom's beads. A phantom
that leans or is aslant, one that was moved between two frames, and two of them are recognized and
identified; another unit, other pixels and a mirror image are named.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect.detection import Detections, SpotFinder
from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.diagnose.data import SOME_SPOTS, convincing
from flexdt.twin.calibration.diagnose.usual_factors import (
    LIKELY_SCALE,
    OF_LENGTHS,
    OF_RADII,
    SAME_SCALE,
    usual_reason,
)
from flexdt.twin.calibration.fit.fit import estimate_geometry
from flexdt.twin.calibration.fit.priors import ASSUMED
from flexdt.twin.calibration.fit.problem import SIX
from flexdt.twin.calibration.frame_source import FrameSpots, Scan
from flexdt.twin.calibration.identify import Identification, attempt
from flexdt.twin.calibration.recognise.constellation import (
    FEWEST,
    Constellation,
    Likeness,
    constellation,
    lean_of,
    likeness,
    similarity,
)
from flexdt.twin.findings import Finding, error, warning
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.geometry.poses import Poses

LEAST_LEAN: Final = math.radians(0.3)
"""Lean from which the beads are turned; a smaller one is a part of the phantom's shears."""
ON_ITS_HEAD: Final = math.radians(170.0)
"""Lean from which a phantom stands on its head."""
ON_ITS_SIDE: Final = math.radians(60.0)
"""Lean from which it lies."""
TURN_TRIALS: Final[Mapping[float, str]] = {
    -1.0: "",
    180.0 / math.pi: "the angles are in radians but were taken for degrees",
    math.pi / 180.0: "the angles were taken for radians but are degrees",
}
"""Factor on the angles -> what would explain it; the other way round is a mistake to be tried."""
MIN_EXPLAINED: Final = 0.4
"""Share of the spots that are beads before the lean is measured."""
MIRRORING: Final = frozenset(
    {
        CalibrationCode.MIRRORED_PHANTOM,
        CalibrationCode.ANGLE_REVERSED,
        CalibrationCode.IMAGE_MIRRORED,
        CalibrationCode.IMAGE_UPSIDE_DOWN,
        CalibrationCode.IMAGE_TURNED,
    }
)
"""Mistakes after which balls are the mirror image of the beads."""
REVERSING: Final = frozenset(
    {
        CalibrationCode.ANGLE_REVERSED,
        CalibrationCode.IMAGE_MIRRORED,
        CalibrationCode.IMAGE_TURNED,
    }
)
"""Mistakes after which balls turn the other way."""
UPENDING: Final = frozenset(
    {
        CalibrationCode.PHANTOM_UPSIDE_DOWN,
        CalibrationCode.IMAGE_TURNED,
        CalibrationCode.IMAGE_UPSIDE_DOWN,
    }
)
"""Mistakes after which the phantom stands on its head."""
NOT_AS_STATED: Final = frozenset(
    {CalibrationCode.ANGLE_ENDPOINT, CalibrationCode.NOT_TURNING}
)
"""Mistakes after which balls do not turn together."""
SHOWN: Final = 0.6
"""Share of the beads that a frame shows from which balls that turn together are found."""
SAME_PLACE_MM: Final = 0.3
"""Shift of a phantom on the stage from which it was moved, in a nominal geometry; without one the
stage turned too far, or frames are lost (assumed) [mm]."""
FAR_AWAY: Final = 0.2
"""Shift along the beam as a share of the SOD from which another scale is likelier."""
MOST_TURNS: Final = 20.0 * math.pi
"""Angle that no scan turns [rad]."""
BEAD_SPREAD_MM: Final = 1.0
"""Prior of the beads' places while the lean is measured [mm]."""


@dataclass(frozen=True, eq=False)
class Recognised:
    """What was recognized.

    Attributes:
        model: the beads as they stand.
        found: identification of them; None if it is the one before.
        finding: on it; None: nothing is said.
        decided: nothing else need be tried.
        right_angles: balls turn together as the angles say.
        mistakes: codes of the mistakes that are possible; None: all.
    """

    model: BeadModel
    found: Identification | None = None
    finding: Finding | None = None
    decided: bool = False
    right_angles: bool = False
    mistakes: frozenset[CalibrationCode] | None = None


def recognise(
    found: Identification | None,
    detections: Sequence[Detections],
    model: BeadModel,
    poses: Poses,
    name: str,
    start: Offsets,
) -> Recognised:
    """Compare the balls that turn together with the phantom's beads, where the identification
    of a scan is poor.

    Args:
        found: the identification, or None.
        detections: spots of each frame.
        model: the beads.
        poses: nominal geometry.
        name: of the scan.
        start: offsets that are known before.
    """
    balls = constellation(detections, poses, start)
    if balls is None:
        return _otherwise_turned(detections, model, poses, name, start)
    like = likeness(model.beads, balls.places)
    scan = _Spots(detections, model, poses, name, start)
    if like is None:
        aslant = scan.aslant()
        if aslant is not None:
            return aslant
        some = found is not None and found.explained >= MIN_EXPLAINED
        left = {CalibrationCode.BEAD_DISPLACED} if some else set()
        return Recognised(model, right_angles=True, mistakes=frozenset(left))
    if like.mirrored:
        return Recognised(model, right_angles=True, mistakes=MIRRORING)
    if like.lean > ON_ITS_HEAD:
        return Recognised(model, right_angles=True, mistakes=UPENDING)
    off = _of_scale(like.scale)
    if off:
        text = (
            f"{name}: the shadows are those of {model.name!r}, {like.scale:.3g} times as "
            f"large as stated: {off}"
        )
        return Recognised(
            model, None, error(CalibrationCode.WRONG_PHANTOM, text), True, True
        )
    other = _second(like, balls, model)
    if other is not None:
        return scan.of_two(like, balls, other)
    moved = scan.moved(like, balls)
    if moved is not None:
        return moved
    if like.lean > LEAST_LEAN:
        leaning = scan.leaning(like)
        if leaning is not None:
            return leaning
    return scan.aslant() or Recognised(model, right_angles=True)


def doubtful(found: Identification | None, poses: Poses) -> bool:
    """Check whether an identification is to be compared with the balls that turn together: it
    is poor, leaves spots over, or puts the phantom far from its stated distance.
    """
    if found is None or not convincing(found) or found.explained < SOME_SPOTS:
        return True
    p = found.parameters
    return abs(p.dO_z + p.tau_z) > FAR_AWAY * float(np.median(poses.sod))


def _of_scale(scale: float) -> str:
    """Name the usual reason for a scale; "" for one that a nominal geometry may have."""
    if abs(math.log(scale)) < SAME_SCALE:
        return ""
    reason = usual_reason(scale, OF_LENGTHS, LIKELY_SCALE)
    if reason:
        return f"{reason}; or it is another phantom of the same form"
    return "a phantom of another scale, or other pixels or distances"


def judge_emptiness(
    scans: Sequence[Scan], looks: Sequence[Sequence[FrameSpots]], model: BeadModel
) -> list[Finding]:
    """Look for spots of any size in scans where no bead of the expected size was found;
    reads their images again.

    Args:
        scans: the scans.
        looks: spots of each frame of each scan.
        model: the beads.

    Returns:
        An error for each scan that shows other balls, round spots in half of its frames or
        more: what their places and sizes tell.
    """
    out = []
    for scan, some in zip(scans, looks, strict=True):
        if any(len(look.detections) for look in some):
            continue
        anything = [look.detections for look in scan.frames.look(SpotFinder())]
        shown = [d.radii_px for d in anything if len(d)]
        if len(shown) < 0.5 * len(anything) or not shown:
            continue
        expected = float(
            np.median(model.bead_radius_mm) * np.median(scan.poses.pixels_per_mm)
        )
        seen = float(np.median(np.concatenate(shown)))
        text = (
            f"{scan.name}: the images show round shadows of radius {seen:.1f} px where the "
            f"beads of {model.name!r} would cast {expected:.3g} px"
        )
        why = _of_other_size(anything, scan, model, seen / expected)
        out.append(error(CalibrationCode.WRONG_PHANTOM, f"{text}: {why}"))
    return out


def _of_other_size(
    detections: Sequence[Detections], scan: Scan, model: BeadModel, ratio: float
) -> str:
    """Say why spots have another size, by the places of the balls if they turn together.

    Args:
        detections: spots of any size.
        scan: that shows them.
        model: the beads that were expected.
        ratio: of the spots' radii and of those expected.
    """
    balls = constellation(detections, scan.poses, NOMINAL)
    like = None if balls is None else likeness(model.beads, balls.places)
    if like is not None and abs(math.log(like.scale)) < SAME_SCALE:
        reason = usual_reason(ratio, OF_RADII)
        return reason or "the beads are where they should be, but of another size"
    scale = ratio if like is None else like.scale
    reason = usual_reason(scale, OF_LENGTHS, LIKELY_SCALE)
    return f"another phantom, or {reason}" if reason else "another phantom"


def _second(like: Likeness, balls: Constellation, model: BeadModel) -> Likeness | None:
    """Find the phantom a second time among the balls that are not the first; None without.
    The numbers of its balls are those among all.
    """
    left = np.setdiff1d(np.arange(len(balls.places)), like.balls)
    # Places near a ball of the first are its own, found twice.
    gap = np.linalg.norm(balls.places[left][:, None] - balls.places[like.balls], axis=2)
    left = left[gap.min(axis=1) > 2.0 * float(np.median(balls.radii))]
    if len(left) < max(FEWEST, len(like.beads) // 2):
        return None
    other = likeness(model.beads, balls.places[left])
    if other is None or other.mirrored or abs(math.log(other.scale)) > SAME_SCALE:
        return None
    return replace(other, balls=left[other.balls])


def _otherwise_turned(
    detections: Sequence[Detections],
    model: BeadModel,
    poses: Poses,
    name: str,
    start: Offsets,
) -> Recognised:
    """Look for other angles with which the balls turn together as the phantom's beads: of
    another unit, or the other way.

    Where frames show most of the beads and no angles do, only mistakes of the angles and of
    the frames are left.
    """
    first = poses.angle[0]
    for factor, said in TURN_TRIALS.items():
        turned = first + factor * (poses.angle - first)
        if not math.radians(5.0) < np.ptp(turned) < MOST_TURNS:
            continue
        balls = constellation(detections, replace(poses, angle=turned), start)
        like = None if balls is None else likeness(model.beads, balls.places)
        if like is not None and not said:
            return Recognised(model, right_angles=True, mistakes=REVERSING)
        if like is None or like.mirrored:
            continue
        text = (
            f"{name}: {said}: the frames fit the phantom if the stage turns {factor:.4g} times "
            "as far"
        )
        return Recognised(
            model, None, error(CalibrationCode.ANGLE_TURN, text), decided=True
        )
    shown = float(np.median([len(d) for d in detections]))
    many = len(model) >= FEWEST and shown >= max(SHOWN * len(model), FEWEST)
    return Recognised(model, mistakes=NOT_AS_STATED if many else None)


@dataclass(frozen=True, eq=False)
class _Spots:
    """Spots of a scan, and what is said of it."""

    detections: Sequence[Detections]
    model: BeadModel
    poses: Poses
    name: str
    start: Offsets

    @property
    def _rise_mm(self) -> float:
        """Rise of the stage as it turns, a radian [mm]."""
        angle = self.poses.angle - self.poses.angle.mean()
        return float(angle @ self.poses.axis[:, 2]) / max(float(angle @ angle), 1e-12)

    def leaning(self, like: Likeness) -> Recognised | None:
        """Identify the beads of a phantom that leans; None if that does not fit either."""
        turn = like.leaning
        for _ in range(2):
            model = _turned(self.model, turn)
            found = attempt(self.detections, model, self.poses, start=self.start)
            if found is None or found.explained < MIN_EXPLAINED:
                return None
            turn = self._measured(found, model) @ turn
        model = _turned(self.model, lean_of(turn))
        found = attempt(self.detections, model, self.poses, start=self.start)
        if found is None or not convincing(found):
            return None
        return Recognised(model, found, self._leans(lean_of(turn)), True, True)

    def aslant(self) -> Recognised | None:
        """Identify the beads of a phantom that is sheared, which the fit tells; None if that does
        not explain all spots either.
        """
        found = attempt(
            self.detections, self.model, self.poses, start=self.start, aslant=True
        )
        if found is None or doubtful(found, self.poses):
            return None
        return Recognised(self.model, found, None, True, True)

    def _measured(self, found: Identification, model: BeadModel) -> FloatArray:
        """Measure by how much the beads are turned against a model, (3, 3)."""
        seen = np.flatnonzero((found.index >= 0).sum(axis=0) >= 3)
        if len(seen) < 3:
            return np.eye(3)
        shape = np.array([d.shape for d in self.detections], dtype=np.float64)
        fit = estimate_geometry(
            found.tracks, model, self.poses, SIX, shape=shape, start=found.parameters,
            centre=found.bias, free_beads=True, bead_tolerance_mm=BEAD_SPREAD_MM,
            priors=ASSUMED, prior_centre=self.start, bound=math.inf,
        )  # fmt: skip
        return lean_of(similarity(model.beads[seen], fit.beads[seen])[0])

    def _leans(self, turn: FloatArray) -> Finding:
        """Make the warning that the phantom leans, with the angle and the direction."""
        angle = math.acos(min(max(float(turn[2, 2]), -1.0), 1.0))
        x, y, _ = turn[:, 2]
        towards = math.degrees(math.atan2(y, x)) % 360.0
        how = "lies on its side, and leans" if angle > ON_ITS_SIDE else "leans"
        return warning(
            CalibrationCode.PHANTOM_LEANS,
            f"{self.name}: the phantom {how} on the stage by {math.degrees(angle):.2f} deg, its "
            f"upper end towards {towards:.0f} deg from its x to its y: its beads were turned so, "
            "and all numbers hold; it stands otherwise than its file has it",
        )

    def of_two(self, like: Likeness, balls: Constellation, other: Likeness) -> Recognised:
        """Identify the beads of two phantoms, or of one that was moved between two frames."""
        frames = [
            np.flatnonzero((balls.index[:, one.balls] >= 0).any(axis=1))
            for one in (like, other)
        ]
        turn = _turn_between(like, other)
        early, late = sorted(frames, key=lambda f: float(np.median(f)))
        share = len(np.intersect1d(early, late)) / max(min(len(early), len(late)), 1)
        if share < 0.2:
            if other.turned_from(like, SAME_PLACE_MM, self._rise_mm):
                return Recognised(self.model)
            return self._remounted(int(early[early < np.median(late)].max()) + 1, turn)
        some = self._only(like, balls)
        second = self._only(other, balls)
        text = (
            f"{self.name}: a second phantom {self.model.name!r} is in view, turned by "
            f"{turn:.1f} deg against the first"
        )
        if some is None or second is None:
            return Recognised(
                self.model, None, error(CalibrationCode.EXTRA_SPOTS, f"{text}: take one away"),
                True, True,
            )  # fmt: skip
        some = replace(
            some, rivals=(*some.rivals, second.parameters), odds=(*some.odds, 1.0)
        )
        return Recognised(
            self.model, some,
            warning(
                CalibrationCode.EXTRA_SPOTS,
                f"{text}: one of them was used, and numbers that differ between the two have "
                "none",
            ), True, True,
        )  # fmt: skip

    def moved(self, like: Likeness, balls: Constellation) -> Recognised | None:
        """Recognise a phantom that stands otherwise in the first or the last frames, too few
        for its balls to be found among all; None without.
        """
        there = (balls.index[:, like.balls] >= 0).mean(axis=1)
        shown = np.array([len(d) for d in self.detections])
        other = np.flatnonzero((there < 0.5) & (shown >= FEWEST))
        at_end = len(other) and (other[0] == 0 or other[-1] == len(shown) - 1)
        if len(other) < FEWEST or not at_end or np.ptp(other) > 1.5 * len(other):
            return None
        part = slice(int(other[0]), int(other[-1]) + 1)
        some = constellation(self.detections[part], self.poses[part], self.start)
        second = None if some is None else likeness(self.model.beads, some.places)
        if second is None or second.mirrored:
            return None
        if second.turned_from(like, SAME_PLACE_MM, self._rise_mm):
            return Recognised(self.model)
        return self._remounted(
            part.start if part.start > 0 else part.stop, _turn_between(like, second)
        )

    def _remounted(self, frame: int, turn: float) -> Recognised:
        """Make the error that the phantom was moved before a frame.

        Args:
            frame: the first that shows it otherwise.
            turn: of it [deg].
        """
        text = (
            f"{self.name}: the phantom stands otherwise from about frame {frame} on: it was "
            f"moved, turned by {turn:.1f} deg; calibrate with the frames before or after it alone"
        )
        return Recognised(
            self.model, None, error(CalibrationCode.REMOUNTED, text), True, True
        )

    def _only(self, like: Likeness, balls: Constellation) -> Identification | None:
        """Identify beads with the spots of some balls alone; None if that does not fit."""
        if like.lean > LEAST_LEAN:
            return None
        index = balls.index[:, like.balls]
        kept = [np.unique(row[row >= 0]) for row in index]
        some = [_taken(d, rows) for d, rows in zip(self.detections, kept, strict=True)]
        found = attempt(some, self.model, self.poses, start=self.start)
        if found is None or not convincing(found):
            return None
        whole = found.index.copy()
        for i, rows in enumerate(kept):
            there = found.index[i] >= 0
            whole[i, there] = rows[found.index[i, there]]
        return replace(found, index=whole)


def _turn_between(one: Likeness, other: Likeness) -> float:
    """Return the angle between two likenesses of a phantom [deg]."""
    turn = one.rotation.T @ other.rotation
    return math.degrees(
        math.acos(min(max((float(np.trace(turn)) - 1.0) / 2.0, -1.0), 1.0))
    )


def _turned(model: BeadModel, turn: FloatArray) -> BeadModel:
    """Return a model whose beads are turned about their middle."""
    return replace(model, beads=model.middle + model.about_middle @ turn.T)


def _taken(d: Detections, rows: npt.NDArray[np.int64]) -> Detections:
    """Keep some spots of a frame."""
    return Detections(
        d.centers[rows], d.covariances[rows], d.radii_px[rows], d.contrast[rows],
        d.bias[rows], d.whole[rows], d.likeness[rows], d.shape,
    )  # fmt: skip
