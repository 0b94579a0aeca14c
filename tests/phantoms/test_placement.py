"""A sample stands where its file has it, in every spelling: against own rays through a box."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import trimesh

import flexdt as fx
from flexdt.phantoms import PhantomError, load_phantom, material, mesh_phantom
from flexdt.phantoms.samples import as_phantom
from flexdt.protocol.methods.scanner_messages import SampleUpload
from flexdt.server.storage.sample_uploads import UploadHead
from flexdt.server.storage.stored_samples import _parse
from flexdt.twin.errors import TwinError

SCAN = fx.ConeVec.circular(sod=300, sdd=600, angles=3, shape=(24, 32), pixel=4.0)
MU = material("pmma").mu_per_mm
SHARP = fx.Detector.ideal()


def through_box(middle: npt.ArrayLike, size: npt.ArrayLike) -> Any:
    """Lengths [mm] of the rays from the source to each pixel inside a box, by its slabs."""
    rows = np.asarray(SCAN, dtype=np.float64).reshape(len(SCAN), 12)
    v, u = np.mgrid[:24, :32]
    v, u = v - 11.5, u - 15.5
    low, high = (np.asarray(middle) + s * np.asarray(size) / 2 for s in (-1, 1))
    found = []
    for row in rows:
        source = row[:3]
        to = row[3:6] + u[..., None] * row[6:9] + v[..., None] * row[9:12] - source
        with np.errstate(divide="ignore"):
            a, b = (low - source) / to, (high - source) / to
        enters = np.minimum(a, b).max(axis=-1)
        leaves = np.maximum(a, b).min(axis=-1)
        length = np.maximum(leaves - enters, 0.0) * np.linalg.norm(to, axis=-1)
        found.append(length)
    return np.array(found)


def upload(raw: bytes, place: str | None) -> Any:
    head = UploadHead.of(
        SampleUpload.model_validate(
            {
                "name": "up",
                "kind": "mesh",
                "format": "stl",
                "total": len(raw),
                "data": b"",
            }
            | ({} if place is None else {"place": place})
        )
    )
    return _parse(head, raw, "pmma")


def scene(folder: Path) -> Path:
    file = folder / "scene.toml"
    file.write_text('schema = 1\n[[mesh]]\nfile = "box.stl"\nmaterial = "pmma"\n')
    return file


SPELLINGS: dict[str, Callable[[Any, Path, Path], Any]] = {
    "mesh": lambda mesh, file, folder: (mesh, "pmma"),
    "list": lambda mesh, file, folder: [(mesh, "pmma")],
    "file": lambda mesh, file, folder: (str(file), "pmma"),
    "files": lambda mesh, file, folder: [(file, "pmma")],
    "phantom": lambda mesh, file, folder: mesh_phantom(file, material="pmma"),
    "bytes": lambda mesh, file, folder: mesh_phantom(
        file.read_bytes(), material="pmma", file_type="stl"
    ),
    "scene": lambda mesh, file, folder: scene(folder),
}


@pytest.mark.parametrize("spelling", SPELLINGS)
@pytest.mark.parametrize("seed", range(3))
def test_a_mesh_stays_where_it_is_in_every_spelling(
    spelling: str, seed: int, tmp_path: Path
) -> None:
    random = np.random.default_rng(seed)
    size, at = random.uniform(4, 12, 3), random.uniform(-9, 9, 3)
    mesh = trimesh.creation.box(size, trimesh.transformations.translation_matrix(at))
    file = tmp_path / "box.stl"
    file.write_bytes(mesh.export(file_type="stl"))
    sample = SPELLINGS[spelling](mesh, file, tmp_path)
    expected = MU * through_box(at, size)
    assert fx.project(sample, SCAN) == pytest.approx(expected, abs=1e-4)
    scan = fx.simulate(sample, SCAN, tube=fx.Tube(mono_keV=50.0), detector=SHARP, rays=1)
    assert scan.truth.line_integrals() == pytest.approx(expected, abs=1e-3)
    centred = fx.project(sample, SCAN, place="centred")
    assert centred == pytest.approx(MU * through_box((0, 0, 0), size), abs=1e-4)
    said = re.search(
        r"moved by \((.*)\) mm", as_phantom(sample, place="centred").description
    )
    assert said is not None
    assert np.array(said[1].split(","), float) == pytest.approx(-at, rel=1e-4)


@pytest.mark.slow  # each upload is read in a process of its own
def test_what_the_wire_leaves_out_stays_and_what_it_asks_for_is_centred() -> None:
    mesh = trimesh.creation.box(
        (2, 4, 6), trimesh.transformations.translation_matrix((5, 6, 7))
    )
    raw = mesh.export(file_type="stl")
    kept, centred = upload(raw, None), upload(raw, "centred")
    assert kept.boxes[0].mean(axis=0) == pytest.approx([5, 6, 7])
    assert "moved" not in kept.description
    assert centred.boxes[0].mean(axis=0) == pytest.approx([0, 0, 0])
    assert "moved by (-5, -6, -7) mm" in centred.description
    old = UploadHead.model_validate(
        {"name": "old", "format": "stl", "total": len(raw), "unit": "mm"}
    )
    assert _parse(old, raw, None).boxes[0].mean(axis=0) == pytest.approx([0, 0, 0])


@pytest.mark.parametrize("name", ["lego", "gear", "normal-3", "shepp-logan"])
def test_any_sample_can_be_centred_and_its_beads_go_with_it(name: str) -> None:
    whole = load_phantom(name)
    aside = as_phantom([{"kind": "sphere", "center": [40, 0, 0], "radius": 1, "material": "abs"},
                        whole], place="centred")  # fmt: skip
    low, high = aside.boxes[:, 0].min(axis=0), aside.boxes[:, 1].max(axis=0)
    assert (low + high) / 2 == pytest.approx([0, 0, 0], abs=1e-9)
    by = aside.boxes[0].mean(axis=0) - [40, 0, 0]
    assert aside.beads == pytest.approx(whole.beads + by)
    assert aside.boxes[1:] == pytest.approx(whole.boxes + by)
    assert np.array(aside.size_mm) == pytest.approx(high - low)


def test_voxels_are_centred_and_what_is_centred_stays_itself() -> None:
    volume = fx.Volume(
        np.full((4, 4, 4), 0.1, np.float32), 1.0, center_mm=(3.0, -2.0, 1.0)
    )
    there = fx.project(volume, SCAN)
    here = fx.project(volume, SCAN, place="centred")
    assert there == pytest.approx(0.1 * through_box((3, -2, 1), (4, 4, 4)), abs=1e-5)
    assert here == pytest.approx(0.1 * through_box((0, 0, 0), (4, 4, 4)), abs=1e-5)
    ball = as_phantom(
        {"kind": "sphere", "center": [0, 0, 0], "radius": 1, "material": "abs"}
    )
    assert as_phantom(ball, place="centred") is ball
    with pytest.raises(TwinError, match="keep"):
        as_phantom(ball, place="center")  # type: ignore[arg-type]
    with pytest.raises((TwinError, PhantomError), match="place"):
        fx.project(ball, SCAN, place="middle")  # type: ignore[arg-type]
