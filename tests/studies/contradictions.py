"""Drawn contradictions at the library's doors: refused, said with the right cause, or right?

    python tests/studies/contradictions.py --count 1000 --right 1000 --seed 1

Each case begins with a right scan: distances, panel, angles and a ball are drawn, and its line
integrals are chords that this file computes. One thing is then made to contradict another, by
an amount that is drawn, and a door of the library is asked: `project`, FDK, iterative methods,
`from_arrays`, `fx.open`, `read_tiffs`, readers of geometry. A case counts where there is a
refusal or a warning that names the cause, or where the result is right. Right scans go through
the same doors, and nothing may be said of them. Prints a line a kind, and exits with 1 where
fewer than 98 % of the contradictions count, or more than 1 % of the right scans are told
something.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import tifffile

import flexdt as fx
from flexdt.library.datasets.image_doubts import image_doubts
from flexdt.twin.projection import Grid
from flexdt.twin.reconstruction import cgls, fdk, sirt, tv

Array = npt.NDArray[Any]
ALLOWED = (
    "no dark image",
    "layers of the grid lie outside",
    "are cut in counts",
    "starved",
    "Poisson",
)
"""Parts of warnings that are true of right scans."""


@dataclass(frozen=True)
class Scan:
    """A right scan of a ball.

    Attributes:
        sod, sdd, pixel: [mm].
        shape: of the panel.
        angles: of the stage [deg].
        radius: of the ball [mm].
        centre: of it [mm].
        mu: attenuation [1/mm].
    """

    sod: float
    sdd: float
    pixel: float
    shape: tuple[int, int]
    angles: Array
    radius: float
    centre: Array
    mu: float

    def geometry(self, **other: Any) -> fx.ConeVec:
        """Its views, with other numbers where some are given."""
        given = {"sod": self.sod, "sdd": self.sdd, "pixel": self.pixel, "angles": self.angles,
                 "shape": self.shape}  # fmt: skip
        return fx.ConeVec.circular(**{**given, **other})

    @property
    def view_mm(self) -> float:
        """The field of view's radius."""
        return 0.5 * self.shape[1] * self.pixel * self.sod / self.sdd

    @property
    def grid(self) -> Grid:
        """A coarse one about the ball."""
        return Grid((9, 9, 9), self.radius / 4, tuple(self.centre))

    def integrals(self) -> Array:
        """Line integrals in closed form, (n, rows, cols)."""
        return self.mu * chords(self.geometry(), self.centre, self.radius)

    def volume(self, scale: float = 1.0, base: float = 0.0) -> fx.Volume:
        """The ball in voxels."""
        z, y, x = np.meshgrid(*[np.linspace(-1.2, 1.2, 15)] * 3, indexing="ij")
        ball = (x**2 + y**2 + z**2 < 1.0) * scale + base
        size = 2.4 * self.radius / 14
        return fx.Volume(ball.astype(np.float32), size, tuple(self.centre))

    def solid(self) -> dict[str, object]:
        """The ball as a solid of plastic."""
        return {"kind": "sphere", "center": self.centre.tolist(), "radius": self.radius,
                "material": "pmma"}  # fmt: skip


def chords(scan: fx.ConeVec, centre: Array, radius: float) -> Array:
    """Lengths of whole lines in a ball, (n, rows, cols) [mm]."""
    towards = scan.pixel_centers() - scan.source[:, None, None]
    towards /= np.linalg.norm(towards, axis=3, keepdims=True)
    seen = (centre - scan.source)[:, None, None]
    along = (seen * towards).sum(axis=3)
    return 2.0 * np.sqrt(np.maximum(radius**2 - ((seen**2).sum(axis=3) - along**2), 0.0))


def drawn(rng: np.random.Generator) -> Scan:
    """A scan that somebody could make."""
    sod = float(np.exp(rng.uniform(np.log(30.0), np.log(600.0))))
    sdd = sod * float(rng.uniform(1.2, 6.0))
    shape = int(rng.integers(20, 34)), int(rng.integers(28, 50))
    half_deg = rng.uniform(2.0, 9.0)
    pixel = 2 * sdd * np.tan(np.radians(half_deg)) / shape[1]
    views = int(rng.integers(36, 80))
    angles = {
        0: np.arange(views) * 360.0 / views,
        1: np.linspace(0.0, 360.0, views),
        2: rng.uniform(-180, 180) + np.arange(views) * 360.0 / views,
        3: np.arange(views) * -360.0 / views,
        4: np.arange(views) * 137.50776,
        5: np.linspace(0, rng.uniform(225, 300), views),
        6: np.arange(2 * views) * 360.0 / views,
    }[int(rng.choice(7, p=[0.3, 0.15, 0.15, 0.1, 0.1, 0.1, 0.1]))]
    view = 0.5 * shape[1] * pixel * sod / sdd
    radius = view * float(rng.uniform(0.3, 0.55))
    centre = rng.uniform(-0.12, 0.12, 3) * view
    mu = float(np.exp(rng.uniform(np.log(0.2), np.log(2.5)))) / (2 * radius)
    return Scan(sod, sdd, float(pixel), shape, angles, radius, centre, mu)


@dataclass
class Told:
    """What a door said: warnings, a refusal, and what it gave."""

    words: list[str] = field(default_factory=list)
    refused: bool = False
    crashed: str = ""
    value: Any = None

    def names(self, *causes: str) -> bool:
        """Whether one of the causes is in what was said."""
        return any(
            cause.lower() in word.lower() for word in self.words for cause in causes
        )


def ask(door: Callable[[], Any]) -> Told:
    """Go through a door; warnings of a data set count as said."""
    told = Told()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            told.value = door()
        except fx.TwinError as error:
            told.words.append(str(error))
            told.refused = True
        except Exception as error:
            told.crashed = f"{type(error).__name__}: {error}"
    told.words += [str(one.message) for one in caught]
    if isinstance(told.value, fx.DataSet):
        told.words += told.value.warnings
        told.words += [told.value.reason] if told.value.reason else []
    return told


def method(rng: np.random.Generator, images: Array, scan: fx.ConeVec, grid: Grid) -> Told:
    """FDK or an iterative method."""
    which = (fdk, sirt, cgls, tv)[int(rng.integers(4))]
    more: dict[str, Any] = {"errors": False} if which is fdk else {"iterations": 2}
    return ask(lambda: which(images, scan, grid, **more))


def exposed(
    rng: np.random.Generator, scan: Scan, flats: Any = (1.0,), beam: Any = 1.0
) -> Callable[[], fx.DataSet]:
    """A data set of counts with noise."""
    opened = float(rng.uniform(5_000, 40_000))
    level = np.broadcast_to(beam, len(scan.angles))[:, None, None]
    counts = rng.poisson(100 + opened * level * np.exp(-scan.integrals()))
    flat = rng.poisson(
        100 + opened * np.asarray(flats)[:, None, None] * np.ones(scan.shape)
    )
    dark = np.full(scan.shape, 100)
    return lambda: fx.DataSet.from_arrays(np.minimum(counts, 65535), scan.geometry(), dark=dark,
                                          flat=flat)  # fmt: skip


def looked(door: Callable[[], fx.DataSet]) -> Callable[[], fx.DataSet]:
    """The same data set, of whose images is warned as before a reconstruction."""

    def look() -> fx.DataSet:
        """Make the data set, and warn of each doubt in its images."""
        made = door()
        for doubt in image_doubts(made):
            warnings.warn(doubt, stacklevel=2)
        return made

    return look


def written(folder: Path, scan: Scan, names: list[str], rng: np.random.Generator) -> None:
    """Images of a scan, whose first pixel is their place in the list."""
    counts = np.rint(20_000 * np.exp(-scan.integrals())).astype(np.uint16)
    counts[:, 0, 0] = 1000 + np.arange(len(counts))
    for name, image in zip(names, counts, strict=True):
        tifffile.imwrite(folder / name, image)
    tifffile.imwrite(folder / "io0.tif", np.full(scan.shape, 20_000, np.uint16))
    tifffile.imwrite(folder / "di0.tif", np.zeros(scan.shape, np.uint16))


def in_place(data: fx.DataSet) -> bool:
    """Whether each image that is there is that of its view."""
    return all(int(data.counts(i)[0, 0]) == 1000 + i for i in data.present)


Verdict = tuple[Told, bool]
"""What was said, and whether that is the cause, or the result right."""


def radians(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """Angles in radians where degrees are asked for; the answer is to name radians."""
    end = float(rng.choice([2 * np.pi, np.pi, rng.uniform(2.5, 6.28)]))
    wrong = scan.geometry(angles=np.linspace(0, end, len(scan.angles), endpoint=False))
    told = method(rng, scan.integrals(), wrong, scan.grid)
    return told, told.names("radians")


def degrees(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """Degrees in an ASTRA geometry, which has radians; the answer is to name degrees."""
    span = float(rng.choice([360.0, 180.0, 200.0, 355.0, 720.0]))
    views = int(rng.choice([45, 72, 90, 180, 360, 361, 720]))
    angles = np.linspace(0, span, views, endpoint=bool(rng.integers(2)))
    astra = {"type": "cone", "DetectorRowCount": 20, "DetectorColCount": 30, "DetectorSpacingX": 1,
             "DetectorSpacingY": 1, "DistanceOriginSource": scan.sod, "DistanceOriginDetector": 50,
             "ProjectionAngles": angles}  # fmt: skip
    told = ask(lambda: fx.ConeVec.from_astra(astra))
    return told, told.names("degrees given")


def panel_inside(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """A panel between source and object is no mistake: the projection or the volume has
    to be right.
    """
    geometry = scan.geometry()
    part = float(rng.uniform(0.05, 1.0)) * scan.sod / scan.sdd
    beam = geometry.detector - geometry.source
    near = fx.ConeVec.from_vectors(geometry.source, geometry.source + part * beam,
                                   part * geometry.u, part * geometry.v, scan.shape)  # fmt: skip
    if rng.integers(2):
        told = ask(lambda: fx.project(scan.volume(scan.mu), near))
        other = fx.project(scan.volume(scan.mu), geometry)
        return told, told.value is not None and np.allclose(told.value, other, atol=1e-3)
    told = ask(lambda: sirt(scan.integrals(), near, scan.grid, iterations=40))
    found = told.value.data[4, 4, 4] if told.value is not None else np.nan
    return told, abs(found / scan.mu - 1.0) < 0.1


def units(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """A length in metres or micrometres; the answer is to name mm."""
    wrong = [{"pixel": 1000 * scan.pixel}, {"pixel": scan.pixel / 1000}, {"sod": scan.sod / 1000},
             {"sod": scan.sod / 1000, "sdd": scan.sdd / 1000}]  # fmt: skip
    given = wrong[int(rng.integers(len(wrong)))]
    door = fx.project if rng.integers(2) else fx.simulate
    told = ask(lambda: door(scan.solid(), scan.geometry(**given)))
    return told, told.names("mm")


def distances(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """Distances of which one is zero, negative, tiny, or both exchanged, by a file or a
    call; they are to be named.
    """
    sod, sdd = (
        (0.0, scan.sdd),
        (scan.sdd, scan.sod),
        (scan.sod, 1e-10),
        (-scan.sod, scan.sdd),
    )[int(rng.integers(4))]
    kind = int(rng.integers(3))
    if kind == 0:
        path = folder / "scan.xtekct"
        path.write_text(f"Projections=4\nSrcToObject={sod}\nSrcToDetector={sdd}\n"
                        f"DetectorPixelSizeX=.1\nDetectorPixelSizeY=.1\n")  # fmt: skip
        told = ask(lambda: fx.open(path))
        return told, told.names("SrcToObject")
    if kind == 1:
        path = folder / "scan.xml"
        scan.geometry().save(path)
        text = path.read_text()
        numbers = {"SourceToIsocenterDistance": -sod, "SourceToDetectorDistance": -sdd}
        for name, value in numbers.items():
            head, *parts = text.split(f"<{name}>")
            text = f"<{name}>{value}<".join([head, *(p.split("<", 1)[1] for p in parts)])
        path.write_text(text)
        told = ask(lambda: fx.ConeVec.load(path, pixel=scan.pixel, shape=scan.shape))
        return told, told.names("SourceTo", "distance")
    told = ask(lambda: scan.geometry(sod=sod, sdd=sdd))
    return told, told.names("sod")


def arc(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """An arc too short for the method; the answer is to name the directions."""
    span = float(rng.uniform(20, 150))
    short = scan.geometry(
        angles=rng.uniform(0, 360) + np.linspace(0, span, len(scan.angles))
    )
    images = scan.mu * chords(short, scan.centre, scan.radius)
    told = method(rng, images, short, scan.grid)
    return told, told.names("directions", "FDK needs")


def laminography(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """A tilted circle for FDK; the answer is to name laminography or iterative methods."""
    level = scan.geometry()
    slope = np.tan(np.radians(rng.uniform(12, 60)))
    source = level.source + [0, 0, -slope * scan.sod * rng.choice([-1, 1])]
    towards = -source / np.linalg.norm(source, axis=1, keepdims=True)
    right = level.u / np.linalg.norm(level.u, axis=1, keepdims=True)
    tilted = fx.ConeVec.from_vectors(
        source, (scan.sdd - scan.sod) * towards, scan.pixel * right,
        scan.pixel * np.cross(towards, right), scan.shape,
    )  # fmt: skip
    images = scan.mu * chords(tilted, scan.centre, scan.radius)
    told = ask(lambda: fdk(images, tilted, scan.grid, errors=False))
    return told, told.names("laminography", "iterative")


def counts(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """Counts where line integrals are asked for; the answer is to name counts."""
    beam = float(np.exp(rng.uniform(np.log(100), np.log(65_000))))
    kind = (np.float32, np.float64, np.uint16, np.int32, np.int64)[int(rng.integers(5))]
    images = np.minimum(rng.poisson(beam * np.exp(-scan.integrals())), 65535).astype(kind)
    told = method(rng, images, scan.geometry(), scan.grid)
    return told, told.names("counts")


def transmission(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """Transmissions where line integrals are asked for; the answer is to name
    transmission.
    """
    noise = rng.normal(0.0, rng.uniform(0.0, 0.02), scan.integrals().shape)
    images = np.exp(-scan.integrals()) + noise
    if rng.integers(2):
        told = ask(
            lambda: fx.DataSet.from_arrays(images.astype(np.float32), scan.geometry())
        )
    else:
        told = method(rng, images, scan.geometry(), scan.grid)
    return told, told.names("transmission")


def not_finite(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """NaN or infinities in images or in a volume; the answer is to name them."""
    bad = float(rng.choice([np.nan, np.inf, -np.inf]))
    if rng.integers(2):
        images = scan.integrals().astype(np.float32)
        images.ravel()[rng.integers(images.size, size=int(rng.integers(1, 50)))] = bad
        if rng.integers(2):
            told = ask(lambda: fx.DataSet.from_arrays(images, scan.geometry()))
        else:
            told = method(rng, images, scan.geometry(), scan.grid)
        return told, told.names("finite")
    data = np.array(scan.volume(scan.mu).data)
    data.ravel()[rng.integers(data.size, size=int(rng.integers(1, 50)))] = bad
    volume = fx.Volume(data, 0.1 * scan.radius)
    told = ask(lambda: fx.project(volume, scan.geometry()))
    return told, told.names("no numbers", "finite")


def hounsfield(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """A volume in Hounsfield units; the answer is to name them."""
    body = float(rng.uniform(800, 3000))
    volume = scan.volume(body, -1000.0)
    if rng.integers(2):
        told = ask(lambda: fx.project(volume, scan.geometry()))
    else:
        told = ask(
            lambda: fx.simulate(volume.data, scan.geometry(), voxel_mm=volume.voxel_mm)
        )
    return told, told.names("Hounsfield")


def whole(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """Line integrals cut to whole numbers; the answer is to name fractions or counts."""
    images = rng.uniform(2, 20) * scan.integrals() / scan.integrals().max()
    cut = images.astype((np.int32, np.int64)[int(rng.integers(2))])
    if rng.integers(2):
        told = ask(lambda: fx.DataSet.from_arrays(cut, scan.geometry()))
    else:
        told = method(rng, cut, scan.geometry(), scan.grid)
    return told, told.names("fraction", "counts")


def steel(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """Very thick objects are no mistake: the line integrals have to stay as they are."""
    images = rng.uniform(8, 60) * scan.integrals() / scan.integrals().max()
    told = ask(lambda: fx.DataSet.from_arrays(images, scan.geometry()))
    same = told.value is not None and np.allclose(
        told.value.line_integrals(), images, rtol=1e-5
    )
    return told, same


STYLES: dict[str, Callable[[int], str]] = {
    "plain": lambda i: f"scan_{i:06d}.tif", "short": lambda i: f"p{i}.tif",
    "tenths": lambda i: f"a_{i / 10}.tif", "quarters": lambda i: f"a_{i / 4:g}.tif",
    "negative": lambda i: f"a_{i - 20}.tif", "deg": lambda i: f"x_{i}deg.tiff",
    "hyphen": lambda i: f"run-2-{i}.tif", "bare": lambda i: f"{i}.tif",
}  # fmt: skip


def names_of(rng: np.random.Generator, count: int) -> list[str]:
    """Names of images of one style."""
    style = STYLES[str(rng.choice([*STYLES]))]
    return [style(i) for i in range(count)]


def numbers(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    written(folder, scan, names_of(rng, len(scan.angles)), rng)
    told = ask(lambda: fx.read_tiffs(folder, scan.geometry()))
    return told, told.value is not None and in_place(told.value)


def duplicates(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """A second file of one number, by another spelling; it has to be refused by its name."""
    names = [f"scan_{i:06d}.tif" for i in range(len(scan.angles))]
    twice = int(rng.integers(len(names)))
    other = str(rng.choice([f"scan_{twice}.tif", f"scan_{twice:06d}.tiff"]))
    if rng.integers(2):
        written(folder, scan, names, rng)
        (folder / other).write_bytes((folder / names[0]).read_bytes())
        more = scan.geometry(angles=np.append(scan.angles, 0.0))
        told = ask(lambda: fx.read_tiffs(folder, more))
    else:
        made = exposed(rng, scan)()
        made.save(folder / "set")
        (folder / "set" / other).write_bytes((folder / "set" / names[0]).read_bytes())
        told = ask(lambda: fx.open(folder / "set"))
    return told, told.refused and told.names(other)


def gap(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """A number of the files is missing; the answer is to name it."""
    lost = int(rng.integers(1, len(scan.angles)))
    names = [f"scan_{i + (i >= lost):04d}.tif" for i in range(len(scan.angles))]
    written(folder, scan, names, rng)
    told = ask(lambda: fx.read_tiffs(folder, scan.geometry()))
    return told, told.names("missing")


def other_name(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """A file beside the frames with another name, which the answer is to name."""
    written(folder, scan, [f"X_{i:03d}.tif" for i in range(len(scan.angles))], rng)
    extra = str(
        rng.choice(["X_180deg.tif", "preview.tif", "X_007_bis.tif", "aX_001.tif"])
    )
    (folder / extra).write_bytes((folder / "X_000.tif").read_bytes())
    if rng.integers(2):
        (folder / f"X_{int(rng.integers(len(scan.angles))):03d}.tif").unlink()
    told = ask(lambda: fx.read_tiffs(folder, scan.geometry()))
    return told, told.names(extra)


def blank(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """The last frames, or all, are zero; the answer is to say that nothing was recorded."""
    made = exposed(rng, scan)()
    some = int(rng.integers(1, len(scan.angles) + 1))
    if rng.integers(2):
        images = made.counts()
        images[-some:] = 0
        told = ask(
            lambda: fx.DataSet.from_arrays(
                images, scan.geometry(), flat=made.flat.round()
            )
        )
    else:
        made.save(folder / "set")
        for i in range(len(made) - some, len(made)):
            tifffile.imwrite(
                folder / "set" / f"scan_{i:06d}.tif", np.zeros(scan.shape, np.uint16)
            )
        told = ask(lambda: fx.open(folder / "set"))
    return told, told.names("nothing was recorded")


def flats(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """Flat images that differ by 2.5 to 60 %; the answer is to name that."""
    apart = float(np.exp(rng.uniform(np.log(0.025), np.log(0.6)))) * rng.choice([-1, 1])
    levels = np.ones(int(rng.integers(2, 6)))
    levels[int(rng.integers(1, len(levels))) :] += apart
    told = ask(looked(exposed(rng, scan, levels)))
    return told, told.names("flat images differ")


def beam(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """An open beam that drifts, or is another than in the flat images; the answer is to
    name it.
    """
    fall = float(rng.uniform(0.05, 0.4))
    ramps = [np.linspace(1.0, 1.0 - fall, len(scan.angles)), 1.0 + fall,
             np.linspace(1.0, 1.0 + fall, len(scan.angles))]  # fmt: skip
    told = ask(looked(exposed(rng, scan, beam=ramps[int(rng.integers(3))])))
    return told, told.names("open beam")


def nexus(
    path: Path, scan: Scan, angles: Array, pixel_mm: float, keys: Array | None = None
) -> None:
    """An NXtomo file of others, with h5py alone."""
    import h5py

    counts = np.rint(20_000 * np.exp(-scan.integrals())).astype(np.uint16)
    images = np.concatenate([np.full((1, *scan.shape), 20_000, np.uint16), counts])
    with h5py.File(path, "w") as file:
        at = file.create_group("entry/instrument/detector")
        at["data"] = images
        at["image_key"] = np.array([1] + [0] * len(counts)) if keys is None else keys
        at["x_pixel_size"] = pixel_mm / 1000
        at["x_pixel_size"].attrs["units"] = "m"
        file["entry/sample/rotation_angle"] = np.concatenate([[0.0], angles])
        file["entry/sample/rotation_angle"].attrs["units"] = "deg"


def nexus_angles(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """Angles of a NeXus file that contradict the geometry given; the answer is to name
    the cause.
    """
    own, kind = scan.angles, int(rng.integers(4))
    wrong = [np.radians(own), own * float(rng.uniform(0.3, 0.9)), rng.permutation(own),
             own + rng.normal(0, 15, len(own))][kind]  # fmt: skip
    nexus(folder / "a.nx", scan, wrong, scan.pixel)
    told = ask(lambda: fx.open(folder / "a.nx", geometry=scan.geometry()))
    causes = [("radians",), ("differ", "order"), ("order", "differ"), ("differ", "order")]
    return told, told.names(*causes[kind])


def nexus_pixel(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """A pixel of a NeXus file that contradicts the geometry given; the answer is to name
    it.
    """
    magnified = scan.sdd / scan.sod
    factor = float(rng.choice([0.001, 1000.0, 2.0 * magnified, 0.5 / magnified]))
    nexus(folder / "a.nx", scan, scan.angles, factor * scan.pixel)
    told = ask(lambda: fx.open(folder / "a.nx", geometry=scan.geometry()))
    return told, told.names("pixel")


def nexus_keys(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """More or fewer image keys than images; the answer is to name them."""
    count = len(scan.angles) + int(rng.choice([-3, -1, 2, 5]))
    nexus(folder / "a.nx", scan, scan.angles, scan.pixel, np.array([1] + [0] * count))
    told = ask(lambda: fx.open(folder / "a.nx", geometry=scan.geometry()))
    return told, told.names("image keys")


def grid_aside(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """A grid outside the field of view; the answer is to name that."""
    far = float(rng.uniform(3.0, 50.0)) * scan.view_mm
    place = far * np.array([[1, 0, 0], [0, -1, 0], [0.7, 0.7, 0]])[int(rng.integers(3))]
    grid = Grid((9, 9, 9), scan.radius / 8, tuple(place))
    told = method(rng, scan.integrals(), scan.geometry(), grid)
    return told, told.names("grid", "field of view")


def voxel(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """Voxels wider than half the field of view; the answer is to name them."""
    made = exposed(rng, scan)()
    size = float(rng.uniform(0.6, 100)) * scan.view_mm
    told = ask(lambda: made.reconstruct("fdk", voxel=size, errors=False))
    return told, told.names("voxels of")


def nikon_lost(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """A Nikon folder that lacks an image; it is to be named, and the others are to have
    their angles.
    """
    count = 36
    few = Scan(scan.sod, scan.sdd, scan.pixel, scan.shape, np.arange(count) * 10.0, scan.radius,
               scan.centre, scan.mu)  # fmt: skip
    written(folder, few, [f"part_{i + 1:04d}.tif" for i in range(count)], rng)
    for name in ("io0.tif", "di0.tif"):
        (folder / name).unlink()
    (folder / f"part_{int(rng.integers(1, count + 1)):04d}.tif").unlink()
    if rng.integers(2):
        tifffile.imwrite(folder / "part_preview.tif", np.ones(scan.shape, np.uint16))
    (folder / "part.xtekct").write_text(
        f"Projections={count}\nSrcToObject={scan.sod}\nSrcToDetector={scan.sdd}\nWhiteLevel=20000\n"
        f"DetectorPixelsX={scan.shape[1]}\nDetectorPixelsY={scan.shape[0]}\nAngularStep=10\n"
        f"DetectorPixelSizeX={scan.pixel}\nDetectorPixelSizeY={scan.pixel}\n"
    )
    told = ask(lambda: fx.open(folder / "part.xtekct"))
    return told, told.names("missing") and told.value is not None and in_place(told.value)


def document(rng: np.random.Generator, scan: Scan, folder: Path) -> Verdict:
    """A geometry file with a byte order mark, which is no mistake, or with 5000 digits,
    to be named.
    """
    path = folder / "scan.json"
    scan.geometry().save(path)
    text = path.read_text()
    if rng.integers(2):
        path.write_text("\ufeff" + text)
        told = ask(lambda: fx.ConeVec.load(path))
        return told, told.value is not None and np.array_equal(
            told.value.rows, scan.geometry().rows
        )
    path.write_text(text.replace('"schema": 1', f'"schema": 1, "more": {"7" * 5000}'))
    told = ask(lambda: fx.ConeVec.load(path))
    return told, told.names("digits")


KINDS: dict[str, Callable[[np.random.Generator, Scan, Path], Verdict]] = {
    "radians as degrees": radians, "degrees as radians": degrees, "panel in the object":
    panel_inside, "units": units, "impossible distances": distances, "limited arc": arc,
    "laminography": laminography, "counts": counts, "transmission": transmission, "not finite":
    not_finite, "Hounsfield": hounsfield, "whole numbers": whole, "steep line integrals": steel,
    "numbers in names": numbers, "two of one number": duplicates, "gap": gap, "other name":
    other_name, "blank frames": blank, "flats": flats, "beam": beam, "NXtomo angles": nexus_angles,
    "NXtomo pixel": nexus_pixel, "NXtomo keys": nexus_keys, "grid aside": grid_aside,
    "voxel": voxel, "Nikon lost image": nikon_lost, "document": document,
}  # fmt: skip


def right(rng: np.random.Generator, scan: Scan, folder: Path) -> tuple[str, Told]:
    """A right scan through a door that is drawn."""
    geometry, grid, images = scan.geometry(), scan.grid, scan.integrals()
    noisy = images + rng.normal(0.0, rng.uniform(0.0, 0.05), images.shape)
    kind = int(rng.integers(12))
    if kind in (0, 1, 4, 10) and rng.integers(2):  # a panel aside and turned
        geometry = scan.geometry(offset=rng.uniform(-0.1, 0.1, 2) * scan.pixel * scan.shape[1],
                                 tilts=rng.uniform(-3, 3, 3))  # fmt: skip
    if kind == 0:
        return "project", ask(lambda: fx.project(scan.solid(), geometry))
    if kind == 1:
        return "project voxels", ask(lambda: fx.project(scan.volume(scan.mu), geometry))
    if kind in (2, 3):
        return "method", method(rng, noisy.astype(np.float32), geometry, grid)
    if kind == 4:
        return "line integrals", ask(lambda: fx.DataSet.from_arrays(noisy, geometry))
    if kind in (5, 6):
        some = np.ones(int(rng.integers(1, 5)))
        return "counts", ask(looked(exposed(rng, scan, some)))
    if kind == 7:
        exposed(rng, scan)().save(folder / "set")
        return "folder", ask(lambda: fx.open(folder / "set"))
    if kind == 8:
        written(folder, scan, names_of(rng, len(scan.angles)), rng)
        return "TIFFs", ask(lambda: fx.read_tiffs(folder, geometry))
    if kind == 9:
        turned = scan.angles * rng.choice([-1, 1]) + rng.uniform(0, 90)
        at_axis = scan.pixel * scan.sod / scan.sdd
        nexus(folder / "a.nx", scan, turned, float(rng.choice([scan.pixel, at_axis])))
        return "NXtomo", ask(lambda: fx.open(folder / "a.nx", geometry=geometry))
    if kind == 10:
        ending = str(rng.choice([".json", ".npy", ".txt", ".csv", ".npz", ".xml"]))
        geometry.save(folder / f"scan{ending}")
        pixel = scan.pixel if ending == ".xml" else None
        return f"file {ending}", ask(
            lambda: fx.ConeVec.load(
                folder / f"scan{ending}", pixel=pixel, shape=scan.shape
            )
        )
    astra = {**geometry.to_astra(), "type": "cone", "DetectorSpacingX": scan.pixel,
             "DetectorSpacingY": scan.pixel, "DistanceOriginSource": scan.sod,
             "DistanceOriginDetector": scan.sdd - scan.sod,
             "ProjectionAngles": np.radians(scan.angles)}  # fmt: skip
    return "ASTRA", ask(lambda: fx.ConeVec.from_astra(astra))


def main(arguments: list[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--count", type=int, default=1000, help="contradictions")
    parser.add_argument("--right", type=int, default=1000, help="right scans")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kind", choices=[*KINDS], help="this kind alone")
    parser.add_argument(
        "--out", type=Path, help="a line of JSON for each case that does not count"
    )
    asked = parser.parse_args(arguments)
    kinds = [asked.kind] if asked.kind else [*KINDS]
    good: Counter[str] = Counter()
    made: Counter[str] = Counter()
    wrong: list[dict[str, Any]] = []
    for i in range(asked.count):
        rng, kind = np.random.default_rng([asked.seed, i]), kinds[i % len(kinds)]
        with tempfile.TemporaryDirectory() as folder:
            told, counts_ = KINDS[kind](rng, drawn(rng), Path(folder))
        made[kind] += 1
        good[kind] += bool(counts_ and not told.crashed)
        if not counts_ or told.crashed:
            wrong.append(
                {"kind": kind, "case": i, "said": told.words, "crashed": told.crashed}
            )
    for kind in kinds:
        print(f"{kind:22} {good[kind]:4} of {made[kind]:4}")
    false = 0
    for i in range(asked.right):
        rng = np.random.default_rng([asked.seed, i, 1])
        with tempfile.TemporaryDirectory() as folder:
            door, told = right(rng, drawn(rng), Path(folder))
        said = [w for w in told.words if not any(part in w for part in ALLOWED)]
        if said or told.crashed:
            false += 1
            wrong.append(
                {"right": door, "case": i, "said": said, "crashed": told.crashed}
            )
    share = sum(good.values()) / max(asked.count, 1)
    print(
        f"refused, said with the cause, or right: {sum(good.values())} of {asked.count}"
    )
    print(f"right scans that were told something: {false} of {asked.right}")
    if asked.out is not None:
        asked.out.write_text("".join(json.dumps(one) + "\n" for one in wrong))
    for one in wrong[:20]:
        print(json.dumps(one)[:300])
    return int(share < 0.98 or false > 0.01 * asked.right)


if __name__ == "__main__":
    sys.exit(main())
