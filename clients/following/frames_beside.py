"""The newest real frame of a folder with the twin's radiograph of the mirrored machine.

The machine's positions and camera are those when the frame appeared; the profile's
offsets and the phantom on the stage are the session's. The distance of the two images
comes from the peak of their cross-correlation, whitened (phase correlation; Kuglin and
Hines 1975).
"""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flexdt.library.datasets.pictures import png
from flexdt.phantoms import Phantom
from flexdt.phantoms.channels import line_integrals as projected
from flexdt.runtime.files.dataset_folder import list_folder, mean_image, read_image
from flexdt.runtime.files.whole_files import write_whole
from flexdt.twin.dataset.normalise import LineIntegrals
from flexdt.twin.following.follower import Follower
from flexdt.twin.following.mirror import Mirror
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.machine.kinematics import motor_poses


def newest_frame(folder: Path) -> tuple[Path, float] | None:
    """Find the TIFF that was written last, and when [s since the epoch].

    Dark ("di...") and flat ("io...") images are skipped, and so are files deleted
    meanwhile.
    """
    found = []
    for path in folder.glob("*.tif*"):
        with suppress(OSError):  # it has gone meanwhile
            if not path.name.startswith(("di", "io")):
                found.append((path.stat().st_mtime, path))
    written, newest = max(found, default=(0.0, None))
    if newest is None:
        return None
    return (newest, written)


@dataclass(frozen=True)
class FramesBeside:
    """Writes `beside.png` (real, virtual) and `beside.json` into a folder.

    Args:
        follower: its machine and profile.
        phantom: on the stage.
        out: folder to write to.
    """

    follower: Follower
    phantom: Phantom
    out: Path

    def write(self, path: Path, mirror: Mirror, age_s: float) -> dict[str, object]:
        """Write one frame with its radiograph, side by side.

        The frame is to the left; beside.png and beside.json are replaced each time. `out`
        is made if it is missing. Columns and rows of the shift are those of the real
        image relative to the virtual one [px]. Dense parts are dark in the picture.

        Args:
            path: of the frame.
            mirror: the machine when it appeared.
            age_s: of the frame [s].

        Returns:
            The content of `beside.json`: file, age, white level and shift of the two
            images, for one.

        Raises:
            TwinError: no readable image, or of another shape than the camera's.
        """
        shape = mirror.camera.shape
        real, white = line_integrals(path, shape)
        machine = self.follower.machine
        profile = self.follower.profile
        poses = motor_poses(machine, profile, mirror.camera, mirror.positions)
        virtual = projected(self.phantom, poses.cone_vec(), shape)[0]
        columns, rows = shift(virtual, real)
        told = {
            "file": path.name,
            "age_s": round(age_s, 3),
            "positions": mirror.positions,
            "assumed": list(mirror.assumed),
            "white": white,
            "shift_px": {"columns": columns, "rows": rows},
        }
        picture = png(np.concatenate([real, virtual], axis=1), dark_is_dense=True)
        self.out.mkdir(parents=True, exist_ok=True)
        for name, data in (
            ("png", picture),
            ("json", json.dumps(told, indent=2).encode()),
        ):
            write_whole(self.out / f"beside.{name}", data)
        return told


def line_integrals(path: Path, shape: tuple[int, int]) -> tuple[Float32Array, str]:
    """Convert a frame to line integrals (rows, cols) of `shape`, with a description of the white
    level.

    The means of the folder's dark and flat images are used if it has both; otherwise dark is 0
    and white is the frame's 99.5 % percentile.

    Returns the line integrals, and a description of the white level.
    Raises TwinError: no readable image, or of another shape.
    """
    counts = read_image(path, shape).astype(np.float32)
    folder = list_folder(path.parent)
    dark = np.zeros_like(counts)
    white = np.full_like(counts, np.percentile(counts, 99.5))
    what = "99.5 % of the frame"
    if folder.darks and folder.flats:
        dark = mean_image(folder.paths(folder.darks), shape)
        white = mean_image(folder.paths(folder.flats), shape)
        what = "dark and flat of the folder"
    return LineIntegrals.of(dark, white)(counts), what


def shift(virtual: Float32Array, real: Float32Array) -> tuple[float, float]:
    """Measure the shift of the real image against the virtual one [px], (columns, rows).

    The peak of the phase correlation, to parts of a pixel; positive means that the real
    image lies at higher columns or rows. Both images have the same shape.

    Example:
        >>> image = np.zeros((32, 48), np.float32)
        >>> image[10:20, 15:25] = 1.0
        >>> columns, rows = shift(image, np.roll(image, (2, -3), axis=(0, 1)))
        >>> round(columns, 1), round(rows, 1)
        (-3.0, 2.0)"""
    import cv2

    (columns, rows), _ = cv2.phaseCorrelate(
        virtual.astype(np.float64), real.astype(np.float64)
    )
    return float(columns), float(rows)
