"""A second reader of `scan settings.txt`, written from the format's description alone.

It imports nothing of the package and takes the geometry from motors, region of interest and the
published zero offsets. Run as `python -I independent_reader.py FOLDER`: prints one JSON document
with a cone_vec row (source, detector centre, u, v; object frame; v downwards) for each projection,
once from the motors and once from the printed SOD, SDD, COR, VC and HC.
"""

import json
import math
import re
import sys
from pathlib import Path

# Profile 2023-08-21 and the axis offsets of 2026 data; the sample's reference height.
DET_TAN, SRC_ORT, AXS_TAN, C_OBJ, C_DET, HEIGHT = (
    24.1215,
    -6.2917,
    -0.5405,
    14.9192,
    40.0008,
    20.0,
)
PITCH, MIDDLE_COLUMN, MIDDLE_ROW = 0.0748, 971, 767


def read(folder):
    values = {}
    for line in (Path(folder) / "scan settings.txt").read_text().splitlines():
        match = re.match(r"\s*([^:=]+?)\s*[:=]\s*([^;]*)", line)
        if match:
            values.setdefault(match[1].lower(), match[2].strip())
    return values


def turned(x, y, phi):
    """World (x, y) in the frame of an object turned clockwise from above by phi."""
    return x * math.cos(phi) - y * math.sin(phi), x * math.sin(phi) + y * math.cos(phi)


def row(source, axis, detector, pixel, phi):
    out = []
    for p in (source, detector):
        x, y = turned(p[0] - axis[0], p[1] - axis[1], phi)
        out += [x, y, p[2] - axis[2]]
    ux, uy = turned(pixel, 0.0, phi)
    return [*out, ux, uy, 0.0, 0.0, 0.0, -pixel]


def main(folder):
    v = read(folder)
    number = lambda key: float(v[key])  # noqa: E731
    left, top, right, bottom = (int(w) for w in re.findall(r"\d+", v["roi (ltrb)"]))
    pixel = number("binned pixel size")
    cols = (right - left + 1) * PITCH / pixel
    rows = (bottom - top + 1) * PITCH / pixel
    source = (number("tra_tube"), 0.0, number("ver_tube") + SRC_ORT)
    axis = (number("tra_obj") + AXS_TAN, number("mag_obj") + C_OBJ, HEIGHT)
    detector = (
        number("tra_det") + DET_TAN + ((left + right) // 2 - MIDDLE_COLUMN) * PITCH,
        number("mag_det") + C_DET,
        number("ver_det") - ((top + bottom) // 2 - MIDDLE_ROW) * PITCH,
    )
    sod, sdd = number("sod"), number("sdd")
    hc, vc, cor = number("hc") - 0.5, number("vc") - 0.5, number("cor") - 0.5
    printed_axis = (source[0] + (cor - hc) * pixel * sod / sdd, sod, HEIGHT)
    printed_detector = (
        source[0] + ((cols - 1) / 2 - hc) * pixel,
        sdd,
        source[2] - ((rows - 1) / 2 - vc) * pixel,
    )
    n = int(v["# projections"])
    angles = [math.radians(i * 360.0 / (n - 1)) for i in range(n)]
    document = {
        "motors": [row(source, axis, detector, pixel, a) for a in angles],
        "printed": [
            row(source, printed_axis, printed_detector, pixel, a) for a in angles
        ],
        "shape": [round(rows), round(cols)],
        "voxel_um": number("voxel size"),
        "magnification": number("magnification"),
        "imported": sorted(
            m for m in sys.modules if m.split(".")[0] in ("flexdt", "numpy")
        ),
    }
    print(json.dumps(document))


if __name__ == "__main__":
    main(sys.argv[1])
