"""Each list of formats and units stands once: a member that is added is at every door.

What cannot iterate a list (pages, docstrings, the wire's models) is compared with it; the
comparison is seen to fail for the member that is added.
"""

from __future__ import annotations

import inspect
import json
import re
import sys
import tomllib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

import flexdt as fx
from flexdt.clients.cli.command_tree import run
from flexdt.clients.cli.commands import phantom_commands, script_commands
from flexdt.clients.client import events, twin_methods
from flexdt.clients.launch import random_truth
from flexdt.library import plots
from flexdt.library.datasets import exchange_formats as geometry
from flexdt.library.datasets.exchange import (
    ExchangeError,
    export_dataset,
    import_geometry,
)
from flexdt.library.reading import foreign_files
from flexdt.library.reading.folders import load_dataset
from flexdt.library.reconstruction import reconstruct, volume_formats
from flexdt.phantoms.files import mesh_files
from flexdt.protocol import fields, state_model
from flexdt.protocol.methods import image_messages, scanner_messages
from flexdt.runtime import process_settings
from flexdt.server.imaging import radiography
from flexdt.twin import length_units
from flexdt.twin.calibration.fit.problem import SIX
from flexdt.twin.dataset.flexdt_json import ScanRecord
from flexdt.twin.exchange.geometry import ScanGeometry
from flexdt.twin.script.commands import ImageKind
from flexdt.twin.script.scan_request import KINDS

DOCS = Path(__file__).resolve().parents[2] / "docs"
ENDING = re.compile(r"(?<![\w.])(\.[a-z][a-z0-9]*(?:\.gz)?)\b")
Differs = Callable[[], object]


def page(name: str, begin: str, end: str = "\n\n") -> str:
    """The part of a page from `begin` to `end`."""
    return (DOCS / name).read_text("utf-8").split(begin, 1)[1].split(end, 1)[0]


def endings(text: str) -> set[str]:
    return set(ENDING.findall(text))


def argument(of: object, name: str) -> str:
    """What a docstring says of one argument."""
    found = re.search(
        rf"^ *{name}: (.*?)(?=^ *[\w, ]+: |\n\n|\Z)",
        inspect.getdoc(of) or "",
        re.M | re.S,
    )
    assert found is not None, (of, name)
    return found[1]


def words(text: str) -> list[str]:
    """The words of `a, b or c` up to the end of the clause."""
    return re.split(
        r", (?:and |or )?| or | and ", re.split(r"[.;]\s|\.$|; ", text.strip())[0]
    )


def difference(found: Iterable[object], expected: Iterable[object]) -> object:
    return set(found) ^ set(expected)


# What iterates nothing is compared; each function returns the difference.


def geometry_page() -> object:
    table = page("exchange.md", "| format | file | carries | does not carry |\n")
    rows = re.findall(r"^\| `(\w+)` \| ([^|]*) \|", table, re.MULTILINE)
    stated = {(name, ending) for name, cell in rows for ending in endings(cell)}
    listed = {(form.name, e) for form in geometry.FORMATS.values() for e in form.endings}
    return difference(stated, listed)


def geometry_usage() -> object:
    usage = page("exchange.md", "--format {", "}")
    return difference(usage.split(","), geometry.exported())


def geometry_command_page() -> object:
    row = page("command-line.md", "`flexdt export DATASET", "\n").lower()
    return [name for name in geometry.exported() if name not in row]


def geometry_docstring() -> object:
    return difference(words(argument(fx.ConeVec.load, "format")), geometry.imported())


def geometry_docstring_endings() -> object:
    said = endings(argument(fx.ConeVec.load, "file"))
    return [form.name for form in geometry.FORMATS.values()
            if form.read and form.endings[0] not in said]  # fmt: skip


def volume_page() -> object:
    sentence = page(
        "reconstruction.md", "The ending of `--out` chooses the format:", "All hold"
    )
    return difference(
        endings(sentence), {f.endings[0] for f in volume_formats.VOLUME_FORMATS}
    )


def volume_docstring() -> object:
    said = (inspect.getdoc(fx.Volume.save) or "").partition("\n\n")[0]
    return difference(
        endings(said), {f.endings[0] for f in volume_formats.VOLUME_FORMATS}
    )


def reconstruction_docstring() -> object:
    said = argument(reconstruct.reconstruct_dataset, "out")
    return difference(
        endings(said), {f.endings[0] for f in volume_formats.VOLUME_FORMATS}
    )


def scan_page() -> object:
    table = page("other-scanners.md", "| scan | needs | missing from the file |\n")
    rows = re.findall(r"^\| ([\w ]+?) (`[^|]*) \|", table, re.MULTILINE)
    stated = {(name, ending) for name, cell in rows for ending in endings(cell)}
    return difference(
        stated, {(f.name, e) for f in foreign_files.SCAN_FORMATS for e in f.endings}
    )


def scan_docstring() -> object:
    said = argument(load_dataset, "folder")
    return [form.name for form in foreign_files.SCAN_FORMATS if form.name not in said]


def mesh_wire() -> object:
    return difference(get_args(scanner_messages.MeshFormat), mesh_files.FORMATS)


def mesh_pages() -> object:
    texts = (
        page("phantoms.md", "\n\nSTL, ", "files become"),
        argument(fx.phantoms.mesh_phantom, "source").split(" file,")[0],
        argument(phantom_commands.make, "mesh").rstrip("."),
    )
    named = [set(re.findall(r"\b[A-Z]{3}\b", f"STL, {text}")) for text in texts]
    return [one ^ {form.upper() for form in mesh_files.FORMATS} for one in named
            if one != {form.upper() for form in mesh_files.FORMATS}]  # fmt: skip


def mesh_docstring() -> object:
    said = words(argument(twin_methods.upload_mesh, "format"))
    return difference(said, mesh_files.FORMATS)


def unit_wire() -> object:
    return difference(get_args(scanner_messages.LengthUnit), length_units.UNITS_MM)


def unit_docstring() -> object:
    said = argument(fx.phantoms.mesh_phantom, "unit").split(": ", 1)[1]
    return difference(words(said), length_units.UNITS_MM)


GEOMETRY = (geometry_page, geometry_usage, geometry_command_page, geometry_docstring,
            geometry_docstring_endings)  # fmt: skip
VOLUMES = (volume_page, volume_docstring, reconstruction_docstring)
SCANS = (scan_page, scan_docstring)
MESHES = (mesh_wire, mesh_pages, mesh_docstring)
UNITS = (unit_wire, unit_docstring)


@pytest.mark.parametrize("differs", [*GEOMETRY, *VOLUMES, *SCANS, *MESHES, *UNITS])
def test_pages_docstrings_and_wire_state_the_lists(differs: Differs) -> None:
    assert not differs()


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (get_args(state_model.LogLevel), get_args(process_settings.LogLevel)),
        (get_args(fields.TopicName), events.MODELS),
        (get_args(script_commands.Kind), KINDS),
        (get_args(get_args(image_messages.ExposurePredict.model_fields["kind"].annotation)[0]),
         KINDS),
        (get_args(ImageKind), plots.KIND_COLOURS),
        (get_args(radiography.Physics), get_args(process_settings.Physics)),
        (SIX, random_truth.RANGES),
    ],
)  # fmt: skip
def test_lists_that_may_not_import_each_other_are_the_same(
    one: Iterable[str], other: Iterable[str]
) -> None:
    assert [*one] == [*other]
    assert len([*one]) > 2


def test_packages_that_files_need_are_those_of_the_extra() -> None:
    rooms = ("flexdt", "runtime")
    sources = [path for room in rooms for path in (DOCS.parent / room).rglob("*.py")]
    called = re.compile(
        r"""\bpackage\(\s*"(\w+)"(?:,\s*f?"[^"]*")?\)|needs (\w+): pip install 'flexdt\[io\]'"""
    )
    found = (one for path in sources for one in called.findall(path.read_text("utf-8")))
    needed = {name or said for name, said in found}
    project = tomllib.loads((DOCS.parent / "pyproject.toml").read_text("utf-8"))
    brought = project["project"]["optional-dependencies"]["io"]
    assert needed == {re.split(r"\W", one)[0] for one in brought}
    assert needed == set(page("install.md", "| `io` | ", " |").split(", "))


# Members that are added.


def add(monkeypatch: pytest.MonkeyPatch, old: tuple[Any, ...], member: object) -> None:
    """Put a tuple with one more member in place of `old`, in all modules of flexdt."""
    places = [
        (module, name)
        for title, module in [*sys.modules.items()]
        for name, value in [*vars(module).items()]
        if title.startswith("flexdt") and value is old
    ]
    assert places
    for module, name in places:
        monkeypatch.setattr(module, name, (*old, member))


@pytest.fixture
def folder(record: Callable[..., ScanRecord], written: Callable[..., Path]) -> Path:
    return written(record(frames=4))


def _write_mango(scan: ScanGeometry, out: Path) -> str:
    return json.dumps(scan.cone_vec.rows.tolist())


def _read_mango(path: Path, given: object) -> ScanGeometry:
    return ScanGeometry(fx.ConeVec(json.loads(path.read_text())))


MANGO = geometry.Format("mango", (".mango",), _write_mango, read=_read_mango)


def completions(words: str, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> set[str]:
    """What a shell is offered after these words."""
    monkeypatch.setenv("_FLEXDT_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", words)
    monkeypatch.setenv("COMP_CWORD", str(len(words.split()) - 1))
    with pytest.raises(SystemExit):
        run([])
    monkeypatch.delenv("_FLEXDT_COMPLETE")
    return set(capsys.readouterr().out.split())


def test_a_format_of_geometry_that_is_added_is_at_every_door(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setitem(geometry.FORMATS, MANGO.name, MANGO)  # type: ignore[arg-type]
    file, back = tmp_path / "g.mango", tmp_path / "back.json"
    rows = load_dataset(folder).geometry.rows
    # The library.
    export_dataset(load_dataset(folder), file, "mango")
    assert np.array_equal(import_geometry(file, "mango").cone_vec.rows, rows)
    fx.ConeVec.load(file).save(tmp_path / "again.mango")
    fx.ConeVec.load(file).save(tmp_path / "again.mango", format="mango")
    assert np.array_equal(fx.ConeVec.load(tmp_path / "again.mango").rows, rows)
    # Errors.
    scan = fx.ConeVec.load(file)
    for wrong in (
        lambda: export_dataset(load_dataset(folder), file, "none"),
        lambda: import_geometry(file, "none"),
        lambda: scan.save(tmp_path / "g.none"),
        lambda: fx.ConeVec.load(tmp_path / "g.none"),
    ):
        with pytest.raises(ExchangeError, match=r"csv.*mango"):
            wrong()
    with pytest.raises(ExchangeError, match=r"ends with \.mango"):
        export_dataset(load_dataset(folder), tmp_path / "g.csv", "mango")
    # The command line.
    file.unlink()
    assert run(["export", str(folder), "--format", "mango", "--out", str(file)]) == 0
    assert run(["import", str(file), "--format", "mango", "--out", str(back)]) == 0
    assert np.array_equal(fx.ConeVec.load(back).rows, rows)
    for command in ("export", "import"):
        capsys.readouterr()
        assert run([command, str(file), "--format", "none", "--out", str(back)]) == 2
        assert "mango" in capsys.readouterr().err
        assert run([command, "--help"]) == 0
        assert "mango" in capsys.readouterr().out
        found = completions(f"flexdt {command} --format ma", monkeypatch, capsys)
        assert found == {"mango"}
    # Pages and docstrings.
    assert all(differs() for differs in GEOMETRY)


def test_a_format_that_is_only_read_or_only_written_is_at_those_doors_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, form in (
        ("wo", geometry.Format("wo", (".wo",), _write_mango)),
        ("ro", geometry.Format("ro", (".ro",), read=_read_mango)),
    ):
        monkeypatch.setitem(geometry.FORMATS, name, form)  # type: ignore[arg-type]
    scan = fx.ConeVec.circular(sod=600, sdd=1059, angles=4, shape=(7, 9), pixel=0.15)
    scan.save(tmp_path / "g.wo")
    (tmp_path / "g.wo").rename(tmp_path / "g.ro")
    assert fx.ConeVec.load(tmp_path / "g.ro").rows.shape == (4, 12)
    for wrong in (
        lambda: scan.save(tmp_path / "h.ro"),
        lambda: scan.save(tmp_path / "h.ro", format="ro"),
        lambda: fx.ConeVec.load(tmp_path / "g.wo"),
        lambda: fx.ConeVec.load(tmp_path / "g.wo", format="wo"),
    ):
        with pytest.raises(ExchangeError, match=r"one of|there are"):
            wrong()
    assert "ro" not in geometry.exported()
    assert "wo" not in geometry.imported()


def test_endings_choose_one_format() -> None:
    for use in ("write", "read"):
        found = [
            e for f in geometry.FORMATS.values() if getattr(f, use) for e in f.endings
        ]
        assert len(set(found)) == len(found)
    volumes = [e for form in volume_formats.VOLUME_FORMATS for e in form.endings]
    assert len(set(volumes)) == len(volumes)
    # Scans may share an ending with formats that are known by their content.
    scans = [form for form in foreign_files.SCAN_FORMATS if form.holds is None]
    found = [ending for form in scans for ending in form.endings]
    assert len(set(found)) == len(found)


def _write_raw(part: Path, path: Path, grid: fx.Grid) -> Iterator[volume_formats.Sink]:
    slabs: list[Any] = []
    yield slabs.append
    np.savez(path.open("wb"), values=np.concatenate(slabs), voxel=grid.voxel_mm)


def _read_raw(path: Path) -> volume_formats.Stored:
    with np.load(path) as file:
        return file["values"], float(file["voxel"]), (0.0, 0.0, 0.0), False


def test_a_volume_format_that_is_added_is_at_every_door(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    added = volume_formats.VolumeFormat((".vol.gz",), _write_raw, _read_raw)
    add(monkeypatch, volume_formats.VOLUME_FORMATS, added)
    values = np.random.default_rng(5).random((3, 4, 5)).astype(np.float32)
    fx.Volume(values, 0.5).save(tmp_path / "v.vol.gz")
    back = fx.Volume.load(tmp_path / "v.vol.gz")
    assert np.array_equal(back.data, values)
    assert back.voxel_mm == 0.5
    for use in (back.save, fx.Volume.load):
        with pytest.raises(fx.TwinError, match=r"one of .*\.zarr, \.vol\.gz"):
            use(tmp_path / "v.none")
    assert run(["reconstruct", str(folder), "--out", str(tmp_path / "v.none")]) == 2
    assert ".vol.gz" in capsys.readouterr().err
    out = tmp_path / "made.vol.gz"
    seen = fx.ConeVec.circular(sod=100, sdd=200, angles=3, shape=(8, 9), pixel=1.0)
    fx.DataSet.from_arrays(
        np.full((3, 8, 9), 900), seen, flat=np.full((8, 9), 1000)
    ).save(tmp_path / "seen")
    sirt = ("--shape", "4,4,4", "--algorithm", "sirt", "--iterations", "1")
    assert run(["reconstruct", str(tmp_path / "seen"), *sirt, "--out", str(out)]) == 0
    assert fx.Volume.load(out).shape == (4, 4, 4)
    assert all(differs() for differs in VOLUMES)


def test_a_format_of_scans_that_is_added_is_opened_and_listed(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = load_dataset(folder)
    added = foreign_files.ScanFormat("Leap", (".leap",), lambda path, cone: data)
    add(monkeypatch, foreign_files.SCAN_FORMATS, added)
    for name in ("scan.LEAP", "scan.none"):
        (tmp_path / name).write_text("")
    assert fx.open(tmp_path / "scan.LEAP") is data
    with pytest.raises(fx.TwinError, match=r"Nikon \(\.xtekct\).*Leap \(\.leap\)"):
        fx.open(tmp_path / "scan.none")
    assert all(differs() for differs in SCANS)


def test_a_unit_that_is_added_is_at_every_door(
    monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    import trimesh

    cube: bytes = trimesh.creation.box((5.0, 6.0, 7.0)).export(file_type="stl")
    with pytest.raises(fx.TwinError, match="inch"):
        fx.phantoms.mesh_phantom(cube, file_type="stl", unit="foot")
    monkeypatch.setitem(length_units.UNITS_MM, "foot", 304.8)  # type: ignore[arg-type]
    small = trimesh.creation.box((0.01, 0.02, 0.03)).export(file_type="stl")
    sized = fx.phantoms.mesh_phantom(small, file_type="stl", unit="foot").size_mm
    assert sized == pytest.approx((3.048, 6.096, 9.144), rel=1e-6)
    with pytest.raises(fx.TwinError, match="inch, foot"):
        fx.phantoms.mesh_phantom(cube, file_type="stl", unit="mile")
    assert completions("flexdt sample --unit fo", monkeypatch, capsys) == {"foot"}
    assert run(["sample", "--help"]) == 0
    assert "foot" in capsys.readouterr().out
    assert all(differs() for differs in UNITS)


def test_a_mesh_format_that_is_added_is_read_and_listed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import trimesh

    add(monkeypatch, mesh_files.FORMATS, "dae")
    with pytest.raises(fx.TwinError, match="off, dae"):
        fx.phantoms.mesh_phantom(b"0", file_type="none")
    with pytest.raises(fx.TwinError, match="DAE"):
        fx.phantoms.mesh_phantom(
            trimesh.creation.box().export(file_type="stl"), file_type="dae"
        )
    assert all(differs() for differs in MESHES)
