"""What a Nikon folder may contradict: distances, numbers as text, lost images, previews."""

import numpy as np
import pytest
import tifffile

import flexdt as fx
from flexdt.twin.dataset.dataset_errors import DatasetError

VIEWS, SHAPE = 8, (6, 9)


def xtekct(folder, said=None, before="", names=None):
    names = [f"part_{i + 1:04d}.tif" for i in range(VIEWS)] if names is None else names
    for i, name in enumerate(names):
        tifffile.imwrite(folder / name, np.full(SHAPE, 100 + i, np.uint16))
    lines = {
        "Name": "part", "Projections": VIEWS, "WhiteLevel": 1000, "DetectorPixelsX": SHAPE[1],
        "DetectorPixelsY": SHAPE[0], "DetectorPixelSizeX": 0.2, "DetectorPixelSizeY": 0.2,
        "SrcToObject": 100.5, "SrcToDetector": 400.25, "InitialAngle": 0.0, "AngularStep": 45.0,
        "InputFolderName": "", **(said or {}),
    }  # fmt: skip
    path = folder / "part.xtekct"
    text = "[XTekCT]\r\n" + "".join(f"{key}={value}\r\n" for key, value in lines.items())
    path.write_text(before + text)
    return path


@pytest.mark.parametrize(
    "said",
    [{"SrcToObject": 0}, {"SrcToObject": 500}, {"SrcToObject": -100}, {"SrcToDetector": 0},
     {"DetectorPixelSizeX": 0}, {"DetectorPixelSizeY": -0.2}, {"SrcToDetector": "inf"},
     {"SrcToObject": "nan"}, {"DetectorPixelSizeX": 300}, {"Projections": 1e30},
     {"Projections": -3}, {"SrcToObject": "1e999"}, {"AngularStep": "9" * 5000},
     {"Projections": 8.9}, {"DetectorPixelsX": 9.5}, {"WhiteLevel": 0}, {"WhiteLevel": -1000},
     {"AngularStep": "1.234,5"}, {"SrcToObject": "100.5 mm"}],
)  # fmt: skip
def test_impossible_numbers_are_refused(tmp_path, said):
    path = xtekct(tmp_path, said)
    with pytest.raises(DatasetError, match=r"part\.xtekct"):
        fx.open(path)


@pytest.mark.parametrize(("before", "said"), [
    ("", {"SrcToObject": "100,5", "SrcToDetector": "400,25"}), ("\ufeff", {}),
    ("; a comment\n\n", {}), ("", {"SrcToObject ": "\t100.5"}),
])  # fmt: skip
def test_numbers_as_some_countries_write_them_are_read(tmp_path, before, said):
    data = fx.open(xtekct(tmp_path, said, before))
    assert np.linalg.norm(data.geometry.source[0]) == pytest.approx(100.5)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig", "latin-1"])
@pytest.mark.parametrize("ends", ["\r\n", "\n", "\r"])
def test_texts_in_any_encoding_are_read(tmp_path, encoding, ends):
    """Helsinki: as programs of Windows and of old machines write them."""
    path = xtekct(tmp_path, {"Name": "Z\u00fcrich"})
    text = path.read_text("utf-8").replace("\r\n", "\n").replace("\n", ends)
    path.write_bytes(text.encode(encoding))
    assert len(fx.open(path)) == VIEWS


@pytest.mark.parametrize(
    ("key", "value"),
    [("SrcToObject", 200), ("AngularStep", -45), ("Projections", 9), ("WhiteLevel", 900)],
)
def test_a_key_with_two_values_is_refused(tmp_path, key, value):
    path = xtekct(tmp_path)
    text = path.read_text()
    path.write_text(text + f"[Copy]\n{key}={value}\n")
    with pytest.raises(DatasetError, match=rf"{key} is \S+ and {value}; allowed"):
        fx.open(path)
    path.write_text(text + "".join(text.splitlines(True)[1:]))
    assert fx.open(path).warnings == ()  # the same values twice
    path.write_text(text + "Notes=1\nNotes=2\n")
    [told] = fx.open(path).warnings
    assert told.endswith("ignored: Notes = 1, Notes = 2")


@pytest.mark.parametrize("lean", [0.0, 0.06, -0.06])
@pytest.mark.parametrize("middle", [0.0, 0.4, -0.4])
def test_old_centres_of_rotation_place_the_axis(tmp_path, middle, lean):
    """CIL#1277: millimetres along the columns where the axis meets first and last row."""
    stated = [middle + lean, middle - lean]
    keys = ("CentreOfRotationTop", "CentreOfRotationBottom")
    data = fx.open(xtekct(tmp_path, dict(zip(keys, stated, strict=True))))
    height = SHAPE[0] * 0.2 / 2 * 100.5 / 400.25
    ends = np.array([[0.0, 0.0, height], [0.0, 0.0, -height]])
    columns = data.geometry.project_points(ends, SHAPE)[0][:, 0]
    across = (columns - (SHAPE[1] - 1) / 2) * 0.2
    np.testing.assert_allclose(across, stated, atol=2e-3)


@pytest.mark.parametrize("lost", [1, 4, VIEWS])
@pytest.mark.parametrize("preview", [True, False])
def test_a_lost_image_shifts_no_view(tmp_path, lost, preview):
    names = [f"part_{i + 1:04d}.tif" for i in range(VIEWS)]
    path = xtekct(tmp_path, names=names)
    (tmp_path / names[lost - 1]).unlink()
    if preview:
        tifffile.imwrite(tmp_path / "part_preview.tif", np.zeros(SHAPE, np.uint16))
    data = fx.open(path)
    assert not data.complete
    assert data.missing == (names[lost - 1],)
    assert [int(data.counts(i)[0, 0]) for i in data.present] == [
        100 + i for i in range(VIEWS) if i != lost - 1
    ]


def test_a_preview_is_left_out(tmp_path):
    path = xtekct(tmp_path)
    tifffile.imwrite(tmp_path / "preview.tif", np.full(SHAPE, 1, np.uint16))
    data = fx.open(path)
    assert (len(data), data.complete) == (VIEWS, True)
    assert any("preview.tif" in doubt for doubt in data.warnings)


def test_a_text_of_any_length_is_refused(tmp_path, monkeypatch):
    path = xtekct(tmp_path)
    with path.open("ab") as file:
        file.truncate(17 << 20)
    with pytest.raises(DatasetError, match="at most 16777216 bytes"):
        fx.open(path)


def listed_angles(folder, ending, angles):
    """A list of angles as Inspect-X leaves it: `_ctdata.txt` or `part.ang`."""
    head = "Projs Frames Exposure(ms)\n{} 1 1000\nProjection\tAngle(deg)\tTime(s)\n"
    rows = "".join(f"{i + 1}\t{angle}\t{2 * i}\n" for i, angle in enumerate(angles))
    if ending == ".ang":
        rows = "".join(f"{i + 1}:\t{angle}\n" for i, angle in enumerate(angles))
        head = "Proj\tAngle(deg)\n"
    (folder / f"part{ending}").write_text(head.format(len(angles)) + rows)


def turned(data):
    """Angles of the sources about the axis, from the first one [deg]."""
    x, y = data.geometry.source[:, :2].T
    return np.rad2deg(np.unwrap(np.arctan2(y, x) - np.arctan2(y[0], x[0])))


@pytest.mark.parametrize("ending", ["_ctdata.txt", ".ang"])
@pytest.mark.parametrize("way", [1, -1])
def test_measured_angles_win_and_both_are_told(tmp_path, ending, way):
    path = xtekct(tmp_path)
    planned = turned(fx.open(path))
    listed_angles(tmp_path, ending, way * 45.0 * np.arange(VIEWS))
    data = fx.open(path)
    assert data.warnings == ()
    np.testing.assert_allclose(turned(data), planned, atol=1e-9)
    listed_angles(tmp_path, ending, way * 22.5 * np.arange(VIEWS))
    data = fx.open(path)
    np.testing.assert_allclose(turned(data), planned / 2.0, atol=1e-9)
    [told] = data.warnings
    assert "157.5 deg by" in told
    assert "315 deg by InitialAngle and AngularStep" in told
    [step] = data.provenance.field("AngularStep")
    assert step.use == "contradicted"


def test_a_list_of_other_length_is_not_used_and_told(tmp_path):
    path = xtekct(tmp_path)
    listed_angles(tmp_path, ".ang", [0.0, 1.0])
    data = fx.open(path)
    np.testing.assert_allclose(np.abs(np.diff(turned(data))), 45.0, atol=1e-9)
    [told] = data.warnings
    assert "2 angles, 8 views: it is not used" in told


def test_of_two_lists_the_measured_one_wins(tmp_path):
    path = xtekct(tmp_path)
    listed_angles(tmp_path, "_ctdata.txt", 44.0 * np.arange(VIEWS))
    listed_angles(tmp_path, ".ang", -45.0 * np.arange(VIEWS))
    data = fx.open(path)
    np.testing.assert_allclose(np.abs(np.diff(turned(data))), 44.0, atol=1e-9)
    assert len(data.warnings) == 0  # 7 deg in 315 are within .2 steps


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({"NewCentreX": 3.2}, "1 field not known to flexdt, ignored: NewCentreX = 3.2"),
        ({"CoefX2": 0.3}, "CoefX2 0.3, which is not applied: line integrals"),
        ({"ObjectOffsetX": 0.4, "CentreOfRotationTop": 1, "CentreOfRotationBottom": 1},
         "ObjectOffsetX 0.4 mm at the axis; ObjectOffsetX is taken"),
        ({"Shuttling": "True"}, "Shuttling True, which is not applied"),
    ],
)  # fmt: skip
def test_what_is_not_honoured_is_told(tmp_path, said, words):
    told = fx.open(xtekct(tmp_path, said)).warnings
    assert any(words in one for one in told), told


def test_every_line_has_its_use_and_it_is_saved(tmp_path):
    (tmp_path / "scan").mkdir()
    path = xtekct(tmp_path / "scan", {"CoefX1": 1.0, "Scattering": 0, "XraykV": 90})
    data = fx.open(path)
    assert data.warnings == ()
    lines = path.read_text().splitlines()[1:]
    assert [f"{one.field}={one.value}" for one in data.provenance] == lines
    assert {one.field for one in data.provenance.of("ignored")} == {
        "InputFolderName", "CoefX1", "Scattering"
    }  # fmt: skip
    data.save(tmp_path / "saved")
    assert fx.open(tmp_path / "saved").provenance == data.provenance
    given = fx.open(path, geometry=data.geometry)
    assert [one.field for one in given.provenance.of("contradicted")][:2] == [
        "DetectorPixelSizeX",
        "DetectorPixelSizeY",
    ]


@pytest.mark.parametrize(("unit", "scale"), [("cm", 10.0), ("um", 1e-3)])
def test_lengths_are_in_the_unit_of_the_file(tmp_path, unit, scale):
    plain = fx.open(xtekct(tmp_path)).geometry.rows
    said = {"Units": unit, "SrcToObject": 100.5 / scale, "SrcToDetector": 400.25 / scale,
            "DetectorPixelSizeX": 0.2 / scale, "DetectorPixelSizeY": 0.2 / scale}  # fmt: skip
    np.testing.assert_allclose(fx.open(xtekct(tmp_path, said)).geometry.rows, plain)
    with pytest.raises(DatasetError, match="Units is ell; allowed: um, mm"):
        fx.open(xtekct(tmp_path, {"Units": "ell"}))
