"""A data set's geometry in every format there is, read back, and the loss of each.

    python examples/exchange.py DATASET [OUT_DIR]

Writes the files into OUT_DIR (default: exchange) and prints one line a format: the largest
difference of any number of cone_vec [mm] and of any projected point [px]. A format that cannot
express the geometry is reported.
"""

import sys
from pathlib import Path

import numpy as np

from flexdt.library.datasets.exchange import (
    FORMATS,
    ExchangeError,
    Given,
    export_dataset,
    geometry_of,
    import_geometry,
)
from flexdt.library.reading.folders import load_dataset


def main(argv: list[str]) -> None:
    """Write a data set's geometry in every format and read it again, and print the
    differences [mm, px].

    `argv` has the data set's folder and, if given, the folder for the files. A format
    that cannot carry the geometry is named with its reason.
    """
    data = load_dataset(argv[0])
    folder = Path(argv[1] if len(argv) > 1 else "exchange")
    folder.mkdir(parents=True, exist_ok=True)
    ours, given = geometry_of(data), Given.of(data)
    ticks = np.linspace(-20.0, 20.0, 5)
    points = np.stack(np.meshgrid(ticks, ticks, ticks), axis=-1).reshape(-1, 3)
    pixels = ours.cone_vec.project_points(points, data.shape)
    print(
        f"{data.name}: {len(data)} projections of {data.shape[1]} x {data.shape[0]} pixels"
    )
    for name, format in FORMATS.items():
        if format.read is None:
            continue
        for ending in (".npy", ".txt") if name == "astra" else format.endings[:1]:
            file = folder / f"{data.name}-{name}{ending}"
            try:
                export_dataset(data, file, name)
            except ExchangeError as error:
                print(f"{name:9} cannot carry it: {error}")
                continue
            back = import_geometry(file, name, given)
            mm = np.abs(back.cone_vec.rows - ours.cone_vec.rows).max()
            px = np.abs(back.cone_vec.project_points(points, data.shape) - pixels).max()
            print(
                f"{name:9} {file.name}: {file.stat().st_size} bytes, {mm:.1e} mm, {px:.1e} px"
            )


if __name__ == "__main__":
    main(sys.argv[1:])
