"""Numbers and warnings on the page, with the twin driven to where they must appear."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from looking import released, seen

from flexdt.clients.client.client import TwinClient

pytestmark = pytest.mark.browser
Wait = Callable[..., Any]
MIDDLE = {"ver_tube": 26.29, "ver_det": 20.0, "tra_tube": 0.0, "tra_det": 25.32, "tra_obj": 0.0,
          "mag_obj": 600.0, "mag_det": 1000.0, "rot_obj": 0.0}  # fmt: skip
PITCH_MM = 0.1496
"""Of the panel behind binning 2 x 2 (thesis 2.3: 74.8 um)."""


def go(page: Any, twin: TwinClient, wait: Wait, **targets: float) -> None:
    """Move the motors, around obstacles if need be, and wait until they stand there and the
    page knows it."""
    page.evaluate("t => flexdt.call('axes.move', {targets: t, plan: true})", targets)

    def there() -> bool:
        axes = twin.state().axes
        return all(
            not axes[n].moving and abs(axes[n].position - v) < 1e-6
            for n, v in targets.items()
        )

    wait(there, str(targets))
    seen(page, twin)


@pytest.fixture(autouse=True)
def in_the_middle(page: Any, twin: TwinClient, wait: Wait) -> Iterator[None]:
    page.evaluate("flexdt.call('sample.set', {name: 'lego'})")
    page.evaluate(
        "flexdt.call('camera.set', {roi: [32, 8, 1943, 1527], mode: 'HW2SW1High'})"
    )
    go(page, twin, wait, **MIDDLE)
    yield
    page.evaluate("flexdt.call('safety.reset')")
    page.evaluate("flexdt.call('sample.set', {name: 'lego'})")
    go(page, twin, wait, **MIDDLE)


def readout(page: Any, name: str) -> str:
    return str(
        page.evaluate(
            "name => [...document.querySelectorAll('#readouts dt')]"
            ".find((d) => d.textContent === name).nextSibling.textContent",
            name,
        )
    )


def number(page: Any, name: str) -> float:
    return float(readout(page, name).rstrip("×").split()[0])


def warnings(page: Any) -> list[str]:
    return list(page.locator("#warnings .warning").all_inner_texts())


def test_readouts_follow_the_motors(page: Any, twin: TwinClient, wait: Wait) -> None:
    """Distances change as the motors do; the rest follows from them by hand."""
    start = twin.state().geometry
    first = start.SOD_mm, start.SDD_mm
    go(page, twin, wait, mag_obj=700.0, mag_det=900.0)
    wait(lambda: abs(number(page, "SOD") - first[0] - 100.0) < 0.011, "SOD")
    wait(lambda: abs(number(page, "SDD") - first[1] + 100.0) < 0.011, "SDD")
    sod, sdd = number(page, "SOD"), number(page, "SDD")
    assert number(page, "magnification") == pytest.approx(sdd / sod, rel=1e-4)
    voxel_mm = PITCH_MM * sod / sdd
    assert number(page, "voxel") == pytest.approx(1000.0 * voxel_mm, abs=0.02)
    width, _, height, unit = readout(page, "field of view").split()
    assert unit == "mm"
    assert float(width) == pytest.approx(956 * voxel_mm, abs=0.06)
    assert float(height) == pytest.approx(760 * voxel_mm, abs=0.06)
    rows = readout(page, "piercing point").removesuffix(" px").split(", ")
    wanted = twin.state().geometry.piercing_point_px
    assert [float(v) for v in rows] == pytest.approx(list(wanted), abs=0.051)
    assert number(page, "axis column") == pytest.approx(
        twin.state().geometry.axis_column_px, abs=0.051
    )


def test_truncation_is_told_and_goes(page: Any, wait: Wait) -> None:
    cut = "sample => flexdt.call('sample.set', {name: 'lego', offset: sample})"
    told = lambda: " ".join(t for t in warnings(page) if t.startswith("Sample"))  # noqa: E731
    wait(lambda: told() == "", "nothing is cut off")
    page.evaluate(cut, {"x": 45})
    wait(lambda: "cut off at the sides" in told(), "sideways")
    assert "at the top" not in told()
    page.evaluate(cut, {"z": 45})
    wait(lambda: "cut off at the top" in told(), "at the top")
    assert "at the sides" not in told()
    page.evaluate(cut, {})
    wait(lambda: told() == "", "and gone again")


def test_end_of_travel_is_told(page: Any, twin: TwinClient, wait: Wait) -> None:
    limit = twin.state().axes["tra_tube"].limits[1]
    go(page, twin, wait, tra_tube=limit)
    wait(lambda: any("tra_tube" in t and "end of travel" in t for t in warnings(page)))
    assert page.locator("[data-axis=tra_tube].limit").count() == 1
    go(page, twin, wait, tra_tube=limit - 5.0)
    wait(lambda: not any("tra_tube" in t for t in warnings(page)))
    assert page.locator("[data-axis=tra_tube].limit").count() == 0


def test_where_the_machine_was_found_is_no_warning(
    page: Any, twin: TwinClient, wait: Wait, open_page: Callable[..., Any]
) -> None:
    """The FleX-ray's detector is at home at an end of its travel."""
    go(page, twin, wait, mag_det=1059.0)
    fresh = open_page()
    wait(lambda: fresh.locator("[data-axis=mag_det].limit").count() == 1)

    def told() -> list[str]:  # others come from what the camera was left with
        return [text for text in warnings(fresh) if "travel" in text]

    assert told() == []
    go(page, twin, wait, mag_det=1040.0)
    seen(fresh, twin)
    go(page, twin, wait, mag_det=1059.0)
    wait(lambda: told() == ["mag_det at the end of travel"])
    fresh.close()


def test_near_contact_then_blocked_then_reset(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    """Runs towards the sample until the twin halts; the third attempt blocks the machine."""
    into = "flexdt.call('axes.move', {targets: {mag_det: 300}}).then(() => null, (e) => e.code)"
    assert page.evaluate(into) == -32002
    wait(lambda: not twin.state().axes["mag_det"].moving)
    page.locator("#near .meter.touch").wait_for()
    distance, _ = page.inner_text("#near .mm").split()
    assert 0.0 < float(distance) <= 2.0  # 1.96 mm is shown as 2.0
    bad = page.locator("#warnings .bad", has_text="mm apart")
    bad.wait_for()
    # The pair on the way there may have been another one.
    pair = lambda: page.inner_text("#near .pair").split(" – ")  # noqa: E731
    wait(lambda: all(part in bad.inner_text() for part in pair()), "the pair, in words")
    assert any(part.startswith("detector") for part in pair())
    page.evaluate(into)
    page.evaluate(into)
    wait(lambda: twin.state().safety.state == "aborted")
    blocked = page.locator("#emergency", has_text="Blocked")
    blocked.wait_for()
    assert "3 times in a row" in blocked.inner_text()
    released(page)
    wait(lambda: twin.state().safety.state == "ok")
    blocked.wait_for(state="hidden")
    go(page, twin, wait, mag_det=1000.0)
    bad.wait_for(state="detached")
    assert page.locator("#near .meter.touch").count() == 0
