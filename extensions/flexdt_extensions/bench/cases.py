"""The benchmark's cases as data: volumes, geometries, detectors.

C1, C2 and C3 are the cases that peers were measured with; the others are what nobody tuned for.
Volumes are filled with random numbers, so no empty space is there to be skipped (but for the ball).
This module computes geometry only; it measures nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, rotation_about, rotation_z
from flexdt.twin.projection import Volume

SOD, SDD = 600.0, 1059.0
C1_SHAPE, C2_SHAPE = (498, 240, 160), (512, 512, 512)
BINNED, FULL = (760, 956), (1944, 1536)
PITCH = {BINNED: 0.1496, FULL: 0.0748}
TILT_DEG = (0.4, 0.7, 0.3)
"""Rotation in the detector's plane, and two out of it [deg]."""
NONE = (0.0, 0.0, 0.0)
LYING = (90.0, 0.0, 0.0)
FAR = 100.0
START = 0.3
"""First angle [rad]: no axis of the volume is special."""


@dataclass(frozen=True)
class Case:
    """One measurement: a volume, views of it, and whether peers take part.

    Attributes:
        name: as in the document.
        volume: builds it.
        geometry: all its views.
        shape: detector (rows, cols).
        peers: run the peers too.
        what: one line for people.
    """

    name: str
    volume: Callable[[], Volume]
    geometry: ConeVec
    shape: tuple[int, int]
    peers: bool
    what: str


def circle(
    views: int,
    shape: tuple[int, int],
    *,
    sod: float = SOD,
    sdd: float = SDD,
    pitch: float | None = None,
    tilt_deg: tuple[float, float, float] = NONE,
    height: float = 0.0,
    above_deg: float = 0.0,
) -> ConeVec:
    """Views on a full circle (object frame), the detector tilted about its normal, u and v; source
    and detector turned together by `above_deg` about u, which brings the source above the object.
    """
    pixel = PITCH[shape] if pitch is None else pitch
    u, v, beam = np.array([1.0, 0, 0]), np.array([0, 0, -1.0]), np.array([0, 1.0, 0])
    for axis, angle in zip((beam, u, v), tilt_deg, strict=True):
        turn = rotation_about(axis, math.radians(angle))
        u, v = turn @ u, turn @ v
    raise_ = rotation_about(np.array([1.0, 0, 0]), -math.radians(above_deg))
    rows = []
    for i in range(views):
        r = rotation_z(START + 2 * math.pi * i / views) @ raise_
        source = np.array([0, -sod, height])
        centre = np.array([0, sdd - sod, -height * (sdd / sod - 1)])
        rows.append(np.concatenate([r @ source, r @ centre, pixel * (r @ u), pixel * (r @ v)]))
    return ConeVec(np.array(rows))


def noise(shape: tuple[int, int, int], voxel: float | tuple[float, float, float] = 0.1) -> Volume:
    """A volume of random numbers, the same every time."""
    values: Float32Array = np.random.default_rng(0).random(shape, dtype=np.float32)
    return Volume(values, voxel)


def ball(side: int) -> Volume:
    """A ball of a tenth of the volume's side in its middle, the rest empty."""
    values = np.zeros((side,) * 3, np.float32)
    n = side // 10
    x = np.arange(-n, n + 1)
    inside = (x[:, None, None] ** 2 + x[:, None] ** 2 + x**2) <= n * n
    at = slice(side // 2 - n, side // 2 + n + 1)
    values[at, at, at] = inside
    return Volume(values, 0.1)


def peer_cases() -> list[Case]:
    """The cases of the targets."""
    c1, c2 = partial(noise, C1_SHAPE), partial(noise, C2_SHAPE)
    above = [
        Case(f"above-{e}", c1, circle(8, BINNED, above_deg=e), BINNED, True,
             f"C1, 8 views from {e} degrees above")
        for e in (30, 45, 60, 75)
    ]  # fmt: skip
    row, small = (1, 956), (95, 120)
    single = Case("row", c1, circle(8, row, pitch=0.1496), row, True, "C1, 8 views, one row")
    tilted = circle(8, small, pitch=1.2, tilt_deg=TILT_DEG)
    cube = partial(noise, (64, 64, 64), 0.8)
    little = Case("small-tilt", cube, tilted, small, True, "64^3 voxels, 120 x 95 pixels, tilted")
    return [
        *(
            Case(name, volume, circle(views, shape, tilt_deg=tilt), shape, True, what)
            for name, volume, views, shape, tilt, what in (
                ("C1", c1, 1, BINNED, NONE, "160 x 240 x 498 voxels, 956 x 760 pixels"),
                ("C2", c2, 1, BINNED, NONE, "512^3 voxels, 956 x 760 pixels"),
                ("C3", c1, 1, FULL, NONE, "C1's volume, 1536 x 1944 pixels"),
                ("C1x36", c1, 36, BINNED, NONE, "C1, 36 views in one call"),
                ("C2x10", c2, 10, BINNED, NONE, "C2, 10 views in one call"),
                ("C1-tilt", c1, 1, BINNED, TILT_DEG, "C1, detector tilted"),
                ("C2-tilt", c2, 1, BINNED, TILT_DEG, "C2, detector tilted"),
                ("C3-tilt", c1, 1, FULL, TILT_DEG, "C3, detector tilted"),
            )
        ),
        *above,
        single,
        little,
    ]


def untuned_cases() -> list[Case]:
    """Cases nobody tuned for: exact, and without a cliff in speed."""
    s, cube, strong = BINNED, (256, 256, 256), (45.0, 45.0, 45.0)
    # 60 degrees across the detector's diagonal.
    wide = 2 * math.tan(math.radians(30)) * 80.0 / math.hypot(*s)
    cone: dict[str, Any] = {"sod": 40.0, "sdd": 80.0, "pitch": wide}
    aslant = (LYING[0] + TILT_DEG[0], *TILT_DEG[1:])
    near, small = {"sod": 19.2, "sdd": 60.0, "pitch": 0.08}, (95, 120)
    # Nearly parallel rays pass no z level: what is left is walking through the voxel columns.
    far = {"sod": FAR * SOD, "sdd": FAR * SDD}
    rows: list[tuple[str, tuple[int, int, int], dict[str, Any], str]] = [
        ("cone-60", cube, cone, "60 degree cone"),
        ("cone-60-tilt", cube, cone | {"tilt_deg": TILT_DEG}, "and tilt"),
        ("tilt-45", C1_SHAPE, {"tilt_deg": strong}, "three tilts of 45 degrees"),
        ("roll-90", C1_SHAPE, {"tilt_deg": LYING}, "C1, detector on its side"),
        ("roll-90-tilt", C1_SHAPE, {"tilt_deg": aslant}, "and tilted"),
        ("near", cube, near, "source 1 mm off the box"),
        ("flat", (4, 1024, 1024), {"height": 100.0}, "4 slices of 1024^2, from above"),
        ("long", (2000, 32, 32), {}, "a rod 2000 voxels long"),
        ("far", C1_SHAPE, far, "C1, 100 times as far"),
    ]
    c1, aniso = partial(noise, C1_SHAPE), partial(noise, C1_SHAPE, (0.1, 0.2, 0.05))
    many = circle(1000, small, pitch=1.2)
    return [
        Case("ball", partial(ball, 512), circle(1, s), s, False, "a ball in empty 512^3"),
        *(Case(name, partial(noise, shape), circle(1, s, **how), s, False, what)
          for name, shape, how, what in rows),
        Case("anisotropic", aniso, circle(1, s), s, False, "voxels 0.1 x 0.2 x 0.05 mm"),
        Case("on-axis", c1, on_axis(s), s, False, "rays along a voxel axis, tilted"),
        Case("C1x1000", c1, many, small, False, "1000 views of 120 x 95 pixels in one call"),
    ]  # fmt: skip


def all_cases() -> list[Case]:
    """Every case that is a projection of voxels."""
    return [*peer_cases(), *untuned_cases()]


def on_axis(shape: tuple[int, int]) -> ConeVec:
    """One tilted view whose central ray runs along y."""
    view = circle(1, shape, tilt_deg=TILT_DEG)
    back = rotation_z(-START)
    return view.moved(back, (0.0, 0.0, 0.0))
