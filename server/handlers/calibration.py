"""calibration.*: corrections put in force, listed, taken back."""

from __future__ import annotations

from collections.abc import Mapping

from flexdt.protocol import params as p
from flexdt.protocol import results as r
from flexdt.protocol import state as w
from flexdt.protocol.fields import Empty
from flexdt.server.core import TwinServer
from flexdt.server.handlers.table import Client, Handler
from flexdt.server.views import correction_view
from flexdt.twin.state import Correction


def apply(twin: TwinServer, client: Client, params: p.CalibrationApply) -> r.CorrectionResult:
    """A new correction in force, instead of the last."""
    correction = twin.corrections.make(params.parameters, params.name, params.comment)
    twin.scanner.apply(correction)
    twin.corrections.put_in_force(correction, params.source)
    return _in_force(twin, f"correction {correction.name!r} is in force")


def get(twin: TwinServer, client: Client, params: p.CalibrationGet) -> r.CorrectionResult:
    """The one in force, or the one named."""
    if params.name is None:
        return r.CorrectionResult(correction=_view(twin, twin.scanner.correction))
    return r.CorrectionResult(correction=_view(twin, twin.corrections.get(params.name)))


def list_all(twin: TwinServer, client: Client, params: Empty) -> r.CorrectionListResult:
    """All, oldest first."""
    current = twin.scanner.correction
    return r.CorrectionListResult(
        corrections=[v for c in twin.corrections.all() if (v := _view(twin, c)) is not None],
        current=None if current is None else current.name,
    )


def revert(twin: TwinServer, client: Client, params: Empty) -> r.CorrectionResult:
    """The one before, or none."""
    twin.scanner.apply(twin.corrections.revert())
    return _in_force(twin, "the correction was reverted")


def _in_force(twin: TwinServer, message: str) -> r.CorrectionResult:
    """What changes geometry may bring parts too close, now or later on the way: that is said."""
    twin.tell("info", message)
    warnings = twin.look_again()
    for warning in warnings:
        twin.tell("warning", f"{message}: {warning}")
    return r.CorrectionResult(correction=_view(twin, twin.scanner.correction), warnings=warnings)


def _view(twin: TwinServer, correction: Correction | None) -> w.Correction | None:
    source = None if correction is None else twin.corrections.source(correction.name)
    return correction_view(correction, source)


TABLE: Mapping[str, Handler] = {
    "calibration.apply": apply,
    "calibration.get": get,
    "calibration.list": list_all,
    "calibration.revert": revert,
}
