"""Scan files as other programs write them: layouts of public files, and what hands make of them.

A second witness of the readers, from public files and pages alone: it shares no table, no writer
and no formula with them or with `drawn_scans`. A file is text, JSON or a tree of HDF5; rivals are
what happens to it between programs: encodings, ends of lines, order, comments, units, locales,
kinds of texts and numbers, keys that lack or stand twice, figures that are none.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

VIEWS, ROWS, COLUMNS = 6, 10, 14
PLANTED = "unknown_thing"
Rng = np.random.Generator


@dataclass
class Layout:
    """A maker's file.

    Attributes:
        file: its name, and that of each image, by number.
        text: as the maker writes it.
        level: counts of the open beam.
        truth: source to axis and to panel, pitch [mm]; column and row of the central ray's foot
            from the first pixel's centre; degrees from view to view, without sign.
        needed: keys without which nothing is known.
        figures: keys of numbers of the geometry.
        section: after which a line may be added.
    """

    file: str
    images: Callable[[int], str]
    text: str
    level: float
    truth: tuple[float, float, float, float, float, float]
    needed: tuple[str, ...]
    figures: tuple[str, ...]
    section: str
    open: dict[str, Any] = field(default_factory=dict)


NIKON = Layout(
    "part.xtekct", lambda k: f"part_{k + 1:04d}.tif",
    """[XTekCT]
Name=part
VoxelsX=14
VoxelSizeX=0.049751
Scaling=1000.0
InputSeparator=_
OutputSeparator=_
InputFolderName=
OutputFolderName=
OperatorID=
SrcToObject=183.25
SrcToDetector=735.5
MaskRadius=7.0
DetectorPixelsX=14
DetectorPixelsY=10
DetectorPixelSizeX=0.25
DetectorPixelSizeY=0.25
DetectorOffsetX=0.0
DetectorOffsetY=0.0
CentreOfRotationTop=0.0
CentreOfRotationBottom=0.0
Units=mm
OutputUnits=/m
WhiteLevel=60000.0
Scattering=0.0
CoefX4=0.0
CoefX3=0.0
CoefX2=0.0
CoefX1=1.0
CoefX0=0.0
Scale=1.0
Projections=6
InitialAngle=0.0
AngularStep=60.0
FilterType=0
CutOffFrequency=3.937008
Shuttling=False
AutomaticCentreOfRotation=1
AutomaticCentreOfRotationOffsetZ1=0
[Xrays]
XraykV=216.5
XrayuA=229
[CTPro]
Filter_ThicknessMM=1.0
Filter_Material=Copper
""", 60_000.0, (183.25, 735.5, 0.25, 6.5, 4.5, 60.0),
    ("SrcToObject", "SrcToDetector", "DetectorPixelSizeX", "AngularStep", "Projections",
     "WhiteLevel", "DetectorPixelsX"),
    ("SrcToObject", "SrcToDetector", "DetectorPixelSizeX", "AngularStep", "WhiteLevel"),
    "[XTekCT]",
)  # fmt: skip

SKYSCAN = Layout(
    "bone~00.log", lambda k: f"bone~00{k:08d}.tif",
    r"""[System]
Scanner=SkyScan1275
Instrument S/N=001
Software Version=1.0.16
Home Directory=C:\SkyScan1275
Source Type=Hamamatsu L11871
Camera Type=DEXELA1512
Camera Pixel Size (um)=275.0
Camera X/Y Ratio=1.0000
[User]
User Name=SkyScan
Computer Name=SCAN1275_001
[Acquisition]
Data Directory=D:\Results\bone
Filename Prefix=bone~00
Number Of Files=  6
Number Of Rows=   10
Number Of Columns=   14
Filename Index Length=8
Partial Width=OFF
Camera binning=1x1
Image Rotation=0.00000
Optical Axis (line)=   3
Object to Source (mm)=24.755
Camera to Source (mm)=286.25
Source Voltage (kV)=  80
Source Current (uA)= 124
Image Pixel Size (um)=23.78200873
Image Format=TIFF
Depth (bits)=16
Reference Intensity=58000
Exposure (ms)=57
Rotation Step (deg)=60.000
Use 360 Rotation=YES
Scanning position=13.965 mm
Frame Averaging=ON (4)
Random Movement=OFF (30)
Flat Field Correction=ON
FF updating interval=120
Filter=Al 1mm
Gantry direction=CC
Rotation Direction=CC
Scanning Start Angle=0.000
Type of Detector Motion=STEP AND SHOOT
Scanning Trajectory=ROUND
Number Of Horizontal Offset Positions=1
Number of connected scans=1
Study Date and Time=22 Sep 2017  06h:56m:05s
[Reconstruction]
Reconstruction Program=NRecon
Program Version=Version: 1.7.1.2
""", 58_000.0, (24.755, 286.25, 0.275, 6.5, 6.0, 60.0),
    ("Object to Source (mm)", "Camera to Source (mm)", "Rotation Step (deg)",
     "Number Of Files", "Number Of Rows"),
    ("Object to Source (mm)", "Camera to Source (mm)", "Rotation Step (deg)",
     "Image Pixel Size (um)", "Reference Intensity"),
    "[Acquisition]",
)  # fmt: skip

PHOENIX = Layout(
    "nano.pca", lambda k: f"nano_{k + 1:04d}.tif",
    """[General]
Version=2.8.2.20099
SystemName=v|tome|x m

[Geometry]
FDD=399.999
FOD=66.5
Magnification=6.01502256
VoxelSizeX=0.0625
VoxelSizeY=0.0625
CalibValue=0.000
cx=6.5
cy=4.5
DetectorRot=0.00000000
Tilt=0.00000000

[CT]
Type=0
NumberImages=6
RotationSector=360.00000000
NoRotation=0
NrImgDone=5
FreeRayFactor=1.00000000

[Trajectory]
Active=0

[CalibValue]
NumberImages=18
Averaging=2
Skip=3

[Image]
Top=0
DimX=14
DimY=10
Rotation=0
MirrorX=0
MirrorY=0
BitPP=16
FreeRay=34010

[Xray]
Name=xs|240 d
Voltage=200
Filter=0.1Cu

[CNC_0]
LoadPos=-149.993687
AcqPos=0.000000
""", 34_010.0, (66.5, 399.999, 0.0625 * 399.999 / 66.5, 6.5, 4.5, 60.0),
    ("FDD", "FOD", "VoxelSizeX", "FreeRay", "DimX"),
    ("FDD", "FOD", "VoxelSizeX", "RotationSector", "FreeRay"),
    "[Geometry]",
)  # fmt: skip

YXLON = Layout(
    "ScanParameter.xml", lambda k: f"Projections/p{k:05d}.tif",
    """<?xml version="1.0" encoding="utf-8"?>
<ScanParameter xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance">
  <ConeBeamScanParameter>
    <PixelSize>
      <Width>0.125</Width>
      <Height>0.125</Height>
    </PixelSize>
    <ProjectionSize>
      <Width>14</Width>
      <Height>10</Height>
    </ProjectionSize>
    <ProjectionBitdepth>16</ProjectionBitdepth>
    <DetectorOrientation>Original</DetectorOrientation>
    <DetectorFlipDirections>None</DetectorFlipDirections>
    <ScanTrajectory xsi:type="CircleTrajectory">
      <PixelPitch>0.5</PixelPitch>
      <Fdd>2000.5</Fdd>
      <Fod>400.25</Fod>
      <NumberOfProjections>6</NumberOfProjections>
      <StartAngle>0</StartAngle>
      <Rotation>360</Rotation>
      <YoCenter>0</YoCenter>
    </ScanTrajectory>
  </ConeBeamScanParameter>
</ScanParameter>
""", 65_535.0, (200.125, 1000.25, 0.125, 6.5, 4.5, 60.0),
    ("Fdd", "Fod", "NumberOfProjections"), ("Fdd", "Fod", "Rotation"),
    "<ConeBeamScanParameter>",
)  # fmt: skip
LAYOUTS = {"Nikon": NIKON, "SkyScan": SKYSCAN, "phoenix": PHOENIX, "YXLON": YXLON}


def scene(folder: Path, layout: Layout, raw: bytes) -> Path:
    """Write a file with its images, which are an even attenuation of a half."""
    for k in range(VIEWS):
        path = folder / layout.images(k)
        path.parent.mkdir(parents=True, exist_ok=True)
        tifffile.imwrite(
            path, np.full((ROWS, COLUMNS), round(layout.level / 2), np.uint16)
        )
    path = folder / layout.file
    path.write_bytes(raw)
    return path


def values_of(layout: Layout, key: str) -> list[re.Match[str]]:
    """Places of a key's value: of a line KEY=VALUE, or of an element."""
    name = re.escape(key)
    lines = rf"(?m)^({name}\s*=\s*)([^\n]*)$"
    element = rf"(<{name}>)([^<]*)(?=</{name}>)"
    return list(
        re.finditer(element if layout.text.startswith("<?xml") else lines, layout.text)
    )


def with_value(layout: Layout, key: str, change: Callable[[str], str]) -> str:
    """The text with the first value of a key changed."""
    found = values_of(layout, key)[0]
    text = layout.text
    return text[: found.start(2)] + change(found[2].strip()) + text[found.end(2) :]


def line_of(layout: Layout, key: str, value: str) -> str:
    if layout.text.startswith("<?xml"):
        return f"<{key}>{value}</{key}>"
    return f"{key}={value}"


def beside(layout: Layout, key: str, value: str) -> str:
    """The text with another statement of a key behind the first one."""
    found = values_of(layout, key)[0]
    end = layout.text.index("\n", found.end(2))
    line = line_of(layout, key, value)
    return f"{layout.text[:end]}\n{line}{layout.text[end:]}"


def planted(layout: Layout, text: str) -> str:
    end = text.index(layout.section) + len(layout.section)
    return f"{text[:end]}\n{line_of(layout, PLANTED, '7.25')}{text[end:]}"


def shuffled(text: str, rng: Rng) -> str:
    """Lines of each section in another order; of XML none."""
    if text.startswith("<?xml"):
        return text
    parts = re.split(r"(?m)(^\[[^\]]*\]\n)", text)
    for i, part in enumerate(parts):
        if part and not part.startswith("["):
            lines = part.splitlines(keepends=True)
            parts[i] = "".join(lines[k] for k in rng.permutation(len(lines)))
    return "".join(parts)


def every_number(layout: Layout, change: Callable[[str], str]) -> str:
    """All values that are numbers with a point, changed."""
    pattern = r"(?<=>)-?\d+\.\d+(?=<)|(?m:(?<==)\s*-?\d+\.\d+$)"
    return re.sub(pattern, lambda found: change(found[0]), layout.text)


def commented(layout: Layout) -> str:
    if layout.text.startswith("<?xml"):
        return layout.text.replace("<PixelSize>", "<!-- of 2019 --><PixelSize>", 1)
    return "# Begin of log file ####\n" + layout.text.replace(
        layout.section, f"{layout.section}\n; Sample: M\u00fcller\n", 1
    )


def cased(layout: Layout) -> str:
    if layout.text.startswith("<?xml"):
        return layout.text
    return re.sub(r"(?m)^([^\[=]+)=", lambda found: found[1].upper() + "=", layout.text)


def coded(text: str, name: str) -> bytes:
    """The text in an encoding, which XML names in its first line."""
    return text.replace('encoding="utf-8"', f'encoding="{name}"').encode(name)


SAME: dict[str, Callable[[Layout, Rng], bytes]] = {
    "as it is": lambda one, _: one.text.encode(),
    "CRLF": lambda one, _: one.text.replace("\n", "\r\n").encode(),
    "CR alone": lambda one, _: one.text.replace("\n", "\r").encode(),
    "byte order mark": lambda one, _: b"\xef\xbb\xbf" + one.text.encode(),
    "UTF-16": lambda one, _: coded(one.text, "utf-16"),
    "Latin-1": lambda one, _: coded(commented(one), "latin-1"),
    "comments": lambda one, _: commented(one).encode(),
    "order": lambda one, rng: shuffled(one.text, rng).encode(),
    "capitals": lambda one, _: cased(one).encode(),
    "blanks": lambda one, _: re.sub(r"(?m)^([^\[<=]+)=(.*)$", r"  \1 = \t\2  ", one.text).encode(),
    "empty lines": lambda one, _: one.text[:40].encode()
    + one.text[40:].replace("\n", "\n\n").encode(),
    "no end of line": lambda one, _: one.text.rstrip("\n").encode(),
    "end of file of DOS": lambda one, _: one.text.encode() + b"\x1a",
    "zeros at the end": lambda one, _: one.text.encode() + bytes(9),
    "decimal commas": lambda one, _: every_number(one, lambda v: v.replace(".", ",")).encode(),
    "exponents": lambda one, _: every_number(one, lambda v: f"{float(v):.9E}").encode(),
    "plus signs": lambda one, _: every_number(one, lambda v: f"+{v.strip()}").encode(),
    "more digits": lambda one, _: every_number(one, lambda v: f"{v}0000").encode(),
}  # fmt: skip
"""What programs and hands do to a text without changing what it says."""


OTHER: dict[str, Callable[[Layout, str], str]] = {
    "lacks": lambda one, key: one.text.replace(values_of(one, key)[0][0], "", 1)
    if not one.text.startswith("<?xml")
    else re.sub(rf"<{key}>[^<]*</{key}>", "", one.text),
    "empty": lambda one, key: with_value(one, key, lambda _: ""),
    "twice": lambda one, key: beside(one, key, "31.5"),
    "words": lambda one, key: with_value(one, key, lambda _: "see notebook"),
    "thousands": lambda one, key: with_value(one, key, lambda v: f"1,{int(float(v)) % 1000:03d}"),
    "both signs": lambda one, key: with_value(one, key, lambda _: "1.234,5"),
    "unit": lambda one, key: with_value(one, key, lambda v: f"{float(v) / 10:g} cm"),
    "percent": lambda one, key: with_value(one, key, lambda v: f"{v}%"),
    "range": lambda one, key: with_value(one, key, lambda v: f"{v}..{v}"),
    "infinite": lambda one, key: with_value(one, key, lambda _: "1e999"),
    "negative": lambda one, key: with_value(one, key, lambda v: f"-{v}"),
    "zero": lambda one, key: with_value(one, key, lambda _: "0"),
}  # fmt: skip
"""What changes or hides a figure: it must be refused or told with its name."""


def seen(rows: Any, shape: tuple[int, int]) -> tuple[float, ...]:
    """What a circle's rows of cone_vec say, by the panel's normal: source to axis and panel, pitch,
    column and row at which the source looks at the panel squarely, degrees from view to view."""
    found = []
    for row in rows:
        source, panel, u, v = row.reshape(4, 3)
        normal = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
        far = (panel - source) @ normal
        foot = source + far * normal - panel
        found.append([
            np.hypot(*source[:2]), abs(far), np.linalg.norm(u),
            foot @ u / (u @ u) + (shape[1] - 1) / 2, foot @ v / (v @ v) + (shape[0] - 1) / 2,
        ])  # fmt: skip
    turn = np.unwrap(np.arctan2(rows[:, 1], rows[:, 0]))
    step = np.degrees(np.abs(np.diff(turn)))
    assert np.ptp(found, axis=0).max() < 1e-6
    assert np.ptp(step) < 1e-6
    return (*np.mean(found, axis=0).tolist(), float(step.mean()))


# Geometry files.


def rtk_by_its_page(numbers: dict[str, float]) -> Any:
    """The projection matrix of RTK's page on its geometry."""
    names = ("Gantry", "OutOfPlane", "InPlane")
    a, o, i = (-np.radians(numbers.get(f"{name}Angle", 0.0)) for name in names)
    about_z = np.array([[np.cos(i), -np.sin(i), 0], [np.sin(i), np.cos(i), 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, np.cos(o), -np.sin(o)], [0, np.sin(o), np.cos(o)]])
    about_y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    turn = np.eye(4)
    turn[:3, :3] = about_z @ about_x @ about_y
    sid, sdd = (numbers[f"SourceTo{end}Distance"] for end in ("Isocenter", "Detector"))
    sx, sy = (numbers.get(f"SourceOffset{axis}", 0.0) for axis in "XY")
    px, py = (numbers.get(f"ProjectionOffset{axis}", 0.0) for axis in "XY")
    shift = np.array([[1.0, 0, sx - px], [0, 1, sy - py], [0, 0, 1]])
    scale = np.array([[-sdd, 0, 0, 0], [0, -sdd, 0, 0], [0, 0, 1, -sid]])
    place = np.eye(4)
    place[:2, 3] = -sx, -sy
    return shift @ scale @ place @ turn


def rtk_text(
    views: list[dict[str, float]], common: dict[str, float], planted: str
) -> str:
    """As RTK's writer: what all views share stands once, defaults not at all."""
    head = "".join(f"  <{k}>{v:.15g}</{k}>\n" for k, v in common.items())
    body = ""
    for view in views:
        inner = "".join(f"    <{k}>{v:.15g}</{k}>\n" for k, v in view.items())
        rows = rtk_by_its_page(common | view)
        matrix = "\n".join(" ".join(f"{x:20.15g}" for x in row) for row in rows)
        body += f"  <Projection>\n{inner}    <Matrix>\n{matrix}\n    </Matrix>\n  </Projection>\n"
    return (
        f'<?xml version="1.0"?>\n<!DOCTYPE RTKGEOMETRY>\n<RTKThreeDCircularGeometry version="3">\n'
        f"{head}{planted}{body}</RTKThreeDCircularGeometry>\n"
    )


def with_planted(document: Any, where: tuple[Any, ...]) -> str:
    made = json.loads(json.dumps(document))
    inner = made
    for key in where:
        inner = inner[key]
    inner[PLANTED] = 7.25
    return json.dumps(made)


# HDF5: NXtomo by its application definition, Data Exchange by its reference.

SOD, SDD, PITCH, STEP = 300.5, 900.25, 0.125, 60.0


@dataclass
class Tree:
    """Values of an HDF5 file.

    Attributes:
        entry, detector: names of groups, which are free.
        length, angle: unit and how many of it a millimetre, or a degree, is.
        text: how texts are stored.
        unit: how the text of a unit is stored.
        shape: of a single number.
        number: type of numbers.
        image: type of images, and arguments of `create_dataset`.
        more: further values, by place.
        without: places that are left out.
    """

    entry: str = "entry"
    detector: str = "detector"
    length: tuple[str, float] = ("m", 1e-3)
    angle: tuple[str, float] = ("degree", 1.0)
    text: Callable[[str], Any] = str
    unit: Callable[[str], Any] = str
    shape: tuple[int, ...] = ()
    number: str = "<f8"
    image: tuple[str, dict[str, Any]] = ("<u2", {})
    more: dict[str, Any] = field(default_factory=dict)
    without: tuple[str, ...] = ()


TREES: dict[str, Tree] = {
    "as it is": Tree(),
    "other names": Tree(entry="entry0000", detector="pco_edge"),
    "micrometres": Tree(length=("um", 1e3)),
    "millimetres": Tree(length=("mm", 1.0)),
    "centimetres": Tree(length=("cm", 0.1)),
    "radians": Tree(angle=("rad", np.pi / 180)),
    "deg": Tree(angle=("deg", 1.0)),
    "texts of bytes": Tree(text=lambda t: np.bytes_(t)),
    "texts in arrays": Tree(text=lambda t: np.array([t.encode()])),
    "units of bytes": Tree(unit=lambda t: np.bytes_(t)),
    "units in arrays": Tree(unit=lambda t: np.array([t.encode()])),
    "numbers in arrays": Tree(shape=(1,)),
    "numbers in grids": Tree(shape=(1, 1)),
    "float32": Tree(number="<f4"),
    "big-endian": Tree(number=">f8", image=(">u2", {})),
    "uint32": Tree(image=("<u4", {})),
    "compressed": Tree(image=("<u2", {"chunks": (1, ROWS, COLUMNS), "compression": "gzip"})),
    "shuffled": Tree(image=("<u2", {"chunks": (2, 5, 7), "shuffle": True, "fletcher32": True})),
}  # fmt: skip
"""What programs do to a file of HDF5 without changing what it says."""


def put(
    file: Any, tree: Tree, place: str, value: Any, unit: tuple[str, float] | None
) -> None:
    """Write a value, in a unit if it has one."""
    if place.rpartition("/")[2] in tree.without:
        return
    if isinstance(value, str):
        file[place] = tree.text(value)
        return
    size = np.asarray(value, np.float64) * (1.0 if unit is None else unit[1])
    if not size.shape:
        size = np.full(tree.shape, size)
    file[place] = size.astype(tree.number)
    if unit is not None:
        file[place].attrs["units"] = tree.unit(unit[0])


def nxtomo_tree(path: Path, tree: Tree) -> Path:
    """A scan by the application definition NXtomo, distances from the sample."""
    import h5py

    kind, options = tree.image
    counts = np.concatenate([np.full((1, ROWS, COLUMNS), 100), np.full((1, ROWS, COLUMNS), 60_100),
                             np.full((VIEWS, ROWS, COLUMNS), 30_100)]).astype(kind)  # fmt: skip
    entry = tree.entry
    at = f"{entry}/instrument/{tree.detector}"
    with h5py.File(path, "w") as file:
        file.create_dataset(f"{at}/data", data=counts, **options)
        file[f"{at}/image_key"] = np.array([2, 1] + [0] * VIEWS, np.int32)
        put(file, tree, f"{entry}/definition", "NXtomo", None)
        put(file, tree, f"{entry}/title", "of others", None)
        turn = np.r_[0.0, 0.0, STEP * np.arange(VIEWS)]
        put(file, tree, f"{entry}/sample/rotation_angle", turn, tree.angle)
        put(file, tree, f"{entry}/sample/name", "bone", None)
        put(file, tree, f"{at}/x_pixel_size", PITCH, tree.length)
        put(file, tree, f"{at}/y_pixel_size", PITCH, tree.length)
        put(file, tree, f"{at}/distance", SDD - SOD, tree.length)
        put(file, tree, f"{entry}/instrument/source/distance", -SOD, tree.length)
        put(file, tree, f"{entry}/instrument/source/probe", "x-ray", None)
        file[f"{entry}/data/data"] = h5py.SoftLink(f"/{at}/data")
        for place, value in tree.more.items():
            file[place.format(entry=entry, detector=at)] = value
    return path


def exchange_tree(path: Path, tree: Tree) -> Path:
    """A scan by Data Exchange's reference, with distances as cone beams have them."""
    import h5py

    kind, options = tree.image
    at = "measurement/instrument"
    with h5py.File(path, "w") as file:
        views = np.full((VIEWS, ROWS, COLUMNS), 30_100, kind)
        file.create_dataset("exchange/data", data=views, **options)
        file["exchange/data_white"] = np.full((2, ROWS, COLUMNS), 60_100, kind)
        file["exchange/data_dark"] = np.full((2, ROWS, COLUMNS), 100, kind)
        put(file, tree, "exchange/theta", STEP * np.arange(VIEWS), tree.angle)
        put(file, tree, "implements", "measurement:exchange", None)
        put(file, tree, f"{at}/detector/pixel_size_x", PITCH, tree.length)
        put(file, tree, f"{at}/detector/pixel_size_y", PITCH, tree.length)
        put(file, tree, f"{at}/detector/distance", SDD - SOD, tree.length)
        put(file, tree, f"{at}/source/distance", SOD, tree.length)
        put(file, tree, f"{at}/detector/manufacturer", "PCO", None)
        for place, value in tree.more.items():
            file[place.format(entry="exchange", detector=f"{at}/detector")] = value
    return path


HDF5 = {"NXtomo": (nxtomo_tree, "s.nxs"), "Data Exchange": (exchange_tree, "s.h5")}
"""Format -> writer, and name of the file."""
NEEDED = {
    "NXtomo": ("rotation_angle", "x_pixel_size", "distance"),
    "Data Exchange": ("theta", "pixel_size_x", "distance"),
}
