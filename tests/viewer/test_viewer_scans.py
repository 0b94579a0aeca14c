"""Scripts on the page: written, checked, scrubbed, run, paused, stepped, aborted; and the
rest."""

from __future__ import annotations

import json
import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import trimesh
import zstandard
from looking import begun, changed, drawn, film, picture, point_at, seen
from PIL import Image

from flexdt.clients.client.client import TwinClient
from flexdt.clients.viewer.scenes.views import FREE
from flexdt.library.reading.folders import load_dataset

pytestmark = pytest.mark.browser
Wait = Callable[..., Any]
ROI = [800, 620, 1199, 939]
LONG = 3000
STRIP_PX = 44
"""Height of the strip below a saved radiograph."""
"""Frames of a scan that does not end meanwhile, however late a busy machine comes to look."""


@pytest.fixture(scope="module", autouse=True)
def small_images(page: Any) -> None:
    page.evaluate("roi => flexdt.call('camera.set', {roi, exposure_ms: 100})", ROI)


@pytest.fixture(autouse=True)
def on_scan_tab(page: Any) -> None:
    page.click("#tabs [data-tab=scan]")


def write(page: Any, kind: str = "step", frames: int = 6) -> str:
    page.select_option("#wish-kind", kind)
    page.fill("#wish-frames", str(frames))
    page.fill(
        "#script", ""
    )  # with which the report of the one before goes, and one on its way
    page.click("#compose")
    page.locator("#report .verdict").wait_for()
    return str(page.input_value("#script"))


def test_a_written_script_is_ready(page: Any) -> None:
    text = write(page, "fly", 45)
    assert "take and save image sequence" in text
    assert page.inner_text("#report .verdict") == "Ready to run"
    assert page.locator("#report .steps div").count() > 10


def test_problems_have_clickable_lines(page: Any) -> None:
    text = write(page)
    lines = text.split("\n")
    lines[4] = lines[4].replace("\tset", "\tsett").replace("move", "moove")
    page.fill("#script", "\n".join(lines))
    page.click("#check")
    page.locator("#report .verdict.bad").wait_for()
    page.locator("#report .problem a", has_text="line 5").first.click()
    chosen = page.evaluate(
        "(() => { const t = document.querySelector('#script');"
        " return t.value.slice(t.selectionStart, t.selectionEnd); })()"
    )
    assert chosen.strip() == lines[4].strip()
    assert page.locator("#gutter .hit", has_text="5").count() == 1


def test_a_file_is_opened_checked_and_each_step_leads_to_its_line(
    page: Any, twin: TwinClient, tmp_path: Path
) -> None:
    path = tmp_path / "from a file.txt"
    path.write_text(
        "rot_obj\tmove absolute\t5.0\t\tACK\t\t\nrot_obj\tset speed\t9\t\tACK\t\t\n"
    )
    page.set_input_files("#script-file", path)
    page.wait_for_function(
        "document.querySelector('#script').value.startsWith('rot_obj')"
    )
    page.click("#check")
    page.locator("#report .verdict.ok").wait_for()
    page.locator("#report .steps div", has_text="speed").last.click()
    chosen = page.evaluate(
        "(() => { const t = document.querySelector('#script');"
        " return t.value.slice(t.selectionStart, t.selectionEnd); })()"
    )
    assert chosen.split("\t")[:3] == ["rot_obj", "set speed", "9"]


def test_a_collision_in_a_script_is_marked(page: Any) -> None:
    page.fill(
        "#script",
        "mag_obj\tmove absolute\t600.0\t\tACK\t\t\nmag_det\tmove absolute\t300.0\t\tACK\t\t\n",
    )
    page.click("#check")
    page.locator("#report .problem", has_text="collision").first.wait_for()
    assert page.locator("#gutter .hit", has_text="2").count() == 1


def test_a_collision_is_listed_once_for_each_pair_and_line(page: Any) -> None:
    into = "mag_obj\tmove absolute\t600.0\t\tACK\t\t\nmag_det\tmove absolute\t300.0\t\tACK\t\t\n"
    page.fill("#script", into)
    report = page.evaluate("text => flexdt.call('script.check', {text})", into)
    page.click("#check")
    page.locator("#report .verdict.bad").wait_for()
    assert len(report["collisions"]) >= 1
    assert page.locator("#report .problem").count() == len(report["problems"])
    of_collisions = page.locator("#report .problem", has_text="collision")
    told = of_collisions.all_text_contents()
    assert len(told) == len(set(told)) == len(report["collisions"])
    # Those of one motion are one event: the first pair is read, the others on request.
    shown = page.locator("#report .problem:visible", has_text="collision")
    assert shown.count() == len({one["line"] for one in report["collisions"]}) < len(told)
    page.click("#report summary")
    assert shown.count() == len(told)


def test_an_edited_script_is_no_longer_ready(page: Any) -> None:
    write(page)
    page.click("#plan")
    page.locator("#timeline-card").wait_for()
    page.locator("#script").press_sequentially("x")
    assert page.locator("#report .verdict").count() == 0
    assert not page.locator("#timeline-card").is_visible()
    # A script that is written anew leaves no timeline of the old one behind either.
    write(page)
    page.click("#plan")
    page.locator("#timeline-card").wait_for()
    page.click("#compose")
    page.locator("#timeline-card").wait_for(state="hidden")


def test_half_a_frame_is_refused(page: Any) -> None:
    page.fill("#script", "")
    page.fill("#wish-frames", "10.5")
    page.click("#compose")
    page.locator(".note.error", has_text="whole number").wait_for()
    assert page.input_value("#script") == ""
    told = page.evaluate(
        "flexdt.call('viewer.compose', {kind: 'fly', frames: 10.5}).catch((e) => e.message)"
    )
    assert "frames" in told
    assert "whole number" in told


def test_the_script_box_can_be_left_with_the_keyboard(page: Any) -> None:
    focus = "document.activeElement.id"
    page.fill("#script", "a")
    page.focus("#script")
    page.keyboard.press("End")
    page.keyboard.press("Tab")
    assert page.input_value("#script") == "a\t"
    page.keyboard.press("Escape")
    page.keyboard.press("Tab")
    assert page.evaluate(focus) != "script"
    page.focus("#script")
    page.keyboard.press("Shift+Tab")
    assert page.evaluate(focus) != "script"
    assert page.input_value("#script") == "a\t"


def test_running_makes_a_data_set(
    page: Any, twin: TwinClient, lab: Any, wait: Wait
) -> None:
    write(page, frames=5)
    page.select_option("#speed-up", "max")
    job = begun(page, twin)
    page.locator("#scan-bar").wait_for()
    wait(lambda: twin.job_status(job).state == "done", "the scan")
    page.locator("#job-state", has_text="done").wait_for()
    page.locator("#job-frames", has_text="5 / 5 frames").wait_for()
    folder = lab.data / str(twin.job_status(job).dataset)
    dataset = load_dataset(folder).require_complete()
    assert len(dataset.frames) == 5
    page.locator("#thumbs canvas").first.wait_for()
    assert page.locator("#thumbs-of").text_content() == f"Some images of {folder.name}"
    # The finished scan comes back onto the timeline, wherever the machine is by now.
    page.fill("#script", "")
    page.evaluate("flexdt.call('axes.move', {targets: {rot_obj: 10}})")
    page.click("#job-scrub")
    page.locator("#timeline-card").wait_for()
    assert "take image" in page.input_value("#script")
    last = page.evaluate("flexdt.call('viewer.scrub', {time_s: 1e9})")["positions"]
    assert last["rot_obj"] == pytest.approx(dataset.positions["rot_obj"][-1])
    page.click("#unscrub")


def test_a_data_set_is_named_after_the_file_its_script_is_from(
    page: Any, twin: TwinClient, tmp_path: Path, wait: Wait
) -> None:
    turn = "rot_obj\tmove absolute\t5.0\t\tACK\t\t\n"
    path = tmp_path / "listing.txt"
    path.write_text(turn)
    page.set_input_files("#script-file", path)
    page.wait_for_function(
        "document.querySelector('#script').value.startsWith('rot_obj')"
    )
    page.select_option("#speed-up", "max")
    job = begun(page, twin)
    wait(lambda: twin.job_status(job).state == "done")
    assert str(twin.job_status(job).name).startswith("listing-")
    write(page, frames=2)
    job = begun(page, twin)
    wait(lambda: twin.job_status(job).state == "done")
    assert "listing" not in str(twin.job_status(job).name)


def test_pause_step_resume_abort(page: Any, twin: TwinClient, wait: Wait) -> None:
    write(page, "fly", LONG)
    page.select_option("#speed-up", "10")
    begun(page, twin)
    wait(lambda: twin.job_status().frames_done > 0, "first frames")
    assert twin.job_status().speed_up == 10.0
    page.click("#job-pause")
    wait(lambda: twin.job_status().state == "paused")
    page.locator("#job-state", has_text="paused").wait_for()
    assert page.inner_text("#job-left") == ""  # nobody knows for how long
    before = twin.job_status()
    page.locator("#job-step:not([disabled])").click()
    wait(
        lambda: (
            (twin.job_status().step, twin.job_status().frames_done)
            != (before.step, before.frames_done)
        )
    )
    wait(lambda: twin.job_status().state == "paused")
    page.locator("#job-resume:not([disabled])").click()
    wait(lambda: twin.job_status().state == "running")
    page.click("#job-abort")
    wait(lambda: twin.job_status().state in ("aborted", "incomplete"))
    page.locator("#job-bar.failed").wait_for()


def test_a_stop_during_a_scan_is_one_warning(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    # It turns for a minute before its first frame.
    text = write(page, "fly", 200)
    page.fill("#script", f"rot_obj\tmove absolute\t3000.0\t\tACK\t\t\n{text}")
    page.select_option("#speed-up", "1")
    begun(page, twin)
    wait(lambda: twin.job_status().state == "running")
    page.evaluate("flexdt.call('axes.stop')")
    page.locator("#warnings", has_text="Scan paused").wait_for()
    assert page.locator(".note.error").all_inner_texts() == []
    assert page.locator("#thumbs canvas").count() == 0  # no frame has been taken
    assert page.locator("#thumb-card").is_hidden()
    page.click("#job-abort")
    wait(lambda: twin.job_status().state in ("aborted", "incomplete"))


def test_an_end_that_was_not_heard_of_is_asked_for(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    """A page whose connection was away when the scan ended must not show it as running for
    ever."""
    write(page, "fly", LONG)
    page.select_option("#speed-up", "1")
    begun(page, twin)
    wait(lambda: twin.job_status().state == "running")
    page.locator("#job-state", has_text="running").wait_for()
    page.evaluate(
        "(() => { const parse = JSON.parse; window.heard = () => { JSON.parse = parse; };"
        " JSON.parse = (t) => { const m = parse(t); return m?.type === 'job' ? {} : m; }; })()"
    )
    try:
        twin.abort_job(twin.job_status().job)
        page.locator("#job-bar.failed").wait_for()
        assert not page.locator("#job-abort").is_visible()
    finally:
        page.evaluate("window.heard()")


def test_who_is_refused_is_told_of_the_button(
    page: Any, open_page: Callable[..., Any]
) -> None:
    page.evaluate("flexdt.call('session.control', {action: 'force'})")
    other = open_page()
    told = other.evaluate(
        "flexdt.call('axes.jog', {axis: 'rot_obj', velocity: 1, lease_s: 0.2})"
        ".catch((e) => e.message)"
    )
    assert "Take over" in told
    assert "session.control" not in told
    other.close()


def test_scrubbing_goes_through_the_plan(page: Any, twin: TwinClient, wait: Wait) -> None:
    page.evaluate("flexdt.call('axes.move', {targets: {rot_obj: 0}})")
    wait(lambda: abs(twin.state().axes["rot_obj"].position) < 1e-6)
    write(page, "fly", 45)
    page.click("#plan")
    page.locator("#timeline-card").wait_for()
    box = page.locator("#timeline").bounding_box()
    place = {"x": box["width"] - 2, "y": box["height"] / 2}
    page.locator("#timeline").click(position=place)
    said = lambda: page.inner_text("#scrub-at")  # noqa: E731
    wait(
        lambda: "line" in said() and not said().startswith("0.0 s"),
        "the moment clicked at",
    )
    end = page.evaluate("flexdt.call('viewer.scrub', {time_s: 1e9})")["positions"]
    begin = page.evaluate("flexdt.call('viewer.scrub', {time_s: 0})")["positions"]
    assert end["rot_obj"] - begin["rot_obj"] > 360.0
    page.click("#unscrub")


def test_the_timeline_comes_into_view_below_a_long_report(page: Any) -> None:
    write(page, "fly", 45)
    page.locator("#tab-scan").evaluate(
        "e => { e.scrollTop = 0; e.parentElement.scrollTop = 0; }"
    )
    page.locator("#report").evaluate("e => { e.style.minHeight = '1500px'; }")
    page.click("#plan")
    in_view = (
        "() => { const b = document.querySelector('#timeline').getBoundingClientRect();"
        " return b.height > 0 && b.top >= 0 && b.bottom <= innerHeight; }"
    )
    try:
        page.wait_for_function(in_view)
    finally:
        page.locator("#report").evaluate("e => { e.style.minHeight = ''; }")
    page.click("#unscrub")


def test_replay_and_scene_files_open_without_a_server(
    page: Any, chromium: Any, tmp_path: Path, wait: Wait
) -> None:
    write(page, "fly", 45)
    page.click("#plan")
    page.locator("#timeline-card").wait_for()
    page.click("#tabs [data-tab=share]")
    for button in ("#export-html", "#replay-html", "#export-viser", "#replay-viser"):
        with page.expect_download(timeout=120_000) as promise:
            page.click(button)
        path = tmp_path / promise.value.suggested_filename
        promise.value.save_as(path)
        assert path.stat().st_size > 20_000
        if path.suffix == ".html":
            assert b"__VISER_EMBED" in path.read_bytes()
            told = re.search(r"<title>(.*?)</title>", path.read_text("utf-8"))
            assert told is not None
            assert re.fullmatch(r"[\w-]+ · [\d-]{10} \d\d:\d\d · flexdt \w+", told[1])
        if (
            path.suffix == ".viser"
        ):  # it opens where the machine is seen, not from viser's default
            messages = contents(path)
            first = [
                m["position"]
                for _, m in messages
                if m["type"] == "SetCameraPositionMessage"
            ]
            assert first
            assert first[0] == pytest.approx(FREE.position)
    for kind in ("scene", "replay"):
        html = next(iter(tmp_path.glob(f"*{kind}*.html")))
        alone = chromium.new_page(viewport={"width": 500, "height": 350})
        alone.set_default_timeout(120_000)
        try:
            alone.goto(html.as_uri())
            canvas = alone.locator("canvas").first
            canvas.wait_for()
            wait(lambda on=canvas: drawn(picture(on)), f"the machine in the {kind}")
            if kind == "scene":
                assert (
                    alone.locator("img[alt=radiograph]").evaluate("e => e.naturalWidth")
                    >= 200
                )
                assert "source to detector: " in alone.locator("aside").inner_text()
            if kind == "replay":
                first = picture(canvas)
                wait(
                    lambda on=canvas, was=first: changed(picture(on), was) > 200,
                    "it plays",
                )
        finally:
            alone.close()


def contents(path: Path) -> list[Any]:
    """The messages of a .viser file, each with its time."""
    inner = zstandard.ZstdDecompressor().decompressobj().decompress(path.read_bytes()[8:])
    length = int.from_bytes(inner[:8], "little")
    messages = msgspec.msgpack.decode(inner[8 : 8 + length])["messages"]
    return list(messages)


def test_scenes_are_saved_and_loaded(
    page: Any, twin: TwinClient, wait: Wait, tmp_path: Path
) -> None:
    page.click("#tabs [data-tab=share]")
    before = twin.state().axes["tra_obj"].position
    with page.expect_download() as promise:
        page.click("#scene-save")
    path = tmp_path / "scene.json"
    promise.value.save_as(path)
    assert json.loads(path.read_text())["positions"]["tra_obj"] == pytest.approx(before)
    page.evaluate("v => flexdt.call('axes.move', {targets: {tra_obj: v}})", before + 4.0)
    wait(lambda: abs(twin.state().axes["tra_obj"].position - before - 4.0) < 1e-6)
    page.set_input_files("#scene-file", path)
    wait(lambda: abs(twin.state().axes["tra_obj"].position - before) < 1e-6)


def test_corrections_are_applied_listed_and_undone(
    page: Any, twin: TwinClient, wait: Wait, tmp_path: Path
) -> None:
    page.click("#tabs [data-tab=calibrate]")
    report = tmp_path / "report.json"
    report.write_text(json.dumps({"parameters": {"dO_x": {"value": 0.4, "sigma": 0.01}}}))
    page.set_input_files("#correction-file", report)
    wait(lambda: twin.state().correction is not None)
    correction = twin.state().correction
    assert correction is not None
    assert correction.parameters["dO_x"] == pytest.approx(0.4)
    page.locator("#in-force", has_text="dO_x").wait_for()
    page.locator("#corrections", has_text="in force").wait_for()
    page.click("#revert")
    wait(lambda: twin.state().correction is None)
    page.locator("#in-force", has_text="nominal").wait_for()


@pytest.mark.parametrize(
    "content", [{}, [], 3, {"alpha": "0.2"}, {"parameters": {}}, {"frames": 12},
                {"identifiable": False, "parameters": {"alpha": 0.2}}]
)  # fmt: skip
def test_what_is_no_report_is_not_applied(
    page: Any, twin: TwinClient, tmp_path: Path, content: object
) -> None:
    page.click("#tabs [data-tab=calibrate]")
    page.locator("#notes").evaluate("e => e.replaceChildren()")
    report = tmp_path / "no report.json"
    report.write_text(json.dumps(content))
    page.set_input_files("#correction-file", report)
    page.locator(".note.error", has_text="Not applied").wait_for()
    assert twin.state().correction is None
    given = content.get("parameters", content) if isinstance(content, dict) else content
    if not isinstance(content, dict) or "identifiable" not in content:
        ask = (
            "p => flexdt.call('calibration.apply', {parameters: p}).catch((e) => e.code)"
        )
        assert page.evaluate(ask, given) == -32602
    assert twin.state().correction is None


def test_corrections_are_shown_with_units_and_digits_that_say_something(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    page.click("#tabs [data-tab=calibrate]")
    assert page.locator("#revert").is_disabled()
    shown = {"dO_x": 0.41234567, "alpha": 0.00321, "angle_scale": 1.000125}
    parameters = {**shown, "dO_z": 2e-9}
    page.evaluate("p => flexdt.call('calibration.apply', {parameters: p})", parameters)
    page.locator("#in-force", has_text="angle_scale").wait_for()
    rows = [r.split("\t") for r in page.locator("#in-force tr").all_inner_texts()]
    assert {name: (value, unit) for name, value, _, unit in rows} == {
        "axis sideways dO_x": ("0.412", "mm"),
        "start angle alpha": ("0.0032", "°"),
        "scale of angles angle_scale": ("1.000125", ""),
    }
    page.click("#revert")
    page.locator(".note.good", has_text="nominal geometry").wait_for()
    wait(lambda: page.locator("#revert").is_disabled())


def test_radiograph_shows_the_twins_values(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    wait(lambda: not any(a.moving for a in twin.state().axes.values()))
    wanted = np.asarray(twin.projection().image)
    shape = list(wanted.shape)
    page.wait_for_function(
        "s => flexdt.store.image?.shape.join() === s.join()", arg=shape
    )
    for across, down in ((0.5, 0.5), (0.31, 0.62), (0.7, 0.2)):

        def shown(across: float = across, down: float = down) -> bool:
            # Whatever coarse or earlier image is still on its way, at rest the page shows this
            # one.
            point_at(page, across, down)
            text = page.inner_text("#pixel")
            if not text.startswith("("):
                return False
            column, row = (int(v) for v in text[1 : text.index(")")].split(","))
            return bool(abs(float(text.split()[2]) - wanted[row, column]) < 2e-3)

        wait(shown, "the value under the pointer")
    page.locator("#film-canvas").hover()
    page.mouse.wheel(0, -600)
    wait(
        lambda: "4." in page.inner_text("#film-note").split("·")[-1],
        "four times as large",
    )
    page.click("#film-reset")
    page.select_option("#kind", "counts")
    page.wait_for_function("flexdt.store.image.kind === 'counts'")
    page.check("#show-flags")
    page.select_option("#kind", "line_integral")
    page.wait_for_function("flexdt.store.image.kind === 'line_integral'")
    page.uncheck("#show-flags")


def test_window_level_and_inversion(page: Any, wait: Wait) -> None:
    page.wait_for_function(
        "flexdt.store.image?.kind === 'line_integral' && flexdt.store.image.code === 'deflate'"
    )
    page.uncheck("#show-beads")
    plain = film(page)
    page.check("#invert")
    wait(
        lambda: film(page)[..., 1].mean() > 255.0 - plain[..., 1].mean() - 12.0,
        "inverted",
    )
    page.uncheck("#invert")
    drag = ("(e, v) => { e.value = v; e.dispatchEvent(new Event('input'));"
            " e.dispatchEvent(new Event('change')); }")  # fmt: skip
    page.locator("#low").evaluate(drag, 0)
    page.locator("#high").evaluate(drag, 60)
    wait(
        lambda: film(page)[..., 1].mean() > plain[..., 1].mean() + 5.0, "a narrow window"
    )
    assert not page.locator("#auto-window").is_checked()
    page.check("#auto-window")
    wait(
        lambda: abs(film(page)[..., 1].mean() - plain[..., 1].mean()) < 1.0, "auto again"
    )
    page.check("#show-beads")


def test_starved_and_saturated_pixels_are_marked(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    # Square to the beam, so that there is open beam beside the block.
    page.evaluate("flexdt.call('axes.move', {targets: {rot_obj: 0}})")
    wait(lambda: abs(twin.state().axes["rot_obj"].position) < 1e-6)
    block = trimesh.creation.box((14.0, 14.0, 14.0)).export(file_type="stl")
    page.evaluate("flexdt.call('session.control', {action: 'release'})")
    twin.upload_mesh(block, "block", format="stl", material="tungsten-carbide")
    page.evaluate("flexdt.call('sample.set', {name: 'block'})")
    page.check("#show-flags")
    seen(page, twin)
    orange = lambda: (np.abs(film(page) - [255, 176, 48, 255]).max(axis=2) < 3).sum()  # noqa: E731
    red = lambda: (np.abs(film(page) - [255, 64, 48, 255]).max(axis=2) < 3).sum()  # noqa: E731
    try:
        wait(lambda: orange() > 100, "starved behind 14 mm of tungsten carbide")
        page.select_option("#kind", "counts")
        page.evaluate("flexdt.call('camera.set', {exposure_ms: 5000})")
        page.evaluate("flexdt.call('tube.set', {on: true})")
        wait(lambda: twin.state().tube.ready, "the tube is ready")
        wait(lambda: red() > 100, "saturated in the open beam")
    finally:
        page.evaluate("flexdt.call('camera.set', {exposure_ms: 100})")
        page.evaluate("flexdt.call('tube.set', {on: false})")
        page.select_option("#kind", "line_integral")
        page.uncheck("#show-flags")
        page.evaluate("flexdt.call('sample.set', {name: 'lego'})")
    page.wait_for_function("flexdt.store.image?.kind === 'line_integral'")


def test_the_radiograph_is_saved_as_a_picture(
    page: Any, twin: TwinClient, tmp_path: Path
) -> None:
    page.click("#tabs [data-tab=share]")
    with page.expect_download() as promise:
        page.click("#shot-film")
    promise.value.save_as(tmp_path / "film.png")
    saved = np.asarray(Image.open(tmp_path / "film.png").convert("L"), dtype=float)
    rows, columns = page.evaluate("flexdt.store.image.full")
    assert saved[:rows].std() > 2.0
    assert saved.shape == (rows + STRIP_PX, columns)
    # The scale is as long as it says, at the axis.
    voxel_mm = twin.state().geometry.voxel_size_mm
    bar = np.flatnonzero(saved[rows + 29] > 150.0)
    bar = bar[: np.argmax(np.diff(bar, append=10**6) > 1) + 1]
    length_mm = len(bar) * voxel_mm
    assert (
        min(abs(length_mm / (m * 10.0**e) - 1.0) for m in (1, 2, 5) for e in range(-2, 3))
        < 0.03
    )


def test_predicted_beads_lie_on_the_shadows(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    page.evaluate("flexdt.call('camera.set', {roi: [32, 8, 1943, 1527]})")
    page.wait_for_function("flexdt.store.image?.shape[0] === 760")
    beads = page.evaluate("flexdt.store.image.beads")
    image = np.asarray(twin.projection().image)
    assert len(beads) >= 2
    for column, row in beads:
        c, r = round(column), round(row)
        if 8 < r < 751:
            inside = image[r - 2 : r + 3, c - 2 : c + 3].mean()
            around = (
                image[r - 30 : r + 31, c - 30 : c + 31].mean() if 30 < r < 729 else 0.0
            )
            assert inside > around + 0.3
    page.evaluate("roi => flexdt.call('camera.set', {roi})", ROI)


def test_two_pages_show_the_same(
    page: Any, open_page: Callable[..., Any], twin: TwinClient, wait: Wait
) -> None:
    other = open_page()
    target = twin.state().axes["rot_obj"].position + 30.0
    page.evaluate("v => flexdt.call('axes.move', {targets: {rot_obj: v}})", target)
    for p in (page, other):
        p.wait_for_function("v => Math.abs(flexdt.store.state.axes.rot_obj.position - v) < 1e-6",
                            arg=target)  # fmt: skip
    seq = "flexdt.store.image.seq"
    wait(lambda: page.evaluate(seq) == other.evaluate(seq), "the same last image")
    other.close()


def test_servers_killed_and_restarted_while_the_page_is_open(
    page: Any, lab: Any, wait: Wait
) -> None:
    lab.twin.stop(signal.SIGKILL)
    page.locator("#veil", has_text="The twin is away").wait_for()
    lab.restart_twin()
    page.locator("#veil").wait_for(state="hidden")
    page.locator("#connection", has_text="connected").wait_for()
    page.wait_for_function(
        "flexdt.store.session"
    )  # the page's own connection to the twin
    with lab.client() as client:
        page.evaluate("flexdt.call('axes.move', {targets: {tra_tube: 2}})")
        wait(lambda: abs(client.state().axes["tra_tube"].position - 2.0) < 1e-6)
    page.click("#tabs [data-tab=scan]")
    write(page, "fly", 45)
    page.click("#plan")
    page.locator("#timeline-card").wait_for()
    lab.viewer.stop(signal.SIGKILL)
    page.locator("#veil", has_text="The viewer is away").wait_for()
    lab.restart_viewer()
    page.locator("#connection", has_text="connected").wait_for()
    page.wait_for_function("flexdt.store.session")
    with lab.client() as client:
        page.evaluate("flexdt.call('axes.move', {targets: {tra_tube: 1}})")
        wait(lambda: abs(client.state().axes["tra_tube"].position - 1.0) < 1e-6)
    # The new viewer knows nothing of the plan: the page makes it anew.
    ask = (
        "flexdt.call('viewer.scrub', {time_s: 1e9}).then((a) => a.positions, () => null)"
    )
    end = wait(lambda: page.evaluate(ask), "the plan is back")
    assert end["rot_obj"] > 360.0
    assert page.locator("#timeline-card").is_visible()
    page.fill("#script", "")
    wait(lambda: page.evaluate(ask) is None, "the plan has gone")


def pull(page: Any, bar: str, share: float) -> float:
    """Moves a bar of the designer; the value that it then says."""
    page.locator(f"#design-{bar}").evaluate(
        "(e, v) => { e.value = 1000 * v; e.dispatchEvent(new Event('input'));"
        " e.dispatchEvent(new Event('change')); }",
        share,
    )
    return float(page.inner_text(f"#design-{bar}-is").split()[0])


def written(page: Any, device: str, command: str) -> list[float]:
    """Values of a command in the script, in their order."""
    rows = [line.split("\t") for line in page.input_value("#script").splitlines()]
    return [float(row[2]) for row in rows if row[:2] == [device, command]]


def test_a_bar_of_the_designer_rewrites_the_script(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    """What it says is counted here: bytes by images, time by exposures, kerma by both."""
    page.evaluate("flexdt.call('sample.set', {name: 'lego'})")
    page.evaluate(
        "flexdt.call('camera.set', {roi: [32, 8, 1943, 1527], mode: 'HW4SW1High'})"
    )
    seen(page, twin)
    page.click("#tabs [data-tab=scan]")
    page.select_option("#wish-kind", "fly")
    page.fill("#script", "")
    page.click("#designer summary")
    page.locator("#design-quality .verdict").wait_for()
    told = []
    for frames in (41, 123):
        page.fill("#wish-frames", str(frames))
        wait(lambda n=frames: f"\t{n}\t" in page.input_value("#script"), "the script")
        size = f"{(frames + 2) * 478 * 380 * 2 / 1e6:.1f} MB"  # a dark and a flat beside them
        page.locator("#design-time", has_text=size).wait_for()
        told.append(
            float(re.findall(r"([0-9.]+) mGy", page.inner_text("#design-time"))[0])
            / frames
        )
    assert told[0] == pytest.approx(told[1], rel=0.02)
    kV = pull(page, "kV", 0.6)
    wait(lambda: set(written(page, "tube", "set kV")) == {kV}, "the voltage")
    g, first = twin.state().geometry, written(page, "mag_obj", "move absolute")[0]
    voxel = pull(page, "voxel_um", 0.62)
    there = first - g.SOD_mm + voxel / 1000 / 0.2992 * g.SDD_mm
    at = lambda: written(page, "mag_obj", "move absolute")[0]  # noqa: E731
    wait(lambda: abs(at() - there) < 2.0, "the magnification")
    # The proposed exposure reaches what was wished for.
    page.locator("#design-quality .verdict").wait_for()
    now = float(page.inner_text("#design-quality .verdict"))
    page.fill("#design-cnr", f"{1.5 * now:.2f}")
    page.press("#design-cnr", "Tab")
    page.locator("#design-reach").wait_for()
    words = page.inner_text("#design-reach")
    page.click("#design-reach")
    page.locator("#design-quality .verdict.ok").wait_for()
    wish, ms = (float(v) for v in re.findall(r"[0-9.]+", words))
    assert float(page.inner_text("#design-quality .verdict")) >= 0.98 * wish
    wait(
        lambda: abs(written(page, "camera", "set exposure")[0] - ms) <= 0.02 * ms,
        "the exposure",
    )
    # Somebody's own script stays.
    page.fill("#script", "camera\tset exposure\t123\t\tACK\t\t\n")
    pull(page, "kV", 0.5)
    page.locator("#design-quality").wait_for()
    assert written(page, "camera", "set exposure") == [123.0]
    # What cannot be is said.
    page.fill("#design-detail", "no such thing")
    page.press("#design-detail", "Tab")
    page.locator("#design-facts", has_text="no such thing").wait_for()
    page.fill("#design-detail", "void:0.5")
    page.click("#designer summary")
    page.fill("#script", "")
    page.evaluate(
        "camera => flexdt.call('camera.set', camera)",
        {"roi": ROI, "exposure_ms": 100, "mode": "HW2SW1High"},
    )
    seen(page, twin)


@pytest.mark.parametrize("kind", ["fly", "tiled"])
@pytest.mark.campaign(1)
def test_the_designer_says_what_the_report_says_in_every_mode(
    page: Any, twin: TwinClient, wait: Wait, kind: str
) -> None:
    """Its scales follow the mode that is set: a script was impossible after a change of
    mode."""
    page.evaluate("flexdt.call('sample.set', {name: 'lego'})")
    page.evaluate(
        "flexdt.call('camera.set', {roi: [32, 8, 1943, 1527], mode: 'HW2SW1High'})"
    )
    seen(page, twin)
    page.click("#tabs [data-tab=scan]")
    page.select_option("#wish-kind", kind)
    page.fill("#script", "")
    page.click("#designer summary")
    page.locator("#design-quality .verdict").wait_for()
    page.fill("#wish-exposure", "350")
    page.fill("#wish-frames", "21")
    for mode in ("HW4SW1High", "HW2SW1High"):
        page.evaluate("mode => flexdt.call('camera.set', {mode})", mode)
        seen(page, twin)
        wait(
            lambda mode=mode: f"set mode\t{mode}" in page.input_value("#script"),
            "the script",
        )
        state = twin.state()
        g, voxel = (
            state.geometry,
            float(page.inner_text("#design-voxel_um-is").split()[0]),
        )
        assert voxel == pytest.approx(
            1000 * state.camera.pixel_mm * g.SOD_mm / g.SDD_mm, abs=0.06
        )
        report = twin.check_script(page.input_value("#script"))
        size = f"{report.bytes / 1e6:.1f} MB"
        page.locator("#design-time", has_text=size).wait_for()
        page.locator("#report", has_text=size).wait_for()
        time_s = page.inner_text("#design-time").split(" · ")[0]
        page.locator("#report", has_text=f"{time_s} · ").wait_for()
    page.click("#designer summary")
    page.fill("#script", "")
    page.select_option("#wish-kind", "fly")
    page.evaluate("roi => flexdt.call('camera.set', {roi, exposure_ms: 100})", ROI)
    seen(page, twin)
