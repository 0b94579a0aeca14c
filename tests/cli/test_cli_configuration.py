"""Words that used to be misread, the configuration file, completion: no servers are needed."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest

from flexdt.clients.cli import value_completion
from flexdt.clients.cli.command_tree import run
from flexdt.clients.cli.commands import process_commands
from flexdt.clients.cli.settings_file import (
    TABLES,
    Configuration,
    config_file,
    configuration,
)
from flexdt.library.failure import CommandError
from flexdt.runtime.process_settings import ProcessSettings

NOBODY = "127.0.0.1:9"  # the port of the discard service


@pytest.fixture(autouse=True)
def no_configuration(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A configuration folder of the test's own."""
    for name in list(os.environ):
        if name.startswith("FLEXDT_"):
            monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    (tmp_path / "flexdt").mkdir()
    return tmp_path / "flexdt" / "config.toml"


def test_a_negative_speed_up_is_a_number(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["clock", "-3", "--server", NOBODY]) == 2
    told = capsys.readouterr().err
    assert "the speed-up -3 must be positive, or 'max'" in told
    assert "No such option" not in told


@pytest.mark.parametrize("command", ["calibrate", "compare"])
def test_a_missing_phantom_is_asked_for_with_the_choice(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([command, str(tmp_path)]) == 2
    told = capsys.readouterr().err
    assert "--phantom is missing" in told
    assert all(name in told for name in ("lego", "normal", "tall"))


@pytest.mark.parametrize(
    "words", [["twin", "--projector"], ["viewer", "--twin"], ["gateway", "--server"]]
)
def test_an_address_without_a_port_is_refused_by_the_command(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    begun: list[object] = []
    monkeypatch.setattr(process_commands, "become", lambda *given: begun.append(given))
    assert run([*words, "myhost"]) == 2
    assert "'myhost' is not HOST:PORT, such as 127.0.0.1:55000" in capsys.readouterr().err
    assert not begun
    assert run([*words, "myhost:55001"]) == 0
    assert len(begun) == 1


def test_nobody_there_says_how_to_start_a_server(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(["state", "--server", NOBODY]) == 4
    assert capsys.readouterr().err == (
        f"flexdt: no server at {NOBODY} (Connection refused): start one with `flexdt up`\n"
    )


def test_the_file_the_environment_and_the_option_in_this_order(
    no_configuration: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:  # fmt: skip
    def asked(*words: str) -> str:
        assert run(["state", *words]) == 4
        return capsys.readouterr().err.split()[4]

    assert configuration({"XDG_CONFIG_HOME": "/nowhere"}) == Configuration()
    no_configuration.write_text('server = "127.0.0.1:7"\ntoken = "a"\ndata = "~/scans"\n')
    assert asked() == "127.0.0.1:7"
    monkeypatch.setenv("FLEXDT_SERVER", "127.0.0.1:8")
    assert asked() == "127.0.0.1:8"
    assert asked("--server", NOBODY) == NOBODY
    assert configuration().token == "a"
    monkeypatch.setenv("FLEXDT_TOKEN_FILE", "mine")
    assert (configuration().token, configuration().token_file) == (None, "mine")
    assert configuration().data == str(Path("~/scans").expanduser())
    begun: list[tuple[str, dict[str, object]]] = []
    monkeypatch.setattr(process_commands, "become", lambda *given: begun.append(given))
    for words in (["up"], ["twin"], ["up", "--data", "here"]):
        assert run(words) == 0
    monkeypatch.setenv("FLEXDT_CONFIG", str(tmp_path / "other.toml"))
    (tmp_path / "other.toml").write_text("")
    assert run(["up"]) == 0
    home = str(Path("~/scans").expanduser())
    assert [str(given["data"]) for _, given in begun] == [home, home, "here", "data"]


def test_a_table_of_the_file_holds_the_options_of_a_process(
    no_configuration: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    begun: list[tuple[str, dict[str, object]]] = []
    monkeypatch.setattr(process_commands, "become", lambda *given: begun.append(given))
    no_configuration.write_text(
        '[twin]\nhttp_port = 9101\nlimit = ["max_views=3"]\nphysics = "mono"\n[up]\nhttp_port = 7\n'
    )
    for words in (
        ["twin"],
        ["up", "--only", "twin", "--http-port", "9102"],
        ["up"],
        ["up", "--http-port", "8"],
        ["projector"],
    ):
        assert run(words) == 0
    asked = [(module.split(".")[-2], given["http_port"]) for module, given in begun]
    assert asked == [
        ("twin", 9101), ("twin", 9102), ("launch", 7), ("launch", 8), ("projector", None)
    ]  # fmt: skip
    assert begun[0][1]["limit"] == ("max_views=3",)
    assert begun[0][1]["physics"] == "mono"
    no_configuration.write_text("[twin]\nhttp_prot = 9101\n")
    assert run(["twin"]) == 1
    assert (
        "[twin] unknown key 'http_prot'; allowed: host, port" in capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (
            'serer = "x:1"',
            "config.toml: unknown key 'serer'; allowed: server, .*'server'",
        ),
        ('[reconstruct]\nwindwo = "hann"', r"\[reconstruct\] unknown key .*'window'"),
        ("[reconstrct]\n", r"unknown key 'reconstrct'; allowed: .*'\[reconstruct\]'"),
    ],
)
def test_every_command_names_a_misspelt_key(
    text: str, says: str, no_configuration: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    no_configuration.write_text(f"{text}\n")
    commands = (["state"], ["phantom", "list"], ["machine", "list"], ["doctor"], ["twin"])
    for words in commands:
        assert run(words) == 1, words
        told = capsys.readouterr()
        assert re.search(f"{says}\\?\n$", told.err), told.err
        assert told.out == ""
    assert run(["phantom", "list", "--help"]) == 0


COMMANDS = [kind for kind in TABLES.values() if not issubclass(kind, ProcessSettings)]


@pytest.mark.parametrize(
    ("command", "flag", "table"),
    [
        *((kind.command, f.name, table) for table, kind in TABLES.items()
          if kind in COMMANDS for f in fields(kind)),
        *(("doctor", name, "up") for name in ("port", "projector_port", "viewer_port", "data")),
    ],
)  # fmt: skip
def test_an_option_that_went_to_the_file_names_its_key(
    command: str,
    flag: str,
    table: str,
    no_configuration: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = [*command.split(), f"--{flag.replace('_', '-')}", "1"]
    assert run(words) == 2
    assert f"set `{flag}` in [{table}] of {no_configuration}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "words", "code", "message"),
    [
        *(
            (f"[script_new]\nheight = {height}", "script new --kind fly", code, message)
            for height, code, message in (("nan", 3, "height_mm is nan; allowed"),
                                    ("inf", 3, "height_mm is inf; allowed"),
                                    ('"high"', 1, "[script_new] height: "))
        ),
        ('[reconstruct]\nwindow = "square"', "reconstruct . --out x.tif", 1,
         "[reconstruct] window: 'square' is not one of"),
        ('[reconstruct]\nmemory = "much"', "reconstruct . --out x.tif", 1,
         "'much' is not a size such as 512M or 4GiB"),
        ('[phantom_make]\nbead = "cheese"', "phantom make p.json --like normal", 1, "cheese"),
    ],
)  # fmt: skip
def test_commands_read_their_tables(
    text: str, words: str, code: int, message: str, no_configuration: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(no_configuration.parent)
    no_configuration.write_text(text)
    assert run(words.split()) == code
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        ["job", "status", "7"],
        ["move", "a=1", "--relative"],
        ["camera", "--roi", "1,2,3,4"],
    ],
)
@pytest.mark.parametrize("form", [["--server", NOBODY], [f"--server={NOBODY}"]])
@pytest.mark.daily(4)
def test_options_of_flexdt_itself_may_stand_anywhere(
    words: list[str], form: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    places = [at for at in range(len(words) + 1) if at == 0 or words[at - 1] != "--roi"]
    for at in places:
        assert run([*words[:at], *form, *words[at:], "--json"]) == 4
        assert NOBODY in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["state", "--server"], "'--server' requires an argument"),
        (["check", "x", "--server", NOBODY], "No such option: --server"),
        (["--server", NOBODY, "check", "x"], "--server is no option of `flexdt check`"),
        (["--json", "up"], "--json is no option of `flexdt up`"),
    ],
)
def test_a_command_that_does_not_heed_an_option_says_so(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(words) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("server = ", "not valid TOML"),
        ('sever = "a:1"', "unknown key 'sever'; allowed: server, token"),
        ("server = 55000", "server is 55000; allowed: a text"),
        ("twin = 5", "unknown key 'twin'; allowed: server, token"),
        ('"[twin]" = "x"', "unknown key '[twin]'; allowed: server, token"),
        ('data = ""', "data is ''"),
        ('token = "a"\ntoken_file = "b"', "token and token_file"),
    ],
)
def test_a_wrong_file_is_named_with_its_key(
    no_configuration: Path, text: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    no_configuration.write_text(text)
    assert run(["state"]) == 1
    told = capsys.readouterr().err
    assert message in told
    assert str(no_configuration) in told
    assert "Traceback" not in told


def test_a_file_that_is_named_must_be_there() -> None:
    with pytest.raises(CommandError, match="FLEXDT_CONFIG"):
        configuration({"FLEXDT_CONFIG": "/nowhere/flexdt.toml"})
    assert config_file({}) == Path("~/.config/flexdt/config.toml").expanduser()


@pytest.mark.parametrize("base", ["below a file", "nobody's home", "BOM"])
def test_homes_and_files_of_other_machines_are_no_error(
    base: str, no_configuration: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """numba#4032: a home that cannot be used or is unknown; vs-streamjsonrpc#695: a mark."""
    no_configuration.write_text(
        "\ufefftoken = 'long enough to be one'\n", encoding="utf-8"
    )
    if base == "BOM":
        assert configuration().token == "long enough to be one"
        return
    monkeypatch.setenv("XDG_CONFIG_HOME", str(no_configuration))
    if base == "nobody's home":
        monkeypatch.delenv("XDG_CONFIG_HOME")
        monkeypatch.setattr(Path, "expanduser", _nobody)
    assert configuration() == Configuration()


def _nobody(path: Path) -> Path:
    raise RuntimeError("Could not determine home directory.")


def test_phantoms_of_a_calibration_are_those_with_beads() -> None:
    assert value_completion.calibration_targets("un") == ["unknown"]
    assert "lego" in value_completion.bead_phantom_names("")
    assert not value_completion.calibration_targets("she")  # the Shepp-Logan has no beads
    assert value_completion.sample_names("she")


@pytest.mark.slow
@pytest.mark.campaign(5)
@pytest.mark.parametrize(
    ("words", "proposed"),
    [
        ("flexdt st", {"state", "stop", "study"}),
        ("flexdt calibrate --ph", {"--phantom"}),
        ("flexdt jog ver", {"ver_tube", "ver_det"}),
        ("flexdt move mag", {"mag_obj="}),
        ("flexdt twin --machine xy", {"xyzr_cabinet"}),
        ("flexdt check script.txt --machine xy", {"xyzr_cabinet"}),
        ("flexdt calibrate --phantom nor", {"normal"}),
        ("flexdt expose --material stee", {"steel"}),
        ("flexdt sample le", {"lego"}),
    ],
)
def test_a_shell_completes_commands_and_options(words: str, proposed: set[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "flexdt.clients.cli"],
        env={**os.environ, "_FLEXDT_COMPLETE": "complete_bash", "COMP_WORDS": words,
             "COMP_CWORD": str(len(words.split()) - 1)},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    offered = set(done.stdout.split())
    assert proposed <= offered
    assert all(word.startswith(words.split()[-1]) for word in offered)
