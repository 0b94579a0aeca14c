"""Read a data set: its size, normalized projections, and the geometry of each.

Run `flexdt demo --no-viewer`, then `python examples/read_a_dataset.py
flexdt-demo/data/lego-...`.
"""

from __future__ import annotations

import sys

import flexdt as fx


def main(folder: str) -> None:
    """Open a data set's folder, and print its size, the first frame's largest line
    integral and source position.
    """
    dataset = fx.open(folder)
    rows, cols = dataset.shape
    print(f"{len(dataset)} projections of {cols} x {rows}, complete: {dataset.complete}")

    first = dataset.line_integrals(0)
    print(f"frame 0: largest line integral {first.max():.3f}")
    print(f"frame 0: source at {dataset.geometry.source[0].round(3).tolist()} mm")


if __name__ == "__main__":
    main(sys.argv[1])
