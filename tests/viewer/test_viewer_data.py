"""Past scans on the page: found, opened, gone through with machine and radiograph, brought
back."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import as_others_write as others
import numpy as np
import pytest
import tifffile
from lab import fly_script
from looking import USUAL, seen, until

import flexdt as fx
from flexdt.clients.client.client import TwinClient

pytestmark = pytest.mark.browser
FRAMES = 9
Wait = Callable[..., Any]


@pytest.fixture(scope="module")
def scans(lab: Any) -> Iterator[Any]:
    """A scan; the same cut short, with a damaged image; a folder of images alone."""
    for left in lab.data.glob("*/flexdt.json"):  # whatever other tests have left
        shutil.rmtree(left.parent)
    with lab.client() as twin:
        twin.set_tube(on=False, kV=90, power_W=20)
        twin.set_camera(**USUAL)
        twin.set_sample("lego")
        twin.submit_script(fly_script(frames=FRAMES), "whole scan", "max")
        assert twin.wait_job().state == "done"
        twin.control("release")
    for name in ("cut scan", "bare", "own texts"):
        shutil.copytree(lab.data / "whole scan", lab.data / name)
    (lab.data / "cut scan" / "scan_000004.tif").write_bytes(b"II*\0")
    (lab.data / "cut scan" / "scan_000008.tif").unlink()
    (lab.data / "own texts" / "flexdt.json").unlink()
    for file in ("flexdt.json", "scan settings.txt", "data settings XRE.txt"):
        (lab.data / "bare" / file).unlink()
    yield lab.data
    for name in ("whole scan", "cut scan", "bare", "own texts"):
        shutil.rmtree(lab.data / name)


@pytest.fixture(autouse=True)
def closed(page: Any) -> Iterator[None]:
    yield
    page.evaluate("flexdt.data.open(null)")


def find(page: Any, words: str) -> None:
    page.click("#tabs [data-tab=data]")
    page.fill("#data-search", words)


def shows(page: Any, index: int) -> None:
    page.wait_for_function(
        f"document.querySelector('#record').dataset.index === '{index}'"
    )
    page.wait_for_function(
        f"flexdt.store.image?.recorded?.index === {index} && !flexdt.store.moment.missing"
    )


def pixels(page: Any) -> Any:
    """What the page has got, as it was saved."""
    told = page.evaluate(
        "(({low, scale, shape, pixels}) => ({low, scale, shape, pixels: [...pixels]}))"
        "(flexdt.store.image)"
    )
    return (told["low"] + told["scale"] * np.array(told["pixels"])).reshape(told["shape"])


def test_data_sets_are_found_by_words(page: Any, scans: Any) -> None:
    find(page, "scan lego")
    page.locator(".data-set[data-name='cut scan']").wait_for()
    page.locator("#data-count", has_text="2 scans").wait_for()
    whole = page.locator(".data-set[data-name='whole scan']")
    assert "9 projections · 90 kV 20 W · 100 ms · lego" in whole.inner_text()
    assert whole.locator(".state.complete").count() == 1
    assert whole.locator("canvas").evaluate("c => c.width") == 64
    cut = page.locator(".data-set[data-name='cut scan']").inner_text()
    assert "8 of 9 projections" in cut
    assert "incomplete: scan_000008.tif is missing" in cut
    find(page, "no such data set")
    page.locator("#data-count", has_text="none is found").wait_for()
    assert page.locator(".data-set").count() == 0


def test_frames_are_gone_through_with_the_machine(page: Any, scans: Any) -> None:
    """Pixels and poses are those of the files, read here by tifffile and json."""
    frames = json.loads((scans / "whole scan" / "flexdt.json").read_text("utf-8"))[
        "frames"
    ]
    find(page, "whole")
    page.locator("#data-count", has_text="1 scan").wait_for()
    page.locator(".data-set[data-name='whole scan']").click()
    shows(page, 2)  # the first projection
    page.select_option("#kind", "counts")
    for index in (2, 0, len(frames) - 1):
        page.locator("#record-frame").evaluate(
            "(e, v) => { e.value = v; e.dispatchEvent(new Event('input')); }", index
        )
        shows(page, index)
        page.wait_for_function("flexdt.store.image.kind === 'counts'")
        file = scans / "whole scan" / frames[index]["file"]
        assert np.array_equal(pixels(page), tifffile.imread(file))
        told = page.evaluate("flexdt.store.image.recorded.positions")
        assert told == frames[index]["positions"]
        page.locator("#record-at", has_text=Path(frames[index]["file"]).stem).wait_for()
    page.locator("#record-note", has_text="cylinder around the sample").wait_for()
    page.locator("#film-recorded", has_text="recorded · scan_000008").wait_for()
    page.select_option("#kind", "line_integral")
    page.wait_for_function("flexdt.store.image?.kind === 'line_integral'")
    # A click on the time axis goes to the image nearest to it.
    box = page.locator("#record-line").bounding_box()
    page.locator("#record-line").click(position={"x": 1, "y": box["height"] - 4})
    shows(page, 0)
    page.click("#record-close")
    page.wait_for_function("flexdt.store.image && !flexdt.store.image.recorded")
    assert not page.locator("#film-recorded").is_visible()


def test_values_of_another_maker_s_file_are_shown_with_their_uses(
    page: Any, scans: Any, tmp_path: Any
) -> None:
    """A scan of Nikon's that was opened with angles of its own and saved; the scanner's texts
    alone; and a scan of flexdt's own, which has no such values."""
    layout = others.NIKON
    text = others.planted(layout, layout.text).replace("CoefX2=0.0", "CoefX2=0.25")
    path = others.scene(tmp_path, layout, text.encode())
    data = fx.open(path, angles=np.linspace(0.0, 200.0, others.VIEWS))
    data.save(scans / "from nikon")
    try:
        find(page, "from nikon")
        page.locator(".data-set[data-name='from nikon']").click()
        shows(page, 2)
        box = page.locator("#record-values")
        unused = sum(one.use != "used" for one in data.provenance)
        words = f"{len(data.provenance)} values of its file, {unused} not used"
        assert box.locator("summary").text_content() == words
        box.locator("summary").click()
        rows = box.locator("tr")
        assert rows.count() == 1 + len(data.provenance)
        shown = [row.split("\t") for row in rows.all_inner_texts()]
        assert shown[0] == ["field", "value", "use", "consequence"]
        uses = {row[0]: row[2] for row in shown[1:]}
        assert uses["SrcToObject"] == "used"
        assert uses["AngularStep"] == "contradicted"
        assert uses[others.PLANTED] == "ignored"
        told = {row[0]: row[3] for row in shown[1:]}
        assert told["AngularStep"] == "angles= takes its place"
        assert told[others.PLANTED] == "not known to flexdt"
        assert "not applied" in told["CoefX2"]
        assert rows.first.is_visible()
        find(page, "own texts")
        page.locator(".data-set[data-name='own texts']").click()
        page.locator("#record-name", has_text="own texts").wait_for()
        page.wait_for_function(
            "[...document.querySelectorAll('#record-values td')]"
            ".some((e) => e.textContent === 'SOD')"
        )
        find(page, "whole")
        page.locator(".data-set[data-name='whole scan']").click()
        page.locator("#record-name", has_text="whole scan").wait_for()
        box.wait_for(state="hidden")
    finally:
        shutil.rmtree(scans / "from nikon")


def test_the_geometry_that_is_read_is_that_of_the_image_shown(
    page: Any, scans: Any, twin: TwinClient, wait: Wait
) -> None:
    """Not of the machine, which has moved since; what is not known is said to be so."""
    frames = json.loads((scans / "whole scan" / "flexdt.json").read_text("utf-8"))[
        "frames"
    ]
    page.evaluate("flexdt.call('session.control', {action: 'force'})")
    to = (
        "mm => flexdt.call('axes.move', {targets: {mag_det: mm}, plan: true, wait: true})"
    )
    page.evaluate(to, 940)
    try:
        seen(page, twin)
        now, stands = twin.state().geometry, twin.state().axes["mag_det"].position
        read = lambda: page.inner_text("#readouts")  # noqa: E731
        live = f"SDD\n{now.SDD_mm:.2f} mm"
        wait(lambda: live in read(), "the machine's")
        page.evaluate("flexdt.data.open('whole scan')")
        shows(page, 2)
        sdd = now.SDD_mm + frames[2]["positions"]["mag_det"] - stands
        assert abs(sdd - now.SDD_mm) > 1.0
        said = read()
        assert f"SOD\n{now.SOD_mm:.2f} mm\nSDD\n{sdd:.2f} mm" in said
        assert f"magnification\n{sdd / now.SOD_mm:.4f}×" in said
        assert f"voxel\n{1000 * 0.1496 * now.SOD_mm / sdd:.2f} µm" in said
        assert said.endswith("beam\n90 kV, 20 W")
        assert page.text_content("#geometry-title") == (
            f"Geometry of whole scan, {Path(frames[2]['file']).stem}"
        )
        assert page.inner_text("#geometry-of") == "nominal, as scanned"
        page.evaluate("flexdt.data.open('bare')")
        page.locator(
            "#geometry-title", has_text=re.compile(r"^Geometry of bare, \w+$")
        ).wait_for()
        assert page.inner_text("#geometry-of") == "not known"
        assert "SDD\n–" in read()
        page.evaluate("flexdt.data.open(null)")
        wait(lambda: live in read(), "the machine's again")
    finally:
        page.evaluate(
            "flexdt.call('axes.move', {targets: {mag_det: 1059}, plan: true, wait: true})"
        )
        page.evaluate("flexdt.call('session.control', {action: 'release'})")


@pytest.mark.timeout(900)
def test_a_past_scan_is_reconstructed_and_gone_through(
    page: Any, scans: Any, twin: TwinClient, wait: Wait
) -> None:
    """In two clicks, or with the reason why not; slices scroll by wheel, keys and drag without
    asking, the value under the pointer is exact, and what no data cover is said."""
    find(page, "whole")
    page.locator(".data-set[data-name='whole scan']").click()
    shows(page, 2)
    page.click("#record-volume")
    page.locator("#volume-note", has_text="FDK needs").wait_for()
    twin.submit_script(fly_script(frames=61, exposure_ms=500.0), "turned once", "max")
    assert twin.wait_job().state == "done"
    twin.control("release")
    find(page, "turned once")
    page.locator(".data-set[data-name='turned once']").click()
    shows(page, 2)
    page.click("#record-volume")
    # Its process is behind all others (nice), so that a busy machine makes it wait.
    page.locator("#volume-title", has_text="Volume of turned once").wait_for(
        timeout=400_000
    )
    page.locator("#volume-note", has_text="flexdt reconstruct --binning").wait_for(
        timeout=400_000
    )
    page.wait_for_function("flexdt.volume().three.block && flexdt.volume().solid")
    nx, ny, nz = page.evaluate("flexdt.volume().told.size")
    cross = "flexdt.volume().three.cross"
    assert page.evaluate(cross) == [nx // 2, ny // 2, nz // 2]
    page.locator("#slice-top").scroll_into_view_if_needed()
    wait(
        lambda: page.locator("#slice-top").get_attribute("data-index") == str(nz // 2),
        "a slice",
    )
    before = page.evaluate("document.querySelector('#slice-top').toDataURL()")
    sent = page.evaluate("flexdt.call('state.get').then(() => 0)")
    page.locator("#slice-top").focus()
    page.keyboard.press("PageUp")
    page.keyboard.press("ArrowUp")
    page.locator("#slice-top").hover()
    page.mouse.wheel(0, 100)
    wait(
        lambda: page.evaluate(cross) == [nx // 2, ny // 2, nz // 2 + 10 + sent],
        "keys and wheel",
    )
    wait(
        lambda: (
            page.evaluate("document.querySelector('#slice-top').toDataURL()") != before
        ),
        "it",
    )
    box = page.locator("#slice-front").bounding_box()
    page.mouse.move(box["x"] + box["width"] * 0.5, box["y"] + box["height"] * 0.5)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 0.25, box["y"] + box["height"] * 0.75)
    page.mouse.up()
    x, y, z = page.evaluate(cross)
    assert (abs(x - nx / 4) < 2, y, abs(z - nz / 4) < 2) == (True, ny // 2, True)
    read = re.compile(r"mm\s+(-?[\d.e-]+) per mm ± ([\d.e-]+), bias at most ([\d.e-]+)")
    page.locator("#volume-at", has_text=read).wait_for(timeout=400_000)  # once compared
    exact = page.evaluate(
        "at => flexdt.call('viewer.voxel', { ...flexdt.volume().of, at })", [x, y, z]
    )
    told = [float(word) for word in read.search(page.inner_text("#volume-at")).groups()]  # type: ignore[union-attr]
    assert told[0] == pytest.approx(exact["volume"], abs=0.01 * exact["sigma"])
    assert told[1:] == pytest.approx([exact["sigma"], exact["bias_bound"]], rel=0.06)
    # Its errors are volumes, too, each with a window of its own.
    block, highs = "flexdt.volume().three.block", set()
    for what in ("sigma", "bias_bound", "volume"):
        high = page.evaluate(f"{block}.high")
        page.select_option("#volume-shown", what)
        page.wait_for_function(f"high => {block}.high !== high", arg=high)
        highs.add(page.evaluate(f"{block}.high"))
    assert len(highs) == 3
    page.select_option("#volume-tool", "profile")
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 0.75, box["y"] + box["height"] * 0.5)
    page.mouse.up()
    page.locator("#volume-profile").wait_for()
    page.evaluate("const v = flexdt.volume().three; v.block.codes.fill(0); v.go(v.cross)")
    page.locator("#volume-at", has_text="no data along this line").wait_for()
    page.select_option("#volume-tool", "")
    page.mouse.move(box["x"] + 20, box["y"] + 20)
    page.locator("#volume-at", has_text="no data cover this voxel").wait_for()
    page.click("#volume-cancel")
    page.locator("#volume-title", has_text=re.compile("^Volume")).wait_for()
    assert not page.locator("#slice-top").is_visible()
    page.click("#record-close")
    shutil.rmtree(scans / "turned once")


def test_an_image_that_cannot_be_read_leaves_none_in_its_place(
    page: Any, scans: Any
) -> None:
    page.evaluate("flexdt.data.open('cut scan')")
    shows(page, 2)
    for index, why in ((6, "not a readable TIFF image"), (10, "is not there")):
        page.locator("#record-frame").evaluate(
            "(e, v) => { e.value = v; e.dispatchEvent(new Event('input')); }", index
        )
        page.locator("#record-at", has_text=why).wait_for()
        assert page.evaluate("flexdt.store.image") is None
        page.locator("#film-recorded", has_text="no image to be shown").wait_for()
    page.click("#record-back")
    shows(page, 9)
    page.evaluate("flexdt.data.open('bare')")
    page.locator("#record-note", has_text="poses and times are not known").wait_for()
    assert page.locator("#record-replay").is_disabled()
    assert page.locator("#compare-mode").is_disabled()


def part(page: Any, what: str) -> Any:
    """The recorded or the virtual image as the page got it, (rows, cols)."""
    told = page.evaluate(
        "what => (({low, scale, shape, [what]: p}) => ({low, scale, shape, p: [...p]}))"
        "(flexdt.store.image)",
        what,
    )
    return (told["low"] + told["scale"] * np.array(told["p"])).reshape(told["shape"])


def compares(page: Any, how: str) -> None:
    page.select_option("#compare-mode", how)
    page.wait_for_function("flexdt.store.image?.virtual && flexdt.store.image.recorded")
    page.locator("#film-recorded", has_text="virtual").wait_for()


def test_a_recorded_image_beside_the_virtual_one(
    page: Any, scans: Any, twin: TwinClient, tmp_path: Any
) -> None:
    """The scanner's own texts alone tell the pose. What the panel shows left and right of the
    curtain, and as difference, is what the two images say there."""
    frames = json.loads((scans / "whole scan" / "flexdt.json").read_text("utf-8"))[
        "frames"
    ]
    page.select_option("#kind", "counts")
    page.evaluate("flexdt.data.open('own texts')")
    shows(page, 2)
    compares(page, "virtual")
    for index in (2, 6):
        page.locator("#record-frame").evaluate(
            "(e, v) => { e.value = v; e.dispatchEvent(new Event('input')); }", index
        )
        shows(page, index)
        page.wait_for_function("flexdt.store.image.virtual")
        shot = frames[index]
        camera = {k: shot[k] for k in ("mode", "roi", "exposure_ms", "averages")}
        tube = {"kV": 90.0, "power_W": 20.0, "on": True}
        there = twin.projection(
            "counts", positions=shot["positions"], tube=tube, camera=camera
        )
        assert np.array_equal(
            part(page, "pixels"), tifffile.imread(scans / "bare" / shot["file"])
        )
        assert (
            np.abs(part(page, "virtual") - there.image).max() <= 2
        )  # the texts round the angle
    recorded, virtual = part(page, "pixels"), part(page, "virtual")
    noise = (recorded - virtual)[8:-8, 8:-8]
    assert abs(noise.mean()) < 0.01 * recorded.mean()  # the same exposure

    page.uncheck("#show-beads")
    compares(page, "curtain")
    page.locator("#curtain").evaluate(
        "e => { e.value = 250; e.dispatchEvent(new Event('input')); }"
    )
    page.wait_for_function("flexdt.value(0, 0) === flexdt.store.image.pixels[0]")
    cols = recorded.shape[1]
    seen = np.array(
        page.evaluate(
            "([r, n]) => [...Array(n).keys()].map((c) => flexdt.value(c, r))", [20, cols]
        )
    )
    cut = round(cols / 4)
    assert np.array_equal(seen[:cut], recorded[20, :cut])
    assert np.array_equal(seen[cut:], virtual[20, cut:])
    page.locator("#film-canvas").scroll_into_view_if_needed()
    box = page.locator("#film-canvas").bounding_box()  # dragged in the picture, too
    page.mouse.move(box["x"] + box["width"] / 4, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 0.75, box["y"] + box["height"] / 2, steps=4)
    page.mouse.up()
    assert float(page.input_value("#curtain")) == pytest.approx(750, abs=20)

    compares(page, "difference")
    page.wait_for_function("flexdt.value(3, 3) < flexdt.store.image.pixels[0] / 2")
    seen = np.array(
        page.evaluate(
            "([r, n]) => [...Array(n).keys()].map((c) => flexdt.value(c, r))", [20, cols]
        )
    )
    assert seen == pytest.approx((recorded - virtual)[20], abs=1.0)
    page.check("#show-beads")
    page.select_option("#compare-mode", "recorded")
    page.select_option("#kind", "line_integral")


def test_the_scene_has_no_other_sample_than_the_image_beside_it(
    page: Any, scans: Any, lab: Any
) -> None:
    """The scan's own stays, another one leaves the pictures, and a line says so."""
    still = """fetch(`/still.jpg?view=sample&w=200&h=200&page=${window.pageId}`)
      .then((r) => r.arrayBuffer()).then((b) => new Uint8Array(b).join())"""
    find(page, "whole")
    page.locator(".data-set[data-name='whole scan']").click()
    shows(page, 2)
    page.click("#tabs [data-tab=setup]")
    page.locator("#record-note", has_text="clearance").wait_for()
    assert "no sample" not in page.locator("#record-note").inner_text()
    own = page.evaluate(still)
    page.uncheck("#layer-sample")
    until(lambda: page.evaluate(still) != own)
    page.check("#layer-sample")
    with lab.client() as twin:
        twin.set_sample("gear")
        try:
            page.locator(
                "#record-note", has_text="no sample in the scene: now gear stands there"
            ).wait_for()
            page.wait_for_timeout(500)
            other = page.evaluate(still)
            page.uncheck("#layer-sample")
            page.wait_for_timeout(500)
            assert page.evaluate(still) == other
            page.check("#layer-sample")
            page.wait_for_timeout(500)
            assert page.evaluate(still) == other
            page.evaluate("flexdt.data.open(null)")
            until(lambda: page.evaluate(still) != other)
        finally:
            twin.set_sample("lego")
            twin.control("release")


def test_playing_ends_with_the_last_image(page: Any, scans: Any) -> None:
    page.evaluate("flexdt.data.open('whole scan')")
    shows(page, 2)
    page.click("#record-play")
    shows(page, FRAMES + 1)
    page.locator("#record-play[title=Play]").wait_for()


def test_a_reload_brings_everything_back(
    open_page: Callable[..., Any], scans: Any, twin: TwinClient
) -> None:
    page = open_page()
    script = "camera\tset exposure\t123\t\tACK\t\t\r\n# ü ✓\r\n"
    page.click("#tabs [data-tab=scan]")
    page.fill("#script", script)
    page.wait_for_function("location.hash.startsWith('#script=')")
    find(page, "whole")
    page.locator("#data-count", has_text="1 scan").wait_for()
    page.locator(".data-set[data-name='whole scan']").click()
    shows(page, 2)
    page.click("#record-next")
    shows(page, 3)
    page.wait_for_function(
        "new URLSearchParams(location.search).get('frame') === 'scan_000001'"
    )
    page.reload()
    page.wait_for_function("window.flexdt?.store.state && window.flexdt.store.session")
    shows(page, 3)
    assert page.locator("#tab-data").is_visible()
    assert page.input_value("#script") == script.replace("\r\n", "\n")
    # Back and forth, as the browser's buttons do.
    page.go_back()
    page.wait_for_function("flexdt.store.recorded === null")
    page.go_forward()
    shows(page, 3)
    page.close()


def test_an_address_that_names_nothing_says_so(
    open_page: Callable[..., Any], scans: Any
) -> None:
    page = open_page(data="no%20such%20scan", frame="x")
    page.locator(".note.error", has_text="no such scan cannot be opened").wait_for()
    assert page.evaluate("flexdt.store.recorded") is None
    page.wait_for_function("flexdt.store.image")
    page.close()


def test_its_script_and_its_replay(page: Any, scans: Any, tmp_path: Any) -> None:
    page.evaluate("flexdt.data.open('whole scan')")
    shows(page, 2)
    with page.expect_download(timeout=120_000) as promise:
        page.click("#record-replay")
    promise.value.save_as(tmp_path / "replay.html")
    assert (tmp_path / "replay.html").stat().st_size > 100_000
    page.click("#record-script")
    until(
        lambda: "take and save image sequence" in page.input_value("#script"),
        "the script",
    )
    page.click("#plan")  # a plan of its own closes the data set
    page.locator("#timeline-card").wait_for()
    assert page.evaluate("flexdt.store.recorded") is None
    page.click("#unscrub")


def test_what_stands_elsewhere_is_kept_when_asked_for(
    page: Any, twin: TwinClient
) -> None:
    twin.move({"tra_tube": 15.5, "ver_det": 33.25}, wait=True)
    twin.control("release")
    seen(page, twin)
    page.click("#tabs [data-tab=scan]")
    page.click("#compose")
    page.locator("#moved", has_text="tra_tube stands at 15.50 mm").wait_for()
    page.locator("#moved", has_text="ver_det stands at 33.25 mm").wait_for()
    page.click("#keep")
    page.locator("#kept").wait_for()
    kept = page.inner_text("#kept").removeprefix("kept where it stands: ").split(", ")
    assert {"tra_tube", "ver_det"} <= set(kept)
    assert page.locator("#moved").count() == 0
    page.click("#plan")
    page.locator("#timeline-card").wait_for()
    for time_s in (1e9, 60.0):
        at = page.evaluate("t => flexdt.call('viewer.scrub', {time_s: t})", time_s)[
            "positions"
        ]
        assert at["tra_tube"] == pytest.approx(15.5)
        assert at["ver_det"] == pytest.approx(33.25)
    page.click("#unscrub")
    page.evaluate("flexdt.call('axes.move', {targets: {tra_tube: 0, ver_det: 20}})")


def test_a_wrong_line_is_marked_and_explained_at_the_caret(page: Any) -> None:
    page.click("#tabs [data-tab=scan]")
    page.fill(
        "#script",
        "# a note\ncamera\tset exposure\t100\t\tACK\t\t\nrot_obj\tmov absolute\t1\t\tACK\t\t\n",
    )
    page.click("#check")
    page.locator("#paint .hit", has_text="mov absolute").wait_for()
    assert page.locator("#gutter .hit").get_attribute("title")
    page.evaluate("flexdt.scan.goTo(3)")
    page.locator("#line-note.error", has_text="line 3: ").wait_for()
    page.evaluate("flexdt.scan.goTo(1)")
    page.locator("#line-note", has_text="line").wait_for(state="detached")
    # What is painted is what is written, line by line.
    painted = page.locator("#paint > div > div").all_inner_texts()
    assert painted[:3] == page.input_value("#script").split("\n")[:3]
    page.fill("#script", "camera\tset exposure\t100\t\tACK\t\t\n")
    assert page.locator("#paint .hit").count() == 0
    page.click("#check")  # a script that may run is drawn over time, too
    page.locator("#timeline-card").wait_for()
    page.fill("#script", "")
