"""The reader: own data sets, a scanner's folders, and everything that can be wrong with them."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flexdt.library.reading.folders import load_dataset
from flexdt.twin.dataset.dataset_errors import (
    DatasetError,
    DatasetFormatError,
    DatasetMissingError,
)
from flexdt.twin.dataset.flexdt_json import (
    DatasetDocument,
    NoiseRecord,
    SampleRecord,
    ScanRecord,
    parse_document,
)
from flexdt.twin.dataset.normalise import LineIntegrals, binned_mean
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.machine.description import builtin_profile, builtin_profiles

Make = Callable[..., ScanRecord]
Written = Callable[..., Path]
Images = Callable[[ScanRecord], dict[str, npt.NDArray[np.uint16]]]


def test_an_own_data_set_comes_back(
    written: Written, record: Make, images: Images
) -> None:
    r = record()
    d = load_dataset(written())
    assert (d.name, len(d), d.shape) == ("scan", 5, (24, 30))
    assert d.complete
    assert repr(d) == (
        "<DataSet 'scan': 5 projections of 24 x 30 (rows x columns) of 'bricks', 80 kV, "
        "complete, 1 warning>"
    )
    page = d._repr_html_()
    for fact in ("bricks", "80 kV", "flexray"):
        assert fact in page
    (told,) = d.warnings  # one flat image is three times as bright as the other
    assert "flat images differ by 100 %" in told
    assert d.require_complete() is d
    assert (d.reason, d.missing) == ("", ())
    assert [f.file for f in d.frames] == [f"scan_{i:06d}.tif" for i in range(5)]
    assert d.cone_vec == r.cone_vec(r.projections)
    assert d.machine == r.machine
    assert d.profile == r.profile
    assert d.positions["rot_obj"].tolist() == [0, 90, 180, 270, 360]
    assert d.angles_deg == pytest.approx([0, 90, 180, 270, 360])
    assert np.array_equal(d.counts(3), images(r)["scan_000003.tif"])
    assert d.settings is not None
    assert d.settings.sample_name == "bricks"


def test_line_integrals_follow_the_definition(written: Written) -> None:
    """p = 100 + 2000 exp(-k/4), dark 100, mean flat 2100, all on one slope: exactly k / 4."""
    d = load_dataset(written())
    for k in range(5):
        assert d.line_integrals(k) == pytest.approx(np.full((24, 30), k / 4), abs=2e-3)
        assert d.line_integrals(k).dtype == np.float32
    assert d.stack((4, 0)).shape == (2, 24, 30)
    assert np.array_equal(next(iter(d)), d.line_integrals(0))


def test_the_correction_stands_beside_and_is_applied_on_request(written: Written) -> None:
    d = load_dataset(written())
    assert d.correction is not None
    assert d.correction.parameters == Offsets(dO_x=0.5)
    # Moving the axis by +0.5 mm moves source and detector by -0.5 mm in the object's frame.
    assert d.corrected().source[0] - d.cone_vec.source[0] == pytest.approx([-0.5, 0, 0])
    assert d.corrected(Offsets()).rows == pytest.approx(d.cone_vec.rows)


def test_dead_pixels_take_their_neighbours_value_and_nothing_is_infinite() -> None:
    dark = np.full((4, 5), 100.0, np.float32)
    flat = np.full((4, 5), 1100.0, np.float32)
    flat[1, 1] = 100.0
    flat[3, 4] = 50.0
    normal = LineIntegrals.of(dark, flat)
    assert np.argwhere(normal.dead).tolist() == [[1, 1], [3, 4]]
    counts = np.full((4, 5), 600, np.uint16)
    counts[1, 1] = 0
    counts[2, 2] = 0
    counts[2, 3] = 100
    out = normal(counts)
    assert np.isfinite(out).all()
    assert out[1, 1] == pytest.approx(np.log(2.0), abs=1e-6)
    assert out[3, 4] == pytest.approx(np.log(2.0), abs=1e-6)
    assert out[2, 2] == out[2, 3] == pytest.approx(np.log(2000.0))
    with pytest.raises(DatasetFormatError, match="was the tube off"):
        LineIntegrals.of(dark, dark)


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_binned_images_are_means_of_whole_squares(factor: int) -> None:
    images = np.random.default_rng(1).integers(0, 999, (2, 7, 8))
    found = binned_mean(images, factor)
    assert found.shape == (2, 7 // factor, 8 // factor)
    for at in np.ndindex(found.shape):
        k, row, col = at
        square = [images[k, row * factor + i, col * factor + j]
                  for i in range(factor) for j in range(factor)]  # fmt: skip
        assert found[at] == pytest.approx(sum(square) / factor**2)


@pytest.mark.parametrize("gone", [("flexdt.json",), ("flexdt.json", "scan settings.txt"),
                                  ("flexdt.json", "data settings XRE.txt")])  # fmt: skip
def test_the_texts_alone_give_the_same_geometry(
    written: Written, record: Make, gone: tuple[str, ...]
) -> None:
    folder = written()
    for name in gone:
        (folder / name).unlink()
    d = load_dataset(folder)
    assert d.document is None
    assert d.complete
    assert d.profile is not None
    assert d.profile.name == "cwi-2023-08-21"
    expected = record().cone_vec(record().projections)
    assert np.abs(d.cone_vec.rows - expected.rows).max() < 1e-5
    assert d.positions["tra_det"][0] == 24.0
    assert d.line_integrals(2) == pytest.approx(np.full((24, 30), 0.5), abs=2e-3)
    assert d.correction is None


@pytest.mark.parametrize("name", builtin_profiles("flexray"))
def test_every_profile_is_found_from_its_figures(
    written: Written, record: Make, name: str
) -> None:
    """The rolled detectors of 2020 and 2022 too; two profiles may not be told apart if equal."""
    r = record(profile=builtin_profile(name))
    d = load_dataset(written(r), ignore_document=True)
    assert d.profile is not None
    assert d.profile.name == name
    assert np.abs(d.cone_vec.rows - r.cone_vec(r.projections).rows).max() < 1e-5


def test_another_profile_can_be_asked_for(written: Written) -> None:
    folder = written()
    thesis = builtin_profile("thesis")
    for ignore in (False, True):
        d = load_dataset(folder, profile=thesis, ignore_document=ignore)
        assert d.poses.source[0, 2] == 26.5
        assert d.poses.sod[0] == 500.0
        assert d.cone_vec == d.poses.cone_vec()


@pytest.mark.parametrize("ignore", [False, True])
def test_missing_frames_are_named(written: Written, ignore: bool) -> None:
    folder = written()
    (folder / "scan_000001.tif").unlink()
    (folder / "scan_000004.tif").unlink()
    d = load_dataset(folder, ignore_document=ignore)
    assert not d.complete
    assert d.missing == ("scan_000001.tif", "scan_000004.tif")
    assert "scan_000001.tif, scan_000004.tif are missing" in d.reason
    assert d.present == (0, 2, 3)
    assert d.stack().shape == (3, 24, 30)
    assert d.angles_deg[3] == pytest.approx(270.0)  # gaps do not shift the angles
    with pytest.raises(DatasetMissingError, match=r"scan_000004.tif is missing \(2 of 5"):
        d.line_integrals(4)
    with pytest.raises(DatasetMissingError, match=r"is incomplete: .*scan_000001"):
        d.require_complete()


def test_missing_darks_warn_and_missing_flats_are_an_error(written: Written) -> None:
    folder = written()
    (folder / "di000000.tif").unlink()
    (folder / "io000000.tif").unlink()
    (folder / "io000001.tif").unlink()
    d = load_dataset(folder, ignore_document=True)
    assert "no dark image" in d.warnings[-1]
    assert d.counts(0).shape == (24, 30)
    with pytest.raises(DatasetMissingError, match="no flat field"):
        d.line_integrals(0)
    assert "io000001.tif" in load_dataset(folder).reason


def test_unfinished_and_cancelled_scans_say_so(written: Written, record: Make) -> None:
    folder = written()
    path = folder / "flexdt.json"
    doc = parse_document(path.read_text())
    doc = doc.model_copy(update={"complete": False, "reason": "projector gone"})
    path.write_text(doc.to_json())
    d = load_dataset(folder)
    assert not d.complete
    assert d.reason == "projector gone"
    text = folder / "scan settings.txt"
    text.write_text(
        text.read_text().replace("Script summary", "SCRIPT CANCELLED!\nScript summary")
    )
    d = load_dataset(folder, ignore_document=True)
    assert not d.complete
    assert "CANCELLED" in d.reason


def image(shape: tuple[int, ...], dtype: str = "uint16") -> bytes:
    from io import BytesIO

    out = BytesIO()
    tifffile.imwrite(out, np.zeros(shape, dtype), metadata=None)
    return out.getvalue()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"II*\0\x08\0\0\0", "not a readable TIFF image: its pixels are cut off"),
        (b"\x80\x04cposix\nsystem\n.", "is no TIFF file: it begins with other bytes"),
        (image((24, 30))[:-100], "not a readable TIFF image: its pixels are cut off"),
        (b"II*\0", "not a readable TIFF image: its pixels are cut off"),
        (image((24, 31)), "has 31 x 24 pixels, the data set has 30 x 24"),
        (image((24, 30), "float32"), "float32"),
        (image((5, 24, 30)), "holds 5 images; allowed: one"),
    ],
    ids=range(8),
)
def test_damaged_images_are_named(written: Written, content: bytes, message: str) -> None:
    folder = written()
    (folder / "scan_000002.tif").write_bytes(content)
    d = load_dataset(folder)
    with pytest.raises(DatasetFormatError, match=message) as caught:
        d.counts(2)
    assert not any(
        raw in caught.value.message for raw in ("index out", "list ", "unpack")
    )
    assert str(folder / "scan_000002.tif") in caught.value.message
    assert caught.value.data["path"] == str(folder / "scan_000002.tif")


def test_images_that_do_not_fit_the_text_are_an_error(written: Written) -> None:
    folder = written()
    for path in folder.glob("*.tif"):
        path.write_bytes(image((24, 31)))
    with pytest.raises(
        DatasetFormatError, match=r"gives images of 30 x 24 pixels, but .* 31 x 24"
    ):
        load_dataset(folder, ignore_document=True)


def test_folders_that_are_none(tmp_path: Path, written: Written) -> None:
    with pytest.raises(
        DatasetMissingError, match=r"cannot read folder .*nowhere: No such file"
    ):
        load_dataset(tmp_path / "nowhere")
    (tmp_path / "first").mkdir()
    with pytest.raises(DatasetMissingError, match=r"; did you mean '.*/first'\?$"):
        load_dataset(tmp_path / "fist")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetMissingError, match="no projections"):
        load_dataset(tmp_path / "empty")
    folder = written()
    for name in ("flexdt.json", "scan settings.txt", "data settings XRE.txt"):
        (folder / name).unlink()
    with pytest.raises(DatasetMissingError, match="geometry is unknown"):
        load_dataset(folder)
    (folder / "scan settings.txt").write_text("SOD : many\n")
    with pytest.raises(DatasetFormatError, match=r"scan settings.txt, line 1: .*many"):
        load_dataset(folder)


def test_one_broken_text_is_replaced_by_the_other(written: Written) -> None:
    folder = written()
    (folder / "scan settings.txt").write_text("SOD : many\n")
    d = load_dataset(folder, ignore_document=True)
    assert "line 1" in d.warnings[0]
    assert d.poses.sod[0] == pytest.approx(514.9192)


def test_a_scanners_own_folder(tmp_path: Path, data: Path) -> None:
    """Files as the scanner leaves them: three of 361 projections, texts in its code page."""
    shutil.copy(
        data / "flexray_data_settings_XRE.txt", tmp_path / "Data Settings XRE.txt"
    )
    text = (data / "flexray_scan_settings.txt").read_bytes().replace(b"Ada", b"Ren\xe9e")
    (tmp_path / "Scan Settings.txt").write_bytes(text)
    for name in ("di000000.TIF", "io000000.tif", "io000001.tif", "scan_000000.tif",
                 "scan_000090.tif", "scan_000360.tif"):  # fmt: skip
        level = {"d": 10, "i": 110, "s": 60}[name[0]]
        tifffile.imwrite(tmp_path / name, np.full((760, 956), level, np.uint16))
    d = load_dataset(tmp_path)
    assert d.settings is not None
    assert d.settings.operator == "Renée"
    assert len(d) == 361
    assert d.present == (0, 90, 360)
    assert not d.complete
    assert len(d.missing) == 358
    assert "and 353 more are missing" in d.reason
    assert d.angles_deg[[0, 90, 360]] == pytest.approx([0.0, 90.0, 360.0])
    np.testing.assert_allclose(
        d.line_integrals(90), np.full((760, 956), np.log(2)), atol=1e-6
    )
    assert d.poses.axis[0] == pytest.approx([0.0137, 600.000003, 20.0])
    assert "cwi-2023-08-21" in d.warnings[0]


def test_a_tiled_scan_without_its_document_is_refused(
    written: Written, record: Make
) -> None:
    r = record()
    block = r.blocks[2]
    second = replace(
        block,
        files=tuple(f"scan_{i:06d}.tif" for i in range(5, 10)),
        positions={**block.positions, "ver_det": block.positions["ver_det"] + 3.0},
    )
    folder = written(replace(r, blocks=(*r.blocks, second)))
    d = load_dataset(folder)
    assert len(d) == 10
    assert d.cone_vec.detector[5, 2] - d.cone_vec.detector[0, 2] == pytest.approx(3.0)
    assert d.corrected(Offsets()).rows == pytest.approx(d.cone_vec.rows)
    with pytest.raises(DatasetFormatError, match="several sections"):
        load_dataset(folder, ignore_document=True)


def test_blocks_with_different_regions_keep_their_own_geometry(
    written: Written, record: Make
) -> None:
    from flexdt.twin.machine.camera import CameraSettings, Roi

    r = record()
    block = r.blocks[2]
    other = replace(
        block,
        files=tuple(f"left_{i:06d}.tif" for i in range(5)),
        camera=CameraSettings("HW2SW1High", Roi(882, 744, 941, 791), 80.0, 2, 5),
    )
    doc = DatasetDocument.of(replace(r, blocks=(*r.blocks, other)))
    found = doc.poses(r.machine, r.profile).cone_vec()
    assert found.rows == pytest.approx(doc.cone_vec().rows)
    assert found.detector[5] - found.detector[0] == pytest.approx([-60 * 0.0748, 0, 0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema": 2}, "schema is '2'; this version reads 1"),
        ({"frames": 3}, "frames: allowed: a list"),
        ({"detector": {}}, "detector.rows"),
        ({"machine": {}}, "machine"),
        ({"duration_s": "long"}, "duration_s"),
        ({"frames": []}, "lists no projections"),
        ({"duration_s": math.nan}, "duration_s"),
        ({"sample": {"diameter_mm": math.inf}}, "sample.diameter_mm"),
        ({"noise": {"model": {"i0_counts": math.nan}}}, "noise.model"),
    ],
)
def test_wrong_documents_name_file_key_and_value(
    written: Written, change: dict[str, object], message: str
) -> None:
    path = written() / "flexdt.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(DatasetError) as caught:
        load_dataset(path.parent)
    assert message in caught.value.message
    assert str(path) in caught.value.message


@pytest.mark.parametrize(
    "name", ["../../etc/passwd", "/etc/passwd", "C:\\x.tif", "a\0.tif", ""]
)
def test_a_document_cannot_name_files_elsewhere(written: Written, name: str) -> None:
    path = written() / "flexdt.json"
    content = json.loads(path.read_text())
    content["frames"][2]["file"] = name
    path.write_text(json.dumps(content))
    with pytest.raises(DatasetFormatError, match=r"frames\.2\.file"):
        load_dataset(path.parent)


def test_a_document_whose_cone_vec_was_changed_is_noticed(written: Written) -> None:
    path = written() / "flexdt.json"
    content = json.loads(path.read_text())
    content["frames"][3]["cone_vec"][0] += 0.01
    path.write_text(json.dumps(content))
    assert (
        "does not follow from its motor positions"
        in load_dataset(path.parent).warnings[0]
    )


def test_documents_come_back_equal(record: Make) -> None:
    doc = DatasetDocument.of(record())
    assert parse_document(doc.to_json()) == doc
    assert doc.machine_of() == record().machine
    assert doc.profile_of() == record().profile


def test_what_a_document_leaves_out_is_what_older_ones_meant(record: Make) -> None:
    content = json.loads(DatasetDocument.of(record()).to_json())
    for key in ("flexdt", "operator", "smooth", "complete", "reason", "sample", "noise",
                "correction", "settings_positions"):  # fmt: skip
        del content[key]
    doc = parse_document(json.dumps(content))
    assert (doc.flexdt, doc.operator, doc.reason) == ("", "", "")
    assert (doc.smooth, doc.complete, doc.correction) == (True, False, None)
    assert (doc.sample, doc.noise, doc.settings_positions) == (
        SampleRecord(),
        NoiseRecord(),
        {},
    )
    assert vars(SampleRecord()) == {
        "name": "", "owner": "", "project": "", "comment": "", "diameter_mm": 0.0, "height_mm": 0.0,
        "material": None, "revision": None, "offset": None,
    }  # fmt: skip
    assert doc.cone_vec(None).rows.shape == (8, 12)
    assert doc.files("flat") == ("io000000.tif", "io000001.tif")


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.text(max_size=8), inner, max_size=3)
    ),
    max_leaves=8,
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(key=st.sampled_from(sorted(DatasetDocument.model_fields)), value=JSON)
def test_garbage_in_a_document_is_a_format_error(
    record: Make, key: str, value: object
) -> None:
    content = json.loads(DatasetDocument.of(record()).to_json())
    content["schema" if key == "schema_version" else key] = value
    with suppress(DatasetFormatError):
        doc = parse_document(json.dumps(content))
        doc.machine_of()
        doc.profile_of()
