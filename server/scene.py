"""The whole state as one versioned document, and back.

`Scene` is what `scene.save` hands out: motors, their settings, tube, camera, sample, correction. It
is validated whole before anything of it is applied. It refuses to hold the hidden misalignment.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from flexdt.protocol.errors import invalid_params
from flexdt.twin.camera import Roi
from flexdt.twin.kinematics import resolve_targets
from flexdt.twin.parameters import Parameters
from flexdt.twin.scanner import ScannerTwin
from flexdt.twin.state import Correction, Offset, Sample

Number = Annotated[float, Field(allow_inf_nan=False)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class TubePart(_Part):
    """Tube settings; `on` is kept for the record and never switched by loading."""

    kV: float
    power_W: float
    on: bool = False


class CameraPart(_Part):
    """Camera settings."""

    mode: str
    roi: tuple[int, int, int, int]
    exposure_ms: float
    averages: int
    frames: int


class OffsetPart(_Part):
    """Placement of the sample [mm, deg]."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    rx: float = 0.0
    ry: float = 0.0
    rz: float = 0.0


class SamplePart(_Part):
    """What stood on the stage."""

    name: str
    material: str | None = None
    offset: OffsetPart = Field(default_factory=lambda: OffsetPart())


class CorrectionPart(_Part):
    """The correction in force; parameters in mm and deg."""

    name: str
    date: str
    parameters: dict[str, Number]
    comment: str = ""


class Scene(_Part):
    """The document."""

    schema_version: Literal[1] = Field(alias="schema")
    flexdt: str = ""
    name: str = ""
    saved: str = ""
    machine: str
    profile: str
    positions: dict[str, Number]
    speeds: dict[str, Number] = Field(default_factory=dict)
    accelerations: dict[str, Number] = Field(default_factory=dict)
    tube: TubePart
    camera: CameraPart
    sample: SamplePart
    correction: CorrectionPart | None = None

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, populate_by_name=True
    )


def save_scene(
    scanner: ScannerTwin, now: float, *, name: str = "", saved: str = "", version: str = ""
) -> Scene:
    """The scanner as a document; a motor under way is saved where it is bound."""
    camera, correction = scanner.camera, scanner.correction
    paces = {axis: scanner.settings(axis) for axis in scanner.machine.axes}
    r = camera.roi
    return Scene(
        schema=1,
        flexdt=version,
        name=name,
        saved=saved,
        machine=scanner.machine.name,
        profile=scanner.profile.name,
        positions=scanner.targets(now),
        speeds={axis: pace[0] for axis, pace in paces.items()},
        accelerations={axis: pace[1] for axis, pace in paces.items()},
        tube=TubePart(kV=scanner.tube.kV, power_W=scanner.tube.power_W, on=scanner.tube.on),
        camera=CameraPart(
            mode=camera.mode,
            roi=(r.left, r.top, r.right, r.bottom),
            exposure_ms=camera.exposure_ms,
            averages=camera.averages,
            frames=camera.frames,
        ),
        sample=SamplePart(
            name=scanner.sample.name,
            material=scanner.sample.material,
            offset=OffsetPart(**asdict(scanner.sample.offset)),
        ),
        correction=None
        if correction is None
        else CorrectionPart(
            name=correction.name,
            date=correction.date,
            parameters=correction.parameters.to_edge(),
            comment=correction.note,
        ),
    )


def parse_scene(document: object, scanner: ScannerTwin) -> Scene:
    """A document as a scene that this scanner can take.

    Raises:
        RpcError: -32602, not a scene, another version, or another machine's.
        UnknownNameError, LimitError: an axis, position or setting this scanner does not have.
        GeometryError: a correction that no scanner can have.
    """
    try:
        scene = Scene.model_validate(document)
    except ValidationError as error:
        problems = [
            {
                "path": ".".join(map(str, e["loc"])),
                "message": e["msg"],
                "asked": repr(e["input"])[:80],
            }
            for e in error.errors(include_url=False)[:20]
        ]
        first = problems[0]
        raise invalid_params(
            f"not a scene: {first['path']}: {first['message']}", problems
        ) from None
    if scene.machine != scanner.machine.name:
        raise invalid_params(
            f"the scene is of machine {scene.machine!r}, this is {scanner.machine.name!r}",
            [{"path": "machine", "message": "another machine", "asked": scene.machine}],
            scanner.machine.name,
        )
    resolve_targets(scanner.machine, scene.positions, scene.positions)
    trial = ScannerTwin(scanner.machine, scanner.profile)
    apply_settings(scene, trial)
    if scene.correction is not None:
        c = scene.correction
        trial.apply(Correction(c.name, c.date, Parameters.from_edge(c.parameters), c.comment))
    return scene


def apply_settings(scene: Scene, scanner: ScannerTwin) -> None:
    """Set tube, camera and paces as in the scene; X-rays are not switched."""
    for axis, speed in scene.speeds.items():
        scanner.set_axis(axis, speed=speed)
    for axis, acceleration in scene.accelerations.items():
        scanner.set_axis(axis, acceleration=acceleration)
    scanner.set_tube(kV=scene.tube.kV, power_W=scene.tube.power_W)
    scanner.set_camera(
        exposure_ms=scene.camera.exposure_ms,
        mode=scene.camera.mode,
        roi=Roi(*scene.camera.roi),
        averages=scene.camera.averages,
        frames=scene.camera.frames,
    )


def sample_of(scene: Scene) -> Sample:
    """The scene's sample."""
    return Sample(
        scene.sample.name, Offset(**scene.sample.offset.model_dump()), scene.sample.material
    )
