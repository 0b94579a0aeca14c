"""The scanner's part of a twin server's state: `Scene` of `document_messages`.

It is the document of scene.*; it is validated completely before any of it is applied.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from flexdt.protocol.methods import document_messages as p
from flexdt.protocol.rpc_errors import invalid_params, problem
from flexdt.twin.machine.camera import Roi
from flexdt.twin.machine.kinematics import resolve_targets
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.state import NamedCorrection, Sample, StagePlacement


def save_scene(
    scanner: ScannerTwin,
    now: float,
    *,
    name: str = "",
    saved: str = "",
    version: str = "",
) -> p.Scene:
    """Convert the scanner to a scene: motors' targets, rates of all axes, tube, camera,
    sample with offset, correction (or None).

    Args:
        scanner: whose state is saved.
        now: twin time [s].
        name: of the scene.
        saved: moment, ISO 8601.
        version: of flexdt.
    """
    return p.Scene(
        schema=1,
        flexdt=version,
        name=name,
        saved=saved,
        machine=scanner.machine.name,
        profile=scanner.profile.name,
        positions=scanner.targets(now),
        speeds={axis: pace[0] for axis, pace in scanner.paces.items()},
        accelerations={axis: pace[1] for axis, pace in scanner.paces.items()},
        tube=p.TubePart(
            kV=scanner.tube.kV, power_W=scanner.tube.power_W, on=scanner.tube.on
        ),
        camera=p.CameraPart(**scanner.camera.stated),
        sample=p.SamplePart(
            name=scanner.sample.name,
            material=scanner.sample.material,
            offset=p.Placement(**asdict(scanner.sample.offset)),
        ),
        correction=None
        if scanner.correction is None
        else p.CorrectionPart(**correction_fields(scanner.correction)),
    )


def correction_fields(correction: NamedCorrection) -> dict[str, Any]:
    """Convert a correction to the names of the wire: name, date, parameters (mm, deg), comment
    and whether its sides are known."""
    return {
        "name": correction.name,
        "date": correction.date,
        "parameters": correction.parameters.to_edge(),
        "comment": correction.note,
        "sides_known": correction.sides_known,
    }


def correction_of(part: p.CorrectionPart) -> NamedCorrection:
    """Make the correction of a document.

    Raises:
        UnknownNameError: a name that is not a parameter.
    """
    return NamedCorrection.from_edge(
        part.name,
        part.date,
        part.parameters,
        part.comment,
        sides_known=part.sides_known,
    )


def require_fit(scene: p.Scene, scanner: ScannerTwin) -> None:
    """Check that a scene is of this machine, then its positions, settings and correction; the
    scanner is not changed.

    Settings are tried on a new scanner of that machine. Collisions are not looked for.

    `scene`: document; `scanner`: that is to have it.
    Raises RpcError: -32602, another machine's; UnknownNameError, LimitError: an axis, position
    or setting this scanner does not have; GeometryError: a correction that no scanner can have.
    """
    if scene.machine != scanner.machine.name:
        raise invalid_params(
            f"the scene is of machine {scene.machine!r}, this is {scanner.machine.name!r}",
            [problem("machine", "another machine", scene.machine)],
            scanner.machine.name,
        )
    resolve_targets(scanner.machine, scene.positions, scene.positions)
    trial = ScannerTwin(scanner.machine, scanner.profile)
    apply_settings(scene, trial)
    if scene.correction is not None:
        trial.require_applicable(correction_of(scene.correction))


def paces_of(scene: p.Scene, scanner: ScannerTwin) -> dict[str, tuple[float, float]]:
    """Return each axis of the scanner -> (speed, acceleration) [mm/s, mm/s^2; deg/s,
    deg/s^2]: the scene's where it has them, else the scanner's.
    """
    return {
        axis: (scene.speeds.get(axis, speed), scene.accelerations.get(axis, acceleration))
        for axis, (speed, acceleration) in scanner.paces.items()
    }


def apply_settings(scene: p.Scene, scanner: ScannerTwin) -> None:
    """Set rates of the axes, then tube voltage and power, then camera as in the scene; X-rays
    and motors stay as they are.

    Settings made before an error stay.

    Raises LimitError, UnknownNameError: a setting or an axis that this scanner does not have.
    """
    for axis, speed in scene.speeds.items():
        scanner.set_axis(axis, speed=speed)
    for axis, acceleration in scene.accelerations.items():
        scanner.set_axis(axis, acceleration=acceleration)
    scanner.set_tube(kV=scene.tube.kV, power_W=scene.tube.power_W)
    camera = scene.camera.model_dump()
    scanner.set_camera(**camera | {"roi": Roi(*scene.camera.roi)})


def sample_of(scene: p.Scene) -> Sample:
    """Return the scene's sample: its name, offset on the stage, and material."""
    return Sample(
        scene.sample.name,
        StagePlacement(**scene.sample.offset.model_dump()),
        scene.sample.material,
    )
