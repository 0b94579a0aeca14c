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
        case c.TubeSetting():
            scanner.set_tube(**command.arguments)
        case c.CameraSetting():
            scanner.set_camera(**command.arguments)
        case c.MotorCommand(component=axis) if not scanner.machine.has(axis):
            pass  # a component of somebody else's
        case c.SetSpeed(component=axis, speed=speed):
            scanner.set_axis(axis, speed=_allowed(scanner, axis, speed, "max_speed"))
        case c.SetAcceleration(component=axis, acceleration=rate):
            scanner.set_axis(axis, acceleration=_allowed(scanner, axis, rate, "max_acceleration"))


def _allowed(scanner: ScannerTwin, axis: str, value: float, limit: str) -> float:
    """A rate above the limit is clamped, as the plan did (it has warned, or refused the script)."""
    moves = scanner.machine.moves(axis)
    limits = [getattr(scanner.machine.axes[m], limit) / abs(f) for m, f in moves.items()]
    return min([value, *map(float, limits)])
