"""Files as other programs write them are read right, refused for their key, or told."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import as_others_write as others
import numpy as np
import pytest

import flexdt as fx
from flexdt.library.datasets.exchange import import_geometry
from flexdt.library.datasets.geometry_content import Given
from flexdt.twin.errors import TwinError

CASES = [
    (form, key)
    for form, one in others.LAYOUTS.items()
    for key in dict.fromkeys((*one.figures, *one.needed))
]


def opened(form: str, raw: bytes, folder: Path) -> fx.DataSet:
    layout = others.LAYOUTS[form]
    return fx.open(others.scene(folder, layout, raw), **layout.open)


def tried(read: Callable[[], Any]) -> tuple[Any, str]:
    """What a reader returns, or None and its refusal."""
    try:
        return read(), ""
    except TwinError as error:
        return None, str(error)


def said_of(data: fx.DataSet) -> str:
    return "\n".join(data.warnings)


@pytest.mark.parametrize("how", others.SAME)
@pytest.mark.parametrize("form", others.LAYOUTS)
@pytest.mark.daily(16)
@pytest.mark.campaign(60)
def test_a_text_that_says_the_same_is_read_the_same(
    form: str, how: str, tmp_path: Path
) -> None:
    layout = others.LAYOUTS[form]
    rng = np.random.default_rng(1)
    data = opened(form, others.SAME[how](layout, rng), tmp_path)
    found = others.seen(data.geometry.rows, data.shape)
    np.testing.assert_allclose(found, layout.truth, rtol=2e-7, atol=2e-6)
    half = data.line_integrals()
    np.testing.assert_allclose(half, np.log(2.0), atol=2.0 / layout.level)
    assert not data.provenance.unknown, data.provenance.unknown
    assert not data.provenance.of("contradicted")


@pytest.mark.parametrize("how", others.SAME)
@pytest.mark.parametrize("form", others.LAYOUTS)
@pytest.mark.daily(12)
@pytest.mark.campaign(40)
def test_what_is_not_known_is_named_however_it_is_written(
    form: str, how: str, tmp_path: Path
) -> None:
    layout = others.LAYOUTS[form]
    text = others.planted(layout, layout.text)
    changed = others.Layout(**{**vars(layout), "text": text})
    data = opened(form, others.SAME[how](changed, np.random.default_rng(2)), tmp_path)
    (said,) = data.provenance.unknown
    assert said.field.lower().endswith(others.PLANTED)
    assert said_of(data).lower().count(others.PLANTED) == 1


@pytest.mark.parametrize("how", others.OTHER)
@pytest.mark.parametrize(("form", "key"), CASES)
@pytest.mark.daily(16)
@pytest.mark.campaign(80)
def test_a_figure_that_is_changed_is_refused_or_told(
    form: str, key: str, how: str, tmp_path: Path
) -> None:
    layout = others.LAYOUTS[form]
    text = others.OTHER[how](layout, key)
    if text == layout.text:
        pytest.fail("nothing was changed")
    data, refused = tried(lambda: opened(form, text.encode(), tmp_path))
    if data is None:
        assert key.removesuffix("X").partition(" (")[0].lower() in refused.lower()
        return
    same = np.allclose(
        others.seen(data.geometry.rows, data.shape), layout.truth, rtol=1e-6, atol=1e-5
    ) and np.allclose(data.line_integrals(), np.log(2.0), atol=2.0 / layout.level)
    told = key in said_of(data) or "geometry" in said_of(data)
    uses = {one.use.value for one in data.provenance.field(key)}
    assert same or told or "contradicted" in uses, (how, data.geometry, data.warnings)


def draw_rtk(rng: np.random.Generator) -> tuple[list[dict[str, float]], dict[str, float]]:
    common = {"SourceToIsocenterDistance": 500.5, "SourceToDetectorDistance": 900.25}
    names = ["OutOfPlaneAngle", "InPlaneAngle", "SourceOffsetX", "SourceOffsetY",
             "ProjectionOffsetX", "ProjectionOffsetY"]  # fmt: skip
    for name in names:
        if rng.integers(3) == 0:
            common[name] = float(rng.uniform(-4, 4))
    views = []
    for k in range(4):
        view = {"GantryAngle": (k * 90 + float(rng.uniform(0, 5))) % 360}
        view |= {n: float(rng.uniform(-4, 4)) for n in names if n not in common}
        views.append(view)
    return views, common


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("how", ["LF", "CRLF", "BOM", "UTF-16"])
@pytest.mark.daily(8)
@pytest.mark.campaign(30)
def test_rtk_s_views_are_those_of_its_page(how: str, seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng([seed, 3])
    views, common = draw_rtk(rng)
    text = others.rtk_text(views, common, f"<{others.PLANTED}>7</{others.PLANTED}>")
    coded = {"LF": text.encode(), "CRLF": text.replace("\n", "\r\n").encode(),
             "BOM": b"\xef\xbb\xbf" + text.encode(), "UTF-16": text.encode("utf-16")}  # fmt: skip
    path = tmp_path / "g.xml"
    path.write_bytes(coded[how])
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        cone, refused = tried(lambda: fx.ConeVec.load(path, pixel=0.5))
    if cone is None:
        assert how == "UTF-16"
        assert "UTF-8" in refused
        return
    assert sum(others.PLANTED in str(one.message) for one in told) == 1
    points = rng.uniform(-30, 30, (5, 3))
    for row, view in zip(cone.rows, views, strict=True):
        source, panel, u, v = row.reshape(4, 3)
        for x, y, z in points:  # RTK's (x, y, z) is our (x, z, -y)
            matrix = others.rtk_by_its_page(common | view) @ [x, z, -y, 1.0]
            expected = matrix[:2] / matrix[2]
            ray = np.array([x, y, z]) - source
            _, a, b = np.linalg.solve(np.stack([ray, -u, -v], 1), panel - source)
            assert np.allclose([a * 0.5, b * 0.5], expected, atol=1e-6)


VIEW = "<Projection>"
DAMAGE = {
    "twice": ("<GantryAngle>", "<GantryAngle>11</GantryAngle><GantryAngle>", "GantryAngle"),
    "words": ("<SourceToIsocenterDistance>", "<SourceToIsocenterDistance>far ",
              "SourceToIsocenterDistance"),
    "curved": (VIEW, f"<RadiusCylindricalDetector>900</RadiusCylindricalDetector>{VIEW}",
               "RadiusCylindricalDetector"),
    "jaws": (VIEW, f"<CollimationUInf>20</CollimationUInf>{VIEW}", "CollimationUInf"),
    "attribute": (VIEW, f'<Projection {others.PLANTED}="1">', others.PLANTED),
    "below": (VIEW, f"{VIEW}<Tube><{others.PLANTED}>1</{others.PLANTED}></Tube>",
              others.PLANTED),
    "two distances": (VIEW, f"{VIEW}<SourceToDetectorDistance>800</SourceToDetectorDistance>",
                      "SourceToDetectorDistance"),
}  # fmt: skip


@pytest.mark.parametrize("how", DAMAGE)
def test_rtk_s_rivals_are_refused_or_told(how: str, tmp_path: Path) -> None:
    views, common = draw_rtk(np.random.default_rng(9))
    old, new, key = DAMAGE[how]
    text = others.rtk_text(views, common, "")
    if how == "two distances":  # the matrix would contradict it, too
        text = text.split("<Matrix>")[0] + "</Projection></RTKThreeDCircularGeometry>"
    (tmp_path / "g.xml").write_text(text.replace(old, new, 1))
    given = Given(pitch_mm=(0.5, 0.5))
    found, refused = tried(lambda: import_geometry(tmp_path / "g.xml", "rtk", given))
    if found is None:
        assert key in refused
        return
    assert any(key in note for note in found.notes), found.notes


PLACES = ["", "detector", "geometry", "geometry/stage", "geometry/source/center", "acquisition",
          "detector/pixel_pitch", "acquisition/pixel_binning", "materials/0", "file"]  # fmt: skip


@pytest.mark.parametrize("place", PLACES)
def test_an_unknown_key_of_a_scenario_is_named(place: str, tmp_path: Path) -> None:
    pytest.importorskip("flexdt_extensions")
    ctsimu_texts = pytest.importorskip("ctsimu_texts")
    document: Any = ctsimu_texts.scenario(16, 20, 3)
    path = tuple(int(p) if p.isdigit() else p for p in place.split("/") if p)
    file = tmp_path / "s.json"
    file.write_text(others.with_planted(document, path))
    found = import_geometry(file, "ctsimu")
    assert [one.field for one in found.provenance.unknown] == [
        ".".join((*map(str, path), others.PLANTED)).replace(".0.", "[0].")
    ]
    assert sum(others.PLANTED in note for note in found.notes) == 1


def test_a_scenario_of_before_its_keys_were_renamed_is_told(tmp_path: Path) -> None:
    """The page on drifts has `drift`, files have `drifts`: the former must not be dropped."""
    ctsimu_texts = pytest.importorskip("ctsimu_texts")
    pytest.importorskip("flexdt_extensions")
    document: Any = ctsimu_texts.scenario(16, 20, 3)
    document["detector"]["pixel_pitch"]["u"]["drift"] = [
        {"value": [0.0, 0.5], "unit": "mm"}
    ]
    (tmp_path / "s.json").write_text(json.dumps(document))
    found = import_geometry(tmp_path / "s.json", "ctsimu")
    assert any("drift" in note for note in found.notes), found.notes


def opened_tree(form: str, tree: others.Tree, folder: Path) -> fx.DataSet:
    pytest.importorskip("h5py")
    write, name = others.HDF5[form]
    return fx.open(write(folder / name, tree))


@pytest.mark.parametrize("how", others.TREES)
@pytest.mark.parametrize("form", others.HDF5)
@pytest.mark.daily(8)
@pytest.mark.campaign(36)
def test_a_tree_that_says_the_same_is_read_the_same(
    form: str, how: str, tmp_path: Path
) -> None:
    data = opened_tree(form, others.TREES[how], tmp_path)
    found = others.seen(data.geometry.rows, data.shape)
    truth = (others.SOD, others.SDD, others.PITCH, 6.5, 4.5, others.STEP)
    close = 1e-5 if how == "float32" else 1e-9
    np.testing.assert_allclose(found, truth, rtol=close, atol=1e-5)
    np.testing.assert_allclose(data.line_integrals(), np.log(2.0), atol=1e-4)
    assert not data.provenance.unknown, data.provenance.unknown
    assert not data.provenance.of("contradicted")


TREE_PLACES = [
    f"{group}{others.PLANTED}"
    for group in (
        "",
        "{entry}/",
        "{detector}/",
        "{entry}/new group/",
        "{detector}/deep/er/",
    )
]


@pytest.mark.parametrize(
    "value", [7.25, "a text", np.arange(300.0), np.zeros((3, 4), ">i2")]
)
@pytest.mark.parametrize("place", TREE_PLACES)
@pytest.mark.parametrize("form", others.HDF5)
@pytest.mark.daily(8)
@pytest.mark.campaign(40)
def test_what_is_not_known_in_a_tree_is_named(
    form: str, place: str, value: Any, tmp_path: Path
) -> None:
    data = opened_tree(form, others.Tree(more={place: value}), tmp_path)
    (said,) = data.provenance.unknown
    assert said.field.endswith(others.PLANTED)
    assert said_of(data).count(others.PLANTED) == 1


@pytest.mark.parametrize("unit", ["furlong", "", "px", "degC", "mm^2"])
@pytest.mark.parametrize("kind", ["length", "angle"])
@pytest.mark.parametrize("form", others.HDF5)
@pytest.mark.daily(6)
@pytest.mark.campaign(20)
def test_a_unit_that_is_none_is_refused(
    form: str, kind: str, unit: str, tmp_path: Path
) -> None:
    usual = {"length": 1e-3, "angle": 1.0}[kind]
    tree = others.Tree(**{kind: (unit, usual)})
    data, refused = tried(lambda: opened_tree(form, tree, tmp_path))
    if unit:
        assert unit in refused
        return
    found = others.seen(data.geometry.rows, data.shape)  # the usual one is taken
    np.testing.assert_allclose(found[:2], (others.SOD, others.SDD), rtol=1e-9)


LACKING = [(form, name) for form, names in others.NEEDED.items() for name in names]


@pytest.mark.parametrize(("form", "name"), LACKING)
def test_what_lacks_in_a_tree_is_asked_for_by_name(
    form: str, name: str, tmp_path: Path
) -> None:
    _, refused = tried(lambda: opened_tree(form, others.Tree(without=(name,)), tmp_path))
    assert name in refused
    assert "give " in refused
