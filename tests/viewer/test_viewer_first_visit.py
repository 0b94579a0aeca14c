"""What a first visitor wants to do, each from a page just opened, by what is written on it.

Clicks are counted as a hand makes them: a press is one, held or dragged too, a choice from a
list two (open it, take one), a field to type into one, a file to pick one. Keys are not
counted.

The clicks of the table in docs/evidence/viewer.json are those counted here, on a small desktop
screen, a tablet and a phone; `pytest -s tests/viewer/test_viewer_first_visit.py` prints the
seconds, too.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import trimesh
from looking import drawn, picture, point_at, settled, until

from flexdt.clients.client.twin_methods import FINAL_STATES
from flexdt.twin.machine.description import builtin_machine, profile_of
from flexdt.twin.script.compose import compose_script
from flexdt.twin.script.scan_request import ScanRequest

pytestmark = pytest.mark.browser
FIGURES = Path(__file__).parents[2] / "docs" / "evidence" / "viewer.json"
SIZES = ((1366, 768), (820, 1180), (390, 844))
HOME = {"mag_obj": 600, "mag_det": 1000, "ver_tube": 26.29, "ver_det": 20, "tra_obj": 0}
WRONG = {"dO_x": 0.6, "dO_z": -0.8}
"""A correction as wrong as a misalignment would be."""


@dataclass
class Visitor:
    """A hand on a page, and how often it has clicked."""

    page: Any
    folder: Path
    clicks: int = 0

    def click(self, what: Any) -> None:
        self.clicks += 1
        what.click()

    def button(self, name: str) -> None:
        self.click(self.page.get_by_role("button", name=name, exact=True))

    def tab(self, name: str) -> None:
        self.click(self.page.get_by_role("tab", name=name, exact=True))

    def write(self, label: str, text: str) -> None:
        field = self.page.get_by_label(label, exact=True)
        self.click(field)
        field.fill(text)
        field.press("Enter")

    def choose(self, label: str | re.Pattern[str], option: str) -> None:
        self.clicks += 2
        self.page.get_by_label(label, exact=True).select_option(option)

    def drag(self, *places: tuple[float, float]) -> None:
        """Over the radiograph, from one share of its width and height to the next."""
        self.clicks += 1
        point_at(self.page, *places[0])
        self.page.mouse.down()
        for place in places[1:]:
            point_at(self.page, *place)
        self.page.mouse.up()

    def sees(self, words: str | re.Pattern[str]) -> str:
        """What is written where the words stand, once they do."""
        found = self.page.get_by_text(words).locator("visible=true").first
        found.wait_for(timeout=240_000)
        return str(found.inner_text())

    def sees_no_more(self, words: str) -> None:
        until(
            lambda: not self.page.get_by_text(words).locator("visible=true").count(),
            words,
        )

    def readout(self, name: str) -> str:
        term = self.page.get_by_role("term").filter(has_text=re.compile(f"^{name}$"))
        return str(term.locator("xpath=following-sibling::dd[1]").inner_text())


def look_along_the_beam(v: Visitor) -> None:
    """the machine from the focal spot"""
    v.button("Beam’s eye")
    v.page.locator("#views").get_by_text("Beam’s eye").wait_for()
    settled(v.page.locator(".view[data-view=beam] .crop"), drawn)


def move_the_sample(v: Visitor) -> None:
    """the readouts follow: SOD 500.00 mm"""
    v.write("Source to sample", "500")
    until(lambda: v.readout("SOD") == "500.00 mm", "the distance")


def turn_the_sample(v: Visitor) -> None:
    """its angle goes on until it is let go"""
    turned = v.page.get_by_label("rot_obj value")
    before = float(turned.input_value())
    v.clicks += 1
    v.page.get_by_role("button", name="jog rot_obj up").hover()
    v.page.mouse.down()
    until(
        lambda: float(turned.input_value()) > before + 2,
        "a turn while the button is held",
    )
    v.page.mouse.up()


def stop_and_go_on(v: Visitor) -> None:
    """“Emergency stop by …”; it goes with the reset"""
    v.button("E-STOP")
    v.sees("nothing moves until it is reset")
    v.button("RESET")
    v.button("Reset this stop")
    v.sees_no_more("nothing moves until it is reset")


def switch_x_rays_on(v: Visitor) -> None:
    """the spectrum, “60 kV” as the beam; the image no longer says that they are off"""
    v.sees("X-rays off: drawn as though on")
    v.tab("Setup")
    v.write("voltage [kV]", "60")
    v.button("Switch X-rays on")
    v.sees("60 kV, behind the filters")
    until(lambda: v.readout("beam").startswith("60 kV"), "the beam")
    v.sees_no_more("X-rays off: drawn as though on")


def put_on_another_sample(v: Visitor) -> None:
    """its radiograph"""
    v.choose("Sample to scan", "normal")
    shown = "flexdt.store.image?.origin?.sample"
    until(lambda: v.page.evaluate(shown) == "normal", "its radiograph")


def bring_a_mesh(v: Visitor) -> None:
    """“little block is on the stage”, its size"""
    file = v.folder / "little block.stl"
    trimesh.creation.box((30, 20, 10)).export(file)
    v.tab("Setup")
    v.clicks += 1
    v.page.get_by_label("file", exact=True).set_input_files(file)
    v.button("Upload")
    v.sees("little block is on the stage")
    v.sees(sized(30, 20, 10))


def measure_a_region(v: Visitor) -> None:
    """mean, deviation, least, greatest, pixels"""
    v.choose(re.compile("^tool"), "statistics of a box")
    v.drag((0.4, 0.4), (0.6, 0.6))
    told = v.sees(re.compile(r"^mean .* pixels"))
    assert float(told.split()[1]) > 0.01  # the sample stands in the middle


def notice_too_long_an_exposure(v: Visitor) -> None:
    """a warning, and the saturated part of the pixels"""
    v.tab("Setup")
    v.write("power [W]", "70")
    v.write("exposure [ms]", "500")
    v.sees(re.compile(r"of the pixels would be saturated"))
    v.sees(re.compile(r"saturated [1-9]\d* %"))


def find_an_exposure(v: Visitor) -> None:
    """contrast to noise, transmission, time, disk"""
    v.tab("Scan")
    v.click(v.page.get_by_text("Design a scan"))
    v.sees(re.compile("^least transmission .* saturated"))
    v.sees(re.compile(r"^contrast to noise of .*: [\d.]+"))


def write_a_script(v: Visitor) -> None:
    """“Ready to run”"""
    v.tab("Scan")
    v.button("Write")
    v.sees("Ready to run")


def run_a_scan(v: Visitor) -> None:
    """“done”, “13 / 13 frames”"""
    v.tab("Scan")
    v.choose("Kind of scan", "step")
    v.write("frames", "13")
    v.button("Write")
    v.sees("Ready to run")
    v.choose("Speed-up of the scan", "max")
    v.button("Run")
    v.sees(re.compile("^done"))
    v.sees("13 / 13 frames")


def go_through_a_scan(v: Visitor) -> None:
    """the next image, with its place in the scan"""
    v.tab("Data")
    v.click(v.page.get_by_role("button", name=re.compile("^past scan")))
    v.sees(re.compile(r"^scan_000000 · "))
    v.button("›")
    v.sees(re.compile(r"^scan_000001 · "))


def calibrate(v: Visitor) -> None:
    """errors of the whole scan before and after (below 0.2 px); “… is in force”"""
    v.tab("Data")
    v.click(v.page.get_by_role("button", name=re.compile("^past scan")))
    v.button("Calibrate")
    v.sees(re.compile("^Safe to reconstruct"))
    v.button("Compare over a radiograph")
    whole = v.page.locator(".figure").filter(has_text="whole scan")
    until(lambda: whole.inner_text().count(" px") == 2, "the errors")
    before, after = (float(px) for px in re.findall(r"([\d.]+) px", whole.inner_text()))
    assert before > 5 * after
    assert after < 0.2
    v.button("Apply")
    v.sees(re.compile("is in force$"))


def share_the_scene(v: Visitor) -> None:
    """an HTML file that needs no server"""
    v.tab("Share")
    card = v.page.locator(".card").filter(
        has=v.page.get_by_role("heading", name="The scene as")
    )
    with v.page.expect_download(timeout=120_000) as told:
        v.click(card.get_by_role("button", name="One HTML file"))
    assert told.value.suggested_filename.endswith(".html")
    alone = v.page.context.browser.new_page()
    told.value.save_as(file := v.folder / "scene.html")
    alone.goto(file.as_uri())
    until(
        lambda: drawn(picture(alone.locator("canvas").first)), "the machine in the file"
    )
    alone.close()


def sized(*mm: float) -> str:
    return " × ".join(f"{side:.1f}" for side in mm) + " mm"


TASKS: dict[str, Callable[[Visitor], None]] = {
    "Look along the beam": look_along_the_beam,
    "Move the sample to a distance": move_the_sample,
    "Turn the sample while a button is held": turn_the_sample,
    "Stop everything at once, and go on": stop_and_go_on,
    "Switch X-rays on, at 60 kV": switch_x_rays_on,
    "Put another sample on the stage": put_on_another_sample,
    "Bring a mesh of one’s own": bring_a_mesh,
    "Measure a part of the radiograph": measure_a_region,
    "Notice that an exposure is too long": notice_too_long_an_exposure,
    "Learn what a scan would look like": find_an_exposure,
    "Have a script written and checked": write_a_script,
    "Run a scan of 13 images": run_a_scan,
    "Go through a past scan": go_through_a_scan,
    "Calibrate from it, and apply that": calibrate,
    "Share the scene": share_the_scene,
}


@pytest.fixture(scope="module")
def past(lab: Any) -> None:
    """A scan that was done before, with a wrong correction in force."""
    machine = builtin_machine()
    wish = ScanRequest("step", frames=13, mode="HW4SW1High")
    with lab.client() as twin:
        twin.control("force")
        twin.set_sample("lego")
        twin.apply_calibration(WRONG, "wrong")
        script = compose_script(wish, machine, profile_of(machine))
        twin.submit_script(script, "past scan", "max")
        assert twin.wait_job().state == "done"
        twin.revert_calibration()
        twin.control("release")


@pytest.fixture
def quiet(lab: Any, past: None) -> None:
    """The machine at home, with small images and a phantom, and no scan of the visit before."""
    with lab.client() as twin:
        twin.control("force")
        for job in twin.jobs().jobs:
            if job.state not in FINAL_STATES:
                twin.wait_job(job.job)
        twin.set_sample("lego")
        twin.set_camera(roi=(32, 8, 1943, 1527), mode="HW4SW1High", exposure_ms=100)
        twin.set_tube(on=False, kV=90, power_W=20)
        twin.move(HOME, plan=True, wait=True)
        twin.control("release")


@pytest.mark.parametrize(("task", "size"), [(t, s) for t in TASKS for s in SIZES])
@pytest.mark.campaign(15)
def test_a_task_of_a_first_visit(
    task: str,
    size: tuple[int, int],
    quiet: None,
    open_page: Callable[..., Any],
    tmp_path: Path,
) -> None:
    do = TASKS[task]
    view = "iso" if do is look_along_the_beam else "none"
    page = open_page(view=view, size=size, fresh=True)
    visitor, begun = Visitor(page, tmp_path), time.monotonic()
    do(visitor)
    print(f"{task}, {size}: {visitor.clicks} clicks, {time.monotonic() - begun:.1f} s")
    page.close()
    assert table()[task] == (str(visitor.clicks), do.__doc__)


def test_the_table_of_the_page_lists_these_tasks() -> None:
    assert list(table()) == list(TASKS)


def table() -> dict[str, tuple[str, str]]:
    """Task -> clicks, and what is seen then, in docs/evidence/viewer.json."""
    [section] = [
        section
        for section in json.loads(FIGURES.read_text("utf-8"))["sections"]
        if section["columns"] == ["task", "clicks", "what is seen then"]
    ]
    return {task: (clicks, seen) for task, clicks, seen in section["rows"]}
