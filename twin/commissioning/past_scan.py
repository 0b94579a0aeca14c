"""A past scan as its folder tells it: texts, executed script and images, each where it is there."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, NamedTuple

from flexdt.twin.calibration.without_phantom.align import Alignment
from flexdt.twin.dataset.rebuild import MATCH_MM, physical, rebuild
from flexdt.twin.dataset.scan_settings import ScanSettings, figures_of
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.machine.description import ZERO, Machine, Profile
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.script import commands as c
from flexdt.twin.script.executed_log import Executed
from flexdt.twin.script.grammar import own_name


class Finding(NamedTuple):
    """A contradiction: between whom, and in words."""

    about: str
    between: str
    text: str


class Question(NamedTuple):
    """What could not be judged, why, and the kind of scan that would settle it ("": none)."""

    what: str
    why: str
    settled_by: str = ""


@dataclass(frozen=True)
class PastScan:
    """One scan.

    Attributes:
        name: of its folder.
        date: when it started.
        settings, second: what `scan settings.txt` and `data settings XRE.txt` say.
        commands: its script, from the log where there is one.
        log: the lines of the executed script.
        images: number of projections; `shape` is the (rows, cols) of the first.
        aligned: what its projections tell of the geometry.
    """

    name: str
    date: datetime | None = None
    settings: ScanSettings | None = None
    second: ScanSettings | None = None
    commands: tuple[c.Command, ...] = ()
    log: tuple[Executed, ...] = ()
    images: int = 0
    shape: tuple[int, int] | None = None
    aligned: Alignment | None = None


@dataclass(frozen=True)
class Stand:
    """How the machine stood in a scan by its texts.

    Attributes:
        positions: motor -> (1,) in the script's sign [mm, deg].
        camera: mode and region.
        profile: the zero offsets behind the printed figures; those of `usual` where there are none.
        stated: whether there are figures.
        notes: what reading the texts decided.
    """

    positions: Mapping[str, FloatArray]
    camera: CameraSettings
    profile: Profile
    stated: bool
    notes: tuple[str, ...] = field(default=())


def stand(scan: PastScan, machine: Machine, usual: Profile) -> Stand | None:
    """How the machine stood; None where the texts do not state motors, mode and region.

    Raises:
        TwinError: the texts contradict themselves.
    """
    s, moved = (None, []) if scan.settings is None else physical(scan.settings, scan.name)
    if s is None or s.roi is None or s.mode is None or not set(s.motors) & set(machine.axes):
        return None
    camera = CameraSettings(s.mode, s.roi, modes=machine.detector.camera.modes)
    zero = Profile(name=ZERO, machine=machine.name, source="figures of the settings text")
    built = rebuild(s, 1, camera.shape, [machine], [zero], file=scan.name)
    f, pose = s.figures, built.poses
    if f is None or not 0.0 < f.sod_mm < f.sdd_mm:
        return Stand(built.positions, camera, usual, False, (*moved, *built.notes))
    far = zero.model_copy(
        update={"c_obj": f.sod_mm - float(pose.sod[0]), "c_det": f.sdd_mm - float(pose.sdd[0])}
    )
    own = figures_of(motor_poses(machine, far, camera, built.positions), camera.shape)
    pixel = own.pixel_mm
    across = [(g.cor_px - g.hc_px) * pixel * g.sod_mm / g.sdd_mm for g in (f, own)]
    found = {
        "det_tan": (own.hc_px - f.hc_px) * pixel,
        "src_ort": (own.vc_px - f.vc_px) * pixel,
        "axs_tan": across[0] - across[1],
    }
    profile = far.model_copy(update=found)
    return Stand(built.positions, camera, profile, True, (*moved, *built.notes))


def scripted(commands: Iterable[c.Command], machine: Machine) -> dict[str, Any]:
    """What a script asks for: axis -> its target when the settings file is written, and the
    camera's and the tube's settings, by the names of `ScanSettings`, when the sequence begins."""
    now: dict[str, Any] = {}
    moved: dict[str, Any] = {}
    for k in commands:
        match k:
            case c.MoveAbsolute():
                now[own_name(k.component, machine.axes)] = k.target
            case c.CameraSetting() | c.TubeSetting():
                now |= k.arguments
            case c.WriteSettingsFile():
                moved = {name: value for name, value in now.items() if name in machine.axes}
            case c.TakeSequence():
                now["projections"] = now.pop("frames", None)
                return {n: v for n, v in now.items() if n not in machine.axes} | moved
    return moved


def near(a: object, b: object) -> bool:
    """Whether two values that texts state are the same, as close as texts carry them."""
    if isinstance(a, int | float) and isinstance(b, int | float):
        return abs(a - b) <= MATCH_MM
    return str(a).lower() == str(b).lower()
