"""Camera modes are the machine file's: drawn files, and one sentence from all who take a
mode."""

from __future__ import annotations

import re
from itertools import product

import numpy as np
import pytest

import flexdt as fx
from flexdt.phantoms.exposure_forecast import expose
from flexdt.twin.errors import LimitError, MachineFileError
from flexdt.twin.machine.camera import Roi
from flexdt.twin.machine.description import (
    Machine,
    builtin_machine,
    parse_machine,
    profile_of,
)
from flexdt.twin.scanner.state import changed_camera
from flexdt.twin.script import ScanRequest, compose_script, plan_script

SMALL = Roi(900, 700, 963, 763)
"""Read out for a prediction: the sentence does not depend on it, and the whole panel costs
much."""


def sentences(machine: Machine, mode: str) -> set[str]:
    """What script, scanner, composed script and prediction say of a mode; "" for nothing."""
    plan = plan_script(f"camera set mode {mode} ACK", machine, profile_of(machine))
    assert [(p.line, p.code) for p in plan.problems] == [(1, "mode")] * len(plan.problems)
    said = {plan.problems[0].message if plan.problems else ""}
    spec = machine.detector
    for ask in (
        lambda: changed_camera(spec, spec.camera, {"mode": mode}),
        lambda: compose_script(ScanRequest(mode=mode), machine, profile_of(machine)),
        lambda: expose(
            "normal-5", machine=machine, mode=mode, roi=SMALL, images=1, kV=[80.0]
        ),
    ):
        try:
            ask()
            said.add("")
        except LimitError as error:
            said.add(error.message)
    return said


@pytest.mark.parametrize("seed", range(6))
def test_the_modes_that_a_file_lists_exist_and_no_others(seed: int) -> None:
    rng = np.random.default_rng(600 + seed)
    factors = [1, 2, 3, 4, 8]
    hardware, software = (
        sorted({1, *(int(x) for x in rng.choice(factors, 2))}) for _ in range(2)
    )
    gains = [["High"], ["Low"], ["High", "Low"]][seed % 3]
    machine = parse_machine(
        f'base = "flexray"\n[detector]\nhardware_binning = {hardware}\n'
        f'software_binning = {software}\ngains = {gains}\nmode = "HW1SW1{gains[0]}"\n'
    )
    known = {f"HW{a}SW{b}{g}" for a, b, g in product(hardware, software, gains)}
    assert set(machine.detector.mode_names) == known
    asked = [
        f"HW{a}SW{b}{g}" for a, b, g in product([1, 3, 13], [1, 2, 7], ["High", "Low"])
    ]
    for mode in asked:
        [said] = sentences(machine, mode)
        assert (said == "") == (mode in known), (mode, said)
        if said:
            assert said.startswith(f"camera mode '{mode}' does not exist; allowed: HW")
            assert set(re.findall(r"HW\d+SW\d+\w+", said.split("allowed")[1])) == known


def test_a_prefix_and_case_do_not_matter() -> None:
    spec = builtin_machine("unitom_xl").detector
    for mode in ("2_HW2SW1LOW", "HW2SW1Low", "1_hw1sw1high"):
        assert changed_camera(spec, spec.camera, {"mode": mode}).mode == mode
    with pytest.raises(LimitError, match="does not exist"):
        changed_camera(spec, spec.camera, {"mode": "HW13SW7Low"})


def test_files_without_the_lists_keep_their_modes() -> None:
    """The mode at start exists whatever the lists say; named modes may be the only ones."""
    old = parse_machine(
        'base = "flexray"\n[detector]\nmode = "HW3SW1High"\nroi = [0, 0, 899, 899]\n'
    )
    assert old.detector.camera.binning == 3
    assert old.detector.check_mode("HW3SW1High") == "HW3SW1High"
    cabinet = builtin_machine("xyzr_cabinet")
    assert cabinet.detector.mode_names == ("2x2", "1x1", "4x4")
    with pytest.raises(LimitError, match="allowed: 2x2, 1x1, 4x4"):
        cabinet.detector.check_mode("HW2SW1High")
    with pytest.raises(MachineFileError, match=r"detector\.gains"):
        parse_machine('base = "flexray"\n[detector]\ngains = ["Medium"]\n')


@pytest.mark.parametrize("seed", range(20))
def test_a_region_is_judged_on_the_line_that_sets_it(seed: int) -> None:
    """Against counts of whole binned pixels; the rest of the script goes on with the old
    one."""
    rng = np.random.default_rng(seed)
    machine = builtin_machine("flexray")
    a, b = int(rng.choice([1, 2, 4])), int(rng.choice([1, 2, 4]))
    left, top = int(rng.integers(0, 1900)), int(rng.integers(0, 1500))
    wide, high = (int(x) for x in rng.integers(1, 24, 2))
    roi = Roi(left, top, left + wide - 1, top + high - 1)
    lines = [
        f"camera set mode HW{a}SW{b}High ACK",
        f"camera set ROI {roi} ACK",
        "camera take image ACK",
        "camera save image di000000.tif ACK",
    ]
    plan = plan_script("\n".join(lines), machine, profile_of(machine))
    fits = wide >= a * b and high >= a * b and roi.right < 1944 and roi.bottom < 1536
    errors = [(p.line, p.code) for p in plan.errors]
    assert errors == ([] if fits else [(2, "roi")])
    assert (plan.groups[0].camera.roi == roi) == fits


def test_a_prediction_is_of_the_mode_and_region_asked_for() -> None:
    whole = fx.expose("normal-5", images=10, kV=[80.0])
    part = fx.expose(
        "normal-5", images=10, kV=[80.0], mode="HW4SW1High", roi=Roi(400, 400, 799, 599)
    )
    assert whole.bytes == 10 * 2 * 956 * 760
    assert part.bytes == 10 * 2 * 100 * 50
