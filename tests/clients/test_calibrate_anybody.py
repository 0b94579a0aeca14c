"""Calibration of anybody's data: markers of unknown positions, marked by hand, foreign frames.

Images and annotations come from the rays and planes of `tests/studies/prior_coverage.py`,
which share nothing with the fit.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
import unknown_markers as study
from prior_coverage import PIXEL, SDD, SHAPE, SOD, pixels, radiographs

import flexdt as fx
from flexdt.clients.cli.command_tree import run
from flexdt.library.calibration.markers import (
    Scale,
    calibrate_unknown,
    read_markers,
)
from flexdt.library.reading.listed_images import markers_alone
from flexdt.phantoms import load_phantom
from flexdt.twin.calibration import Detections, detect_beads
from flexdt.twin.calibration.frame_source import nothing
from flexdt.twin.calibration.pipeline import CalibrationRequest
from flexdt.twin.calibration.unknown_markers import link, triangulate
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.offsets import NOMINAL
from flexdt.twin.geometry.poses import Poses


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("anybody")
    study.write(folder, seed=3, views=16)
    return folder


@pytest.mark.slow
def test_unknown_markers_are_found_in_foreign_float_images(
    written: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames, geometry = str(written / "frames"), str(written / "geometry.json")
    words = [
        "calibrate",
        "--frames",
        frames,
        "--geometry",
        geometry,
        "--phantom",
        "unknown",
    ]
    assert run([*words, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["rms_px"] < 0.05
    assert document["scale"] == "free"
    # The same scan, made once more for its truth.
    rng = np.random.default_rng([7, 3])
    truth, beads = study.truth_of(rng), study.balls(rng, 8)
    found = np.array([m["position_mm"] for m in document["markers"]])
    assert len(found) == 8
    # From the highest to the lowest; heights differ by more than a tilt of the axis makes.
    worst, _ = study.unlike(found, beads[np.argsort(-beads[:, 2])])
    assert worst < 0.002
    p = document["parameters"]
    for name in ("dO_x", "dD_x", "det_roll", "det_yaw"):
        assert abs(p[name]["value"] - truth[name]) < 4 * p[name]["sigma"]
    assert p["dO_z"]["sigma"] > 25  # nothing says how far the axis is


@pytest.mark.slow
def test_annotations_by_hand_are_fitted_by_one_command(
    written: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "calibrate",
        "--geometry",
        str(written / "geometry.json"),
        "--phantom",
        "unknown",
    ]
    words += ["--markers", str(written / "markers.csv")]
    truth, _, beads, _ = study.marked(3, 16, 12, study.HAND_PX, 0.2)
    mm = np.linalg.norm(beads[0] - beads[5])
    assert run([*words, "--scale", f"0-5={mm:.3f}", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert 0.35 < document["rms_px"] < 0.6
    found = np.array([m["position_mm"] for m in document["markers"]])
    assert np.linalg.norm(found[0] - found[5]) == pytest.approx(mm, abs=0.05)
    assert study.unlike(found, beads)[0] < 0.3
    p = document["parameters"]
    for name in ("dO_x", "dO_z", "dD_x", "det_roll"):
        assert abs(p[name]["value"] - truth[name]) < 4 * p[name]["sigma"]
    assert run(words) == 0
    assert "give the distance of two: --scale A-B=MM" in capsys.readouterr().out


def test_the_example_of_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).parents[2] / "docs" / "calibrate-any-scanner.md").read_text(
        "utf-8"
    )
    block = page.split("```python\n")[1].split("```")[0]
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(block, names)
    column = names["column"]
    assert abs(column["value"] - (477.5 - 0.8 / 0.1496)) < 4 * column["sigma"]
    assert 0.01 < column["sigma"] < 0.3
    assert study.unlike(np.array(names["positions"]), names["markers"])[0] < 0.3


def test_annotated_beads_of_a_known_phantom(tmp_path: Path) -> None:
    beads = load_phantom("lego").beads
    angles = 36.0 * np.arange(10)
    truth = {
        "dO_x": 3.0,
        "dO_y": -2.0,
        "dO_z": 5.0,
        "alpha": 130.0,
        "tau_x": 0.5,
        "tau_z": -0.3,
    }
    tracks = pixels(beads, angles, SOD, truth)
    tracks += 0.1 * np.random.default_rng(1).normal(size=tracks.shape)
    tracks[2, 1] = np.nan
    np.save(tmp_path / "seen.npy", tracks)
    scan = study.geometry(angles)
    found = fx.calibrate(None, "lego", geometry=scan, markers=tmp_path / "seen.npy")
    assert found.calibration.identifiable
    for name, true in truth.items():
        p = found.parameters[name]
        assert abs(p["value"] - true) < 4 * p["sigma"]  # type: ignore[operator]
    assert found.document["detections"] == 49
    rows = [
        (i, str(k), *tracks[i, k].tolist(), None)
        for i, k in np.ndindex(10, 5)
        if (i, k) != (2, 1)
    ]
    same = fx.calibrate(None, "lego", geometry=scan, markers=rows)
    assert same.parameters == found.parameters
    numbered = [(i, int(k), *rest) for i, k, *rest in rows]
    assert (
        fx.calibrate(None, "lego", geometry=scan, markers=numbered).parameters
        == same.parameters
    )
    for bad in (
        7,
        (0, "1", 3.0, 4.0),
        (0.5, "1", 3.0, 4.0, None),
        (0, "1", "left", 4.0, None),
    ):
        with pytest.raises(
            TwinError, match=r"mark 1 is .* allowed: \(frame, marker, column, row"
        ):
            fx.calibrate(None, "lego", geometry=scan, markers=[rows[0], bad])
    with pytest.raises(
        TwinError, match="marker '4' is no bead of 'normal-4'; allowed: 0 to 3"
    ):
        fx.calibrate(None, "normal-4", geometry=scan, markers=tmp_path / "seen.npy")
    with pytest.raises(TwinError, match="no data: allowed with geometry and markers"):
        fx.calibrate(None, "lego", geometry=scan)


@pytest.mark.parametrize("ending", ["json", "npy", "txt", "npz", "csv", "xml", "toml"])
def test_any_program_s_geometry_goes_with_marked_beads(
    ending: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    angles = 36.0 * np.arange(10)
    truth = {"dO_x": 1.5, "dO_y": 0.7, "alpha": 20.0}
    tracks = pixels(load_phantom("lego").beads, angles, SOD, truth)
    np.save(
        tmp_path / "seen.npy",
        tracks + 0.05 * np.random.default_rng(2).normal(size=(10, 5, 2)),
    )
    study.geometry(angles).save(tmp_path / f"scan.{ending}")
    words = ["calibrate", "--markers", str(tmp_path / "seen.npy"), "--phantom", "lego", "--json",
             "--geometry", str(tmp_path / f"scan.{ending}")]  # fmt: skip
    unsaid = {"npy": "shape=", "txt": "shape=", "xml": "pixel="}
    if ending in unsaid:
        assert run(words) != 0
        assert unsaid[ending] in capsys.readouterr().err
    assert run([*words, "--shape", "760,956", "--pixel", "0.1496"]) == 0
    p = json.loads(capsys.readouterr().out)["parameters"]
    for name, true in truth.items():
        assert abs(p[name]["value"] - true) < 4 * p[name]["sigma"]


@pytest.mark.parametrize(
    ("columns", "named"),
    [(slice(9, 12), "rows upwards"), (slice(6, 9), "from right to left")],
)
def test_a_panel_counted_the_other_way_is_named(
    columns: slice, named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """ASTRA's own `cone` geometry has v upwards; beads then lay "behind the source"."""
    angles = 36.0 * np.arange(10)
    np.save(tmp_path / "seen.npy", pixels(load_phantom("lego").beads, angles, SOD, {}))
    rows = study.geometry(angles).rows.copy()
    rows[:, columns] *= -1.0
    np.save(tmp_path / "vectors.npy", rows)
    words = ["calibrate", "--markers", str(tmp_path / "seen.npy"), "--phantom", "lego",
             "--geometry", str(tmp_path / "vectors.npy"), "--shape", "760,956"]  # fmt: skip
    assert run(words) != 0
    assert named in capsys.readouterr().err


def test_compressed_images_of_another_writer_are_read(tmp_path: Path) -> None:
    images = np.random.default_rng(4).integers(900, 1000, (3, 40, 50)).astype(np.uint16)
    lzw, packbits = 5, 32773
    for i, (image, how) in enumerate(zip(images, (lzw, packbits, lzw), strict=True)):
        packed = [cv2.IMWRITE_TIFF_COMPRESSION, how]
        assert cv2.imwrite(str(tmp_path / f"p{i}.tif"), image, packed)
    for name in ("di0.tif", "io0.tif"):
        cv2.imwrite(
            str(tmp_path / name), np.full((40, 50), 1000 * (name[0] == "i"), np.uint16)
        )
    scan = fx.ConeVec.circular(sod=100, sdd=200, angles=3, pixel=1)
    np.testing.assert_array_equal(fx.read_tiffs(tmp_path, scan).counts(), images)
    short = (tmp_path / "p1.tif").read_bytes()[:600]
    (tmp_path / "p1.tif").write_bytes(short)
    with pytest.raises(TwinError, match=r"p1\.tif"):
        fx.read_tiffs(tmp_path, scan).counts()


@pytest.mark.slow
@pytest.mark.campaign
def test_sigmas_of_unknown_markers_are_true() -> None:
    """Pulls over random truths, noise and missing markers: their root mean square is 1."""
    rows = [study.annotated(seed) for seed in range(24)]
    assert all(r["identifiable"] for r in rows)
    square = [np.mean([r["pulls"][n] ** 2 for n in r["pulls"]]) for r in rows]
    assert 0.6 < np.sqrt(np.mean(square)) < 1.35
    assert max(abs(p) for r in rows for p in r["pulls"].values()) < 4.5


@pytest.fixture(scope="module")
def seen(written: Path) -> tuple[fx.DataSet, list[Detections]]:
    """The written frames with the spots in each."""
    data = fx.read_tiffs(written / "frames", written / "geometry.json")
    return data, [detect_beads(image) for image in data]


@pytest.mark.slow
def test_linking_finds_what_turns(seen: tuple[fx.DataSet, list[Detections]]) -> None:
    data, spots = seen
    index, places, _ = link(spots, data.poses, NOMINAL)
    assert index.shape == (16, len(places)) == (16, 8)
    with pytest.raises(TwinError, match="0 markers are found"):
        link([nothing(d.shape) for d in spots], data.poses, NOMINAL)


@pytest.mark.slow
def test_linking_refuses_what_does_not_turn(
    seen: tuple[fx.DataSet, list[Detections]],
) -> None:
    """All spots are there, but the angles are not those of the images."""
    data, spots = seen
    wrong = np.random.default_rng(0).permutation(16)
    with pytest.raises(TwinError, match=r"markers are found that move as the angles say"):
        link([spots[i] for i in wrong], data.poses, NOMINAL)


def test_points_seen_from_one_direction_are_nowhere() -> None:
    cone = study.geometry(np.array([0.0, 90.0, 180.0]))
    points = np.array([[5.0, -3.0, 7.0]])
    tracks = cone.project_points(points, SHAPE)
    assert triangulate(tracks, cone, SHAPE) == pytest.approx(points, abs=1e-9)
    tracks[1:] = np.nan
    with pytest.raises(TwinError, match="marker 0 is seen in too few directions"):
        triangulate(tracks, cone, SHAPE)


@pytest.mark.parametrize("radius_mm", [0.17, 0.4, 2.0])
def test_spots_of_two_pixels_and_more_need_no_option(radius_mm: float) -> None:
    rng = np.random.default_rng(4)
    beads = np.array([[-9.0, 4, 15], [8, -5, 6], [0, 9, -3], [-6, -8, -14], [10, 3, -22]])
    (image,) = radiographs(
        rng, beads, np.array([20.0]), SOD, {}, radius_mm, 0.5 / radius_mm
    )
    seen = detect_beads(image)
    true = pixels(beads, np.array([20.0]), SOD, {})[0]
    assert len(seen) == 5
    assert np.linalg.norm(seen.centers[:, None] - true, axis=2).min(axis=1).max() < 0.15
    assert np.median(seen.radii_px) == pytest.approx(
        radius_mm * SDD / SOD / PIXEL, rel=0.1
    )


def test_nothing_detected_says_what_was_looked_for(tmp_path: Path) -> None:
    for i in range(3):
        noise = np.random.default_rng(i).normal(scale=0.01, size=SHAPE).astype(np.float32)
        tifffile.imwrite(tmp_path / f"view{i}.tif", noise)
    scan = study.geometry(120.0 * np.arange(3))
    found = fx.calibrate(tmp_path, "lego", geometry=scan)
    (said,) = [f.text for f in found.calibration.errors]
    assert (
        "looked for were round spots, darker than what is round them, of 7.7 to 17.7 px"
        in said
    )
    found = fx.calibrate(tmp_path, "lego", geometry=scan, radius=3)
    assert "of 2.0 to 4.5 px radius" in found.calibration.errors[0].text
    with pytest.raises(TwinError, match=r"radius 0.2 px; allowed: 1.5 to 60"):
        fx.calibrate(tmp_path, "lego", geometry=scan, radius=0.2)


def test_float_images_are_counts_or_line_integrals(tmp_path: Path) -> None:
    integrals = np.linspace(0.0, 3.0, 60, dtype=np.float32).reshape(3, 4, 5)
    scan = fx.ConeVec.circular(sod=100, sdd=200, angles=3, pixel=1)
    for kind, dark, flat in (("integrals", 0.0, 0.0), ("counts", 7.0, 300.0)):
        folder = tmp_path / kind
        folder.mkdir()
        for i, image in enumerate(integrals):
            seen = dark + (flat - dark) * np.exp(-image) if flat else image
            tifffile.imwrite(folder / f"p{i}.tif", seen.astype(np.float32))
        if flat:
            tifffile.imwrite(folder / "io.tif", np.full((4, 5), flat, np.float32))
            tifffile.imwrite(folder / "di.tif", np.full((4, 5), dark, np.float32))
        data = fx.read_tiffs(folder, scan)
        assert data.line_integrals() == pytest.approx(integrals, abs=3e-4)
    tifffile.imwrite(folder / "p1.tif", np.zeros((3, 5), np.float32))
    with pytest.raises(
        TwinError, match=r"p1.tif has 5 x 3 pixels, the data set has 5 x 4"
    ):
        fx.read_tiffs(folder, scan)
    tifffile.imwrite(folder / "p1.tif", np.full((4, 5), np.nan, np.float32))
    with pytest.raises(TwinError, match=r"p1.tif has pixels that are no numbers"):
        fx.read_tiffs(folder, scan)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "line 1: columns none; allowed: frame, marker, column, row"),
        ("frame,marker,column\n", "line 1: columns frame, marker, column; allowed"),
        ("frame,marker,x,y\n0,a,1,two\n", "line 2: '0,a,1,two' is not"),
        ("frame,marker,x,y\n0,a,1,2\n0,a,1,2\n", "line 3: marker 'a' in frame 0"),
        ("view,point,u,v,sigma\n9,a,1,2,0.5\n", "allowed: frames 0 to 3"),
        ("view,point,u,v,sigma\n0,a,1,2,0\n", "sigma above 0"),
        ("view,point,u,v,sigma\n0,a,1,2,inf\n", "sigma above 0 to 10000"),
        (
            "frame,marker,x,y\n0,a,inf,2\n",
            "line 2: pixel (inf, 2); allowed: up to 100000",
        ),
        ("frame,marker,x,y\n0,a,1,-1e12\n", "allowed: up to 100000"),
        ("frame,marker\r,x,y\n0,a,1,2\n", "cannot read"),
    ],
)
def test_files_of_markers_that_do_not_hold_say_where(
    tmp_path: Path, text: str, says: str
) -> None:
    file = tmp_path / "markers.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(TwinError, match=r"markers.csv") as caught:
        read_markers(file, 4)
    assert says in str(caught.value)


def test_files_of_markers(tmp_path: Path) -> None:
    file = tmp_path / "markers.csv"
    file.write_text(
        "row,Column,id,frame,sigma\n2,1,10,0,.3\n\n4,3,9,1,.2\n,,9,0,1\n", "utf-8"
    )
    found = read_markers(file, 2)
    assert found.names == ("9", "10")
    assert found.tracks[0, 1].tolist() == [1.0, 2.0]
    assert found.tracks[1, 0].tolist() == [3.0, 4.0]
    assert np.isnan(found.tracks[0, 0]).all()
    assert found.sigma[1, 0] == 0.2
    np.save(tmp_path / "flat.npy", np.zeros((2, 3)))
    with pytest.raises(TwinError, match=r"shape 2 x 3; allowed: 2 frames x markers x 2"):
        read_markers(tmp_path / "flat.npy", 2)
    np.save(tmp_path / "complex.npy", np.zeros((2, 3, 2), np.complex128))
    np.save(tmp_path / "far.npy", np.full((2, 3, 2), np.inf))
    with pytest.raises(TwinError, match="pixels up to inf; allowed: 100000"):
        read_markers(tmp_path / "far.npy", 2)
    for name in ("none.npy", "complex.npy"):
        with pytest.raises(TwinError, match=r"cannot read|there is no file"):
            read_markers(tmp_path / name, 2)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda tracks: tracks, None),
        (lambda tracks: tracks[::-1], "angle_reversed"),
        (lambda tracks: (SHAPE[1] - 1, 0) + (-1, 1) * tracks, "angle_reversed"),
        (lambda tracks: np.repeat(tracks[:1], len(tracks), axis=0), "not_turning"),
    ],
)
@pytest.mark.daily(1)
def test_what_is_wrong_with_unknown_markers_is_named(
    change: Any, code: str | None
) -> None:
    """And where nothing is, nothing is said: the markers' own frame is no value held
    exactly."""
    _, angles, _, markers = study.marked(1, 12, 8, 0.1, 0.0)
    data = markers_alone(study.geometry(angles), "marks")
    marked = replace(markers, tracks=np.array(change(markers.tracks)))
    found, _ = calibrate_unknown(data, None, marked, CalibrationRequest(free=("dO_x",)))
    codes = [f.code for f in found.findings]
    assert codes == [] if code is None else code in codes
    assert found.identifiable == (code is None)


@pytest.mark.parametrize(
    "text", ["0-1", "0=5", "0-1=x", "0-1=inf", "0-1=3+-inf", "0-1=-3", "-1=3", "0-1=3+-0"]
)
def test_scales_of_another_form_are_refused(text: str) -> None:
    assert Scale.of("a-b=3.5+-0.1") == Scale("a", "b", 3.5, 0.1)
    with pytest.raises(TwinError, match="allowed: A-B=MM"):
        Scale.of(text)


def test_options_that_do_not_go_together(
    written: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    geometry, markers = str(written / "geometry.json"), str(written / "markers.csv")
    words = ["calibrate", "--geometry", geometry, "--phantom"]
    for more, code, says in (
        (["unknown"], 2, "no data set; allowed: --frames DIR or --markers FILE"),
        (["lego", "--markers", markers], 1, "is no bead of 'lego'; allowed: 0 to 4"),
        (["lego", "--markers", markers, "--scale", "0-1=5"], 2, "states its own size"),
        (
            ["unknown", "--markers", markers, "--scale", "0-99=5"],
            1,
            "no marker '99'; allowed: 0",
        ),
        (
            ["unknown", "--markers", markers, "--scale", "0-0=5"],
            1,
            "allowed: two markers",
        ),
        (["unknown", "--markers", str(written / "none.csv")], 1, "none.csv"),
    ):
        assert run([*words, *more]) == code
        assert says in " ".join(capsys.readouterr().err.split())


def test_poses_do_not_matter() -> None:
    """The machine's own poses and those told from the vectors give the same marker
    positions."""
    truth, angles, _, markers = study.marked(1, 12, 6, 0.1, 0.0)
    told = markers_alone(study.geometry(angles), "vectors")
    u, v = [PIXEL, 0, 0], [0, 0, -PIXEL]
    own = Poses([0, 0, 0], [0, SOD, 0], [0, SDD, 0], u, v, np.radians(angles))
    found = []
    for data in (told, replace(told, nominal=own)):
        result, _ = calibrate_unknown(
            data, None, markers, CalibrationRequest(free=("dO_x",))
        )
        assert result.fit is not None
        found.append(result.fit)
    assert found[0].beads == pytest.approx(found[1].beads, abs=1e-3)
    assert abs(found[0].values["dO_x"] - truth["dO_x"]) < 4 * found[0].sigmas["dO_x"]
