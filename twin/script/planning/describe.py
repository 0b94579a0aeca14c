"""One readable line for each command, for reports and progress."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

from flexdt.twin.script import commands as c
from flexdt.twin.script.grammar import shorten
from flexdt.twin.script.planning.image_names import bare_name

_WAITS: Final[Mapping[c.Wait, str]] = {
    c.Wait.NO_WAIT: ", goes on at once",
    c.Wait.RCV: ", goes on when received",
}


def _move(k: c.MoveAbsolute) -> str:
    until = f", goes on at {k.trigger:g}" if k.wait is c.Wait.POS and k.trigger is not None else ""
    return f"{k.component} to {k.target:.10g}{until}"


_TEXT: Final[Mapping[type[c.Command], Callable[[Any], str]]] = {
    c.Pause: lambda k: f"pause {k.duration_ms / 1000:g} s",
    c.SetOutputPath: lambda k: f"output path {shorten(k.path)} (the twin chooses the folder)",
    c.SetSampleInfo: lambda k: "sample info",
    c.KeepXrayOn: lambda k: f"keep X-rays on: {'yes' if k.keep else 'no'}",
    c.WriteSettingsFile: lambda k: "write settings file",
    c.XrayOn: lambda k: "X-rays on",
    c.XrayOff: lambda k: "X-rays off",
    c.SetVoltage: lambda k: f"tube voltage {k.kV:g} kV",
    c.SetPower: lambda k: f"tube power {k.power_W:g} W",
    c.WaitXrayReady: lambda k: "wait until X-rays are ready",
    c.SetMode: lambda k: f"camera mode {shorten(k.mode)}",
    c.SetExposure: lambda k: f"exposure {k.exposure_ms:g} ms",
    c.SetFrames: lambda k: f"number of frames {k.frames}",
    c.SetAverages: lambda k: f"number of averages {k.averages}",
    c.SetRoi: lambda k: f"ROI {k.roi}",
    c.TakeImage: lambda k: "take image",
    c.SaveImage: lambda k: f"save image {bare_name(k.path)}",
    c.TakeSequence: lambda k: f"take and save sequence {bare_name(k.prefix)}",
    c.MoveAbsolute: _move,
    c.SetSpeed: lambda k: f"{k.component} speed {k.speed:.10g}",
    c.SetAcceleration: lambda k: f"{k.component} acceleration {k.acceleration:.10g}",
    c.Custom: lambda k: shorten(" ".join((k.component, *k.words))),
}


def describe(command: c.Command) -> str:
    """What `command` asks for."""
    return _TEXT[type(command)](command) + _WAITS.get(command.wait, "")
