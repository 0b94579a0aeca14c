"""Both forms of scripts to typed commands; every error at once, with its place."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from flexdt.twin.machine.camera import Roi
from flexdt.twin.machine.description import builtin_machine, profile_of
from flexdt.twin.script import ScriptError, Wait, parse_script, plan_script, read_script
from flexdt.twin.script import commands as c
from flexdt.twin.script.grammar import shorten
from flexdt.twin.script.parse import FEW_PROBLEMS, line_count, rows
from tests.twin.script.conftest import blob, tabbed

LISTING_1 = Path(__file__).parents[3] / "examples/scripts/listing1.txt"


def one(text: str | bytes) -> c.Command:
    script, problems = read_script(text)
    assert problems == (), problems
    (command,) = script.commands
    return command


def codes(text: str | bytes) -> list[tuple[int, str]]:
    return [(p.line, p.code) for p in read_script(text)[1]]


EVERY_COMMAND = [
    (("scanner", "pause", "500.000000"), c.Pause, {"duration_ms": 500.0}),
    (("scanner", "set output path", "E:\\a b\\c"), c.SetOutputPath, {"path": "E:\\a b\\c"}),
    (("scanner", "keep xrayon", "TRUE"), c.KeepXrayOn, {"keep": True}),
    (("scanner", "keep xrayon", "FALSE"), c.KeepXrayOn, {"keep": False}),
    (("scanner", "write settings file"), c.WriteSettingsFile, {}),
    (("tube", "xrayon"), c.XrayOn, {}),
    (("tube", "xrayoff"), c.XrayOff, {}),
    (("tube", "set kV", "90.000000"), c.SetVoltage, {"kV": 90.0}),
    (("tube", "set power", "50.5"), c.SetPower, {"power_W": 50.5}),
    (("tube", "REPEAT UNTIL TRUE status_XReady_get"), c.WaitXrayReady, {}),
    (("camera", "set mode", "2_HW2SW1LOW"), c.SetMode, {"mode": "2_HW2SW1LOW"}),
    (("camera", "set exposure", "99.998199"), c.SetExposure, {"exposure_ms": 99.998199}),
    (("camera", "set number of frames", "1440"), c.SetFrames, {"frames": 1440}),
    (("camera", "set number of averages", "15"), c.SetAverages, {"averages": 15}),
    (("camera", "set ROI", "32 8 1943 1527"), c.SetRoi, {"roi": Roi(32, 8, 1943, 1527)}),
    (("camera", "take image"), c.TakeImage, {}),
    (("camera", "save image", "E:\\x y\\di000000.tif"), c.SaveImage,
     {"path": "E:\\x y\\di000000.tif"}),
    (("rot_obj", "move absolute", "-3.222728"), c.MoveAbsolute,
     {"component": "rot_obj", "target": -3.222728, "trigger": None}),
    (("ver_tube", "set speed", "45.0000000000"), c.SetSpeed,
     {"component": "ver_tube", "speed": 45.0}),
    (("mag_det", "set acceleration", "22.5"), c.SetAcceleration,
     {"component": "mag_det", "acceleration": 22.5}),
]  # fmt: skip


@pytest.mark.parametrize(("fields", "type_", "values"), EVERY_COMMAND)
def test_every_command_reads_alike_in_both_forms(
    fields: tuple[str, ...], type_: type[c.Command], values: dict[str, object]
) -> None:
    argument = fields[2] if len(fields) > 2 else ""
    from_tabs = one(tabbed(fields[0], fields[1], argument, "", "ACK", "2000", "150"))
    padded = "   ".join([fields[0], *fields[1].split(), argument]) + "   ACK 2000 150"
    from_spaces = one(padded)
    for command in (from_tabs, from_spaces):
        assert type(command) is type_
        assert command.wait is Wait.ACK
        assert (command.line, command.timeout_ms, command.expected_ms) == (
            1,
            2000.0,
            150.0,
        )
        for name, value in values.items():
            assert getattr(command, name) == value


def test_triggered_move_and_sequence_have_two_arguments() -> None:
    move = one(tabbed("rot_obj", "move absolute", "363.2", "0.000000", "POS"))
    assert move == c.MoveAbsolute(
        line=1, wait=Wait.POS, component="rot_obj", target=363.2, trigger=0.0
    )
    assert (
        one("rot_obj      move                absolute          363.2 0.000000  POS")
        == move
    )
    sequence = one(
        tabbed("camera", "take and save image sequence", "E:\\a b\\scan_", "7", "ACK")
    )
    assert sequence == c.TakeSequence(line=1, prefix="E:\\a b\\scan_", first=7)
    assert one("camera   take and save image sequence E:\\a b\\scan_ 7  ACK") == sequence


BLANKS = st.text(" \ufeff", max_size=3)


@settings(max_examples=100, deadline=None)
@given(
    st.sampled_from(EVERY_COMMAND), st.lists(BLANKS, min_size=16, max_size=16), st.data()
)
def test_a_problem_is_told_at_the_column_of_its_field(
    entry: tuple[tuple[str, ...], type[c.Command], dict[str, object]],
    blanks: list[str],
    data: st.DataObject,
) -> None:
    fields, type_, _ = entry
    cells = [*fields, *[""] * (4 - len(fields)), "ACK", "2000", "150", ""]
    takes = 2 if type_ is c.MoveAbsolute else len(fields) - 2
    taken = type_ in (c.SetOutputPath, c.SaveImage, c.SetMode)
    wrong = data.draw(st.sampled_from([i for i in range(1, 8) if i != 2 or not taken]))
    cells[wrong] = "odd"
    text = "\t".join(
        a + x + b for a, x, b in zip(blanks[:8], cells, blanks[8:], strict=True)
    )
    [problem, *_] = read_script("tube\txrayon\t\t\tACK\n\n" + text)[1]
    codes = ["", "unknown_command", "value", "value", "wait", "value", "value", "syntax"]
    expected = "syntax" if 1 < wrong < 4 and wrong - 1 > takes else codes[wrong]
    if type_ is c.SetRoi and wrong == 2:
        expected = "roi"
    assert (problem.line, problem.column, problem.code) == (
        3,
        text.index("odd") + 1,
        expected,
    )


def test_a_missing_component_is_told_at_the_first_column() -> None:
    [problem, *_] = read_script("\tmove absolute\t3\t\tACK")[1]
    assert (problem.line, problem.column, problem.code) == (1, 1, "syntax")


def test_a_command_may_be_split_over_columns() -> None:
    """Then the whole line is read by its words."""
    found = one(b"camera\tset\texposure\t40\tACK\t1\t2")
    assert found == c.SetExposure(
        line=1, exposure_ms=40.0, timeout_ms=1.0, expected_ms=2.0
    )


@settings(max_examples=100, deadline=None)
@given(
    st.binary(max_size=150) | st.lists(st.sampled_from([b"\t", b"ACK", b"\xff"])).map(b"".join),
    st.sampled_from([b"\r\n", b"\n"]), st.sampled_from([None, 1, 2]),
    st.integers(0, 3), st.integers(1, 3),
)  # fmt: skip
def test_what_follows_a_binary_argument_has_its_columns_too(
    data: bytes, end: bytes, wrong: int | None, blanks: int, columns: int
) -> None:
    assume(b"\n" not in data and b"\r" not in data)
    tail = [b"ACK", b"2000", b"150"]
    if wrong is not None:
        tail[wrong] = b" " * blanks + b"odd"
    else:
        del tail[columns:]
    line = b"\t".join([b"scanner", b"set sample info", data, b"", *tail])
    script, found = read_script(line + end + b"tube\txrayon\t\t\tACK" + end)
    assert (type(script.commands[-1]), script.commands[-1].line) == (c.XrayOn, 2)
    if wrong is None:
        bounds = (2000.0 if columns > 1 else None, 150.0 if columns > 2 else None)
        wanted = c.SetSampleInfo(
            line=1, data=data, timeout_ms=bounds[0], expected_ms=bounds[1]
        )
        assert (script.commands[0], found) == (wanted, ())
    else:
        behind = len(line) - line.rindex(b"odd")
        column = len(line.decode("utf-8", "surrogateescape")) - behind + 1
        assert [(p.line, p.column, p.code) for p in found] == [(1, column, "value")]


@pytest.mark.parametrize(
    ("command", "most"),
    [
        ("camera set number of frames", 1_000_000), ("camera set number of averages", 100_000),
        ("camera set ROI 0 0 1", 1_000_000), ("camera take and save image sequence scan_", 999_999),
        ("rot_obj move absolute", 1_000_000_000), ("scanner pause", 1_000_000_000),
    ],
)  # fmt: skip
def test_numbers_of_a_script_have_bounds(command: str, most: int) -> None:
    assert read_script(f"{command} {most} ACK")[1] == ()
    assert [p.code for p in read_script(f"{command} {most + 1} ACK")[1]] in (
        ["value"],
        ["roi"],
    )


@pytest.mark.parametrize("command", ["rot_obj set speed", "rot_obj set acceleration",
                                     "camera set exposure"])  # fmt: skip
def test_rates_are_above_zero(command: str) -> None:
    assert read_script(f"{command} 0.000000001 ACK")[1] == ()
    [problem] = read_script(f"{command} 0 ACK")[1]
    assert problem.message.endswith("it must be above 0")


def test_a_number_with_a_comma_is_told_how_it_is_written() -> None:
    [with_comma], [without] = (
        read_script(f"tube set kV {x} ACK")[1] for x in ("8,5", "8.5.1")
    )
    hint = "decimals are written with a point"
    assert (hint in with_comma.message, hint in without.message) == (True, False)


def test_a_free_argument_holds_spaces_without_tabs_too() -> None:
    info, path = parse_script(
        "scanner set sample info a b  c ACK\nscanner set output path E:\\a b ACK 5"
    ).commands
    assert info == c.SetSampleInfo(line=1, data=b"a b  c")
    assert path == c.SetOutputPath(line=2, path="E:\\a b", expected_ms=5.0)
    [missing] = read_script("rot_obj move absolute 1 POS")[1]
    assert missing.code == "trigger"


def test_text_of_two_bytes_a_character_is_told() -> None:
    text = "tube\txrayon\t\t\tACK"
    for data in (
        text.encode("utf-16"),
        text.encode("utf-16-le"),
        text.encode("utf-16-be"),
    ):
        [problem] = read_script(data)[1]
        assert (problem.line, problem.column) == (1, 1)
        assert "UTF-16" in problem.message
    for fine in (text.encode(), b"tub\0", text.encode("utf-8-sig"), "tübe"):
        assert not any("UTF-16" in p.message for p in read_script(fine)[1])


@pytest.mark.parametrize(
    ("word", "wait"),
    [
        ("ACK", Wait.ACK),
        ("no wait", Wait.NO_WAIT),
        ("RCV", Wait.RCV),
        ("No  Wait", Wait.NO_WAIT),
    ],
)
def test_waits(word: str, wait: Wait) -> None:
    assert one(tabbed("tra_obj", "move absolute", "5", "", word)).wait is wait
    assert one(f"tra_obj move absolute 5 {word}").wait is wait


def test_listing_1_as_typed_from_the_thesis() -> None:
    script = parse_script(LISTING_1.read_bytes())
    assert script.warnings == ()
    assert len(script.commands) == 24
    assert script.commands[0] == c.Pause(line=1, duration_ms=0.0, expected_ms=0.0)
    assert script.commands[15] == c.SaveImage(line=16, path="...\\di000000.tif")
    assert script.commands[21] == c.MoveAbsolute(
        line=22, wait=Wait.POS, component="rot_obj", target=360.503021, trigger=0.0
    )
    assert script.commands[22] == c.TakeSequence(line=23, prefix="...\\scan_", first=0)


def test_comments_blank_lines_and_white_space() -> None:
    text = (
        "# a comment\n\n   \t \n// another\n; a third\n"
        "  tube\txrayon \t\t\tACK\t\t\t# after the columns\n"
        "\tx\n"
        "tra_obj   move   absolute\t 5.0   ACK // after the wait\n"
        "camera save image C:\\my scan #2\\io000000.tif ACK ; note\n"
    )
    script, problems = read_script(text)
    assert [(p.line, p.code) for p in problems] == [(7, "syntax")]
    on, move, save = script.commands
    assert on == c.XrayOn(line=6, column=3)
    assert isinstance(move, c.MoveAbsolute)
    assert (move.line, move.target, move.wait) == (8, 5.0, Wait.ACK)
    assert save == c.SaveImage(line=9, path="C:\\my scan #2\\io000000.tif")


@pytest.mark.parametrize("end", [b"\r\n", b"\n", b"\r"])
def test_line_ends_and_byte_order_mark(end: bytes) -> None:
    script = parse_script(
        b"\xef\xbb\xbf" + end.join([b"tube xrayon ACK", b"tube xrayoff ACK"])
    )
    assert [x.line for x in script.commands] == [1, 2]


@pytest.mark.parametrize(
    "name",
    [
        "sweets",
        "ninechars",
        "ten chars!",
        "thirteen char",
        "x" * 0x80,
        "Müller",
        "a\tb",
        "ACK",
    ],
)
def test_binary_sample_info_survives_whatever_bytes_it_has(name: str) -> None:
    """Lengths of 9, 10 and 13 are TAB, LF and CR; 0x80 and more is not UTF-8."""
    data = blob(name, 33.3)
    text = (
        tabbed("tube", "xrayoff", "", "", "ACK")
        + tabbed("scanner", "set sample info", data, "", "ACK")
        + tabbed("tube", "xrayon", "", "", "ACK")
    )
    off, info, on = parse_script(text).commands
    assert isinstance(off, c.XrayOff)
    assert info == c.SetSampleInfo(line=2, data=data)
    assert isinstance(on, c.XrayOn)


def test_binary_sample_info_in_a_file_whose_line_ends_were_converted() -> None:
    data = blob("ten chars!")
    line = tabbed("scanner", "set sample info", data, "", "ACK").replace(b"\r\n", b"\n")
    info, on = parse_script(line + b"tube\txrayon\t\t\tACK\n").commands
    assert info == c.SetSampleInfo(line=1, data=data)
    assert isinstance(on, c.XrayOn)


@pytest.mark.parametrize(("lines", "whole"), [(63, True), (64, False)])
def test_a_binary_argument_is_looked_for_in_64_lines(lines: int, whole: bool) -> None:
    data = b"scanner\tset sample info\t" + b"\x01\n" * lines + b"\x01\t\tACK\n"
    assert (len([*rows(data.decode("latin-1"))]) == 1) == whole


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        ("", 0),
        ("a", 1),
        ("a\n", 1),
        ("a\nb", 2),
        ("\n", 1),
        ("a\r\n\r\n", 2),
        ("a\rb\r", 2),
    ],
)
def test_the_last_line_of_a_script_counts_with_and_without_an_end(
    text: str, lines: int
) -> None:
    assert line_count(text) == lines


@pytest.mark.parametrize("count", [FEW_PROBLEMS - 1, FEW_PROBLEMS, FEW_PROBLEMS + 1, 99])
def test_of_a_file_that_is_no_script_a_few_problems_are_listed(count: int) -> None:
    _, problems = read_script("Dear reader\n" * count)
    if count > FEW_PROBLEMS:
        assert len(problems) == FEW_PROBLEMS + 1
        assert f"{FEW_PROBLEMS} of {count} problems are listed" in problems[0].message
    else:
        assert len(problems) == count
        assert not any("are listed" in p.message for p in problems)


def test_ten_errors_are_reported_at_once_with_their_places() -> None:
    text = "\n".join(
        [
            "rot_obj move absolute x ACK",
            "rot_obj mvoe absolute 5 ACK",
            "tube xrayon 7 ACK",
            "camra take image ACK",
            "rot_obj move absolute 5 POS",
            "rot_obj\tmove absolute\t5\t3\tPAS",
            "camera set ROI 1 2 3 ACK",
            "camera set number of frames 2.5 ACK",
            "camera take image POS",
            "tube\txrayon\t\t\tACK\tsoon",
            "scanner pause -1 ACK",
            "scanner pause 0 ACK",
        ]
    )
    with pytest.raises(ScriptError) as caught:
        parse_script(text)
    assert [(p.line, p.column, p.code) for p in caught.value.problems] == [
        (1, 23, "value"),
        (2, 9, "unknown_command"),
        (3, 13, "syntax"),
        (4, 1, "unknown_component"),
        (5, 23, "trigger"),
        (6, 27, "wait"),
        (7, 16, "roi"),
        (8, 29, "value"),
        (9, 1 + len("camera take image "), "wait"),
        (10, len("tube\txrayon\t\t\tACK\t") + 1, "value"),
        (11, 15, "value"),
    ]
    assert "did you mean 'move absolute'" in caught.value.problems[1].message
    assert "did you mean 'camera'" in caught.value.problems[3].message
    listed = caught.value.data["problems"]
    assert isinstance(listed, list)
    assert listed[0]["line"] == 1
    assert listed[0]["severity"] == "error"
    # What can be read is there all the same.
    assert read_script(text)[0].commands == (c.Pause(line=12, duration_ms=0.0),)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("rot_obj move absolute nan ACK", "value"),
        ("rot_obj move absolute inf ACK", "value"),
        ("rot_obj move absolute 1e400 ACK", "value"),
        ("rot_obj move absolute 1_000 ACK", "value"),
        ("rot_obj move absolute 0,5 ACK", "value"),
        ("rot_obj set speed 0 ACK", "value"),
        ("rot_obj set speed -2 ACK", "value"),
        ("camera set exposure 0 ACK", "value"),
        ("camera set number of averages 0 ACK", "value"),
        ("camera set ROI 1 2 3 4.5 ACK", "roi"),
        ("camera set ROI -1 2 3 4 ACK", "roi"),
        ("scanner keep xrayon MAYBE ACK", "value"),
        ("camera save image ACK", "value"),
        ("rot_obj move absolute ACK", "value"),
        ("rot_obj move absolute 1 2 3 ACK", "syntax"),
        ("rot_obj", "syntax"),
        ("tube hello there ACK", "unknown_command"),
        ("ver_obj dance ACK", "unknown_command"),
        ("hello world", "unknown_component"),
        ("\t\t\tACK", "syntax"),
        ("tube\txrayon\t\t\tACK\t\t\textra", "syntax"),
        ("", "syntax"),
        ("# only a comment", "syntax"),
    ],
)
def test_errors(text: str, code: str) -> None:
    assert [x[1] for x in codes(text)] == [code]


def test_custom_components_are_allowed_with_a_warning() -> None:
    for text in (
        "grid_motor wiggle 3 ACK",
        tabbed("grid_motor", "wiggle", "3", "", "ACK"),
    ):
        script, problems = read_script(text)
        assert [(p.severity, p.code) for p in problems] == [
            ("warning", "custom_component")
        ]
        assert isinstance(script.commands[0], c.Custom)
    # The scanner's naming makes it a motor, whatever machine has it.
    assert isinstance(one("rot_grid move absolute 3 ACK"), c.MoveAbsolute)


@pytest.mark.parametrize(
    ("tail", "known"), [("ACK", True), ("no wait", True), ("no wait 5", True), ("ACK 5 7.5", True),
                        ("ACK 5 7 // x", True), ("no wait x", False), ("no wait 5 x", False),
                        ("no wait 1 2 3", False), ("", False)]
)  # fmt: skip
def test_a_wait_is_followed_by_two_numbers_at_most(tail: str, known: bool) -> None:
    """Only a line with a wait can be of a custom component."""
    script, problems = read_script(f"my_thing wiggle {tail}")
    assert [p.code for p in problems] == [
        "custom_component" if known else "unknown_component"
    ]
    assert len(script.commands) == known


@pytest.mark.parametrize(
    "tail", ["ACK // go", "ACK\t5 // x", "ACK // a\tb\tc", "ACK\t// 5"]
)
def test_a_comment_may_stand_from_the_column_of_the_wait_on(tail: str) -> None:
    script, problems = read_script(f"tra_obj\tmove absolute\t10\t\t{tail}")
    assert problems == ()
    assert [(x.wait, x.timeout_ms) for x in script.commands] == [
        (Wait.ACK, 5.0 if "5 //" in tail else None)
    ]


def test_an_error_s_message_counts_errors_and_its_data_has_all() -> None:
    text = "tra_obj move absolute 5\ntra_obj move absolute much ACK\ntra_obj move absolute 6\n"
    with pytest.raises(ScriptError) as caught:
        parse_script(text)
    first, *lines = str(caught.value).splitlines()
    assert first == "the script has 1 error:"
    assert [line.split(",")[0] for line in lines] == ["line 2"]
    assert [p.severity for p in caught.value.problems] == ["warning", "error", "warning"]


@pytest.mark.parametrize("length", [1, 59, 60, 61, 62, 500])
def test_text_in_messages_is_shortened_to_60_characters(length: int) -> None:
    text = "abcdefghij" * 50
    found = shorten(text[:length])
    assert len(found) == min(length, 60)
    assert found == text[:length] or (length > 60 and found == text[:57] + "...")


def test_commands_of_an_axis_that_the_twin_does_not_know_are_said() -> None:
    machine = builtin_machine("xyzr_cabinet")
    script, _ = read_script("X wiggle 3 ACK\ngrid_motor wiggle 3 ACK\n")
    found = plan_script(script, machine, profile_of(machine)).problems
    assert [
        p.line for p in found if p.message.startswith("X: the twin does not know")
    ] == [1]
    assert not [p for p in found if "grid_motor: the twin" in p.message]


def test_missing_wait_is_assumed_and_said() -> None:
    script, problems = read_script("tra_obj move absolute 5\ntube xrayon\n")
    assert [x.wait for x in script.commands] == [Wait.NO_WAIT, Wait.ACK]
    assert [(p.line, p.severity, p.code) for p in problems] == [
        (1, "warning", "wait_missing"),
        (2, "warning", "wait_missing"),
    ]


def test_trigger_without_pos_is_said() -> None:
    assert codes("rot_obj move absolute 5 1 ACK") == [(1, "trigger_unused")]


@pytest.mark.slow
def test_a_long_line_is_read_in_linear_time_and_its_message_is_short() -> None:
    for filler in ("x" * 2_000_000, " " * 2_000_000, "ACK " * 400_000, "\t" * 500_000):
        for _, problem in enumerate(read_script("tube nonsense " + filler + " end")[1]):
            assert len(problem.message) < 500


@pytest.mark.parametrize("fields", [f for f, *_ in EVERY_COMMAND])
def test_one_argument_more_than_a_command_takes_is_said(fields: tuple[str, ...]) -> None:
    takes = 2 if fields[1] == "move absolute" else len(fields) - 2
    if takes == 2:
        return
    most = [*fields[2:], "7", "8"][: takes + 1]
    columns = [*most, "", ""][:2] if takes else ["7", ""]
    (problem,) = read_script(tabbed(*fields[:2], *columns, "ACK"))[1]
    said = f"takes {takes or 'no'} argument"
    assert (problem.code, said in problem.message) == ("syntax", True), problem
    if "path" in fields[1] or "save" in fields[1]:
        return  # without tabs it is part of the path
    (problem,) = read_script(" ".join([*fields, "7", "ACK"]))[1]
    assert problem.code in ("syntax", "value", "roi"), problem
