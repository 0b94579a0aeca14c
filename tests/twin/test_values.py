"""Plans and geometries are values: equal by content, printed in one line, through JSON and
back."""

from __future__ import annotations

import json
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from flexdt.twin.dataset.flexdt_json import DatasetDocument, ScanRecord, parse_document
from flexdt.twin.errors import GeometryError, TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.machine.kinematics import poses
from flexdt.twin.motion.profiles import AxisPath
from flexdt.twin.script import SampleSize, ScanPlan, StartState, parse_script, plan_script

finite = st.floats(-1e6, 1e6)
cone_vecs = st.integers(1, 5).flatmap(
    lambda n: arrays(np.float64, (n, 12), elements=finite).map(ConeVec)
)

SCRIPT = b"\n".join(
    [
        b"scanner set sample info \x00\xff\xfe\x80binary ACK",
        b"scanner set output path E:\\data\\scan ACK",
        b"scanner keep xrayon TRUE ACK",
        b"tube set kV 90 ACK",
        b"tube set power 50 ACK",
        b"camera set mode HW2SW1High ACK",
        b"camera set exposure 100 ACK",
        b"camera set ROI 32 8 1943 1527 ACK",
        b"camera set number of frames 1 ACK",
        b"camera set number of averages 1 ACK",
        b"camera take image ACK",
        b"camera save image E:\\data\\di000000.tif ACK",
        b"tube xrayon ACK",
        b"tube REPEAT UNTIL TRUE status_XReady_get ACK",
        b"scanner write settings file ACK",
        b"mag_obj set speed 20 ACK",
        b"mag_obj move absolute 660 ACK",
        b"rot_obj move absolute 90 no wait",
        b"camera take and save image sequence E:\\data\\scan_ 0 ACK",
        b"scanner pause 100 ACK",
        b"tra_obj move absolute 9000 ACK",
        b"tube xrayoff ACK",
    ]
)


@pytest.fixture(scope="module")
def plan() -> ScanPlan:
    return plan_script(SCRIPT)


def test_a_plan_equals_the_plan_of_the_same_script_and_no_other(plan: ScanPlan) -> None:
    assert plan == plan_script(SCRIPT)
    assert plan_script(parse_script(SCRIPT)) == plan
    assert plan != plan_script(SCRIPT.replace(b"kV 90", b"kV 80"))
    assert plan != plan_script(SCRIPT, sample=SampleSize(5.0))
    assert plan != plan_script(SCRIPT, profile=builtin_profile("thesis"))
    assert plan != SCRIPT
    with pytest.raises(TypeError, match="unhashable"):
        hash(plan)


def test_a_plan_goes_to_json_and_back(plan: ScanPlan) -> None:
    document = plan.to_dict()
    back = ScanPlan.from_dict(json.loads(json.dumps(document, allow_nan=False)))
    assert back == plan
    assert back.to_dict() == document
    assert [type(s.command) for s in back.steps] == [type(s.command) for s in plan.steps]
    assert back.exposures == plan.exposures
    assert back.paths == plan.paths
    assert back.starts.dtype == np.float64


@settings(max_examples=25, deadline=None)
@given(
    st.floats(0.0, 400.0),
    st.integers(1, 5),
    st.integers(1, 5),
    st.binary(min_size=1, max_size=20),
)
def test_any_plan_goes_to_json_and_back(
    target: float, frames: int, averages: int, info: bytes
) -> None:
    text = "\n".join(
        [
            f"camera set number of frames {frames} ACK",
            f"camera set number of averages {averages} ACK",
            f"ver_tube move absolute {target!r} no wait",
            "camera take and save image sequence E:\\scan_ 3 ACK",
            "somebody else did this ACK",
        ]
    )
    made = plan_script(text)
    again = ScanPlan.from_dict(json.loads(json.dumps(made.to_dict())))
    assert again == made == plan_script(text)


def test_a_plan_s_document_of_another_form_is_an_error(plan: ScanPlan) -> None:
    document = plan.to_dict()
    with pytest.raises(ValueError, match="duration_s"):
        ScanPlan.from_dict({**document, "duration_s": "long"})
    for wrong in ({"command": "Explode"}, {"command": "Command"}, {"command": []}, {},
                  {"command": "MotorCommand", "motor": "Z"}, None, 5, "Pause", []):  # fmt: skip
        step = {**document["steps"][0], "command": wrong}
        with pytest.raises(TwinError, match="command"):
            ScanPlan.from_dict({**document, "steps": [step]})
    with pytest.raises(ValueError, match="machine"):
        ScanPlan.from_dict({k: v for k, v in document.items() if k != "machine"})


def test_one_differing_number_anywhere_makes_a_plan_another(plan: ScanPlan) -> None:
    def changes(node: object, path: tuple[object, ...] = ()) -> list[tuple[object, ...]]:
        if isinstance(node, dict):
            return [p for k, v in node.items() for p in changes(v, (*path, k))]
        if isinstance(node, list):
            return [p for i, v in enumerate(node[:2]) for p in changes(v, (*path, i))]
        return [path] if type(node) is float else []

    whole = plan.to_dict()
    paths = [p for p in changes(whole) if p[0] not in ("machine", "profile")]
    assert len(paths) > 50
    for path in paths:
        document = json.loads(json.dumps(whole))
        node = document
        for key in path[:-1]:
            node = node[key]
        node[path[-1]] += 0.5
        assert ScanPlan.from_dict(document) != plan, path


@settings(deadline=None)
@given(cone_vecs)
def test_a_geometry_goes_to_json_and_back(cone: ConeVec) -> None:
    back = ConeVec.from_dict(json.loads(json.dumps(cone.to_dict())))
    assert back == cone
    assert hash(back) == hash(cone)
    shifted = cone.rows.copy()
    shifted[-1, 4] += 1.0
    assert ConeVec(shifted) != cone


def test_a_geometry_s_document_is_checked() -> None:
    with pytest.raises(GeometryError, match="allowed: n x 12"):
        ConeVec.from_dict({"rows": [[1.0, 2.0]]})


def record(plan: ScanPlan) -> ScanRecord:
    return ScanRecord.from_plan(
        plan, name="bird", started=datetime(2026, 5, 4, 3, 2, tzinfo=UTC)
    )


def test_records_are_values_and_their_documents_go_to_json_and_back(
    plan: ScanPlan,
) -> None:
    assert record(plan) == record(plan_script(SCRIPT))
    assert record(plan) != record(
        plan_script(SCRIPT.replace(b"exposure 100", b"exposure 50"))
    )
    document = DatasetDocument.of(record(plan))
    assert parse_document(document.to_json()) == document


def test_values_print_in_one_short_line(plan: ScanPlan) -> None:
    machine = builtin_machine()
    many = poses(
        machine,
        builtin_profile("thesis"),
        machine.detector.camera,
        {"rot_obj": np.arange(360.0), "mag_obj": np.linspace(500.0, 600.0, 360)},
    )
    made = record(plan)
    printed = {
        repr(many.cone_vec()): "<ConeVec: 360 views, pixels of 0.1496 mm, "
        "source to detector 1059 mm>",
        repr(many): "<Poses: 360 views, 0 to 359 deg>",
        repr(plan): f"<ScanPlan on flexray: {len(plan.steps)} steps, 1 projections, "
        f"{plan.duration_s:.1f} s, {len(plan.errors)} errors, {len(plan.warnings)} warnings>",
        repr(
            made
        ): "<ScanRecord 'bird' on flexray: 2 images, 2026-05-04 03:02, incomplete>",
        repr(made.blocks[0]): "<FrameBlock: 1 dark images, di000000.tif to di000000.tif>",
    }
    for found, expected in printed.items():
        assert found == expected
    assert repr(many.cone_vec()[np.array([0, 1, 2])]).startswith("<ConeVec: 3 views")
    one = many[:1]
    spelt = eval(repr(one), {"Poses": Poses})
    assert spelt == one


def test_paths_compare_by_content() -> None:
    start = StartState.of(builtin_machine())
    assert start == StartState.of(builtin_machine())
    assert AxisPath.of(1.0, ()) == AxisPath.of(1.0, ())
    assert AxisPath.of(1.0, ()) != AxisPath.of(2.0, ())
