"""Drawn scan files of each maker, with what a reader must say of them.

Every file holds images of four balls in closed form and a planted `unknown_thing`. A draw changes
the file in one or more ways: fields in other spellings and units, absent, twice, contradicting,
without a number, with an effect that nobody applies. For each change the draw says what is right:
the images fit the geometry, or names are in the warnings, or the file is refused for a named field.
Writers know the formats from their descriptions and share nothing with the readers.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from turned_balls import integrals

VIEWS, SHAPE, PITCH, SOD, SDD = 8, (20, 24), 1.5, 120.0, 260.0
MIDDLE = ((SHAPE[0] - 1) / 2, (SHAPE[1] - 1) / 2)
STEP = 360.0 / VIEWS
ANGLES = STEP * np.arange(VIEWS)
UNKNOWN = "unknown_thing"


@dataclass
class Draw:
    """A file to be written, and what must be said of it.

    Attributes:
        said: fields in order: name and value; HDF5's may be (value, unit).
        world: arguments of `integrals`: the right geometry.
        named: words that warnings must have; of each inner tuple one.
        refused: words of the error, or empty where the file opens.
        fits: the images fit the geometry that is read.
        columns, rows: images are stored mirrored.
        level: counts of the open beam.
        extra: further files beside it, name -> text.
        open: further arguments of `fx.open`.
    """

    said: list[tuple[str, Any]]
    world: dict[str, Any] = field(default_factory=lambda: {"angles_deg": ANGLES})
    named: list[tuple[str, ...]] = field(default_factory=list)
    refused: tuple[str, ...] = ()
    fits: bool = True
    columns: bool = False
    rows: bool = False
    level: float = 50_000.0
    flat: float = 1.0
    extra: dict[str, str] = field(default_factory=dict)
    open: dict[str, Any] = field(default_factory=dict)

    def get(self, name: str) -> Any:
        return next(value for key, value in self.said if key == name)

    def set(self, name: str, value: Any) -> None:
        there = [k for k, (key, _) in enumerate(self.said) if key == name]
        if there:
            self.said[there[0]] = (name, value)
        else:
            self.said.append((name, value))

    def drop(self, name: str) -> None:
        self.said = [one for one in self.said if one[0] != name]

    def images(self) -> Any:
        world = {"sod": SOD, "sdd": SDD, "pitch": PITCH, "shape": SHAPE, **self.world}
        lines = integrals(world.pop("angles_deg"), **world)
        lines = lines[:, ::-1] if self.rows else lines
        return lines[:, :, ::-1] if self.columns else lines


Change = Callable[[Draw, np.random.Generator], None]


def comma(*names: str) -> Change:
    """A number with a decimal comma, in another case of the key, between blanks."""

    def change(draw: Draw, rng: np.random.Generator) -> None:
        name = names[int(rng.integers(len(names)))]
        value = f"  {float(draw.get(name)):.9f}".replace(".", ",")
        draw.set(name, value)

    return change


def absent(*names: str) -> Change:
    """A field without which the file cannot be read."""

    def change(draw: Draw, rng: np.random.Generator) -> None:
        name = names[int(rng.integers(len(names)))]
        draw.drop(name)
        draw.refused = (name.split("/")[-1],)

    return change


def no_number(*names: str) -> Change:
    def change(draw: Draw, rng: np.random.Generator) -> None:
        name = names[int(rng.integers(len(names)))]
        draw.set(name, str(rng.choice(["far", "1.2.3", "nan", "--"])))
        draw.refused = (name.split("/")[-1],)

    return change


def twice(*names: str) -> Change:
    """A field twice: with one value, or with two, of which nobody knows which is right."""

    def change(draw: Draw, rng: np.random.Generator) -> None:
        name = names[int(rng.integers(len(names)))]
        value = draw.get(name)
        if rng.integers(2):
            draw.said.append((name, value))
        else:
            draw.said.append((name, float(value) * 1.1 + 1.0))
            draw.refused = (name.split("/")[-1],)

    return change


def told(name: str, value: Any, *, fits: bool = True) -> Change:
    """A figure with an effect that is in no image: it must be named; images do not fit
    where the reader has to take it all the same.
    """

    def change(draw: Draw, rng: np.random.Generator) -> None:
        draw.set(name, value)
        draw.named.append((name.split("/")[-1],))
        draw.fits = draw.fits and fits

    return change


def stated(
    name: str, draw_value: Callable[[np.random.Generator], Any], effect: Any
) -> Change:
    """A figure that is in the images: `effect` changes the draw by its value."""

    def change(draw: Draw, rng: np.random.Generator) -> None:
        value = draw_value(rng)
        draw.set(name, value)
        effect(draw, value)

    return change


def world(**changes: Callable[[Any], Any]) -> Any:
    """An effect on arguments of `integrals`: name -> its value from the figure."""

    def effect(draw: Draw, value: Any) -> None:
        for name, of in changes.items():
            draw.world[name] = of(value)

    return effect


def planted(draw: Draw, rng: np.random.Generator, prefix: str = "") -> None:
    at = int(rng.integers(len(draw.said) + 1))
    draw.said.insert(at, (f"{prefix}{UNKNOWN}", round(float(rng.uniform(1, 9)), 3)))


def tiffs(folder: Path, draw: Draw, pattern: str, first: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for k, image in enumerate(draw.images()):
        counts = np.rint(draw.level * np.exp(-image)).astype(np.uint16)
        tifffile.imwrite(folder / pattern.format(k + first), counts)
    for name, text in draw.extra.items():
        (folder / name).write_text(text)


# Nikon.


def nikon_draw(rng: np.random.Generator) -> Draw:
    draw = Draw([
        ("Name", "part"), ("Projections", VIEWS), ("WhiteLevel", 50000),
        ("DetectorPixelsX", SHAPE[1]), ("DetectorPixelsY", SHAPE[0]),
        ("DetectorPixelSizeX", PITCH), ("DetectorPixelSizeY", PITCH),
        ("SrcToObject", SOD), ("SrcToDetector", SDD), ("InitialAngle", 0.0),
        ("AngularStep", STEP), ("InputFolderName", ""), ("OperatorID", "ab"),
        ("VoxelsX", 24), ("CoefX1", 1.0), ("Scattering", 0),
    ], columns=True)  # fmt: skip
    planted(draw, rng)
    return draw


def listed_angles(name: str) -> Change:
    """A list of angles that contradicts AngularStep: the measured one is right."""

    def change(draw: Draw, rng: np.random.Generator) -> None:
        angles = float(rng.choice([0.5, 0.8, 1.1])) * ANGLES
        draw.world["angles_deg"] = angles
        rows = "".join(f"{k + 1}\t{a:.6f}\t{k}\n" for k, a in enumerate(angles))
        head = (
            f"Projs Frames Exposure(ms)\n{VIEWS} 1 500\nProjection\tAngle(deg)\tTime(s)\n"
        )
        if name.endswith(".ang"):
            rows = "".join(f"{k + 1}:\t{-a:.6f}\n" for k, a in enumerate(angles))
            head = "Proj\tAngle(deg)\n"
        draw.extra[name] = head + rows
        draw.named.append(("InitialAngle and AngularStep",))

    return change


def other_unit(draw: Draw, rng: np.random.Generator) -> None:
    unit, size = (("cm", 10.0), ("um", 1e-3), ("m", 1e3), ("parsec", 0.0))[
        int(rng.integers(4))
    ]
    draw.set("Units", unit)
    if not size:
        draw.refused = ("Units",)
        return
    for name in (
        "SrcToObject",
        "SrcToDetector",
        "DetectorPixelSizeX",
        "DetectorPixelSizeY",
    ):
        draw.set(name, float(draw.get(name)) / size)


def two_axes(draw: Draw, rng: np.random.Generator) -> None:
    aside = float(rng.uniform(1.0, 3.0))
    draw.set("ObjectOffsetX", aside)
    draw.set("CentreOfRotationTop", -7.0)
    draw.set("CentreOfRotationBottom", -7.0)
    draw.world["column"] = MIDDLE[1] - aside * SDD / SOD / PITCH
    draw.named.append(("CentreOfRotationTop",))
    draw.fits = False  # an axis aside moves the object, not the ray: compared elsewhere


NIKON: list[Change] = [
    comma("SrcToObject", "AngularStep"),
    absent("SrcToDetector", "AngularStep", "WhiteLevel"),
    no_number("SrcToObject", "DetectorPixelSizeX"),
    twice("SrcToObject", "AngularStep"),
    told("DetectorOffsetX", 3.5), told("CoefX2", 0.2), told("Shuttling", "True"),
    told("Scattering", 12), told("Scale", 2.0),
    stated("InitialAngle", lambda r: float(r.uniform(0, 90)),
           world(angles_deg=lambda a: ANGLES + a)),
    stated("WhiteLevel", lambda r: float(r.integers(20000, 60000)),
           lambda d, v: setattr(d, "level", v)),
    listed_angles("_ctdata.txt"), listed_angles("part.ang"), other_unit, two_axes,
]  # fmt: skip


def write_ini(path: Path, draw: Draw, section: str) -> None:
    lines = [f"[{section}]"] + [f"{key}={value}" for key, value in draw.said]
    path.write_text("\r\n".join(lines) + "\r\n")


def nikon(folder: Path, draw: Draw) -> Path:
    tiffs(folder, draw, "part_{:04d}.tif", 1)
    path = folder / "part.xtekct"
    write_ini(path, draw, "XTekCT")
    return path


# SkyScan.


def skyscan_draw(rng: np.random.Generator) -> Draw:
    draw = Draw([
        ("Filename Prefix", "bone"), ("Number Of Files", VIEWS),
        ("Number Of Rows", SHAPE[0]), ("Number Of Columns", SHAPE[1]),
        ("Object to Source (mm)", SOD), ("Camera to Source (mm)", SDD),
        ("Image Pixel Size (um)", 1000 * PITCH * SOD / SDD),
        ("Rotation Step (deg)", STEP), ("Use 360 Rotation", "YES"),
        ("Rotation Direction", "CC"), ("Image Format", "TIFF"), ("Depth (bits)", 16),
        ("Reference Intensity", 50000), ("Source Voltage (kV)", 80),
    ])  # fmt: skip
    planted(draw, rng)
    return draw


SKYSCAN: list[Change] = [
    comma("Object to Source (mm)", "Rotation Step (deg)"),
    absent("Object to Source (mm)", "Rotation Step (deg)", "Number Of Files"),
    no_number("Camera to Source (mm)"),
    twice("Object to Source (mm)"),
    told("Random Movement", "ON (30)"), told("Image Rotation", "0.35"),
    told("Camera X/Y Ratio", "1.02"), told("Number of connected scans", "2"),
    told("Camera Pixel Size (um)", 900.0), told("Use 360 Rotation", "NO"),
    stated("Optical Axis (line)", lambda r: int(r.integers(3, 17)),
           world(row=lambda v: SHAPE[0] - 1.0 - v)),
    stated("Scanning Start Angle", lambda r: float(r.uniform(0, 90)),
           world(angles_deg=lambda a: ANGLES + a)),
    stated("Rotation Direction", lambda r: "CW", world(angles_deg=lambda _: -ANGLES)),
    stated("Reference Intensity", lambda r: float(r.integers(20000, 60000)),
           lambda d, v: setattr(d, "level", v)),
]  # fmt: skip


def trajectory(draw: Draw, rng: np.random.Generator) -> None:
    draw.set("Scanning Trajectory", "SPIRAL")
    draw.refused = ("Scanning Trajectory",)


SKYSCAN.append(trajectory)


def skyscan(folder: Path, draw: Draw) -> Path:
    tiffs(folder, draw, "bone{:08d}.tif", 0)
    path = folder / "bone.log"
    write_ini(path, draw, "Acquisition")
    return path


# phoenix.


def phoenix_draw(rng: np.random.Generator) -> Draw:
    voxel = PITCH * SOD / SDD
    draw = Draw([
        ("Geometry/FDD", SDD), ("Geometry/FOD", SOD), ("Geometry/VoxelSizeX", voxel),
        ("Geometry/VoxelSizeY", voxel), ("Geometry/cx", MIDDLE[1]),
        ("Geometry/cy", MIDDLE[0]), ("CT/NumberImages", VIEWS),
        ("CT/RotationSector", 360.0), ("Image/DimX", SHAPE[1]), ("Image/DimY", SHAPE[0]),
        ("Image/FreeRay", 50000), ("Xray/Voltage", 60), ("CalibValue/NumberImages", 18),
    ])  # fmt: skip
    planted(draw, rng, ["Geometry/", "CT/", "Image/", "Strange/"][int(rng.integers(4))])
    return draw


PHOENIX: list[Change] = [
    comma("Geometry/FDD", "Geometry/VoxelSizeX"),
    absent("Geometry/FOD", "CT/NumberImages", "Image/FreeRay"),
    no_number("Geometry/FDD"), twice("Geometry/FDD"),
    told("Geometry/CalibValue", -1.5), told("Geometry/Tilt", 0.2), told("Image/MirrorX", 1),
    told("Geometry/Magnification", 4.0), told("Detector/PixelsizeX", 0.9),
    stated("Geometry/cx", lambda r: float(r.uniform(8, 15)), world(column=float)),
    stated("Geometry/cy", lambda r: float(r.uniform(6, 13)), world(row=float)),
    stated("CT/RotationSector", lambda r: float(r.choice([180.0, 270.0])),
           world(angles_deg=lambda v: v / 360.0 * ANGLES)),
    stated("CT/FreeRayFactor", lambda r: 1.1, lambda d, v: setattr(d, "level", 55000.0)),
]  # fmt: skip


def another_path(draw: Draw, rng: np.random.Generator) -> None:
    draw.set("Trajectory/Active", 1)
    draw.refused = ("Trajectory/Active",)


PHOENIX.append(another_path)


def phoenix(folder: Path, draw: Draw) -> Path:
    tiffs(folder, draw, "part_{:04d}.tif", 1)
    text = "".join("[{}]\n{}={}\n".format(*k.split("/"), v) for k, v in draw.said)
    path = folder / "part.pca"
    path.write_text(text)
    return path


# YXLON.


def yxlon_draw(rng: np.random.Generator) -> Draw:
    draw = Draw([
        ("PixelSize/Width", PITCH), ("PixelSize/Height", PITCH),
        ("ProjectionSize/Width", SHAPE[1]), ("ProjectionSize/Height", SHAPE[0]),
        ("ProjectionBitdepth", 15), ("ScanTrajectory/PixelPitch", 1.0),
        ("ScanTrajectory/Fdd", SDD), ("ScanTrajectory/Fod", SOD),
        ("ScanTrajectory/NumberOfProjections", VIEWS),
        ("ScanTrajectory/StartAngle", 0.0), ("ScanTrajectory/Rotation", 360.0),
    ], world={"angles_deg": -ANGLES}, level=32767.0)  # fmt: skip
    planted(draw, rng, ["ScanTrajectory/", "", "PixelSize/"][int(rng.integers(3))])
    return draw


def scaled(draw: Draw, rng: np.random.Generator) -> None:
    unit = float(rng.choice([0.5, 2.0, 0.127]))
    draw.set("ScanTrajectory/PixelPitch", unit)
    for name in ("Fdd", "Fod"):
        draw.set(f"ScanTrajectory/{name}", draw.get(f"ScanTrajectory/{name}") / unit)


YXLON: list[Change] = [
    comma("ScanTrajectory/Fdd", "PixelSize/Width"), scaled,
    absent("ScanTrajectory/Fdd", "PixelSize/Height", "ProjectionSize/Width"),
    no_number("ScanTrajectory/Fod"), twice("ScanTrajectory/Fdd"),
    told("ScanTrajectory/YoCenter", 2.5), told("DejustmentParameter/DetectorTiltB", 0.3),
    told("DejustmentParameter/HorizontalDetectorOffset", 2.0),
    told("DetectorFlipDirections", "Vertical"), told("DetectorOrientation", "Rotate90"),
    stated("ScanTrajectory/StartAngle", lambda r: float(r.uniform(0, 90)),
           world(angles_deg=lambda a: a - ANGLES)),
    stated("ScanTrajectory/Rotation", lambda r: 200.0,
           world(angles_deg=lambda v: -v / 360.0 * ANGLES)),
]  # fmt: skip


def yxlon(folder: Path, draw: Draw) -> Path:
    tiffs(folder / "Projections", draw, "p{:05d}.tif", 0)
    groups: dict[str, list[str]] = {}
    for name, value in draw.said:
        group, _, key = name.rpartition("/")
        inner = f"<{key}>{value}</{key}>" if group else str(value)
        groups.setdefault(group or name, []).append(inner)
    inner = "".join(f"<{g}>{''.join(parts)}</{g}>" for g, parts in groups.items())
    path = folder / "ScanParameter.xml"
    path.write_text(f"<S><ConeBeamScanParameter>{inner}</ConeBeamScanParameter></S>")
    return path


# Varian.


def xim(path: Path, image: Any, said: Sequence[tuple[str, Any]]) -> None:
    """An image that is not compressed, with doubles and texts behind it."""
    rows, cols = image.shape
    out = b"VMS.XI\0\0" + struct.pack("<7i", 1, cols, rows, 32, 4, 0, 4 * image.size)
    out += image.astype("<i4").tobytes() + struct.pack("<2i", 0, len(said))
    for name, value in said:
        out += struct.pack("<i", len(name)) + name.encode()
        if isinstance(value, str):
            out += struct.pack("<2i", 2, len(value)) + value.encode()
        else:
            out += struct.pack("<id", 1, float(value))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(out)


def varian_draw(rng: np.random.Generator) -> Draw:
    draw = Draw([
        ("SAD", SOD), ("SID", SDD), ("ImagerSizeX", SHAPE[1]), ("ImagerSizeY", SHAPE[0]),
        ("ImagerResX", PITCH), ("ImagerResY", PITCH), ("ImagerLat", 0.0), ("Fan", "Full"),
        ("xim/KVDetectorLat", 0.0), ("xim/KVDetectorLng", 0.0), ("xim/PixelWidth", PITCH / 10),
        ("xim/KVKiloVolts", 100.0),
    ], columns=True)  # fmt: skip
    planted(draw, rng, ["", "xim/", "Strange/"][int(rng.integers(3))])
    return draw


def panel_aside(draw: Draw, rng: np.random.Generator) -> None:
    aside = float(rng.uniform(-6.0, 6.0))
    draw.set("xim/KVDetectorLat", aside / 10.0)
    draw.world["column"] = MIDDLE[1] + aside / PITCH
    if rng.integers(2):
        draw.named.append(("ImagerLat",))
    else:
        draw.set("ImagerLat", aside)


VARIAN: list[Change] = [
    comma("SAD", "ImagerResX"), absent("SAD", "SID", "ImagerResX", "ImagerSizeY"),
    no_number("SID", "ImagerLat"), twice("SAD", "SID"), panel_aside,
    told("xim/KVDetectorRtn", 0.4), told("xim/KVSourceVrt", 13.0), told("xim/PixelHeight", 0.3),
    told("xim/DataOffset", 20.0), told("SourceAngleOffset", 80.0),
    stated("xim/KVDetectorLng", lambda r: float(r.uniform(-0.5, 0.5)),
           world(row=lambda v: MIDDLE[0] - 10.0 * v / PITCH)),
    stated("xim/KVSourceRtn", lambda r: -ANGLES, world(angles_deg=lambda v: v)),
    stated("xim/GantryRtn", lambda r: 30.0 + ANGLES,
           world(angles_deg=lambda v: 90.0 + v)),
]  # fmt: skip


def varian(folder: Path, draw: Draw) -> Path:
    own = [(name[4:], value) for name, value in draw.said if name.startswith("xim/")]
    if not any(
        name.endswith("Rtn") and name[0] in "GK" and np.ndim(v) for name, v in own
    ):
        own.append(("KVSourceRtn", ANGLES))
    beam = folder / "Calibrations" / "Air-1" / "Filter.xim"
    xim(beam, np.full(SHAPE, 60_000), [("KVNormChamber", 500.0)])
    for k, image in enumerate(draw.images()):
        chamber = 400.0 + 10.0 * k
        each = [(name, value[k] if np.ndim(value) else value) for name, value in own]
        path = folder / "Acquisitions" / "5" / f"Proj_{k:05d}.xim"
        counts = np.rint(60_000 * chamber / 500.0 * np.exp(-image))
        xim(path, counts, [*each, ("KVNormChamber", chamber)])
    rows = []
    for name, value in draw.said:
        if not name.startswith("xim/"):
            outer, _, inner = name.rpartition("/")
            text = f"<{inner}>{value}</{inner}>"
            rows.append(f"<{outer}>{text}</{outer}>" if outer else text)
    path = folder / "Scan.xml"
    path.write_text(f"<Scan><Acquisitions>{''.join(rows)}</Acquisitions></Scan>")
    return path


# HDF5: Data Exchange and NXtomo.

LENGTHS = {
    "m": 1e-3,
    "mm": 1.0,
    "cm": 0.1,
    "Millimetres": 1.0,
    "\u00b5m": 1e3,
    "inch": 1 / 25.4,
}
"""Unit -> how many of it a millimetre is."""


def unit_of_length(*names: str) -> Change:
    def change(draw: Draw, rng: np.random.Generator) -> None:
        for name in names:
            unit = list(LENGTHS)[int(rng.integers(len(LENGTHS)))]
            draw.set(name, (draw.get(name)[0] * LENGTHS[unit], unit))

    return change


def unknown_unit(*names: str) -> Change:
    def change(draw: Draw, rng: np.random.Generator) -> None:
        name = names[int(rng.integers(len(names)))]
        draw.set(name, (draw.get(name)[0], "furlong"))
        draw.refused = ("furlong",)

    return change


def radians(name: str, lead: int) -> Change:
    def change(draw: Draw, rng: np.random.Generator) -> None:
        unit, size = (
            ("rad", np.pi / 180),
            ("mrad", 1000 * np.pi / 180),
            ("turn", 1 / 360),
        )[int(rng.integers(3))]
        values = np.r_[np.zeros(lead), ANGLES] * size
        draw.set(name, (values, unit))

    return change


def absent_h5(words: dict[str, str]) -> Change:
    def change(draw: Draw, rng: np.random.Generator) -> None:
        name = list(words)[int(rng.integers(len(words)))]
        draw.drop(name)
        draw.refused = (words[name],)

    return change


DETECTOR = "measurement/instrument/detector"


def exchange_draw(rng: np.random.Generator) -> Draw:
    draw = Draw([
        ("implements", "exchange:measurement"), ("exchange/theta", (ANGLES, "deg")),
        (f"{DETECTOR}/pixel_size_x", (PITCH, "mm")), (f"{DETECTOR}/pixel_size_y", (PITCH, "mm")),
        ("measurement/sample/name", "bone"),
    ], open={"distances": (SOD, SDD)})  # fmt: skip
    planted(draw, rng, ["", "exchange/", f"{DETECTOR}/"][int(rng.integers(3))])
    return draw


def other_exposure(draw: Draw, rng: np.random.Generator) -> None:
    factor = float(rng.choice([0.5, 2.0, 1.25]))
    flats = "process/acquisition/flat_fields"
    draw.said += [(f"{DETECTOR}/exposure_time", (0.2, "s")),
                  (f"{flats}/flat_exposure_time", (0.2 * factor, "s")),
                  (f"{flats}/different_flat_exposure", "Different")]  # fmt: skip
    draw.flat, draw.level = factor, 25_000.0


def steps_besides(draw: Draw, rng: np.random.Generator) -> None:
    draw.said.append(("process/acquisition/rotation/rotation_step", 17.0))
    draw.named.append(("rotation_step",))


def steps_alone(draw: Draw, rng: np.random.Generator) -> None:
    draw.drop("exchange/theta")
    draw.said.append(("process/acquisition/rotation/rotation_step", STEP))


EXCHANGE: list[Change] = [
    unit_of_length(f"{DETECTOR}/pixel_size_x", f"{DETECTOR}/pixel_size_y"),
    unknown_unit(f"{DETECTOR}/pixel_size_x", "exchange/theta"),
    radians("exchange/theta", 0), other_exposure, steps_besides, steps_alone,
    absent_h5({"exchange/theta": "theta", f"{DETECTOR}/pixel_size_x": "pixel_size_x"}),
    told(f"{DETECTOR}/x_pixel_size", (9.0, "mm")), told("exchange/center", 9.5),
    told(f"{DETECTOR}/rotation_center", 7.0),
    stated("exchange/theta", lambda r: (ANGLES * 0.6, "deg"),
           world(angles_deg=lambda v: v[0])),
]  # fmt: skip


def write_h5(path: Path, said: Sequence[tuple[str, Any]], images: dict[str, Any]) -> Path:
    import h5py

    with h5py.File(path, "w") as file:
        for name, values in images.items():
            file[name] = values
        for name, value in said:
            held, unit = value if isinstance(value, tuple) else (value, "")
            file[name] = held
            if unit:
                file[name].attrs["units"] = unit
    return path


def counts_of(draw: Draw, dark: float) -> tuple[Any, Any]:
    """Projections and one flat image, as counts above a dark level."""
    lines = draw.images()
    views = (draw.level * np.exp(-lines) + dark).round().astype(np.uint16)
    flat = np.full((1, *SHAPE), round(draw.level * draw.flat + dark), np.uint16)
    return views, flat


def exchange(folder: Path, draw: Draw) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    views, flat = counts_of(draw, 40.0)
    images = {"exchange/data": views, "exchange/data_white": flat,
              "exchange/data_dark": np.full((1, *SHAPE), 40, np.uint16)}  # fmt: skip
    return write_h5(folder / "scan.h5", draw.said, images)


NX = "entry/instrument/detector"


def nxtomo_draw(rng: np.random.Generator) -> Draw:
    draw = Draw([
        ("entry/definition", "NXtomo"),
        ("entry/sample/rotation_angle", (np.r_[0.0, 0.0, ANGLES], "deg")),
        (f"{NX}/x_pixel_size", (PITCH, "mm")), (f"{NX}/y_pixel_size", (PITCH, "mm")),
        (f"{NX}/distance", (SDD - SOD, "mm")), ("entry/instrument/source/distance", (-SOD, "mm")),
        ("entry/instrument/source/current", 0.2),
    ])  # fmt: skip
    planted(draw, rng, ["entry/", f"{NX}/", "entry/sample/", "entry/instrument/source/", ""][
        int(rng.integers(5))
    ])  # fmt: skip
    return draw


def twice_flat(draw: Draw, rng: np.random.Generator) -> None:
    draw.said.append((f"{NX}/count_time", (np.r_[1.0, 2.0, np.ones(VIEWS)], "s")))
    draw.flat, draw.level = 2.0, 25_000.0


def two_flips(draw: Draw, rng: np.random.Generator) -> None:
    draw.set(f"{NX}/y_flipped", True)
    draw.set(f"{NX}/transformations/ry", (0.0, "deg"))
    draw.rows = True
    draw.named.append(("transformations/ry",))


HEIGHTS = np.linspace(-1.5, 2.0, VIEWS)
NXTOMO: list[Change] = [
    unit_of_length(f"{NX}/x_pixel_size", f"{NX}/y_pixel_size", f"{NX}/distance",
                   "entry/instrument/source/distance"),
    unknown_unit(f"{NX}/x_pixel_size", f"{NX}/distance", "entry/sample/rotation_angle"),
    radians("entry/sample/rotation_angle", 2),
    absent_h5({f"{NX}/x_pixel_size": "x_pixel_size", f"{NX}/distance": "detector distance",
               "entry/sample/rotation_angle": "rotation_angle"}),
    stated(f"{NX}/y_flipped", lambda r: True, lambda d, v: setattr(d, "rows", True)),
    stated(f"{NX}/x_flipped", lambda r: 1, lambda d, v: setattr(d, "columns", True)),
    stated(f"{NX}/transformations/rz", lambda r: (180.0, "deg"),
           lambda d, v: setattr(d, "columns", True)),
    stated(f"{NX}/x_rotation_axis_pixel_position", lambda r: float(r.uniform(8, 15)),
           world(column=float)),
    stated(f"{NX}/y_rotation_axis_pixel_position", lambda r: float(r.uniform(6, 13)),
           world(row=float)),
    stated("entry/sample/z_translation", lambda r: (np.r_[0.0, 0.0, HEIGHTS], "mm"),
           world(heights=lambda v: HEIGHTS)),
    twice_flat, two_flips,
    told("entry/sample/x_translation", (np.linspace(0, 1, VIEWS + 2), "mm")),
    told(f"{NX}/transformations/ty", (3.0, "mm")), told(f"{NX}/field_of_view", "Half"),
    told(f"{NX}/rotation_angle", np.r_[0.0, 0.0, 0.5 * ANGLES], fits=False),
    told("entry/control/data", np.zeros(VIEWS + 2)),
]  # fmt: skip


def nxtomo(folder: Path, draw: Draw) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    views, flat = counts_of(draw, 40.0)
    dark = np.full((1, *SHAPE), 40, np.uint16)
    images = {f"{NX}/data": np.concatenate([dark, flat, views]),
              f"{NX}/image_key": [2, 1] + [0] * VIEWS}  # fmt: skip
    return write_h5(folder / "scan.nxs", draw.said, images)


FORMATS: dict[str, tuple[Callable[..., Draw], list[Change], Callable[..., Path]]] = {
    "Nikon": (nikon_draw, NIKON, nikon),
    "SkyScan": (skyscan_draw, SKYSCAN, skyscan),
    "phoenix": (phoenix_draw, PHOENIX, phoenix),
    "YXLON": (yxlon_draw, YXLON, yxlon),
    "Varian": (varian_draw, VARIAN, varian),
    "Data Exchange": (exchange_draw, EXCHANGE, exchange),
    "NXtomo": (nxtomo_draw, NXTOMO, nxtomo),
}
"""Format -> what draws a file, its changes, and what writes it."""


def drawn(form: str, seed: int, folder: Path) -> tuple[Path, Draw]:
    """Write a drawn file with one change or none; the first draws have every change."""
    make, changes, write = FORMATS[form]
    rng = np.random.default_rng([seed, *form.encode()])
    draw = make(rng)
    if seed < len(changes):
        changes[seed](draw, rng)
    elif rng.integers(5):
        chosen = rng.choice(len(changes), 2, replace=False)
        first = changes[int(chosen[0])]
        first(draw, rng)
        if not draw.refused and int(chosen[1]) in plain(changes):
            changes[int(chosen[1])](draw, rng)
    return write(folder, draw), draw


def plain(changes: list[Change]) -> set[int]:
    """Numbers of the changes that only add a figure to be told: these combine freely."""
    return {k for k, one in enumerate(changes) if "told" in one.__qualname__}
