"""CTSimU scenarios beside images that BAM published, and by the evaluations that `ctsimu` ships.

    python tests/studies/ctsimu_scenarios.py published CHECKOUT

`published` simulates the examples of a checkout of github.com/BAMresearch/ctsimu-scenarios and
compares every projection with the one that aRTist made of it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import tifffile

from flexdt.clients.scenario import ScenarioImages
from flexdt.twin.errors import TwinError


def published(checkout: Path) -> None:
    """Differences in grey values, of about 50 000 in the open beam."""
    for path in sorted(checkout.glob("examples/*/*.json")):
        try:
            images = ScenarioImages(path)
        except TwinError as error:
            print(f"{path.stem:32s} refused: {str(error).partition(': ')[2]}")
            continue
        difference, most = [], 0.0
        for i, ours in enumerate(images.projections()):
            theirs = tifffile.imread(path.parent / "projections" / f"{path.stem}_{i:04d}.tif")
            difference.append(ours.astype(np.float64) - theirs)
            most = max(most, float(theirs.max()))
        found = np.array(difference)
        print(f"{path.stem:32s} {len(found)} images, at most {most:.0f}: rms "
              f"{np.sqrt((found**2).mean()):.1f}, mean {found.mean():+.1f}, worst pixel "
              f"{np.abs(found).max():.0f}")  # fmt: skip


STUDIES: dict[str, Callable[[Path], None]] = {"published": published}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("study", choices=STUDIES)
    parser.add_argument("folder", type=Path)
    given = parser.parse_args()
    STUDIES[given.study](given.folder)
