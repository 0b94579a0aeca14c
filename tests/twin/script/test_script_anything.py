"""Whatever comes in: reading raises nothing but ScriptError, and every plan keeps its
promises."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.script import (
    ScriptError,
    check_script,
    html_report,
    parse_script,
    read_script,
)
from flexdt.twin.script.grammar import FIXED, encode, vocabulary
from flexdt.twin.script.parse import decode

FLEXRAY = builtin_machine("flexray")
PROFILE = builtin_profile(FLEXRAY.default_profile)

COMMANDS = [f"{n} {v}" for n, table in FIXED.items() for v in table] + [
    f"{axis} {verb}"
    for axis in [*FLEXRAY.axes, "ver_obj", "rot_x", "gadget"]
    for verb in vocabulary("rot_obj")
]
number = st.one_of(
    st.floats(-1e3, 1e3).map(lambda x: f"{x:.6f}"),
    st.sampled_from(
        ["0", "1", "-0.0", "1e9", "-1e9", "1e-9", "1e300", "nan", "x", "0.000001"]
    ),
)
argument = st.one_of(
    number,
    st.tuples(number, number).map(" ".join),
    st.sampled_from(["", "32 8 1943 1527", "0 0 0 0", "HW1SW1High", "HW9SW9Low", "TRUE", "scan_",
                     "E:\\a b\\di0.tif", "\\", "io0.tif", "é\x00ÿ"]),
)  # fmt: skip
wait = st.sampled_from(["ACK", "no wait", "POS", "RCV", "", "NEVER"])
line = st.one_of(
    st.tuples(st.sampled_from(COMMANDS), argument, wait).map("  ".join),
    st.tuples(st.sampled_from(COMMANDS), argument, argument, wait).map(
        lambda t: "\t".join([*t[0].split(" ", 1), *t[1:]])
    ),
    st.text(max_size=30),
)
script_like = st.lists(line, max_size=25).flatmap(
    lambda rows: st.sampled_from(["\n", "\r\n", "\r"]).map(lambda end: end.join(rows))
)


anything = st.one_of(
    st.text(),
    st.binary(),
    script_like,
    script_like.map(lambda s: s.encode("utf-8", "replace")),
)


@settings(max_examples=300, deadline=None)
@given(anything)
@pytest.mark.slow
def test_reading_anything_raises_nothing_but_script_error(data: str | bytes) -> None:
    script, problems = read_script(data)
    assert [p.line for p in problems] == sorted(p.line for p in problems)
    if any(p.severity == "error" for p in problems):
        with pytest.raises(ScriptError) as caught:
            parse_script(data)
        assert caught.value.problems == problems
        json.dumps(caught.value.data)
    else:
        assert parse_script(data) == script


@settings(max_examples=300, deadline=None)
@given(st.binary())
def test_decoding_keeps_every_byte(data: bytes) -> None:
    if not data.startswith(b"\xef\xbb\xbf"):
        assert encode(decode(data)) == data


@settings(max_examples=150, deadline=None)
@given(script_like)
def test_any_script_plans_and_every_plan_keeps_its_promises(text: str) -> None:
    report = check_script(text, FLEXRAY, PROFILE)
    plan = report.plan
    end = plan.duration_s
    assert np.isfinite(end)
    starts = [s.start_s for s in plan.steps]
    assert starts == sorted(starts)
    assert all(s.duration_s >= 0 and s.holds_s >= 0 for s in plan.steps)
    assert all(0 <= s.assumed_s <= s.holds_s for s in plan.steps)
    assert end >= sum(s.holds_s for s in plan.steps) * (1 - 1e-12)
    times = np.linspace(-1.0, end + 1.0, 400)
    for axis, x in plan.positions(times).items():
        limits = FLEXRAY.axes[axis]
        assert x.min() >= limits.lower - 1e-6
        assert x.max() <= limits.upper + 1e-6
        step = times[1] - times[0]
        assert np.abs(np.diff(x)).max() <= limits.max_speed * step * (1 + 1e-9) + 1e-6
    assert all(0.0 <= b.start_s < b.end_s <= end for b in plan.beam)
    assert len(plan.starts) == sum(len(g) for g in plan.groups)
    if len(plan.starts) < 5000:
        assert [e.index for e in plan.exposures] == list(range(len(plan.starts)))
        assert plan.bytes == sum(
            2 * e.camera.shape[0] * e.camera.shape[1] for e in plan.exposures if e.file
        )
    json.dumps(report.to_dict(), allow_nan=False)
    html_report(report)
