"""What the gateway's commands mean, without a socket."""

from __future__ import annotations

import pytest

from flexdt.clients.gateway.actions import ACTIONS
from flexdt.clients.gateway.event_server import (
    bind_endpoint,
    check_loopback,
    transcript_line,
)
from flexdt.clients.gateway.vocabulary import (
    Question,
    Refusal,
    component_type,
    known_commands,
    read_command,
)
from flexdt.protocol.acquila import AcquilaEvent
from flexdt.runtime.access import AccessError
from flexdt.twin.machine.description import builtin_machine, builtin_machines
from flexdt.twin.script import commands as c
from flexdt.twin.script import grammar, parse_script

AXES = (*builtin_machine().axes, *builtin_machine().virtual_axes)


def read(component: str, command: str, arg1: str = "", arg2: str = "") -> c.Command:
    return read_command(AcquilaEvent(component, command, arg1, arg2), AXES)


def test_commands_are_the_scripts_own() -> None:
    assert read("tube", "set kV", "90") == c.SetVoltage(kV=90.0)
    assert read("CAMERA", "set  roi".replace("  ", " "), "32 8 1943 1527") == c.SetRoi(
        roi=grammar.Roi(32, 8, 1943, 1527)
    )
    move = read("ROT_OBJ", "move absolute", "360.5", "0.0")
    assert move == c.MoveAbsolute(component="rot_obj", target=360.5, trigger=0.0)
    assert read("mag_obj", "status_position_get") == Question(
        path=("axes", "mag_obj", "position")
    )


def test_names_of_axes_are_the_machines_own_in_any_case() -> None:
    for machine in map(builtin_machine, builtin_machines()):
        axes = (*machine.axes, *machine.virtual_axes)
        for name in axes:
            for asked in (name, name.upper(), name.lower()):
                assert component_type(asked, axes) == "motor"
                made = read_command(AcquilaEvent(asked, "move absolute", "10"), axes)
                assert made == c.MoveAbsolute(component=name, target=10.0)
                made = read_command(AcquilaEvent(asked, "status_position_get"), axes)
                assert made == Question(path=("axes", name, "position"))


@pytest.mark.parametrize(
    ("event", "says"),
    [
        (("tube", "explode"), "knows: xrayon, xrayoff, set kV"),
        (
            ("tra_sky", "move absolute", "1"),
            "the twin has: tube, camera, scanner, ver_tube",
        ),
        (("tube", "set kV", "ninety"), "kV must be a number"),
        (("tube", "xrayon", "1"), "takes no argument"),
        (("camera", "set number of frames", "0"), "from 1 to"),
        (("scanner", "run script", " "), "it knows: "),
        (("mag_obj", "move absolute", "1e400"), "number"),
    ],
)
def test_what_is_refused_says_what_is_allowed(event: tuple[str, ...], says: str) -> None:
    with pytest.raises(Refusal, match=says):
        read(*event)


def test_every_command_of_the_grammar_has_an_action() -> None:
    for component in (*grammar.FIXED, "rot_obj"):
        for command in grammar.vocabulary(component):
            spec = grammar.find(component, command)
            assert spec is not None
            assert spec.type in ACTIONS, command


def test_every_command_that_is_told_of_can_be_read() -> None:
    arguments = {"set kV": "80", "set power": "40", "set mode": "HW1SW1High", "set ROI": "0 0 9 9",
                 "keep xrayon": "TRUE"}  # fmt: skip
    for component in (*grammar.FIXED, "rot_obj"):
        for command in known_commands(component):
            argument = arguments.get(command, "5")
            try:
                made = read(component, command, argument)
            except Refusal:
                made = read(component, command)
            assert type(made) in ACTIONS, command


@pytest.mark.parametrize(
    ("name", "kind"),
    [("tube", "tube"), ("Camera", "camera"), ("scanner", "other"), ("rot_obj", "motor"),
     ("tra_unheard_of", "motor"), ("SC", "other"), ("heater", None)],
)  # fmt: skip
def test_reserved_names_are_the_scanners(name: str, kind: str | None) -> None:
    assert component_type(name, AXES) == kind


def test_the_transcript_is_a_script() -> None:
    asked = [("tube", "set kV", "90", ""), ("rot_obj", "move absolute", "360", "0"),
             ("camera", "take and save image sequence", "E:\\x\\scan_", "0"),
             ("scanner", "set output path", "E:\\a\tb", "")]  # fmt: skip
    lines = [transcript_line(AcquilaEvent(*words), read(*words)) for words in asked]
    assert None not in lines
    script = parse_script("\r\n".join(map(str, lines)))
    assert [type(command) for command in script.commands] == [
        c.SetVoltage, c.MoveAbsolute, c.TakeSequence, c.SetOutputPath,
    ]  # fmt: skip
    assert script.commands[1].wait is c.Wait.POS
    assert (
        transcript_line(AcquilaEvent("rot_obj", "stop"), read("rot_obj", "stop")) is None
    )


def test_only_this_machine_may_connect() -> None:
    for host in ("127.0.0.1", "::1", "localhost"):
        check_loopback(host)
    for host in ("0.0.0.0", "::", "192.168.1.7", "lab.example"):
        with pytest.raises(AccessError, match="SSH"):
            check_loopback(host)
    assert bind_endpoint("::1", 0) == "tcp://[::1]:*"
    assert bind_endpoint("localhost", 50000) == "tcp://127.0.0.1:50000"
