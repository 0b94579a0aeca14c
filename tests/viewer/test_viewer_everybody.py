"""The page for everybody: screen readers, keyboards, fingers, small screens, no WebGL."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from looking import KNOWN_HERE, begun, seen

from flexdt.clients.client.client import TwinClient

pytestmark = pytest.mark.browser
Wait = Callable[..., Any]
AXE = Path(__file__).parents[1] / "data" / "axe" / "axe.min.js"
RULES = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
TABS = ("move", "setup", "scan", "data", "calibrate", "share")
SIZES = [(390, 844), (768, 1024), (1024, 768), (1280, 800), (1600, 900)]


def findings(page: Any) -> list[str]:
    """What axe-core finds in our part of the page, which is dimmed while no server answers, as
    on a busy machine: then once more."""
    if not page.evaluate("'axe' in window"):
        page.evaluate(AXE.read_text())
    old, found = True, []
    while old:
        page.wait_for_function("document.body.dataset.old === 'false'")
        found, old = page.evaluate(
            "async (values) => { const r = await axe.run({ exclude: ['#views iframe'] },"
            " { runOnly: { type: 'tag', values } });"
            " const found = r.violations.flatMap((v) =>"
            " v.nodes.map((n) => `${v.id}: ${n.target}`)); "
            " return [found, document.body.dataset.old !== 'false']; }",
            RULES,
        )
    return list(found)


def too_small(page: Any) -> list[str]:
    """Visible controls of less than 24 px."""
    return list(
        page.evaluate(
            "[...document.querySelectorAll('button, input, select, textarea, [role=button]')]"
            ".filter((e) => e.offsetParent).map((e) => [e, e.getBoundingClientRect()])"
            ".filter(([, b]) => b.width < 23.9 || b.height < 23.9)"
            ".map(([e, b]) => `${e.id || e.textContent} ${b.width} x ${b.height}`)"
        )
    )


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_axe_finds_nothing_and_targets_are_large(
    open_page: Callable[..., Any], theme: str
) -> None:
    page = open_page(theme=theme)
    for tab in TABS:
        page.click(f"#tabs [data-tab={tab}]")
        if tab == "scan":
            page.click("#compose")
            page.locator("#report .verdict").wait_for()
            page.select_option("#tool", "profile")
        assert findings(page) == [], tab
        assert too_small(page) == [], tab
    page.click("#help")
    assert findings(page) == []
    page.close()


def test_axe_finds_nothing_after_a_run_and_with_a_data_set_open(
    open_page: Callable[..., Any], twin: TwinClient, wait: Wait
) -> None:
    page = open_page(size=(1366, 768))
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.id") == "skip"
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.id") == "film-canvas"
    page.click("#tabs [data-tab=scan]")
    assert all(page.locator(f"#{name}").is_disabled() for name in ("check", "run"))
    page.fill("#wish-frames", "60")
    page.click("#compose")
    page.locator("#report .verdict.ok").wait_for()
    page.select_option("#speed-up", "max")
    name = twin.job_status(begun(page, twin)).dataset
    page.locator("#job-state", has_text="done").wait_for()
    page.locator("#thumbs figure").first.wait_for()
    assert findings(page) == []
    assert page.inner_text("#volume-note") == ""
    page.click("#job-data")
    page.locator("#record-at", has_text="scan_").wait_for()
    wait(lambda: "measuring" not in page.inner_text("#record-note"), "all lanes")
    assert str(name).endswith(page.inner_text("#record-name"))
    assert findings(page) == []
    assert page.inner_text("#saturated") == "saturated 0 %"  # of its scan, as predicted
    lanes = page.locator("#record .lanes")
    assert lanes.evaluate("e => e.scrollHeight <= e.clientHeight + 1"), (
        "no lane is cut off"
    )
    page.click("#record-close")
    page.evaluate("flexdt.call('session.control', {action: 'release'})")
    page.close()


@pytest.mark.parametrize("size", SIZES)
def test_every_size_has_all_parts_and_the_stop(
    open_page: Callable[..., Any], size: tuple[int, int]
) -> None:
    page = open_page(size=size)
    assert findings(page) == []
    assert too_small(page) == []
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0], (
        "nothing sideways"
    )
    for part in (
        "#film-canvas",
        "[data-axis=rot_obj] .num",
        "#tab-of-share",
        "#readouts",
    ):
        page.locator(part).scroll_into_view_if_needed()
        box = page.locator("#estop").bounding_box()
        middle = [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2]
        assert page.evaluate(
            "([x, y]) => document.elementFromPoint(x, y)?.id === 'estop'", middle
        ), part
    page.close()


def test_without_webgl_radiograph_axes_and_scans_work(
    chromium: Any, lab: Any, twin: TwinClient, wait: Wait
) -> None:
    page = chromium.new_page()
    page.add_init_script(KNOWN_HERE)
    page.add_init_script(
        "const get = HTMLCanvasElement.prototype.getContext;"
        " HTMLCanvasElement.prototype.getContext = function (kind, ...more) {"
        " return /webgl/.test(kind) ? null : get.call(this, kind, ...more); };"
    )
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(f"{lab.url}?view=four&theme=light&patience=100")
    page.locator(".bare", has_text="WebGL is off").wait_for()
    page.wait_for_function("window.flexdt?.store.image && window.flexdt.store.session")
    assert page.locator("iframe").count() == 0
    field = page.locator("[data-axis=tra_obj] .num")
    field.fill("3")
    field.press("Enter")
    wait(lambda: abs(twin.state().axes["tra_obj"].position - 3.0) < 1e-6)
    page.click("#tabs [data-tab=scan]")
    page.select_option("#wish-kind", "step")
    page.fill("#wish-frames", "12")
    page.click("#compose")
    page.locator("#report .verdict.ok").wait_for()
    page.select_option("#speed-up", "max")
    page.evaluate("flexdt.call('session.control', {action: 'release'})")
    job = begun(page, twin)
    wait(lambda: twin.job_status(job).state == "done", "the scan")
    page.close()
    assert errors == []


def test_a_plan_is_gone_through_by_keyboard(page: Any, wait: Wait) -> None:
    page.click("#tabs [data-tab=scan]")
    page.fill("#wish-frames", "73")
    page.click("#compose")
    page.locator("#report .verdict").wait_for()
    page.focus("#plan")
    page.keyboard.press("Enter")
    page.locator("#timeline").wait_for()
    page.focus("#timeline")
    now = lambda: float(page.get_attribute("#timeline", "aria-valuenow") or 0)  # noqa: E731
    page.keyboard.press("End")
    end = float(page.get_attribute("#timeline", "aria-valuemax"))
    wait(lambda: abs(now() - end) < 1e-6)
    page.keyboard.press("ArrowLeft")
    wait(lambda: abs(now() - 0.99 * end) < 1e-6)
    step = page.locator("#report .steps [role=button]").nth(2)
    step.focus()
    page.keyboard.press("Enter")
    wait(
        lambda: page.evaluate("document.activeElement.id") == "script", "the step's line"
    )
    page.evaluate(
        "document.querySelector('#unscrub').click()"
    )  # hidden beside the script's line
    page.click("#tabs [data-tab=move]")


@pytest.mark.campaign
def test_four_views_fetch_the_program_once(
    open_page: Callable[..., Any], wait: Wait
) -> None:
    page = open_page("four")
    page.locator(".view iframe").nth(3).wait_for()
    sizes = (
        "[...document.querySelectorAll('.view iframe')].map((f) => f.contentWindow.performance"
        ".getEntriesByType('resource').find((e) => /viser-/.test(e.name))?.transferSize)"
    )
    fetched = lambda: page.evaluate(sizes)  # noqa: E731
    wait(
        lambda: len(fetched()) == 4 and None not in fetched(),
        "four views have their program",
    )
    assert sum(size > 100_000 for size in fetched()) <= 1, fetched()
    page.close()


@pytest.mark.campaign
def test_slices_grow_while_a_scan_runs(page: Any, twin: TwinClient, wait: Wait) -> None:
    page.click("#tabs [data-tab=scan]")
    page.fill("#wish-frames", "45")
    page.click("#compose")
    page.locator("#report .verdict").wait_for()
    page.evaluate("flexdt.call('session.control', {action: 'release'})")
    job = begun(page, twin)
    page.locator("#volume-card").wait_for()
    page.select_option("#volume-side", "128")
    views = lambda: int((page.inner_text("#volume-note").split() or ["0"])[0])  # noqa: E731
    told = lambda: "of 45 views" in page.inner_text("#volume-note")  # noqa: E731
    wait(told, "the first slices")
    first = views()
    wait(lambda: twin.job_status(job).state == "done", "the scan")
    wait(lambda: views() == 45, "all views")
    assert first <= 45
    whole = "flexdt.volume().told.done === 1 && flexdt.volume().three.block"
    shape = page.wait_for_function(f"{whole} && {whole}.shape").json_value()
    assert all(80 < n < 150 for n in shape)
    # What is shown in the end is the finished volume, also where it was told while one was
    # fetched.
    apart = (
        "async ([z, y, x]) => { const b = flexdt.volume().three.block; const at = [x >> 1, y >> 1, "
        "z >> 1]; const code = b.codes[(at[2] * y + at[1]) * x + at[0]], step = (b.high - b.low) "
        "/ 65534; const exact = await flexdt.call('viewer.voxel', { ...flexdt.volume().of, at }); "
        "return Math.abs(b.low + (code - 1) * step - exact.volume) / step; }"
    )
    wait(lambda: page.evaluate(apart, shape) <= 0.51, "the newest volume")
    for name in ("top", "front", "side"):
        spread = page.evaluate(
            "name => { const c = document.querySelector(`#slice-${name}`);"
            " const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
            " return new Set(d.filter((v, k) => k % 4 === 0)).size; }",
            name,
        )
        assert spread > 20, "a picture of something"
    page.select_option("#volume-side", "")
    seen(page, twin)
    page.fill("#wish-frames", "73")
    page.click("#tabs [data-tab=move]")


def test_what_is_no_data_set_is_not_followed(page: Any) -> None:
    for name in ("../outside", "not-there", ".hidden"):
        said = page.evaluate(
            "name => flexdt.call('viewer.live', {name}).then(() => null, (e) => e.message)",
            name,
        )
        assert said, name
