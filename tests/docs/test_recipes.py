"""Recipes of CONTRIBUTING.md, carried out on a copy; the tests that they name must pass.

A copy is imported through its own `src/`, with the dependencies of this environment.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = (
    "src", "flexdt", "protocol", "twin", "phantoms", "runtime", "server", "clients", "tests",
    "examples", "extensions",
)  # fmt: skip
PAGES = ("docs/phantoms.md", "docs/exchange.md", "docs/command-line.md", "docs/reconstruction.md",
         "docs/other-scanners.md", "docs/tutorials/own-sample.md")  # fmt: skip
ROW = re.compile(
    r"^\| (?!file \|)(?P<file>[^|]*)\| (?P<change>[^|]*)\| (?P<test>[^|]*)\|$", re.M
)


def recipes() -> dict[str, list[dict[str, str]]]:
    """Name of each recipe that is a table -> its rows."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    _, *parts = re.split(r"^\*\*(.+?)\.\*\*", text, flags=re.M)
    found = {
        name: [m.groupdict() for m in ROW.finditer(body)]
        for name, body in zip(parts[::2], parts[1::2], strict=True)
    }
    return {
        name: [r for r in rows if "---" not in r["file"]] for name, rows in found.items()
    }


def files_to_run(rows: list[dict[str, str]]) -> list[str]:
    """Test files of a recipe, in order, each once, but for those marked slow or browser."""
    found: dict[str, None] = {}
    for row in rows:
        if "(slow)" not in row["test"] and "(browser)" not in row["test"]:
            found.update(dict.fromkeys(re.findall(r"`(tests/[\w/]+\.py)`", row["test"])))
    return list(found)


def test_recipes_are_tables_whose_rows_end_with_a_test() -> None:
    tables = {name: rows for name, rows in recipes().items() if rows}
    assert {
        "A wire method",
        "A machine",
        "A phantom",
        "A figure of the detector",
        "A format of geometry",
    } <= set(tables)
    for name, rows in tables.items():
        assert len(rows) >= 3, name
        silent = [row["file"] for row in rows if not row["test"].strip()]
        assert len(silent) <= 1, (name, silent)
        assert files_to_run(rows), name
        for row in rows:
            assert row["change"].strip(), (name, row)
            place = re.search(r"`([\w./]+/[\w./*]*)`", row["file"])
            assert not place or list(ROOT.glob(place[1].rstrip("/"))), (name, place)


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """The files that git knows or would add, links as links."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", "--", *FOLDERS,
         "pyproject.toml", *PAGES],
        cwd=ROOT, capture_output=True, check=True,
    ).stdout.decode().split("\0")  # fmt: skip
    for name in filter(None, listed):
        if os.path.lexists(ROOT / name):
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, tmp_path / name, follow_symlinks=False)
    return tmp_path


def run(copy: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run Python in the copy, which provides flexdt."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")}
    environment["PYTHONPATH"] = str(copy / "src")
    return subprocess.run(
        [sys.executable, *words], cwd=copy, env=environment,
        capture_output=True, text=True, check=False,
    )  # fmt: skip


def passed(copy: Path, files: list[str], word: str) -> int:
    """How many tests of `files` whose name has `word` passed in the copy; none may fail."""
    words = [
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:xdist",
        "-m",
        "not slow and not browser",
    ]
    done = run(copy, *words, "-k", word, *files)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    count = re.search(r"(\d+) passed", done.stdout)
    return int(count[1]) if count else 0


def test_a_copy_is_imported_from_its_own_folders(copy: Path) -> None:
    program = "import flexdt.twin.errors as e, flexdt as f; print(e.__file__, f.__file__)"
    done = run(copy, "-c", program)
    assert done.returncode == 0, done.stderr
    assert all(word.startswith(str(copy)) for word in done.stdout.split())


@pytest.mark.slow
def test_a_machine_is_added_by_its_recipe(copy: Path) -> None:
    rows = recipes()["A machine"]
    machines, profiles = copy / "twin/data/machines", copy / "twin/data/profiles"
    text = (machines / "micro_ct.toml").read_text()
    named = text.replace(
        'name = "micro_ct"', 'name = "added"\ndefault_profile = "added-2030"', 1
    )
    named = named.replace('scanner_name = "micro-CT"', 'scanner_name = "Added"')
    assert named.count("added") == 2
    (machines / "added.toml").write_text(named)
    (profiles / "added-2030.toml").write_text(
        'name = "added-2030"\nmachine = "added"\nsource = "drawn for a test"\ndet_tan = 0.5\n'
    )
    checked = run(
        copy, "-m", "flexdt.clients.cli", "machine", "check", str(machines / "added.toml")
    )
    assert checked.returncode == 0, checked.stderr
    shown = run(copy, "-m", "flexdt.clients.cli", "machine", "list")
    assert "added" in shown.stdout
    assert passed(copy, files_to_run(rows), "added") >= 3


@pytest.mark.slow
def test_a_phantom_is_added_by_its_recipe(copy: Path) -> None:
    rows = recipes()["A phantom"]
    samples = copy / "phantoms" / "samples.py"
    text = samples.read_text()
    maker = (
        "def added_phantom() -> Phantom:\n"
        '    """Return a ball of water of 10 mm."""\n'
        "    water = material_of('water').mu_per_mm\n"
        "    ball = Solid(Ellipsoid((0.0, 0.0, 0.0), (5.0, 5.0, 5.0)), 'water', water)\n"
        "    size = (10.0, 10.0, 10.0)\n"
        "    return Phantom('added', 'a ball of water', Scene((ball,)), size)\n\n\n"
    )
    before = "_MAKERS: Final[Mapping[str, Callable[[], Phantom]]] = {\n"
    assert text.count(before) == 1
    samples.write_text(
        text.replace(before, maker + before + '    "added": added_phantom,\n')
    )
    page = copy / "docs" / "phantoms.md"
    row = "| `chiral` |"
    page.write_text(
        page.read_text().replace(row, f"| `added` | a ball of water |\n{row}")
    )
    listed = run(copy, "-m", "flexdt.clients.cli", "phantom", "list")
    assert "added" in listed.stdout, listed.stderr
    assert passed(copy, files_to_run(rows), "added or every or row") >= 3


@pytest.mark.slow
def test_a_format_of_geometry_is_added_by_its_recipe(copy: Path) -> None:
    rows = recipes()["A format of geometry"]
    (copy / "twin" / "exchange" / "added.py").write_text(
        '"""Rows of cone_vec as JSON."""\n\n'
        "import json\n\n"
        "from flexdt.twin.exchange.geometry import ScanGeometry\n"
        "from flexdt.twin.geometry.cone_vec import ConeVec\n\n\n"
        "def added_text(geometry):\n"
        "    return json.dumps(geometry.cone_vec.rows.tolist())\n\n\n"
        "def read_added(text, shape):\n"
        "    return ScanGeometry(ConeVec(json.loads(text)), shape)\n"
    )
    changes = {
        "flexdt/library/datasets/exchange_formats.py": (
            ("FORMATS: Final[", "def _write_added(geometry, out):\n"
             "    from flexdt.twin.exchange.added import added_text\n\n"
             "    return added_text(geometry)\n\n\n"
             "def _read_added(path, given):\n"
             "    from flexdt.twin.exchange.added import read_added\n\n"
             "    return read_added(path.read_text(), given.shape)\n\n\n"),
            ('        Format("csv",',
             '        Format("added", (".added",), _write_added, read=_read_added),\n'),
        ),
        "twin/geometry/cone_vec.py": (
            ("csv; None:", "added, "),
            (".csv, .xml (RTK)", ".added, "),
        ),
        "docs/exchange.md": (
            ("csv,nxtomo} --out", "added,"), ("| `csv` |", "| `added` | `.added` | cone_vec | |\n"),
        ),
        "docs/command-line.md": (("csv and back, images", "added, "),),
    }  # fmt: skip
    for name, insertions in changes.items():
        for place, text in insertions:
            whole = (copy / name).read_text()
            assert whole.count(place) == 1, (name, place)
            (copy / name).write_text(whole.replace(place, text + place))
    shown = run(copy, "-m", "flexdt.clients.cli", "export", "--help")
    assert "|added|" in shown.stdout, shown.stderr
    assert passed(copy, files_to_run(rows), "added or state") >= 20
