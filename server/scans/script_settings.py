"""What a script's commands set on the scanner, one case for each type that sets something.

Moves and images are the plan's business and have no effect here.
"""

from __future__ import annotations

from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.script import commands as c


def apply_command(scanner: ScannerTwin, command: c.Command, now: float) -> None:
    """Set what `command` sets at `now`; the plan has checked that it may.

    Raises:
        SafetyError: X-rays on during an E-stop.
    """
    match command:
        case c.XrayOn():
            scanner.set_tube(on=True, now=now, warm=True)
        case c.XrayOff():
            scanner.set_tube(on=False, now=now)
        case c.SetVoltage(kV=kV):
            scanner.set_tube(kV=kV)
        case c.SetPower(power_W=power):
            scanner.set_tube(power_W=power)
        case c.SetMode(mode=mode):
            scanner.set_camera(mode=mode)
        case c.SetExposure(exposure_ms=exposure):
            scanner.set_camera(exposure_ms=exposure)
        case c.SetFrames(frames=frames):
            scanner.set_camera(frames=frames)
        case c.SetAverages(averages=averages):
            scanner.set_camera(averages=averages)
        case c.SetRoi(roi=roi):
            scanner.set_camera(roi=roi)
        case c.SetSpeed(component=axis, speed=speed) if _known(scanner, axis):
            scanner.set_axis(axis, speed=_allowed(scanner, axis, speed, "max_speed"))
        case c.SetAcceleration(component=axis, acceleration=rate) if _known(scanner, axis):
            scanner.set_axis(axis, acceleration=_allowed(scanner, axis, rate, "max_acceleration"))
        case _:
            pass


def _known(scanner: ScannerTwin, axis: str) -> bool:
    return scanner.machine.has(axis)


def _allowed(scanner: ScannerTwin, axis: str, value: float, limit: str) -> float:
    """A rate above the limit is clamped, as the plan did (it has warned, or refused the script)."""
    moves = scanner.machine.moves(axis)
    limits = [getattr(scanner.machine.axes[m], limit) / abs(f) for m, f in moves.items()]
    return min([value, *map(float, limits)])
