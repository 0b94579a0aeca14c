"""A scan's record as one frozen value: everything the files of a data set are made from.

All geometry in it is nominal (motors and profile); the correction in force stands beside it, and
the hidden misalignment is nowhere in it. Dates are arguments.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import ClassVar, Literal

import numpy as np
from pydantic import ConfigDict

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.scanner.state import NamedCorrection
from flexdt.twin.script import SampleSize, ScanPlan
from flexdt.twin.script.plan import saved_images
from flexdt.twin.values import ArrayValue

SAME = 1e-4
"""Positions this close are one place [mm, deg]: the texts carry six decimals."""

FINITE = ConfigDict(allow_inf_nan=False)
"""In flexdt.json, where pydantic reads these values, numbers are finite."""
FrameKind = Literal["dark", "flat", "projection"]


@dataclass(frozen=True)
class SampleRecord:
    """The sample's description for the texts; empty where unknown."""

    __pydantic_config__: ClassVar = FINITE

    name: str = ""
    owner: str = ""
    project: str = ""
    comment: str = ""
    diameter_mm: float = 0.0
    height_mm: float = 0.0


@dataclass(frozen=True)
class NoiseRecord:
    """How counts came about: seed None means no noise was added.

    Attributes:
        seed: frame i's generator is np.random.default_rng([seed, i]).
        model: the detector's figures by name.
    """

    __pydantic_config__: ClassVar = FINITE

    seed: int | None = None
    model: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, repr=False)
class FrameBlock(ArrayValue):
    """Saved images of one kind and one camera setting, in the order taken.

    Attributes:
        kind: dark, flat or projection.
        files: n bare file names.
        times_s: (n,) nominal moments on the scan's clock [s].
        camera: settings in force; its averages make one image.
        positions: axis -> (n,) motor positions [mm, deg], script's sign.
        xrays_on: whether the tube was on.
    """

    kind: FrameKind
    files: tuple[str, ...]
    times_s: FloatArray
    camera: CameraSettings
    positions: Mapping[str, FloatArray]
    xrays_on: bool = True

    def __len__(self) -> int:
        return len(self.files)

    def __repr__(self) -> str:
        span = f", {self.files[0]} to {self.files[-1]}" if self.files else ""
        return f"<FrameBlock: {len(self)} {self.kind} images{span}>"


@dataclass(frozen=True, eq=False, repr=False)
class ScanRecord(ArrayValue):
    """One scan.

    Attributes:
        name: of the data set.
        machine: the scanner.
        profile: zero offsets in force.
        camera: settings of the projections.
        kV, power_W: tube settings of the projections.
        positions: axis -> value when the settings file was written [mm, deg], script's sign.
        speeds, accelerations: axis -> value at that moment.
        blocks: all saved images, in the order taken, done or not.
        smooth: whether the projections were taken in motion.
        started: date of the scan's beginning.
        duration_s: of the scan so far, on the twin's clock.
        complete: whether every image was taken.
        reason: why not, for people.
        sample, noise, correction: see their types.
        operator: who submitted it.
        flat_axis: the motor that took the sample out of the beam, "" if none.
        version: of the software.
    """

    name: str
    machine: Machine
    profile: Profile
    camera: CameraSettings
    kV: float
    power_W: float
    positions: Mapping[str, float]
    speeds: Mapping[str, float]
    accelerations: Mapping[str, float]
    blocks: tuple[FrameBlock, ...]
    smooth: bool
    started: datetime
    duration_s: float
    complete: bool = False
    reason: str = ""
    sample: SampleRecord = field(default_factory=SampleRecord)
    noise: NoiseRecord = field(default_factory=NoiseRecord)
    correction: NamedCorrection | None = None
    operator: str = ""
    flat_axis: str = ""
    version: str = ""

    def __repr__(self) -> str:
        return (
            f"<ScanRecord {self.name!r} on {self.machine.name}: {len(self.files)} images, "
            f"{self.started:%Y-%m-%d %H:%M}, {'complete' if self.complete else 'incomplete'}>"
        )

    @classmethod
    def from_plan(
        cls,
        plan: ScanPlan,
        *,
        name: str,
        started: datetime,
        sample: SampleRecord | None = None,
        noise: NoiseRecord | None = None,
        correction: NamedCorrection | None = None,
        operator: str = "",
        version: str = "",
    ) -> ScanRecord:
        """The record of a plan that is about to run; `complete` is False.

        Settings are those at `write settings file`, or, for a script without that command, those
        at the first projection.
        """
        blocks = tuple(_blocks(plan))
        first = next((g for g in plan.groups if g.kind == "projection" and g.files), None)
        shown = plan.start if plan.settings is None else plan.settings
        positions = shown.positions
        if plan.settings is None:
            at = first.starts[0] if first is not None else 0.0
            positions = {n: float(v) for n, v in plan.positions(at).items()}
        lit = shown if first is None else first
        if sample is None:
            size = plan.sample or SampleSize(0.0)
            sample = SampleRecord(diameter_mm=size.diameter_mm, height_mm=size.height_mm)
        return cls(
            name=name,
            machine=plan.machine,
            profile=plan.profile,
            camera=lit.camera,
            kV=lit.kV,
            power_W=lit.power_W,
            positions=dict(positions),
            speeds=dict(shown.speeds),
            accelerations=dict(shown.accelerations),
            blocks=blocks,
            smooth=any(g.moving for g in plan.groups if g.kind == "projection" and g.files),
            started=started,
            duration_s=plan.duration_s,
            sample=sample,
            noise=noise if noise is not None else NoiseRecord(),
            correction=correction,
            operator=operator,
            flat_axis=_flat_axis(plan.machine, blocks),
            version=version,
        )

    @property
    def stopped(self) -> datetime:
        """Date of the scan's end so far."""
        return self.started + timedelta(seconds=self.duration_s)

    @property
    def projections(self) -> tuple[FrameBlock, ...]:
        """Blocks of projections."""
        return tuple(b for b in self.blocks if b.kind == "projection")

    @property
    def files(self) -> tuple[str, ...]:
        """Names of all images, in the order taken."""
        return tuple(f for b in self.blocks for f in b.files)

    def count(self, kind: FrameKind) -> int:
        """Number of saved images of a kind."""
        return sum(len(b) for b in self.blocks if b.kind == kind)

    def poses_of(self, block: FrameBlock) -> Poses:
        """Nominal poses of a block's images."""
        return motor_poses(self.machine, self.profile, block.camera, block.positions)

    def cone_vec(self, blocks: Iterable[FrameBlock] | None = None) -> ConeVec:
        """Nominal geometry of all images, or of some blocks'."""
        chosen = self.blocks if blocks is None else tuple(blocks)
        return ConeVec.concatenate([self.poses_of(b).cone_vec() for b in chosen if len(b)])

    def angles_deg(self) -> FloatArray:
        """Stage angle of every projection [deg], accumulated."""
        parts = [np.degrees(self.poses_of(b).angle) for b in self.projections if len(b)]
        return np.concatenate(parts) if parts else np.zeros(0)

    def sections(self) -> int:
        """How many stretches of projections the texts' one pose and one angle rule cannot join.

        1 means that the texts alone give the geometry: all motors but the turning one stand where
        the settings file says, and image i of N lies at first + i * (last - first) / (N - 1).
        """
        blocks = [b for b in self.projections if len(b)]
        if not blocks:
            return 1
        turning = self.machine.geometry.get("angle", {})
        still = {
            n: np.concatenate([b.positions[n] for b in blocks])
            for n in self.machine.axes
            if n not in turning
        }
        angles = self.angles_deg()
        rule = np.linspace(angles[0], angles[-1], len(angles))
        if np.abs(angles - rule).max() < SAME and all(
            np.abs(v - self.positions[n]).max() < SAME for n, v in still.items()
        ):
            return 1
        steps = np.zeros(len(angles) - 1, dtype=bool)
        for values in still.values():
            steps |= np.abs(np.diff(values)) > SAME
        return max(2, 1 + int(np.count_nonzero(steps)))

    def settings_pose(self) -> Poses:
        """Nominal pose at the moment of the settings file, n = 1."""
        return motor_poses(self.machine, self.profile, self.camera, self.positions)


def _blocks(plan: ScanPlan) -> Iterable[FrameBlock]:
    for group, positions in saved_images(plan):
        if group.kind != "preview":
            yield FrameBlock(
                group.kind, group.files, group.starts, group.camera, positions, group.xrays_on
            )


def _flat_axis(machine: Machine, blocks: Sequence[FrameBlock]) -> str:
    """The linear motor that stands farthest from the projections' place during the flats."""
    flats = next((b for b in blocks if b.kind == "flat"), None)
    scans = next((b for b in blocks if b.kind == "projection"), None)
    if flats is None or scans is None:
        return ""
    moved = {
        n: abs(float(flats.positions[n][0] - scans.positions[n][0]))
        for n in flats.positions
        if n not in machine.geometry["angle"]
    }
    best = max(moved, key=lambda n: moved[n], default="")
    return best if best and moved[best] > 1.0 else ""
