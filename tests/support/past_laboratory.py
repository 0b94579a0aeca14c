"""A laboratory's past: folders of scans with a hidden machine behind them, written byte by
byte.

Kinematics, X-rays, texts and logs are this file's and `timed_rigs`'s own; of flexdt nothing
is used. Motors are the FleX-ray's; the script's tra_det is positive to the left. Contradictions
are planted, each with what a report has to name.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import tifffile
from timed_rigs import FAMILIES, Rig, Scan

PITCH, COLUMNS, ROWS = 0.0748, 1944, 1536
SHAPE = (100, 120)
FRAMES = 49
MODES = {"HW2SW1High": 2, "HW4SW1High": 4, "HW2SW2Low": 4, "HW4SW1Low": 4}
LINEAR = ("ver_tube", "ver_det", "tra_obj", "tra_det", "mag_det", "mag_obj")
NAMED = {
    "speed": "rates of ver_tube", "limits": "limits of tra_obj", "target": "mag_obj in",
    "sod": "c_obj of the texts", "pixel": "binned_pixel_mm in", "roi": "shape in",
    "mode": "camera in", "count": "projections in", "axis": "axs_tan",
}  # fmt: skip
"""What is planted -> how the contradiction's name begins."""


@dataclass
class Past:
    """One scan.

    Attributes:
        column: where the axis really crosses the image's middle row [px].
        years: since the last scan of the laboratory, negative.
    """

    name: str
    started: datetime
    years: float
    at: dict[str, float]
    mode: str
    roi: tuple[int, int, int, int]
    aside: float = 0.0
    column: float = math.nan
    binning: int = 4
    plants: list[str] = field(default_factory=list)


class Laboratory:
    """Hidden: limits, rates, sign, zero offsets, drift, times. `planted` is (about, folder)."""

    def __init__(self, seed: int, scans: int = 6, plants: int = 3) -> None:
        """Draw a laboratory with its past scans, and plant contradictions in some.

        Args:
            seed: the same gives the same laboratory.
            scans: how many, over three years at most, the last now.
            plants: contradictions, each in another scan, none in the last; fewer than
                `scans`.
        """
        rng = self.rng = random.Random(f"laboratory {seed}")
        self.family = rng.choice(FAMILIES)
        self.rig = Rig(rng, self.family)
        for axis in LINEAR:
            low, high = sorted((-rng.uniform(300, 400), rng.uniform(1060, 1500)))
            self.rig.limits[axis] = (low, high, *self.rig.limits[axis][2:])
            self.rig.at[axis] = 100.0
        low, high = -rng.uniform(5000, 9000), rng.uniform(5000, 9000)
        self.rig.limits["rot_obj"] = (low, high, 200.0, 300.0)
        self.rig.rates["rot_obj"] = [45.0, 22.5]
        self.sign = rng.choice((1, -1))
        self.c_obj, self.c_det = rng.uniform(12, 18), rng.uniform(36, 44)
        self.det_tan, self.src_ort = rng.uniform(20, 28), rng.uniform(-8, -4)
        self.axs_tan = rng.uniform(-1, 1)
        self.hidden_axs, self.hidden_det = rng.uniform(-0.4, 0.4), rng.gauss(0.0, 0.25)
        self.drift = rng.uniform(-0.4, 0.4)
        self.roll = math.radians(rng.gauss(0.0, 0.2))
        ages = sorted((rng.uniform(0.05, 3.0) for _ in range(scans - 1)), reverse=True)
        ends = datetime(2026, 6, 1, 9, 30, 12)
        self.scans = [self._scan(i, ends, age) for i, age in enumerate([*ages, 0.0])]
        self.planted: list[tuple[str, str]] = []
        if self.sign != -1:
            self.planted.append(("sign of tra_det", "machine flexray"))
        early = self.scans[:-1]
        drawn = rng.sample(list(NAMED), plants)
        for plant, scan in zip(drawn, rng.sample(early, plants), strict=True):
            self._plant(scan, plant)
        self.bodies = self._bodies()

    def _scan(self, i: int, ends: datetime, age: float) -> Past:
        """Draw a scan: mode, region of the panel and positions.

        Args:
            i: its number, for its name.
            ends: when the last scan was.
            age: how many years before that it began.
        """
        rng = self.rng
        mode = rng.choice(list(MODES))
        binning = MODES[mode]
        half = (SHAPE[1] * binning // 2, SHAPE[0] * binning // 2)
        middle = (972 + rng.randrange(-100, 100), 768 + rng.randrange(-60, 60))
        roi = (middle[0] - half[0], middle[1] - half[1],
               middle[0] + half[0] - 1, middle[1] + half[1] - 1)  # fmt: skip
        sod = rng.choice((350.0, 500.0, 700.0)) + round(rng.uniform(-20, 20), 3)
        aside = (middle[0] - COLUMNS / 2) * PITCH
        up = (middle[1] - ROWS / 2) * PITCH
        height = round(rng.uniform(25, 60), 3)
        at = {
            "ver_tube": height,
            "ver_det": round(height + self.src_ort + up + rng.uniform(-0.5, 0.5), 3),
            "tra_obj": round(rng.uniform(-1, 1), 3),
            # The panel's region stands about behind the source.
            "tra_det": round(self.det_tan + aside + rng.uniform(-0.3, 0.3), 3),
            "mag_det": round(1018.0 + rng.uniform(-5, 5), 3),
            "mag_obj": round(sod - self.c_obj, 3),
            "rot_obj": 0.0,
        }
        started = (ends - timedelta(days=365.25 * age)).replace(microsecond=0)
        years = (started - ends).total_seconds() / (365.25 * 86400)
        return Past(f"scan-{i}", started, years, at, mode, roi, binning=binning)

    def _bodies(self) -> np.ndarray:
        """Draw the ellipsoids of the sample (8, 7): centre, half axes and density; the
        first holds the others.
        """
        rng = np.random.default_rng(self.rng.randrange(1 << 30))
        inside = np.column_stack(
            [rng.uniform(-0.55, 0.55, (7, 2)), rng.uniform(-0.7, 0.7, 7),
             rng.uniform(0.1, 0.3, (7, 3)), rng.choice([-0.4, 0.6], 7)]
        )  # fmt: skip
        return np.vstack([[[0.05, -0.1, 0, 0.9, 0.8, 1.05, 0.4]], inside])

    # What is, in world coordinates seen from the source: x right, y along the beam, z up [mm].

    def _where(self, p: Past, *, true: bool) -> tuple[float, float, float, float, float]:
        """x of the axis, SOD, SDD, x and z of the image's centre on the panel, from the
        source [mm].

        Args:
            p: the scan.
            true: as it is, with drift, hidden offsets and roll; false: as the laboratory
                believes.
        """
        left, top, right, bottom = p.roi
        aside = ((left + right) / 2 - (COLUMNS - 1) / 2) * PITCH
        up = -((top + bottom) / 2 - (ROWS - 1) / 2) * PITCH
        axis, panel = p.at["tra_obj"] + self.axs_tan, -p.at["tra_det"] + self.det_tan
        if true:
            axis += self.hidden_axs + self.drift * p.years + p.aside
            panel += self.hidden_det
        z = p.at["ver_det"] - p.at["ver_tube"] - self.src_ort
        sod, sdd = p.at["mag_obj"] + self.c_obj, p.at["mag_det"] + self.c_det
        if not true:
            return axis, sod, sdd, panel + aside, z + up
        c, s = math.cos(self.roll), math.sin(self.roll)
        # The panel turns about its middle, and the region with it.
        return axis, sod, sdd, panel + aside * c + up * s, z - aside * s + up * c

    def _rays(self, p: Past) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Centre of the image and steps of a column and a row, from the source [mm], as
        they truly are.
        """
        _, _, sdd, x, z = self._where(p, true=True)
        c, s = math.cos(self.roll), math.sin(self.roll)
        pixel = PITCH * p.binning
        return (
            np.array([x, sdd, z]),
            pixel * np.array([c, 0, -s]),
            pixel * np.array([-s, 0, -c]),
        )

    def true_column(self, p: Past) -> float:
        """The column at which the axis of rotation crosses the image's middle row."""
        axis, sod, *_ = self._where(p, true=True)
        centre, u, v = self._rays(p)
        seen = []
        for z in (-1.0, 1.0):
            ray = np.array([axis, sod, z])
            seen.append(np.linalg.solve(np.array([u, v, -ray]).T, -centre)[:2])
        (c0, r0), (c1, r1) = seen
        return float(c0 - r0 * (c1 - c0) / (r1 - r0) + (SHAPE[1] - 1) / 2)

    def images(self, p: Past) -> np.ndarray:
        """Line integrals of a scan (frames, rows, columns), of a whole turn."""
        axis, sod, sdd, *_ = self._where(p, true=True)
        centre, u, v = self._rays(p)
        size = 0.36 * SHAPE[1] * PITCH * p.binning * sod / sdd
        c, r = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in SHAPE[::-1]))
        rays = centre + c[..., None] * u + r[..., None] * v
        rays /= np.linalg.norm(rays, axis=-1)[..., None]
        high = centre[2] * sod / sdd
        out = np.zeros((FRAMES, *SHAPE))
        for k in range(FRAMES):
            a = 2 * math.pi * k / (FRAMES - 1)
            turn = np.array([[math.cos(a), math.sin(a)], [-math.sin(a), math.cos(a)]])
            for x, y, z, *half, density in self.bodies:
                at = np.array(
                    [*(turn @ [x, y] * size + [axis, sod]), z * size * 0.8 + high]
                )
                q = np.zeros((3, 3))
                q[:2, :2] = turn @ np.diag([1 / half[0] ** 2, 1 / half[1] ** 2]) @ turn.T
                q[2, 2] = 1 / (0.8 * half[2]) ** 2
                q /= size**2
                dq = rays @ q
                dd, ds = np.einsum("rci,rci->rc", dq, rays), dq @ at
                root = np.maximum(ds**2 - dd * (at @ q @ at - 1), 0.0)
                out[k] += density / size * 2 * np.sqrt(root) / dd
        return out

    def write(self, root: Path) -> list[Path]:
        """Write all scans to folders below `root`, and return the folders, the oldest
        first.

        Each holds settings, log, a dark frame, a flat field and projections with noise,
        as TIFF. A folder that exists raises FileExistsError.
        """
        rng = np.random.default_rng(self.rng.randrange(1 << 30))
        folders = []
        for p in self.scans:
            p.column = self.true_column(p)
            folder = root / p.name
            folder.mkdir(parents=True)
            (folder / "scan settings.txt").write_bytes(self._text(p).encode())
            (folder / "script_executed.txt").write_bytes(self._log(p))
            light, dark = 8000.0, 100.0
            flat = rng.poisson(light, (20, *SHAPE)).mean(axis=0) + dark
            lines = self.images(p)
            counts = rng.poisson(light * np.exp(-lines)) + dark
            rows = SHAPE[0] - 2 * ("roi" in p.plants)
            files = {"di000000": np.full(SHAPE, dark), "io000000": flat}
            files |= {
                f"scan_{k:06d}": counts[k] for k in range(FRAMES - ("count" in p.plants))
            }
            for name, image in files.items():
                tifffile.imwrite(folder / f"{name}.tif", image[:rows].astype(np.uint16))
            folders.append(folder)
        return folders

    def _log(self, p: Past) -> bytes:
        """The executed script of a scan as the scanner writes it, with what is planted in
        it.
        """
        scan = Scan(self.rig)
        if "limits" in p.plants:
            low, high, *rates = self.rig.limits["tra_obj"]
            self.rig.limits["tra_obj"] = (low, high - 25.0, *rates)  # type: ignore[assignment]
        scan.exposure = 0.1
        scan.put(f"camera|set mode|{p.mode}", "camera")
        scan.put("camera|set ROI|{} {} {} {}".format(*p.roi), "camera")
        scan.put("camera|set exposure|100", "camera")
        for axis in LINEAR:
            target = p.at[axis] + 5.0 * (axis == "mag_obj" and "target" in p.plants)
            scan.move(axis, target)
            scan.move(axis, target)
        scan.put("tube|xrayon", "xrayon")
        scan.put("tube|REPEAT UNTIL TRUE status_XReady_get", "ready")
        scan.put("scanner|write settings file", "write")
        scan.move("rot_obj", -1.0)
        scan.camera(1, FRAMES)
        scan.put("camera|take and save image sequence|scan_|0", "image", 0.1 * FRAMES)
        scan.put("tube|xrayoff", "xrayoff")
        if "limits" in p.plants:
            self.rig.limits["tra_obj"] = (low, high, *rates)  # type: ignore[assignment]
        return scan.log

    def _text(self, p: Past) -> str:
        """The text of `scan settings.txt`, with the offsets that the laboratory believes
        in.
        """
        axis, sod, sdd, x, z = self._where(p, true=False)
        sod += 1.0 * ("sod" in p.plants)
        pixel = PITCH * p.binning
        rows, cols = SHAPE
        hc, vc = cols / 2 - x / pixel, rows / 2 + z / pixel
        told = pixel * (2.0 if "pixel" in p.plants else 1.0)
        d = p.started
        out = [
            f"ScanID : {p.name}", "START",
            f"date: {d.month}/{d.day}/{d.year}; time: {d.hour % 12 or 12}:{d.minute:02d}:"
            f"{d.second:02d} {'AM' if d.hour < 12 else 'PM'}", "",
            f"COR : {hc + axis * sdd / sod / pixel:.6f}", f"VC : {vc:.6f}", f"HC : {hc:.6f}",
            f"SDD : {sdd:.6f}", f"SOD : {sod:.6f}",
            f"Voxel size : {1000 * told * sod / sdd:.6f}", f"Magnification : {sdd / sod:.6f}",
            "Scanner name : FleX-ray", "Scanner type : FleX-rayScanner S/N : 042_0001",
            "Tube voltage : 80.000000", "Exposure time (ms) : 100.000000",
            f"Original pixel size : {PITCH:.6f}", f"Imaging mode : {p.mode}",
            f"Binning value : {p.binning}", f"Binned pixel size : {told:.6f}",
            "ROI (LTRB) : {},{},{},{}".format(*p.roi), "",
        ]  # fmt: skip
        for name, value in p.at.items():
            speed, acceleration = self.rig.rates[name]
            speed *= 0.5 if name == "ver_tube" and "speed" in p.plants else 1.0
            sign = self.sign if name == "tra_det" else 1
            out.append(
                f"{name} : {sign * value:.6f} ; speed : {speed:.6f} ; "
                f"acceleration : {acceleration:.6f}"
            )
        out += ["tra_tube : 0.000000 ; speed : 50.000000 ; acceleration : 50.000000", "",
                "scan type:", "smooth scan", f"# projections: {FRAMES}", "Start angle : 0.000000",
                "Last angle : 360.000000"]  # fmt: skip
        return "\r\n".join(out) + "\r\n"

    def _plant(self, p: Past, plant: str) -> None:
        """Put a contradiction into a scan, and note it in `planted`.

        The texts and the log look at the scan's `plants` themselves; "axis" and "mode"
        change the scan.
        """
        p.plants.append(plant)
        self.planted.append((NAMED[plant], p.name))
        if plant == "axis":
            p.aside = 0.4
        if plant == "mode":  # one that does not ship; the region grows with its binning
            old, p.binning, p.mode = p.binning, 3, "HW3SW1High"
            left, top, right, bottom = p.roi
            x, y = (left + right + 1) // 2, (top + bottom + 1) // 2
            wide, high = ((right - left + 1) * 3 // old, (bottom - top + 1) * 3 // old)
            p.roi = (x - wide // 2, y - high // 2, x + wide // 2 - 1, y + high // 2 - 1)
