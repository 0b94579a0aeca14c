"""Geometry from data sets of the data directory: `calibration.fit` and `calibration.align`.

The work is that of `flexdt.calibrate` and `flexdt.align`, in a worker process with limits
on time and memory; one runs at a time, and it ends when its client has gone.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from flexdt.phantoms import is_shipped, load_phantom, load_phantom_file
from flexdt.protocol.methods import calibration_messages as p
from flexdt.runtime.files.dataset_folder import read_text
from flexdt.runtime.files.directory import Directory
from flexdt.runtime.wire_errors import from_root
from flexdt.twin.dataset.dataset_errors import DatasetMissingError
from flexdt.twin.dataset.file_names import plain_name

MAX_SECONDS: Final = float(p.FIT_LIMITS["seconds"])
MAX_MEMORY_BYTES: Final = int(p.FIT_LIMITS["memory_bytes"])
PHANTOM_SUFFIXES: Final = (".toml", ".json")


def fit(root: Directory, asked: p.CalibrationFit, *_: object) -> p.CalibrationFitResult:
    """Calibrate from data sets for `calibration.fit`; blocks, for a worker process.

    Args:
        root: the data directory, against which names of data sets and phantom files are
            resolved.
        asked: parameters of `calibration.fit`. The phantom is a shipped name, a file with
            one of `PHANTOM_SUFFIXES`, or `UNKNOWN`.

    Returns:
        The calibration's document; with a fit also the covariance by step and, where
        requested, residuals [px] (None for a bead that was not used); bead tracks where
        requested. Paths are relative to the data directory.

    Raises:
        TwinError: there is no such data set or phantom, or nothing can be fitted.
    """
    # Here, as only workers fit: the server's own process loads nothing of it.
    from flexdt.library.analysis import calibrate
    from flexdt.library.calibration.bead_tracks import tracks_document
    from flexdt.library.calibration.calibration_options import ON_THE_WIRE
    from flexdt.twin.calibration.fit.fit import covariance_by_step
    from flexdt.twin.calibration.unknown_markers import UNKNOWN

    phantom: Any = asked.phantom
    if not is_shipped(phantom) and Path(phantom).suffix in PHANTOM_SUFFIXES:
        phantom = load_phantom_file(_text(root, phantom), phantom)
    elif phantom != UNKNOWN and not is_shipped(phantom):
        load_phantom(phantom)  # the error lists the names
    options: Any = {name: getattr(asked, name) for name in ON_THE_WIRE}
    if asked.markers is not None:
        marks = [(m.frame, m.marker, m.column, m.row, m.sigma) for m in asked.markers]
        options["markers"] = marks
    found = calibrate(
        [_dataset_path(root, name) for name in asked.datasets],
        phantom,
        **options,
    )
    document = dict(found.document)
    fitted = found.calibration.fit
    if fitted is not None:
        if asked.residuals:
            c = fitted.certificate
            document["residuals_px"] = [
                [bead if used else None for bead, used in zip(frame, some, strict=True)]
                for frame, some in zip(
                    c.residuals_px.tolist(), c.used.tolist(), strict=True
                )
            ]
        document["steps"] = [
            {"frames": n, "covariance": None if matrix is None else matrix.tolist()}
            for n, matrix in covariance_by_step(fitted, asked.steps)
        ]
    if asked.tracks:
        document["tracks"] = tracks_document(found)
    return p.CalibrationFitResult.model_validate(from_root(document, root.path))


def align(
    root: Directory, asked: p.CalibrationAlign, *_: object
) -> p.CalibrationAlignResult:
    """Align a data set for `calibration.align`; blocks, for a worker process.

    Paths are relative to `root`. Raises TwinError: no such data set, or nothing to align.
    """
    from flexdt.library.analysis import align as align_data_set

    found = align_data_set(_dataset_path(root, asked.name), per_frame=asked.per_frame)
    return p.CalibrationAlignResult.model_validate(from_root(found.document, root.path))


def _dataset_path(root: Directory, name: str) -> Path:
    """Return the path of a data set's folder.

    Raises DatasetMissingError: there is no such folder; DatasetNameError: the name is no plain
    file name.
    """
    if not root.is_directory(plain_name(name, "data set")):
        raise DatasetMissingError(
            f"no data set {name!r} in the data directory", {"asked": name}
        )
    return root.path / name


def _text(root: Directory, name: str) -> str:
    """Read the text of a phantom file of the data directory.

    Raises DatasetMissingError: there is no such file; DatasetNameError: the name is no plain
    file name.
    """
    if plain_name(name, "phantom") not in root.names():
        raise DatasetMissingError(
            f"no phantom {name!r} in the data directory", {"asked": name}
        )
    return read_text(root.path / name)
