"""Hypothesis strategies that draw machines and geometries.

    from hypothesis import given
    from flexdt.testing.strategies import geometries

    @given(geometries())
    def test_mine(scan): ...

Needs Hypothesis: `pip install 'flexdt[testing]'`.
"""

from __future__ import annotations

from flexdt.library.optional.extras import package
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.machine.description import (
    Machine,
    builtin_machine,
    builtin_machines,
    parse_machine,
)

package("hypothesis", "flexdt.testing.strategies", "testing")
from hypothesis import strategies as st  # noqa: E402

__all__ = ["geometries", "machines"]
# Read here, and not by the first example that is drawn, which Hypothesis would call slow.
MACHINES = {name: builtin_machine(name) for name in builtin_machines()}


@st.composite
def machines(draw: st.DrawFn) -> Machine:
    """Draw valid machines: each of the shipped ones, whose motors have names and
    directions of their own, with other travel, speeds and accelerations; name and zero
    offsets are the shipped one's.

    Travel on either side of home, speed and acceleration are each multiplied by a number
    drawn from 0.1 to 1.

    Example:
        >>> @given(machines())
        ... def test_home_is_within_travel(machine: Machine) -> None:
        ...     assert all(a.lower <= a.home <= a.upper for a in machine.axes.values())"""
    name = draw(st.sampled_from(list(MACHINES)))
    text = f'base = "{name}"\n'
    for motor, axis in MACHINES[name].axes.items():
        least, most, slow, soft = (draw(st.floats(0.1, 1.0)) for _ in range(4))
        text += (
            f"[axes.{motor}]\nlower = {axis.home - least * (axis.home - axis.lower)}\n"
            f"upper = {axis.home + most * (axis.upper - axis.home)}\n"
            f"speed = {slow * axis.speed}\nacceleration = {soft * axis.acceleration}\n"
        )
    return parse_machine(text, "drawn.toml")


@st.composite
def geometries(draw: st.DrawFn, *, max_views: int = 8, max_pixels: int = 64) -> ConeVec:
    """Draw cone-beam geometries with a detector: circles and helices at any angles, even
    or not, with the panel moved aside and tilted by up to 10 deg about each axis, and
    pixels that may be oblong.

    Lengths [mm]: 50 to 2000 from source to panel, the axis at 0.02 to 0.98 of it, pixels
    of 0.005 to 1, the panel aside by up to half its side, heights up to 50 and rises up
    to 50 a turn. Angles are -720 to 720 deg, at least one.

    Args:
        draw: of Hypothesis.
        max_views: at most so many views.
        max_pixels: at most so many rows, and columns, of the detector.

    Example:
        >>> @given(geometries(max_views=3))
        ... def test_files_keep_it(scan: ConeVec) -> None:
        ...     assert ConeVec.from_dict(scan.to_dict()) == scan
    """
    shape = draw(st.tuples(*2 * [st.integers(1, max_pixels)]))
    sdd = draw(st.floats(50.0, 2000.0))
    pixel = draw(st.tuples(*2 * [st.floats(0.005, 1.0)]))
    aside = [
        draw(st.floats(-n * p, n * p)) / 2
        for n, p in zip(shape[::-1], pixel, strict=True)
    ]
    return ConeVec.helical(
        sod=sdd * draw(st.floats(0.02, 0.98)),
        sdd=sdd,
        shape=shape,
        pixel=pixel,
        offset=aside,
        angles=draw(st.lists(st.floats(-720.0, 720.0), min_size=1, max_size=max_views)),
        rise=draw(st.just(0.0) | st.floats(-50.0, 50.0)),
        tilts=draw(st.tuples(*3 * [st.floats(-10.0, 10.0)])),
        height=draw(st.floats(-50.0, 50.0)),
    )
