"""What `show` gives in a notebook: pages with a slider, whose pictures are those of the
values."""

from __future__ import annotations

import base64
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

import flexdt as fx
from flexdt.library.notebook.notebook_pages import MAX_PICTURES, NotebookPage

PICTURE = re.compile(
    r'<img data-of="(.*?)" .*?width="(\d+)" height="(\d+)" src="data:.*?,(.*?)"(.*?)>'
)


def pictures(page: NotebookPage) -> list[tuple[str, tuple[int, int], np.ndarray, bool]]:
    """Name, size on the page (rows, cols), pixels, and whether it is shown."""
    found = []
    for name, width, height, data, more in PICTURE.findall(page.html):
        raw = np.frombuffer(base64.b64decode(data), np.uint8)
        pixels = cv2.imdecode(raw, cv2.IMREAD_UNCHANGED)
        found.append((name, (int(height), int(width)), pixels, "hidden" not in more))
    return found


def test_layers_of_a_volume_are_its_values(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    values = rng.uniform(0.0, 1.0, (7, 9, 11)).astype(np.float32)
    values[0, 0, 0] = np.nan
    volume = fx.Volume(values, (1.0, 1.0, 2.0))
    page = volume.show(window=(0.25, 0.75))
    shown = pictures(page)
    assert len(shown) == 7 + 9 + 11
    grey = np.clip(255.0 * (np.nan_to_num(values, nan=0.0) - 0.25) / 0.5, 0, 255).astype(
        np.uint8
    )
    layers = [grey[i, ::-1] for i in range(7)]
    layers += [grey[::-1, i] for i in range(9)]
    layers += [grey[::-1, :, i] for i in range(11)]
    for (_, _, pixels, _), layer in zip(shown, layers, strict=True):
        assert np.abs(pixels.astype(int) - layer).max() <= 1
    assert [name for name, _, _, seen in shown if seen] == [
        "z = 0 mm",
        "y = 0 mm",
        "x = 0 mm",
    ]
    rows, cols = next(size for name, size, _, _ in shown if name == "y = 0 mm")
    assert rows / cols == pytest.approx(
        7 * 2.0 / 11, rel=0.02
    )  # a voxel is twice as high
    page.save(tmp_path / "volume.html")
    assert page.html in (tmp_path / "volume.html").read_text()


@pytest.mark.parametrize("window", [(1.0,), (0.5, 0.5), (0.7, 0.2)])
def test_a_window_that_is_none_is_refused(window: tuple[float, ...]) -> None:
    with pytest.raises(
        fx.TwinError, match=r"window .*; allowed: \(black, white\), black first"
    ):
        fx.Volume(np.zeros((2, 3, 4), np.float32), 1.0).show(window=window)


def test_a_large_volume_shows_some_layers() -> None:
    volume = fx.Volume(np.broadcast_to(np.float32(1.0), (300, 400, 500)), 0.1)
    page = volume.show()
    assert len(pictures(page)) == 3 * MAX_PICTURES
    assert len(page.html) < 500_000


def test_frames_and_sinogram_of_a_data_set() -> None:
    scan = fx.ConeVec.circular(sod=100, sdd=200, angles=5, pixel=0.2)
    rng = np.random.default_rng(6)
    counts = rng.integers(200, 900, (5, 20, 30)).astype(np.uint16)
    data = fx.DataSet.from_arrays(counts, scan, flat=np.full((20, 30), 1000))
    *frames, sinogram = pictures(data.show())
    assert [name.split(":")[0] for name, *_ in frames] == list("01234")
    order = np.argsort(data.line_integrals(2).ravel())
    assert (np.diff(frames[2][2].ravel()[order].astype(int)) >= 0).all()
    middle = data.line_integrals()[:, 10]
    rows = sinogram[2][:: len(sinogram[2]) // 5][:5]
    assert np.corrcoef(rows.ravel(), middle.ravel())[0, 1] > 0.99
    bare = fx.DataSet.from_arrays(counts, scan)
    assert "counts" in bare.show().html


def test_a_geometry_is_drawn_with_one_scale() -> None:
    """Width of the panel, and its distance along x, in the same millimetres."""
    scan = fx.ConeVec.circular(
        sod=100, sdd=300, angles=[0.0, 90.0], shape=(40, 50), pixel=2.0
    )
    page = scan.show()
    per_mm = 420 / float(re.search(r"([\d.]+) mm across", page.html)[1])  # type: ignore[index]
    views = re.findall(
        r'<line x1="(.*?)" y1="(.*?)" x2="(.*?)".*?<polygon points="(.*?)"', page.html
    )
    (x1, _, x2, outline), (x3, _, x4, _) = views
    xs = [float(point.split(",")[0]) for point in outline.split()]
    assert max(xs) - min(xs) == pytest.approx(100.0 * per_mm, abs=0.3)
    assert abs(float(x1) - float(x2)) < 0.2  # along the line of sight
    assert abs(float(x3) - float(x4)) == pytest.approx(300.0 * per_mm, abs=0.3)
    assert page.html.count('style="display:none"') == 1
    (ax, ay, bx, by) = map(
        float,
        re.search(  # type: ignore[union-attr]
            r'class="axis" x1="(.*?)" y1="(.*?)" x2="(.*?)" y2="(.*?)"', page.html
        ).groups(),
    )
    named = re.findall(r"([xyz]) ([\d.e+]+) mm</text>", page.html)
    assert [name for name, _ in named] == list("xyz")
    assert (bx - ax) == pytest.approx(float(named[0][1]) * per_mm, abs=0.3)
    assert ay == by
    dots = [float(r) for r in re.findall(r'r="([\d.]+)" fill="#d33" opacity', page.html)]
    assert len(dots) == 2
    assert min(dots) >= 2.0


def test_axes_of_a_plotted_geometry_are_equal() -> None:
    pytest.importorskip("matplotlib", reason="the extra `plots`").use("Agg")
    axes = fx.ConeVec.circular(sod=100, sdd=300, angles=9, shape=(4, 5), pixel=2.0).plot()
    spans = [np.ptp(ends) for ends in (axes.get_xlim(), axes.get_ylim(), axes.get_zlim())]
    scales = np.divide(axes.get_box_aspect(), spans)
    assert scales == pytest.approx([scales[0]] * 3)
    assert [axes.get_xlabel(), axes.get_zlabel()] == ["x [mm]", "z [mm]"]
    dots = [line for line in axes.lines if line.get_label() in ("source", "detector")]
    assert min(line.get_markersize() for line in dots) >= 4.0


def test_widgets_show_any_layer_and_window() -> None:
    widgets = pytest.importorskip("ipywidgets", reason="the extra `notebook`")
    from flexdt.library.notebook.notebook_show import volume_widgets

    values = np.random.default_rng(7).normal(size=(6, 4, 5)).astype(np.float32)
    box = volume_widgets(widgets, fx.Volume(values, 0.5))
    columns, window = box.children
    for column, count in zip(columns.children, (6, 4, 5), strict=True):
        picture, slider = column.children
        assert (slider.min, slider.max) == (0, count - 1)
        before = [one.children[0].value for one in columns.children]
        slider.value = 0
        after = [one.children[0].value for one in columns.children]
        assert all(
            a != b for a, b in zip(after, before, strict=True)
        )  # the lines move, too
        assert bytes(picture.value).startswith(
            b"\x89PNG"
        )  # newer ipywidgets hold a view of bytes
    before = columns.children[0].children[0].value
    window.value = (0.0, 0.1)
    assert columns.children[0].children[0].value != before


def test_a_live_volume_is_a_page_where_no_program_is_behind_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("ipywidgets", reason="the extra `notebook`")
    from flexdt.library.notebook import notebook_show

    monkeypatch.setattr(notebook_show, "in_notebook", lambda: True)
    shown = fx.Volume(np.ones((4, 5, 6), np.float32), 0.5).show()
    bundle = shown._repr_mimebundle_()
    assert "<img" in bundle["text/html"]
    assert "application/vnd.jupyter.widget-view+json" in bundle


def test_a_volume_with_unknown_voxels_tells_its_finite_range() -> None:
    values = np.full((4, 5, 6), 0.25, np.float32)
    values[0] = np.nan
    values[1, 0, 0] = -0.5
    shown = fx.Volume(values, 0.5)._repr_html_()
    assert "-0.5 to 0.25 / mm; 25 % of the voxels are not known" in shown
    assert "nan to" not in shown
    assert "none is known" in fx.Volume(np.full((2, 2, 2), np.nan), 0.5)._repr_html_()


def test_two_volumes_share_a_figure_and_a_window() -> None:
    pyplot = pytest.importorskip("matplotlib.pyplot", reason="the extra `plots`")
    one, other = (fx.Volume(np.arange(60.0).reshape(3, 4, 5) * k, 0.5) for k in (1, 2))
    figure, axes = pyplot.subplots(1, 2)
    one.plot(axes[0], window=other)
    other.plot(axes[1], window=other)
    assert axes[0].images[0].get_clim() == axes[1].images[0].get_clim()
    figure.canvas.draw()
    boxes = [one.get_tightbbox() for one in axes]
    assert boxes[0].x1 <= boxes[1].x0
    pyplot.close(figure)
