"""Drive the scanner from Python: move two axes, take a projection, print its
geometry.

Start `flexdt up` in another terminal, then run `python examples/drive_from_python.py`.
"""

from __future__ import annotations

import sys

from flexdt.clients import TwinClient
from flexdt.twin.geometry.cone_vec import ConeVec


def main(host: str = "127.0.0.1", port: int = 55000) -> None:
    """Put a sample on a twin's stage, move, and print distances, an image's figures and
    where the sample's center falls in it.
    """
    with TwinClient(host, port) as client:
        client.set_sample("normal-5")
        moved = client.move({"mag_obj": 585.0, "rot_obj": 30.0}, wait=True)
        print(f"arrived after {moved.duration_s:.2f} s of the twin's clock")

        g = client.state().geometry
        print(
            f"SOD {g.SOD_mm:.3f} mm, SDD {g.SDD_mm:.3f} mm, magnification {g.magnification:.4f}"
        )

        taken = client.projection(kind="line_integral")
        print(
            f"projection {taken.image.shape}, largest line integral {taken.image.max():.3f}"
        )

        # With the image's geometry the shadow of any point of the sample is computed.
        column, row = ConeVec(taken.cone_vec).project_points(
            [[0, 0, 0]], taken.image.shape
        )[0, 0]
        print(f"the sample's centre is at column {column:.2f}, row {row:.2f}")


if __name__ == "__main__":
    main(*sys.argv[1:2], *map(int, sys.argv[2:3]))
