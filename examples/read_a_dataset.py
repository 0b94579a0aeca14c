"""Read a data set: normalised projections, the geometry of each, and what the scanner wrote down.

Run `flexdt demo --no-viewer`, then `python examples/read_a_dataset.py flexdt-demo/data/lego-...`.
"""

from __future__ import annotations

import sys

from flexdt.clients.dataset import load_dataset


def main(folder: str) -> None:
    dataset = load_dataset(folder)
    rows, cols = dataset.shape
    print(f"{len(dataset.frames)} projections of {cols} x {rows}, complete: {dataset.complete}")

    first = dataset.line_integrals(0)
    print(f"frame 0: largest line integral {first.max():.3f}")
    print(f"frame 0: source at {dataset.cone_vec.source[0].round(3).tolist()} mm")


if __name__ == "__main__":
    main(sys.argv[1])
