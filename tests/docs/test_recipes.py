"""Recipes of CONTRIBUTING.md, carried out on a copy; the tests that they name must pass.

A copy is imported through its own `src/`, with the dependencies of this environment.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = (
    "src", "flexdt", "protocol", "twin", "phantoms", "runtime", "server", "clients", "tests",
    "examples", "extensions",
)  # fmt: skip
PAGES = ("docs/phantoms.md", "docs/exchange.md", "docs/command-line.md", "docs/reconstruction.md",
         "docs/other-scanners.md", "docs/install.md", "docs/coming-from",
         "docs/_ext/format_pages.py")  # fmt: skip
QUICK = "not slow and not browser"
"""Marks of the tests that `make test` runs."""
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
        "A material",
        "A limit rule",
        "A field of the state",
        "A reader of scan files",
        "A cause of residuals",
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


def of_copy(
    copy: Path, files: Iterable[str], word: str, marks: str
) -> subprocess.CompletedProcess[str]:
    """Run those tests of `files` in the copy whose names have `word`, and whose marks are these."""
    words = [
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:xdist",
        "-m",
        marks,
    ]
    return run(copy, *words, "-k", word, *files)


def passed(copy: Path, files: Iterable[str], word: str) -> int:
    """How many tests of `files` whose name has `word` passed in the copy; none may fail."""
    done = of_copy(copy, files, word, QUICK)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    count = re.search(r"(\d+) passed", done.stdout)
    return int(count[1]) if count else 0


def failed(copy: Path, files: Iterable[str], word: str, marks: str = QUICK) -> set[str]:
    """Functions of `files` whose name has `word` and that fail in the copy."""
    done = of_copy(copy, files, word, marks)
    return set(re.findall(r"^FAILED tests/\S*?\.py::(\w+)", done.stdout, re.MULTILINE))


Changes = dict[str, tuple[tuple[str, str], ...]]
"""File -> pairs: a text that is there once, and what is inserted before it."""


def inserted(copy: Path, changes: Changes) -> None:
    """Insert texts into files of the copy."""
    for name, insertions in changes.items():
        for place, text in insertions:
            whole = (copy / name).read_text()
            assert whole.count(place) == 1, (name, place)
            (copy / name).write_text(whole.replace(place, text + place))


def test_a_copy_is_imported_from_its_own_folders(copy: Path) -> None:
    program = "import flexdt.twin.errors as e, flexdt as f; print(e.__file__, f.__file__)"
    done = run(copy, "-c", program)
    assert done.returncode == 0, done.stderr
    assert all(word.startswith(str(copy)) for word in done.stdout.split())


@pytest.mark.slow
@pytest.mark.campaign(0)
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
@pytest.mark.campaign(0)
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
    changes: Changes = {
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
        "docs/command-line.md": (("csv; images and geometry", "added, "),),
    }  # fmt: skip
    inserted(copy, changes)
    shown = run(copy, "-m", "flexdt.clients.cli", "export", "--help")
    assert "|added|" in shown.stdout, shown.stderr
    assert passed(copy, files_to_run(rows), "added or state") >= 20


TIN = """[material.planted]
label = "tin"
density_g_cm3 = 7.29
formula = "Sn"
color = [200, 200, 190]

"""


@pytest.mark.slow
def test_a_material_is_added_by_its_recipe(copy: Path) -> None:
    files = files_to_run(recipes()["A material"])
    word = "material or density"
    listed = "twin/attenuation/data/materials.toml"
    first: Changes = {listed: (("[material.pmma]", TIN),)}
    inserted(copy, first)
    table = copy / listed
    right = table.read_text()
    table.write_text(right.replace("= 7.29", "= 0.00729"))
    assert failed(copy, files, word) == {
        "test_a_right_density_is_taken_without_a_word",
        "test_the_materials_are_listed",
    }
    table.write_text(right)
    inserted(copy, {"docs/phantoms.md": (("pmma steel ", "planted "),)})
    assert passed(copy, files, word) >= 20
    filtered = (
        "import flexdt as fx; print(fx.Tube(filters=[('planted', 0.3)]).filters[-1])"
    )
    assert "planted" in run(copy, "-c", filtered).stdout


@pytest.mark.slow
def test_a_limit_rule_is_added_by_its_recipe(copy: Path) -> None:
    files = ["tests/server/test_setting_doors.py"]
    assert set(files) <= set(files_to_run(recipes()["A limit rule"]))
    word = "figure or starts"
    inserted(copy, {
        "twin/machine/description.py": (
            ("    kV: Positive\n    power_W: Positive\n",
             '    max_mA: Positive | None = None\n    """Greatest current [mA]."""\n'),
        ),
    })  # fmt: skip
    figures = "every_figure_that_limits"
    assert failed(copy, files, figures) == {
        "test_every_figure_that_limits_settings_has_a_case"
    }
    inserted(copy, {
        "tests/server/test_setting_doors.py": (
            ('    "max_kV": (M,', '    "max_mA": (HELD, {"power_W": 60.0}),\n'
             '    "max_mA by kV": (HELD, {"kV": 60.0}),\n'),
            ("RULES: dict[",
             'HELD = M.model_copy(update={"tube": M.tube.model_copy(update={"max_mA": 0.6})})\n'),
        ),
    })  # fmt: skip
    # The figure alone does nothing, which every door says.
    assert failed(copy, files, word) == {"test_the_rule_of_a_figure_holds_at_every_door"}
    inserted(copy, {
        "twin/scanner/state.py": (
            ("    return new\n\n\ndef changed_camera(",
             "    if spec.max_mA is not None and new.kV > 0.0:\n"
             "        current = new.power_W / new.kV\n"
             '        _require_within("tube", "mA", current, 0.0, spec.max_mA)\n'),
        ),
    })  # fmt: skip
    # A machine may start with more than it allows.
    assert failed(copy, files, word) == {
        "test_a_machine_starts_with_settings_that_it_allows"
    }
    inserted(copy, {
        "twin/machine/description.py": (
            ('        _refuse_if(self.spot_points == 2',
             "        most = math.inf if self.max_mA is None else self.max_mA * self.kV\n"
             '        allowed = f"at most max_mA, {self.max_mA} mA, times kV"\n'
             '        _refuse_if(self.power_W > most, "power_W", self.power_W, allowed)\n'),
        ),
    })  # fmt: skip
    assert passed(copy, files, word) >= 40


@pytest.mark.slow
def test_a_field_of_the_state_is_added_by_its_recipe(copy: Path) -> None:
    files = files_to_run(recipes()["A field of the state"])
    inserted(copy, {
        "protocol/state_model.py": (
            ("    ready: bool = True\n", "    current_mA: float\n"
             '    """tube current, from power and voltage"""\n'),
        ),
    })  # fmt: skip
    assert failed(copy, files, "default") == {
        "test_fields_that_were_added_have_a_default",
    }
    model = copy / "protocol" / "state_model.py"
    model.write_text(
        model.read_text().replace(
            "current_mA: float\n", "current_mA: float | None = None\n"
        )
    )
    word = "field or current"
    assert failed(copy, files, word) == {
        "test_the_twin_fills_every_field_of_the_state",
        "test_the_page_shows_every_field_but_these",
        "test_the_openrpc_file_is_current",
    }
    inserted(copy, {
        "server/twin/state_views.py": (
            ("        ready=tube.ready(now),\n",
             "        current_mA=tube.power_W / tube.kV if tube.kV else None,\n"),
        ),
        "tests/server/test_state_fields.py": (
            ("    JobStatus: {", '    TubeState: {"current_mA"},\n'),
        ),
    })  # fmt: skip
    assert run(copy, "tests/protocol/test_openrpc_file.py").returncode == 0
    assert passed(copy, files, word) >= 4


PROBE_TABLE = '''"""The fields of Probe's .probe."""

from flexdt.twin.dataset.format_table import FormatTable, used

PROBE = FormatTable(
    "Probe",
    "this test",
    (
        used("rows", "cone_vec of each view", "the geometry", "mm"),
        used("images", "names of the projections", "the images"),
        used("flats", "names of the flat images", "the flat image"),
    ),
    "this format states nothing twice.",
    example='fx.open("scan.probe")',
)
'''
PROBE = '''"""Read Probe's .probe: rows of the geometry and names of images, as JSON."""

import json
from dataclasses import replace

from flexdt.library.reading.foreign_parsing import head_text
from flexdt.library.reading.listed_images import listed
from flexdt.library.reading.probe_table import PROBE
from flexdt.runtime.files.dataset_folder import list_folder
from flexdt.twin.dataset.format_table import Ledger
from flexdt.twin.geometry.cone_vec import ConeVec


def read_probe(path, geometry):
    content = json.loads(head_text(path))
    said = Ledger(PROBE, str(path))
    said.state_all(content.items())
    cone = ConeVec(content["rows"])
    for name in content:
        said.use(name)
    folder = list_folder(path.parent)
    data = listed(folder, cone, content["images"], (), content["flats"])
    return replace(data, provenance=said.finish())
'''
MAKER = """def probe(folder: Path) -> None:
    import json

    from PIL import Image

    counts = 5e4 * np.concatenate([images(0.0, 0.0), np.ones((1, ROWS, COLS))])
    names = [f"p{i:04d}.tif" for i in range(VIEWS + 1)]
    for name, image in zip(names, counts, strict=True):
        Image.fromarray(image.round().astype(np.uint16)).save(folder / name)
    scan = fx.ConeVec.circular(
        sod=SOD, sdd=SDD, angles=VIEWS, shape=(ROWS, COLS), pixel=PIXEL
    )
    said = {"rows": scan.rows.tolist(), "images": names[:-1], "flats": names[-1:]}
    (folder / "scan.probe").write_text(json.dumps(said))


"""


@pytest.mark.slow
def test_a_reader_of_scan_files_is_added_by_its_recipe(copy: Path) -> None:
    files = files_to_run(recipes()["A reader of scan files"])
    module = copy / "flexdt" / "library" / "reading" / "probe_reading.py"
    module.write_text(PROBE)
    module.with_name("probe_table.py").write_text(PROBE_TABLE)
    inserted(copy, {
        "flexdt/library/reading/foreign_files.py": (
            ("from flexdt.library.reading.text_formats.skyscan_reading",
             "from flexdt.library.reading.probe_reading import read_probe\n"
             "from flexdt.library.reading.probe_table import PROBE\n"),
            ('    ScanFormat("YXLON"',
             '    ScanFormat("Probe", (".probe",), read_probe, table=PROBE),\n'),
        ),
    })  # fmt: skip
    word = "state_the_lists or of_the_balls or Probe"
    # Of a table of cases `make test` keeps some, which need not be the new one.
    every = f"({word}) and not volume and not damaged"
    assert failed(copy, files, every, "not browser") == {
        "test_pages_docstrings_and_wire_state_the_lists",
        "test_every_format_of_scans_has_a_block_and_a_scan_of_the_balls",
        "test_another_geometry_takes_the_place_of_the_files",
    }
    inserted(copy, {
        "flexdt/library/reading/folders.py": (("Zeiss's .txrm; a", "Probe's .probe; "),),
        "docs/other-scanners.md": (
            ("| YXLON `.xml`", "| Probe `.probe` | its TIFFs beside it |  |\n"),
        ),
        "tests/docs/test_others_scans.py": (
            ("MAKERS = {", MAKER),
            ('"YXLON": yxlon', '"Probe": probe, '),
        ),
    })  # fmt: skip
    # The file's geometry stays where another one is given.
    assert failed(copy, files, every, "not browser") == {
        "test_another_geometry_takes_the_place_of_the_files"
    }
    module.write_text(PROBE.replace('ConeVec(content["rows"])',
                                    'geometry or ConeVec(content["rows"])'))  # fmt: skip
    assert passed(copy, files, word) >= 10
    done = of_copy(copy, files, "volume and Probe", "slow")
    assert "1 passed" in done.stdout, done.stdout[-3000:]
