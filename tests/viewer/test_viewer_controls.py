"""Each control of the page, and its effect in the twin's own state."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from looking import answered, released, seen

from flexdt.clients.client.client import TwinClient

pytestmark = pytest.mark.browser
Wait = Callable[..., Any]

TARGETS = {
    "ver_tube": 60.0,
    "tra_tube": 15.5,
    "mag_obj": 580.0,
    "tra_obj": -12.25,
    "rot_obj": 33.0,
    "ver_obj": 330.0,
    "mag_det": 1000.0,
    "ver_det": 41.0,
    "tra_det": 20.0,
}


def tab(page: Any, name: str) -> None:
    page.click(f"#tabs [data-tab={name}]")


def settled(twin: TwinClient, axis: str, value: float) -> Callable[[], bool]:
    def check() -> bool:
        state = twin.state().axes[axis]
        return not state.moving and abs(state.position - value) < 1e-6

    return check


def stands(page: Any, twin: TwinClient, axis: str) -> Callable[[], bool]:
    """Whether an axis stands still for a while: on a busy machine a lease may run out
    before."""

    def check() -> bool:
        before = twin.state().axes[axis]
        page.wait_for_timeout(400)
        after = twin.state().axes[axis]
        return (
            not before.moving and not after.moving and before.position == after.position
        )

    return check


@contextmanager
def quickly(page: Any) -> Iterator[None]:
    """By a clock so fast that nobody waits for an axis to get anywhere."""
    page.evaluate("flexdt.call('clock.set', {speed_up: 200})")
    try:
        yield
    finally:
        page.evaluate("flexdt.call('clock.set', {speed_up: 8})")


@contextmanager
def gently(page: Any, twin: TwinClient, wait: Wait, axis: str) -> Iterator[None]:
    """An axis to jog, by a clock so slow that a busy machine's pauses send it into nothing; it
    goes back to where it was."""
    before = twin.state().axes[axis].position
    page.evaluate("flexdt.call('clock.set', {speed_up: 1})")
    seen(page, twin)  # the lease that the page asks for depends on it
    try:
        yield
    finally:
        page.evaluate("window.dispatchEvent(new Event('blur'))")
        with quickly(page):
            page.evaluate("t => flexdt.call('axes.move', {targets: t})", {axis: before})
            wait(settled(twin, axis, before), f"{axis} is back")


@pytest.fixture(autouse=True)
def on_move_tab(page: Any) -> None:
    tab(page, "move")


@pytest.mark.parametrize("axis", list(TARGETS))
@pytest.mark.campaign(3)
def test_number_of_every_axis(page: Any, twin: TwinClient, wait: Wait, axis: str) -> None:
    field = page.locator(f"[data-axis={axis}] .num")
    field.fill(str(TARGETS[axis]))
    with quickly(page):
        field.press("Enter")
        wait(settled(twin, axis, TARGETS[axis]), axis)


@pytest.mark.parametrize("axis", list(TARGETS))
@pytest.mark.campaign(3)
def test_slider_of_every_axis(page: Any, twin: TwinClient, wait: Wait, axis: str) -> None:
    value = twin.state().axes[axis].position - 2.0
    # Read in the same breath: a state that comes may draw the slider anew.
    set_to = float(
        page.locator(f"[data-axis={axis}] input[type=range]").evaluate(
            "(e, v) => { e.value = v; const set = e.value; e.dispatchEvent(new Event('input'));"
            " e.dispatchEvent(new Event('change')); return set; }",
            value,
        )
    )
    assert abs(set_to - value) <= 0.051
    wait(settled(twin, axis, set_to), axis)


@pytest.mark.parametrize("axis", list(TARGETS))
@pytest.mark.campaign(3)
def test_jog_buttons_of_every_axis(
    page: Any, twin: TwinClient, wait: Wait, axis: str
) -> None:
    def travel() -> float:
        return twin.state().axes[axis].position - before

    with gently(page, twin, wait, axis):
        for direction in (1, -1):
            before = twin.state().axes[axis].position
            button = page.locator(f'[data-jog="{axis}:{direction}"]')
            button.scroll_into_view_if_needed()
            button.hover()
            page.mouse.down()
            try:
                wait(lambda: travel() * direction > 0.05, f"{axis} {direction}")  # noqa: B023
            finally:
                page.mouse.up()
            wait(stands(page, twin, axis), "letting go stops")


KEYS = {
    "i": ("ver_tube", 1), "k": ("ver_tube", -1), "j": ("tra_tube", -1), "l": ("tra_tube", 1),
    "t": ("mag_obj", 1), "g": ("mag_obj", -1), "f": ("tra_obj", -1), "h": ("tra_obj", 1),
    "r": ("rot_obj", -1), "y": ("rot_obj", 1), "8": ("ver_det", 1), "2": ("ver_det", -1),
    "4": ("tra_det", 1), "6": ("tra_det", -1), "9": ("mag_det", 1), "7": ("mag_det", -1),
    "u": ("ver_obj", -1), "o": ("ver_obj", 1),
}  # fmt: skip


@pytest.mark.parametrize("key", list(KEYS))
@pytest.mark.campaign(6)
def test_keys_jog_while_held(page: Any, twin: TwinClient, wait: Wait, key: str) -> None:
    axis, direction = KEYS[key]
    page.check("#key-jog")
    page.locator("#views").evaluate("() => document.activeElement.blur()")
    with gently(page, twin, wait, axis):
        before = twin.state().axes[axis].position
        page.keyboard.down(key)
        try:
            wait(
                lambda: (twin.state().axes[axis].position - before) * direction > 0.05,
                key,
            )
        finally:
            page.keyboard.up(key)
        wait(stands(page, twin, axis), "letting go stops")


@pytest.mark.parametrize(
    ("name", "share"), [("slow", 0.04), ("medium", 0.2), ("fast", 1.0)]
)
def test_jog_speed(
    page: Any, twin: TwinClient, wait: Wait, name: str, share: float
) -> None:
    page.select_option("#jog-speed", label=name)
    top = twin.state().axes["rot_obj"].speed
    button = page.locator('[data-jog="rot_obj:1"]')
    button.scroll_into_view_if_needed()
    button.hover()
    page.mouse.down()
    try:
        wait(
            lambda: twin.state().axes["rot_obj"].velocity == pytest.approx(share * top),
            name,
        )
    finally:
        page.mouse.up()
    wait(lambda: not twin.state().axes["rot_obj"].moving)
    page.select_option("#jog-speed", label="medium")


def test_a_way_around_obstacles_where_it_is_asked_for(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    sample = "flexdt.call('sample.set', {name: 'lego', offset: {y: -80}})"
    before = {n: a.position for n, a in twin.state().axes.items() if n != "ver_obj"}
    page.evaluate(sample)
    start = {
        "mag_obj": 70.0,
        "tra_obj": -60.0,
        "rot_obj": 0.0,
        "ver_tube": 40.0,
        "tra_tube": 0.0,
    }
    for axis, value in start.items():
        if axis != "mag_obj":
            page.evaluate("t => flexdt.call('axes.move', {targets: t})", {axis: value})
            wait(settled(twin, axis, value), axis)
    page.evaluate("flexdt.call('axes.move', {targets: {mag_obj: 70}})")
    wait(settled(twin, "mag_obj", 70.0))
    field = page.locator("[data-axis=tra_obj] .num")
    field.fill("60")
    field.press("Enter")
    page.locator(".note.error").filter(has_text="tra_obj goes to").first.wait_for()
    wait(lambda: not twin.state().axes["tra_obj"].moving)
    assert twin.state().axes["tra_obj"].position < 20.0, (
        "as far as is free, and no farther"
    )
    page.check("#around")
    field.fill("60")
    field.press("Enter")
    page.locator(".note", has_text="direct way").first.wait_for()
    wait(settled(twin, "tra_obj", 60.0), "around")
    page.uncheck("#around")
    page.evaluate("flexdt.call('sample.set', {name: 'lego'})")
    page.evaluate(
        "t => flexdt.call('axes.move', {targets: t, plan: true, wait: true})", before
    )
    wait(settled(twin, "mag_obj", before["mag_obj"]))


def test_single_keys_move_nothing_unless_they_are_asked_to(
    page: Any, twin: TwinClient
) -> None:
    page.uncheck("#key-jog")
    page.evaluate("() => document.activeElement.blur()")
    before = {n: a.position for n, a in twin.state().axes.items()}
    for key in KEYS:
        page.keyboard.down(key)
        page.keyboard.up(key)
    answered(page)
    assert {n: a.target for n, a in twin.state().axes.items()} == before


def test_typing_into_a_field_does_not_jog(page: Any, twin: TwinClient) -> None:
    tab(page, "scan")
    before = {n: a.position for n, a in twin.state().axes.items()}
    page.locator("#script").press_sequentially("ikjltgfhry8246")
    answered(page)
    assert {n: a.position for n, a in twin.state().axes.items()} == before
    page.locator("#script").fill("")


def test_help_lists_every_key(page: Any) -> None:
    page.click("#help")
    text = page.inner_text("#help-dialog")
    assert "source up" in text
    assert "emergency stop" in text
    assert page.locator("#help-dialog kbd").count() == 23
    page.locator("#help-dialog").get_by_role("button", name="Close", exact=True).click()
    assert not page.locator("#help-dialog").is_visible()


def test_stop_button_and_space(page: Any, twin: TwinClient, wait: Wait) -> None:
    for act in (lambda: page.click("#stop"), lambda: page.keyboard.press("Space")):
        start = twin.state().axes["mag_obj"].position
        # So slow that a busy machine stops it on the way.
        page.evaluate("flexdt.call('clock.set', {speed_up: 0.05})")
        page.evaluate(
            "v => flexdt.call('axes.move', {targets: {mag_obj: v}})", start - 200.0
        )
        wait(lambda: twin.state().axes["mag_obj"].moving)
        page.evaluate("() => document.activeElement.blur()")
        act()
        wait(lambda: not twin.state().axes["mag_obj"].moving)
        assert abs(twin.state().axes["mag_obj"].position - start) < 190.0
        page.evaluate("flexdt.call('clock.set', {speed_up: 8})")
        page.evaluate("v => flexdt.call('axes.move', {targets: {mag_obj: v}})", start)
        wait(settled(twin, "mag_obj", start))


def test_refusals_are_notes_and_nothing_moves(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    before = twin.state().axes["mag_obj"].position
    field = page.locator("[data-axis=mag_obj] .num")
    field.fill("5000")
    field.press("Enter")
    note = page.locator(".note.error").filter(has_text="mag_obj")
    note.filter(has_text="[70, 996]").first.wait_for()
    assert twin.state().axes["mag_obj"].target == before


def test_collision_is_refused_with_its_pair(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    answer = page.evaluate(
        "flexdt.call('axes.move', {targets: {mag_det: 200}})"
        ".then(() => null, ({ code, data }) => ({ code, data }))"
    )
    assert answer["code"] == -32002, answer
    assert "detector" in " ".join(answer["data"]["pair"])
    assert twin.state().axes["mag_det"].target > 400.0, "it goes no farther than is free"
    page.evaluate("flexdt.call('axes.move', {targets: {mag_det: 1000}})")
    wait(settled(twin, "mag_det", 1000.0))


def test_emergency_stop_and_reset(page: Any, twin: TwinClient, wait: Wait) -> None:
    assert page.locator("#estop").is_visible()
    page.click("#estop")
    wait(lambda: twin.state().safety.estop)
    page.locator("#emergency", has_text="Emergency stop by you").wait_for()
    released(page)
    wait(lambda: not twin.state().safety.estop)
    page.keyboard.press("Shift+Space")
    wait(lambda: twin.state().safety.estop, "by key")
    released(page)
    wait(lambda: twin.state().safety.state == "ok")


def test_tube(page: Any, twin: TwinClient, wait: Wait) -> None:
    tab(page, "setup")
    page.fill("#kV", "70")
    page.fill("#power", "30")
    page.click("#tube-apply")
    wait(lambda: (twin.state().tube.kV, twin.state().tube.power_W) == (70.0, 30.0))
    before = twin.state().tube.on
    page.click("#beam")
    wait(lambda: twin.state().tube.on != before)
    seen(page, twin)  # the button does the opposite of what the page knows
    page.click("#beam")
    wait(lambda: twin.state().tube.on == before)


def test_camera(page: Any, twin: TwinClient, wait: Wait) -> None:
    tab(page, "setup")
    page.fill("#exposure", "150")
    page.fill("#averages", "3")
    page.select_option("#mode", "HW2SW2High")
    for name, value in zip("ltrb", (100, 50, 1899, 1449), strict=True):
        page.fill(f"#roi-{name}", str(value))
    page.click("#camera-apply")
    wait(lambda: twin.state().camera.mode == "HW2SW2High")
    camera = twin.state().camera
    assert (camera.exposure_ms, camera.averages) == (150.0, 3)
    assert camera.roi == (100, 50, 1899, 1449)
    page.locator("#camera-shape", has_text="450 × 350").wait_for()
    page.evaluate(
        "flexdt.call('camera.set', {exposure_ms: 100, mode: 'HW2SW1High', averages: 1,"
        " roi: [32, 8, 1943, 1527]})"
    )


def test_sample_chooser(page: Any, twin: TwinClient, wait: Wait) -> None:
    tab(page, "setup")
    page.select_option("#sample", "normal")
    page.fill("#off-x", "1.5")
    page.fill("#off-rz", "20")
    page.click("#sample-apply")
    wait(lambda: twin.state().sample.name == "normal")
    assert (twin.state().sample.offset.x, twin.state().sample.offset.rz) == (1.5, 20.0)
    # Typed at once, also before the page has its answer: that takes back nothing of it.
    page.fill("#off-x", "0")
    page.fill("#off-rz", "0")
    page.select_option("#sample", "lego")
    page.click("#sample-apply")
    wait(lambda: twin.state().sample.name == "lego")


@pytest.mark.parametrize(
    ("form", "name"), [("stl", "rod"), ("glb", "试样"), ("off", "..rod")]
)
@pytest.mark.campaign(1)
def test_upload_of_a_mesh(
    page: Any, twin: TwinClient, wait: Wait, tmp_path: Path, form: str, name: str
) -> None:
    centre = {"ver_tube": 40.0, "ver_det": 33.7, "tra_tube": 0.0, "tra_det": 25.32,
              "tra_obj": 0.0, "mag_obj": 600.0, "mag_det": 1000.0}  # fmt: skip
    page.evaluate("t => flexdt.call('axes.move', {targets: t})", centre)
    for axis, value in centre.items():
        wait(settled(twin, axis, value), axis)
    tab(page, "setup")
    # What names may not hold goes, and such a name is never one that is taken already.
    taken = {sample.name for sample in twin.samples().samples}
    free = (n for n in ("rod", *(f"rod-{i}" for i in range(1, 9))) if n not in taken)
    shown = next(free) if name == "..rod" else name
    mesh = trimesh.creation.cylinder(radius=0.6, height=2.0)
    path = tmp_path / f"{name}.{form}"
    mesh.export(path)
    page.set_input_files("#mesh-file", path)
    assert page.input_value("#mesh-unit") == ("m" if form == "glb" else "mm")
    page.select_option("#mesh-unit", "cm")
    page.select_option("#mesh-material", "aluminium")
    page.click("#mesh-upload")
    wait(lambda: twin.state().sample.name == shown, shown)
    assert twin.state().sample.size_mm == pytest.approx((12.0, 12.0, 20.0), rel=0.01)
    assert twin.state().sample.material == "aluminium"
    middle = np.asarray(twin.projection().image)
    assert middle.max() > 0.1
    page.locator(
        ".note.good", has_text=shown
    ).wait_for()  # the page has done all that it does
    page.evaluate("flexdt.call('sample.set', {name: 'lego'})")
    page.select_option("#sample", "lego")
    assert page.is_hidden("#sample-delete"), "what ships stays"
    page.select_option("#sample", shown)
    page.click("#sample-delete")
    wait(
        lambda: shown not in {sample.name for sample in twin.samples().samples}, "deleted"
    )
    page.locator("#sample-delete").wait_for(state="hidden")


def test_an_ended_scan_and_a_correction_are_taken_off_their_lists(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    def call(method: str, params: dict[str, Any]) -> Any:
        return page.evaluate("([m, p]) => flexdt.call(m, p)", [method, params])

    poses = [{"rot_obj": 1.0}]
    scan = {"poses": poses, "exposure_ms": 50.0, "name": f"short-{twin.ping():.6f}"}
    job = call("trajectory.submit", scan)["job"]
    wait(lambda: twin.job_status(job).state == "done", "the scan")
    page.locator("#job-forget").wait_for()
    page.click("#job-forget")
    wait(lambda: job not in {one.job for one in twin.jobs().jobs}, "forgotten")
    page.locator("#scan-bar").wait_for(state="hidden")
    old, _ = (
        call("calibration.apply", {"parameters": {"dO_x": x}})["correction"]["name"]
        for x in (0.1, 0.2)
    )
    tab(page, "calibrate")
    row = page.locator("#corrections > div", has_text=old)
    row.get_by_role("button", name="delete").click()
    wait(lambda: old not in {c.name for c in twin.calibrations().corrections}, "deleted")
    while twin.calibrations().current is not None:
        call("calibration.revert", {})


def test_names_of_uploads_keep_letters_and_overwrite_nothing(page: Any) -> None:
    named = {
        ("试样.stl", ()): "试样",
        ("Größe 2.stl", ("Größe 2",)): "Größe 2",  # the same file again
        ("a:b.stl", ()): "a-b",
        ("a:b.stl", ("a-b", "a-b-1")): "a-b-2",
        ("....stl", ("mesh-1", "mesh-2")): "mesh-3",
    }
    ask = "([file, taken]) => import('/names.js').then((m) => m.sampleName(file, taken))"
    for (file, taken), name in named.items():
        assert page.evaluate(ask, [file, list(taken)]) == name


def test_a_broken_upload_is_told(page: Any, tmp_path: Path) -> None:
    tab(page, "setup")
    path = tmp_path / "broken.stl"
    path.write_bytes(b"not a mesh at all")
    page.set_input_files("#mesh-file", path)
    page.click("#mesh-upload")
    page.locator(".note.error").filter(has_text="broken.stl").first.wait_for()


HOLDERS = """(() => {
  const pill = document.getElementById("holder");
  window.held = [pill.innerText];
  new MutationObserver(() => {
    if (window.held.at(-1) !== pill.innerText) window.held.push(pill.innerText);
  }).observe(pill, { childList: true, subtree: true, characterData: true });
})()"""
"""Records all that is said about who controls."""


def test_people_have_names(
    page: Any, twin: TwinClient, open_page: Callable[..., Any], wait: Wait
) -> None:
    """In control, log and take-over; kept in the browser, and changeable."""
    connected = "window.flexdt.store.session"
    page.fill("#person", "Ada <b>")
    page.press("#person", "Enter")
    wait(lambda: "Ada" in (page.evaluate(connected) or ""), "the name")
    seen(page, twin)
    if page.inner_text("#take") != "Release":  # control follows a new name
        page.click("#take")
    page.locator("#holder", has_text="you control").wait_for()
    page.evaluate(HOLDERS)
    for name in ("Ada Byron", "Ada <b>"):
        page.fill("#person", name)
        page.press("#person", "Enter")
        wait(lambda name=name: name in (page.evaluate(connected) or ""), "the name")
    seen(page, twin)
    assert page.evaluate("window.held") == ["you control"]
    assert (twin.state().controller or "").startswith("Ada <b> #")
    other = open_page()
    other.locator("#holder", has_text="held by Ada <b>").wait_for()
    other.fill("#person", "Emmy")
    other.press("#person", "Enter")
    wait(lambda: "Emmy" in (other.evaluate(connected) or ""), "the other name")
    other.click("#take")
    told = "Emmy #"
    page.locator(".note").filter(has_text=told).filter(
        has_text="took control from you"
    ).wait_for()
    page.locator("#holder", has_text="held by Emmy").wait_for()
    page.reload()
    page.wait_for_function("window.flexdt?.store.session")
    assert page.input_value("#person") == "Ada <b>"
    other.click("#take")
    other.close()
    page.fill("#person", "")
    page.press("#person", "Enter")
    wait(lambda: "a visitor" in (page.evaluate(connected) or ""), "no name")


def test_control_is_taken_released_and_taken_over(
    page: Any, twin: TwinClient, open_page: Callable[..., Any], wait: Wait
) -> None:
    seen(page, twin)
    if page.inner_text("#take") == "Release":
        page.click("#take")
    page.locator("#holder", has_text="nobody").wait_for()
    page.click("#take")
    page.locator("#holder", has_text="you control").wait_for()
    session = page.evaluate("flexdt.store.session")
    assert twin.state().controller == session
    other = open_page()
    other.locator("#holder", has_text=session).wait_for()
    field = other.locator("[data-axis=tra_obj] .num")
    inert = "(e) => e.closest('[inert]') !== null"
    why = f"{session} controls: take over first"
    other.locator("#move-down", has_text=f"Nothing moves: {why}.").wait_for()
    other.locator("#scan-it-note", has_text=f"No scan: {why}.").wait_for()
    assert field.evaluate(inert)
    assert [other.is_disabled(f"#{id}") for id in ("scan-it", "beam")] == [True, True]
    assert [page.is_disabled(f"#{id}") for id in ("scan-it", "beam")] == [False, False]
    assert not page.locator("#move-down").is_visible()
    assert not any(other.is_disabled(f"#{id}") for id in ("estop", "stop", "take"))
    other.click("#tabs [data-tab=setup]")
    other.fill("#kV", "61")
    other.press("#kV", "Enter")
    other.locator(".note.error", has_text="is the controller").wait_for()
    page.click("#take")
    other.locator("#holder", has_text="nobody").wait_for()
    assert other.locator(".note.error", has_text="is the controller").count() == 0
    page.click("#take")
    other.locator("#holder", has_text="held by").wait_for()
    other.click("#take")
    other.locator("#holder", has_text="you control").wait_for()
    page.locator("#holder", has_text="held by").wait_for()
    other.click("#tabs [data-tab=move]")
    other.locator("#move-down").wait_for(state="hidden")
    assert page.is_disabled("#scan-it")
    assert not field.evaluate(inert)
    field.fill("4")
    field.press("Enter")
    wait(settled(twin, "tra_obj", 4.0))
    shown = page.locator("[data-axis=tra_obj] .num")
    wait(lambda: shown.input_value() == "4.000", "both pages show it")
    other.close()
    wait(lambda: twin.state().controller is None, "a page that goes gives control back")
