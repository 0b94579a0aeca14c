"""One list of algorithms: one that is added there is found at every door, and its page lacks
it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pytest

import flexdt as fx
from flexdt.clients.cli.settings_file import ReconstructSettings
from flexdt.twin.algorithms import ALGORITHMS, OPTIONS, WINDOWS, Algorithm, misfit

PAGE = Path(__file__).parents[2] / "docs" / "reconstruction.md"
ADDED = Algorithm("half", "tests.clients.test_algorithms", "half_everywhere")
WITH_IT = """
import os, sys
from flexdt.twin.algorithms import ALGORITHMS
from tests.clients.test_algorithms import ADDED
ALGORITHMS[ADDED.name] = ADDED
from flexdt.clients.cli.command_tree import run
sys.exit(run(sys.argv[1:]))
"""


def half_everywhere(
    projections: np.ndarray,
    cone_vec: fx.ConeVec,
    like: fx.Volume,
    *,
    watch: object,
    **options: int,
) -> fx.Volume:
    """An algorithm that looks at nothing."""
    assert len(projections) == len(cone_vec)
    return like.like(np.full(like.shape, 0.5 * options.get("iterations", 1), np.float32))


def with_it(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """`flexdt` with the algorithm in the list from the beginning."""
    return subprocess.run(
        [sys.executable, "-c", WITH_IT, *words], env={**os.environ, **environment},
        cwd=PAGE.parents[1], capture_output=True, text=True, check=False,
    )  # fmt: skip


@pytest.fixture(scope="module")
def scan() -> fx.DataSet:
    geometry = fx.ConeVec.circular(sod=100, sdd=200, angles=5, shape=(4, 5), pixel=1)
    counts, flat = np.full((5, 4, 5), 500), np.full((4, 5), 1000)
    return fx.DataSet.from_arrays(counts, geometry, flat=flat)


def test_the_command_takes_it(scan: fx.DataSet, tmp_path: Path) -> None:
    scan.save(tmp_path / "scan")
    words = ("reconstruct", str(tmp_path / "scan"), "--out", str(tmp_path / "v.tif"))
    done = with_it(*words, "--algorithm", "half", "--iterations", "3")
    assert done.returncode == 0, done.stderr
    assert (fx.Volume.load(tmp_path / "v.tif").data == 1.5).all()
    done = with_it(*words, "--algorithm", "half", "--weight", "3")
    assert "half has none" in done.stderr


def test_help_and_completion_show_it() -> None:
    shown = with_it("reconstruct", "--help", COLUMNS="200").stdout
    assert all(name in re.findall(r"\w+", shown) for name in (*ALGORITHMS, "half"))
    words = "flexdt reconstruct --algorithm h"
    done = with_it(
        "reconstruct", _FLEXDT_COMPLETE="complete_bash", COMP_WORDS=words, COMP_CWORD="3"
    )
    assert done.stdout.split() == ["half"]


def test_the_library_takes_it(scan: fx.DataSet, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(fx.TwinError, match="unknown algorithm 'half'"):
        scan.reconstruct("half")
    monkeypatch.setitem(ALGORITHMS, "half", ADDED)
    assert (scan.reconstruct("half", voxel=0.5, iterations=4).data == 2.0).all()
    with pytest.raises(fx.TwinError, match="half") as caught:
        scan.reconstruct("art")
    assert "half" in caught.value.data["allowed"]


def in_the_table() -> set[str]:
    """Names in the first column of the page's table of algorithms."""
    table = PAGE.read_text("utf-8").split("| algorithm |", 1)[1].split("\n\n", 1)[0]
    return {
        name
        for row in table.splitlines()
        for name in re.findall(r"`(\w+)`", row.split("|")[1])
    }


def test_the_table_of_options_says_what_is_refused() -> None:
    table = PAGE.read_text("utf-8").split("| option |", 1)[1].split("\n\n", 1)[0]
    head, _, *rows = [
        [*map(str.strip, row.split("|"))][1:-1] for row in table.splitlines()
    ]
    columns = [re.findall(r"`(\w+)`", cell) for cell in head]
    said = {}
    for row in rows:
        names = re.findall(r"`(\w+)`", row[0]) or ["materials"]
        for name in names:
            for algorithms, word in zip(columns, row[-len(columns) :], strict=True):
                said |= {(name, one): word == "yes" for one in algorithms}
    assert {name for name, _ in said} == set(OPTIONS) - {"tube", "kv"}
    for (name, algorithm), takes in said.items():
        assert (misfit(algorithm, {name}) is None) == takes, (name, algorithm)


def test_the_page_has_all_and_would_lack_it(monkeypatch: pytest.MonkeyPatch) -> None:
    assert in_the_table() == set(ALGORITHMS)
    monkeypatch.setitem(ALGORITHMS, "half", ADDED)
    assert set(ALGORITHMS) - in_the_table() == {"half"}


def test_docstrings_and_settings_name_all() -> None:
    for text, names in ((fx.reconstruct.__doc__, ALGORITHMS), (fx.reconstruct.__doc__, WINDOWS),
                        (fx.fdk.__doc__, WINDOWS)):  # fmt: skip
        assert text is not None
        assert all(re.search(rf"\b{name}\b", text) for name in names)
    assert get_args(get_type_hints(ReconstructSettings)["window"]) == tuple(WINDOWS)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_each_is_where_it_is_said_to_be(name: str) -> None:
    from inspect import signature

    algorithm = ALGORITHMS[name]
    takes = signature(algorithm.load()).parameters
    spelt = {"materials": "hardening"}
    of_commands = {"scheduler", "slurm"}
    options = algorithm.options - of_commands
    assert {spelt.get(option, option) for option in options} <= set(takes)
    assert algorithm.direct or "watch" in takes
