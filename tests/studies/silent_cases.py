"""What FDK once got wrong without a word: in an older state of the code, now, and by itk-rtk.

    python tests/studies/silent_cases.py [COMMIT] [--views 360]

Gaps among the views, listed in any order; a pixel size that changes between views; a panel
moved aside until a column or two see the axis; objects wider than the panel; turns that are not
whole. The projections are chords that this file computes itself. A line has the worst mean
error of the regions that its object has and the worst root mean square, in per cent, and `w`
where the reconstruction warned; `refused` where it declined.
COMMIT's files are laid out in a temporary folder and run with this environment's libraries, as
`old_beside_new.py` does; RTK (`pip install itk-rtk`) has its filters for displaced panels and
short scans, and for objects wider than the panel its correction of truncation.
"""

from __future__ import annotations

import argparse
import math
import pickle
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
SOD, SDD, COLS, ROWS, PITCH = 300.0, 600.0, 160, 4, 0.8  # mm
HALF = COLS * PITCH / 2
FIELD = SOD * math.sin(math.atan2(HALF, SDD))
CELLS = 101


@dataclass(frozen=True)
class Column:
    """An ellipse or a rectangle of any turn, endless along z [mm, rad, 1/mm]."""

    at: tuple[float, float]
    half: tuple[float, float]
    mu: float
    turn: float = 0.0
    round: bool = True

    def _own(self, x: FloatArray, y: FloatArray, at: tuple[float, float]) -> Any:
        c, s = math.cos(self.turn), math.sin(self.turn)
        x, y = x - at[0], y - at[1]
        return (c * x + s * y) / self.half[0], (c * y - s * x) / self.half[1]

    def chord(self, start: FloatArray, way: FloatArray) -> FloatArray:
        """Lengths in it of rays from (2,) along `way` (..., 2), in units of `way`."""
        px, py = self._own(start[0], start[1], self.at)
        dx, dy = self._own(way[..., 0], way[..., 1], (0.0, 0.0))
        if self.round:
            a, b, c = dx**2 + dy**2, px * dx + py * dy, px**2 + py**2 - 1.0
            return np.asarray(2.0 * np.sqrt(np.maximum(b**2 - a * c, 0.0)) / a)
        with np.errstate(divide="ignore"):
            ends = [
                np.sort(np.stack([(-1 - p) / d, (1 - p) / d]), 0)
                for p, d in ((px, dx), (py, dy))
            ]
        return np.maximum(
            np.minimum(*(e[1] for e in ends)) - np.maximum(*(e[0] for e in ends)), 0.0
        )

    def holds(
        self, x: FloatArray, y: FloatArray, part: float = 1.0
    ) -> npt.NDArray[np.bool_]:
        u, v = self._own(x, y, self.at)
        far = np.hypot(u, v) if self.round else np.maximum(np.abs(u), np.abs(v))
        return np.asarray(far < part)


@dataclass(frozen=True)
class Case:
    """A scan, and where its volume is compared: within `radius` of the middle [mm]."""

    name: str
    columns: tuple[Column, ...]
    degrees: FloatArray
    aside: float = 0.0
    source_aside: float = 0.0
    pitch: FloatArray | float = 1.0
    radius: float = 0.8 * FIELD
    wide: bool = False

    def rows(self) -> FloatArray:
        """cone_vec (n, 12) [mm]: the stage turns clockwise under a camera that stands."""
        out = []
        for a, p in np.broadcast(
            np.radians(self.degrees), PITCH * np.asarray(self.pitch)
        ):
            c, s = math.cos(a), math.sin(a)
            turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            parts = (
                (self.source_aside, -SOD, 0.0), (self.aside, SDD - SOD, 0.0),
                (p, 0.0, 0.0), (0.0, 0.0, -p),
            )  # fmt: skip
            out.append(np.concatenate([turn @ part for part in parts]))
        return np.array(out)

    def images(self) -> npt.NDArray[np.float32]:
        """Line integrals (n, rows, cols)."""
        out = np.zeros((len(self.degrees), ROWS, COLS), np.float32)
        i, j = np.mgrid[:ROWS, :COLS]
        for k, row in enumerate(self.rows()):
            source, detector, u, v = row.reshape(4, 3)
            to = (
                detector
                + (j[..., None] - (COLS - 1) / 2) * u
                + (i[..., None] - (ROWS - 1) / 2) * v
            )
            way = to - source
            chords = (c.mu * c.chord(source[:2], way[..., :2]) for c in self.columns)
            out[k] = np.linalg.norm(way, axis=-1) * sum(chords)
        return out

    @property
    def voxel_mm(self) -> float:
        return 2.0 * self.radius / CELLS

    def errors(self, layer: FloatArray) -> tuple[float, float]:
        """The worst mean error of a region away from edges, and the worst root mean square."""
        at = (np.arange(CELLS) - (CELLS - 1) / 2) * self.voxel_mm
        x, y = np.meshgrid(at, at)
        inside, means, rms = np.hypot(x, y) < self.radius, [0.0], [0.0]
        for k, column in enumerate(self.columns):
            flat = column.holds(x, y, 0.85) & inside
            for other in self.columns[k + 1 :]:
                flat &= ~other.holds(x, y, 1.2)
            value = sum(
                c.mu for c in self.columns[: k + 1] if c.holds(*np.array(column.at))
            )
            if flat.sum() >= 4 and value > 0.0:
                off = layer[flat] / value - 1.0
                means.append(float(off.mean()))
                rms.append(float(np.sqrt(np.mean(off**2))))
        return max(means, key=abs), max(rms)


def cases(views: int) -> list[Case]:
    """What was found, in that order; the last ones were refused."""
    turn = np.arange(views) * 360.0 / views
    ball = (
        Column((0.0, 0.0), (0.7 * FIELD, 0.7 * FIELD), 0.02),
        Column((8.0, 6.0), (6.0, 6.0), 0.02),
    )
    out = []
    for gap in (36.7, 23.8, 120.0):
        left = turn[(turn < 150.0) | (turn >= 150.0 + gap)]
        out.append(Case(f"gap of {gap:g} deg in the list's middle", ball, left))
        behind = np.concatenate([left[left > 150.0], left[left < 150.0] + 360.0])
        out.append(Case(f"gap of {gap:g} deg, listed from behind it", ball, behind))
    zoom = np.where(np.arange(views) % 2, 1.1, 1.0)
    out.append(Case("pitch alternating by 1.1", ball, turn, pitch=zoom))
    out.append(
        Case("pitch growing to 1.3", ball, turn, pitch=np.linspace(1.0, 1.3, views))
    )
    small = (Column((0.0, 0.0), (0.9 * FIELD, 0.9 * FIELD), 0.02),)
    for part in (0.90, 0.96, 0.99):
        aside = part * HALF
        name = f"panel aside by {part:g} of its half width: the axis"
        out.append(Case(name, small, turn, aside=aside, radius=0.04 * FIELD))
    out.append(
        Case("source aside by 20 mm", small, turn, source_aside=20.0, radius=0.5 * FIELD)
    )
    thin = (
        Column((0.0, 0.0), (1.4 * FIELD, 1.4 * FIELD), 0.002),
        Column((4.0, 2.0), (8.0, 8.0), 0.298),
    )
    out.append(
        Case(
            "thin jacket wider than the panel", thin, turn, wide=True, radius=0.5 * FIELD
        )
    )
    heavy = (Column((0.0, 0.0), (1.3 * FIELD, 1.1 * FIELD), 0.02, 0.3),
             Column((9.0, -5.0), (8.0, 8.0), -0.012))  # fmt: skip
    out.append(
        Case("jacket with a lighter core", heavy, turn, wide=True, radius=0.5 * FIELD)
    )
    voids = (
        Column((10.0, 6.0), (6.0, 5.0), -0.02, 0.9),
        Column((-14.0, 2.0), (5.0, 7.0), -0.02),
    )
    box = (Column((0.0, 0.0), (1.3 * FIELD, 0.8 * FIELD), 0.02, 0.4, False), *voids)
    out.append(
        Case(
            "box with voids, wider than the panel",
            box,
            turn,
            wide=True,
            radius=0.5 * FIELD,
        )
    )
    clamp = (Column((0.0, 0.0), (0.6 * FIELD, 0.6 * FIELD), 0.02),
             Column((1.3 * FIELD, 0.0), (0.2 * FIELD, 0.1 * FIELD), 0.1, 0.2, False))  # fmt: skip
    out.append(
        Case("clamp beyond the panel's edge", clamp, turn, wide=True, radius=0.5 * FIELD)
    )
    for degrees in (422.0, 722.0, 1250.0):
        many = np.arange(round(views * degrees / 360.0)) * 360.0 / views
        out.append(Case(f"{degrees:g} degrees", ball, many))
    return out


def by_flexdt(asked: Path) -> None:
    """In the state of the code that Python finds: what each scan gives."""
    from flexdt.twin.geometry.cone_vec import ConeVec
    from flexdt.twin.projection import Grid
    from flexdt.twin.reconstruction import fdk

    found: list[tuple[FloatArray | None, str]] = []
    for rows, images, voxel_mm in pickle.loads(asked.read_bytes()):
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            try:
                grid = Grid((1, CELLS, CELLS), voxel_mm)
                made = fdk(images, ConeVec(rows), grid)
            except Exception as error:  # older states refuse in several ways
                found.append((None, str(error)))
                continue
        found.append((np.asarray(made.data[0], np.float64), "w" if said else ""))
    asked.with_suffix(".out").write_bytes(pickle.dumps(found))


def by_rtk(case: Case) -> FloatArray:
    """RTK's layer, or an error where its one pixel size does not fit."""
    import itk  # here, so that --help needs no peer
    from itk import RTK

    from flexdt_extensions.bench import rtk_peer

    if np.ptp(case.pitch):
        raise ValueError("one pixel size")
    rows, kind = case.rows(), itk.Image[itk.F, 3]
    stack, geometry = rtk_peer.rtk_stack(case.images(), rows), rtk_peer.rtk_geometry(rows)
    for made in (RTK.DisplacedDetectorImageFilter, RTK.ParkerShortScanImageFilter):
        weighted = made[kind].New()
        weighted.SetInput(stack)
        weighted.SetGeometry(geometry)
        weighted.InPlaceOff()
        weighted.Update()
        stack = weighted.GetOutput()
    blank = np.zeros((1, CELLS, CELLS), np.float32)
    filters = RTK.FDKConeBeamReconstructionFilter[kind].New()
    filters.SetInput(0, rtk_peer.rtk_volume(blank, (case.voxel_mm,) * 3, (0.0, 0.0, 0.0)))
    filters.SetInput(1, stack)
    filters.SetGeometry(geometry)
    if case.wide:
        filters.GetRampFilter().SetTruncationCorrection(0.5)
    filters.Update()
    return np.asarray(
        itk.array_from_image(filters.GetOutput())[::-1].transpose(1, 0, 2)[0], np.float64
    )


def told(case: Case, layer: FloatArray | None, word: str) -> str:
    """A case's errors in percent with a word for a warning; "refused" where there is no
    layer.
    """
    if layer is None:
        return "refused"
    mean, rms = case.errors(layer)
    return f"{100.0 * mean:+.2f} {100.0 * rms:6.2f} {word:1}"


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument(
        "commit", nargs="?", help="an older state, to stand beside today's"
    )
    parser.add_argument("--views", type=int, default=360)
    parser.add_argument("--asked", type=Path, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.asked is not None:
        by_flexdt(chosen.asked)
        return 0
    sys.path.insert(0, str(Path(__file__).parent))
    from old_beside_new import ROOT, SAFE, Code

    tried = cases(chosen.views)
    columns: dict[str, Sequence[str]] = {}
    with tempfile.TemporaryDirectory(prefix="flexdt-old-") as name:
        asked = Path(name) / "asked"
        asked.write_bytes(
            pickle.dumps([(c.rows(), c.images(), c.voxel_mm) for c in tried])
        )
        codes = (
            {chosen.commit[:7]: Code.of(chosen.commit, Path(name))}
            if chosen.commit
            else {}
        )
        for side, code in {**codes, "now": Code(ROOT, SAFE)}.items():
            subprocess.run(
                [sys.executable, __file__, "--asked", asked],
                env=code.environment,
                check=True,
            )
            found = pickle.loads(asked.with_suffix(".out").read_bytes())
            columns[side] = [told(c, *f) for c, f in zip(tried, found, strict=True)]
    theirs = []
    for case in tried:
        try:
            theirs.append(told(case, by_rtk(case), ""))
        except (ValueError, RuntimeError, ImportError) as error:
            theirs.append(
                "refused" if not isinstance(error, ImportError) else "not installed"
            )
    columns["itk-rtk"] = theirs
    print(f"{'':48}" + "".join(f"{side:>18}" for side in columns))
    for k, case in enumerate(tried):
        print(
            f"{case.name:48}" + "".join(f"{column[k]:>18}" for column in columns.values())
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
