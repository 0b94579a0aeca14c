"""What a newcomer tries first, and what flexdt says to it."""

from __future__ import annotations

import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import tifffile

import flexdt as fx
from flexdt.clients.cli.command_tree import run
from flexdt.clients.client import twin_methods
from flexdt.library.calibration.calibrate import _digits
from flexdt.protocol import RpcError

SCAN = fx.ConeVec.circular(sod=600, sdd=1059, angles=8, shape=(12, 16), pixel=4.0)
COUNTS = np.full((8, 12, 16), 900, np.uint16)


@pytest.mark.parametrize("kept", [(1, 1), (3, 2), (0, 4)])
def test_a_data_set_shows_how_many_dark_and_flat_images_it_has(
    kept: tuple[int, int],
) -> None:
    dark, flat = (np.full((k, 12, 16), 100.0 + 900.0 * i) for i, k in enumerate(kept))
    data = fx.DataSet.from_arrays(
        COUNTS, SCAN, flat=flat, dark=dark if kept[0] else np.zeros((12, 16))
    )
    [shown] = re.findall(r"dark, flat images</th><td>([\d, ]+)<", data._repr_html_())
    assert shown == f"{max(kept[0], 1)}, {kept[1]}"


def test_warnings_point_to_the_line_of_the_caller() -> None:
    """At every depth: a function of the library, and a method that calls others."""
    data = fx.DataSet.from_arrays(COUNTS, SCAN, flat=np.full((12, 16), 1000))
    grid = fx.Grid((6, 8, 8), 2.0)
    for call in (
        lambda: data.reconstruct("fdk", progress=False),
        lambda: fx.reconstruct(data, "fdk", progress=False),
        lambda: fx.fdk(data.line_integrals(), SCAN, grid, progress=False),
        lambda: fx.simulate("lego", SCAN, exposure_ms=9000.0, progress=False),
    ):
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            call()
        assert said
        assert {w.filename for w in said} == {__file__}


def test_the_name_of_a_file_is_no_script() -> None:
    for name in ("scan.txt", "/data/scan.txt"):
        with pytest.raises(RpcError, match=r"one word and no script; .*read_bytes\(\)"):
            next(twin_methods.submit_script(name))
    next(twin_methods.submit_script("tube\txrayon\t\t\tACK\t\t\r\n"))


@pytest.mark.parametrize("seed", range(3))
def test_a_file_that_is_no_script_is_said_so_in_a_few_lines(
    seed: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    noise = np.random.default_rng(6420 + seed).integers(0, 256, 60_000).astype(np.uint8)
    (tmp_path / "noise.bin").write_bytes(noise.tobytes())
    (tmp_path / "table.csv").write_text("1.5,2.5,3.5\n" * 5000)
    assert run(["check", str(tmp_path / "table.csv")]) == 1
    told = capsys.readouterr()
    assert "no line is a command of a scan script" in told.err
    assert len(told.err.splitlines()) <= 30
    assert run(["check", str(tmp_path / "noise.bin")]) == 1
    told = capsys.readouterr()
    assert "binary data" in told.err
    assert len(told.err.splitlines()) <= 30


def test_a_closed_pipe_of_errors_changes_no_exit_code(tmp_path: Path) -> None:
    lines = "x\ty\tz\r\n" * 4000 + "tube\tset kV\t60\t\tACK\t\t\r\n"
    (tmp_path / "long.txt").write_text(lines)
    flexdt = subprocess.Popen(
        [sys.executable, "-m", "flexdt.clients.cli", "check", str(tmp_path / "long.txt")],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    assert flexdt.stdout is not None
    flexdt.stdout.readline()
    flexdt.stdout.close()
    assert flexdt.wait() == 1


def test_an_alignment_that_cannot_tell_says_why() -> None:
    data = fx.DataSet.from_arrays(COUNTS, SCAN, flat=np.full((12, 16), 1000))
    found = data.align()
    assert "8 directions" in found.verdict
    assert found.verdict in repr(found)


@pytest.mark.parametrize(
    "words", ["flexdt up --machine ", "flexdt machine show ", "flexdt up --sample "]
)
def test_names_are_completed(
    words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("_FLEXDT_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", words)
    monkeypatch.setenv("COMP_CWORD", str(len(words.split(" ")) - 1))
    with pytest.raises(SystemExit):
        run([])
    found = capsys.readouterr().out.split()
    assert {"flexray", "micro_ct"} <= set(found) or {"lego", "chiral"} <= set(found)


def test_a_result_in_place_of_its_correction_names_it() -> None:
    data = fx.DataSet.from_arrays(COUNTS, SCAN, flat=np.full((12, 16), 1000))
    with pytest.raises(fx.TwinError, match=r"its \.correction may be meant"):
        data.with_correction(data.align())  # type: ignore[arg-type]
    with pytest.raises(fx.TwinError) as told:
        data.counts("abc")  # type: ignore[arg-type]
    assert "may be meant" not in str(told.value)


def test_a_misspelt_name_of_the_library_has_a_suggestion() -> None:
    with pytest.raises(AttributeError, match="did you mean 'simulate'"):
        fx.simulat  # type: ignore[attr-defined] # noqa: B018


@pytest.mark.parametrize("flats", [("flat_0.tif", "white.tif"), ()])
def test_counts_without_a_flat_say_how_to_name_it(
    flats: tuple[str, ...], tmp_path: Path
) -> None:
    for name in (*(f"proj_{i}.tif" for i in range(8)), *flats):
        tifffile.imwrite(tmp_path / name, COUNTS[0])
    data = fx.read_tiffs(tmp_path, SCAN, frames="proj*")
    [told] = [text for text in data.warnings if "no flat image" in text]
    assert "no flat image (io* unless said)" in told
    assert ("flat_0.tif looks like one" in told) == bool(flats)
    with pytest.raises(fx.TwinError, match=r"no flat field .*the count of an open beam"):
        data.line_integrals()
    with pytest.raises(fx.TwinError, match=r"no projections match 'none\*'.*proj_0"):
        fx.read_tiffs(tmp_path, SCAN, frames="none*")


@pytest.mark.parametrize(
    ("value", "sigma", "shown"),
    [
        (-1.73331, 1.0725, ("-1.7", "1.1")),
        (0.0123456, 0.00098, ("0.01235", "0.00098")),
        (1059.25, 12.3, ("1059", "12")),
        (1.5, 0.0, ("1.5", "0")),
        (None, None, ("-", "-")),
    ],
)
def test_values_end_at_the_second_digit_of_their_sigma(
    value: float | None, sigma: float | None, shown: tuple[str, str]
) -> None:
    assert _digits(value, sigma) == shown
