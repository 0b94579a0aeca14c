"""Checks of the data before a fit: frames, phantom, handedness, angles.

When spots and phantom disagree, possible mistakes are tried one by one and the one that explains
the spots is reported; the data are not changed. A finding is an error where the numbers must not be
used, and a warning where they may.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect.detection import Detections, Detector
from flexdt.twin.calibration.frame_source import Frames, FrameState, Look
from flexdt.twin.calibration.identify import Identification, Search, identify
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.poses import Poses

GOOD_SHARE = 0.7
"""Share of the spots that must be some bead, and of the beads in view that must be seen."""
GOOD_RMS_PX = 0.6
"""Residual of the first assignment above which another explanation is looked for."""


class Severity(enum.Enum):
    """Whether the numbers may be used."""

    ERROR = "error"
    WARNING = "warning"


@dataclass(frozen=True)
class Finding:
    """Something about the data, with a code for programs and a sentence for people."""

    code: str
    severity: Severity
    text: str


def error(code: str, text: str) -> Finding:
    """A finding with which the numbers must not be used."""
    return Finding(code, Severity.ERROR, text)


def warning(code: str, text: str) -> Finding:
    """A finding with which the numbers may be used."""
    return Finding(code, Severity.WARNING, text)


_STATES = {
    FrameState.MISSING: "missing",
    FrameState.DARK: "dark",
    FrameState.REPEATED: "copies of the frame before",
}


def judge_frames(name: str, looks: Sequence[Look], sought: Detector) -> list[Finding]:
    """Missing and dark frames, and frames without any spot like those that were `sought`."""
    out = []
    n = len(looks)
    for state, code in (
        (FrameState.MISSING, "frames_missing"),
        (FrameState.DARK, "frames_dark"),
        (FrameState.REPEATED, "frames_repeated"),
    ):
        count = sum(look.state is state for look in looks)
        if count:
            out.append(
                Finding(
                    code,
                    Severity.ERROR if count == n else Severity.WARNING,
                    f"{name}: {count} of {n} frames are {_STATES[state]}; the others are used",
                )
            )
    usable = [look for look in looks if look.state is FrameState.USABLE]
    empty = sum(len(look.detections) == 0 for look in usable)
    if usable and empty == len(usable):
        out.append(
            error(
                "no_beads",
                f"{name}: no bead was found in any of {n} frames; looked for were round spots, "
                f"darker than what is round them, of {sought.radius_px[0]:.1f} to "
                f"{sought.radius_px[1]:.1f} px radius: is this a bead phantom, is it in the beam, "
                "and are geometry and pixel size right?",
            )
        )
    elif empty:
        out.append(warning("frames_empty", f"{name}: {empty} of {n} frames show no bead"))
    return out


class ScanLike(Protocol):
    """A scan's images and name (see `pipeline.Scan`)."""

    @property
    def frames(self) -> Frames:
        """The images."""

    @property
    def name(self) -> str:
        """For the text."""

    @property
    def poses(self) -> Poses:
        """Nominal geometry."""


def judge_emptiness(
    scans: Sequence[ScanLike], looks: Sequence[Sequence[Look]], model: BeadModel
) -> list[Finding]:
    """Where no bead of the expected size was found: are there spots of another size?"""
    out = []
    for scan, some in zip(scans, looks, strict=True):
        if any(len(look.detections) for look in some):
            continue
        anything = scan.frames.look(Detector())
        radii = [look.detections.radii_px for look in anything if len(look.detections)]
        if len(radii) < 0.5 * len(anything) or not radii:
            continue
        scale = scan.poses.sdd / scan.poses.sod / np.linalg.norm(scan.poses.u, axis=1)
        expected = float(np.median(model.bead_radius_mm) * np.median(scale))
        seen = float(np.median(np.concatenate(radii)))
        out.append(
            error(
                "wrong_phantom",
                f"{scan.name}: the images show round shadows of radius {seen:.1f} px where the "
                f"beads of {model.name!r} would cast {expected:.1f} px: another phantom",
            )
        )
    return out


def explain_identification(
    found: Identification | None,
    detections: Sequence[Detections],
    model: BeadModel,
    poses: Poses,
    name: str,
    search: Search,
) -> list[Finding]:
    """Judge an assignment; if it is poor, find the mistake that explains the spots."""
    most = max((len(d) for d in detections), default=0)
    if most == 1:
        return [
            Finding(
                "one_bead",
                Severity.WARNING if len(model) == 1 and found is not None else Severity.ERROR,
                f"{name}: no frame shows more than one bead: one bead alone fixes neither the "
                "scale nor the angle",
            )
        ]
    if found is not None and found.ambiguous and _convincing(found):
        angles = [p.to_edge()["alpha"] % 360.0 for p in (found.parameters, *found.rivals)]
        listed = ", ".join(f"{a:.1f}" for a in angles)
        return [
            error(
                "ambiguous",
                f"{name}: the beads cannot be told apart: start angles {listed} deg explain the "
                "shadows equally well; use a phantom without that symmetry",
            )
        ]
    missing = _missing(found)
    if missing:
        listed = ", ".join(map(str, missing))
        return [
            warning(
                "beads_missing",
                f"{name}: bead {listed} of {model.name!r} has no spot in any frame, and all spots "
                "fit the others: it is lost or out of view; the others are used",
            )
        ]
    if found is not None and _convincing(found):
        return []
    explanation = _alternative(found, detections, model, poses, search)
    if explanation is not None:
        code, text = explanation
        return [error(code, f"{name}: {text}")]
    if found is not None and _plausible(found):
        return []  # The right beads in about the right places: the residuals will tell.
    if found is None:
        why = "no orientation of the phantom explains them"
    else:
        why = (
            f"at best {100 * found.explained:.0f} % of the shadows are a bead, "
            f"{100 * found.found:.0f} % of the beads in view have a shadow, and they lie "
            f"{found.rms_px:.2f} px off"
        )
    return [
        error(
            "wrong_phantom",
            f"{name}: the shadows do not fit the phantom {model.name!r}: {why}; wrong phantom, or "
            "wrong frame angles",
        )
    ]


def _missing(found: Identification | None) -> list[int]:
    """Beads without any spot where every spot fits one of the others, at least three of them."""
    if found is None or found.explained < GOOD_SHARE or not found.rms_px < GOOD_RMS_PX:
        return []
    share = (found.index >= 0).mean(axis=0)
    if np.count_nonzero(share >= GOOD_SHARE) < 3 or ((share > 0) & (share < GOOD_SHARE)).any():
        return []
    missing: list[int] = np.flatnonzero(share == 0).tolist()
    return missing


def _plausible(found: Identification) -> bool:
    return found.explained >= 0.85 and found.found >= 0.85 and found.rms_px < 4.0


def _convincing(found: Identification) -> bool:
    return (
        found.explained >= GOOD_SHARE
        and found.found >= GOOD_SHARE
        and found.rms_px < GOOD_RMS_PX
        and bool((found.index >= 0).any())
    )


def _flipped(detections: Sequence[Detections], axis: int) -> list[Detections]:
    out = []
    for d in detections:
        centers = d.centers.copy()
        size = d.shape[1] if axis == 0 else d.shape[0]
        centers[:, axis] = size - 1 - centers[:, axis]
        out.append(replace(d, centers=centers))
    return out


def _alternative(
    found: Identification | None,
    detections: Sequence[Detections],
    model: BeadModel,
    poses: Poses,
    search: Search,
) -> tuple[str, str] | None:
    """The first mistake under which phantom and spots agree."""
    n = len(poses)
    trials: list[tuple[str, str, BeadModel, Poses, Sequence[Detections]]] = []
    if n > 1:
        for factor, text in (
            (n / (n - 1), f"the frames turn by 360 / {n - 1}, not 360 / {n} (endpoint error)"),
            ((n - 1) / n, f"the frames turn by 360 / {n}, not 360 / {n - 1} (endpoint error)"),
        ):
            turned = replace(poses, angle=poses.angle[0] + factor * (poses.angle - poses.angle[0]))
            trials.append(
                ("angle_endpoint", f"the angles are off by a factor {factor:.5f}: {text}",
                 model, turned, detections)
            )  # fmt: skip
    trials += [
        ("mirrored_phantom", "the phantom is the mirror image of its model", model.mirrored(),
         poses, detections),
        ("angle_reversed", "the stage turns the other way than the angles say", model,
         replace(poses, angle=-poses.angle), detections),
        ("image_mirrored", "the images are mirrored left to right", model, poses,
         _flipped(detections, 0)),
        ("image_upside_down", "the images are upside down", model, poses, _flipped(detections, 1)),
        ("not_turning", "the object does not turn although the angles say so", model,
         replace(poses, angle=np.zeros(n)), detections),
    ]  # fmt: skip
    best: tuple[float, str, str] | None = None
    for code, text, beads, geometry, shadows in trials:
        try:
            other = identify(shadows, beads, geometry, search=search)
        except TwinError:
            continue
        better = (
            found is None
            or other.rms_px < 0.3 * found.rms_px
            or (other.explained > found.explained + 0.2)
        )
        if _convincing(other) and better and (best is None or other.rms_px < best[0]):
            best = (other.rms_px, code, text)
    return _half_right(detections, model, poses, search) if best is None else best[1:]


def _half_right(
    detections: Sequence[Detections], model: BeadModel, poses: Poses, search: Search
) -> tuple[str, str] | None:
    """Whether the first or the last frames by themselves are those of the phantom."""
    n = len(poses)
    for part in (slice(0, n // 2), slice(n - n // 2, n)):
        try:
            half = identify(detections[part], model, poses[part], search=search)
        except TwinError:
            continue
        if _convincing(half):
            return "frame_numbers", (
                f"frames {part.start} to {part.stop - 1} by themselves fit the phantom, all of "
                "them do not: frames are missing, or their numbers or angles are wrong"
            )
    return None
