"""Writes one data set: images, the scanner's texts, the script, flexdt.json.

Each file appears only when complete. Until `finish` the data set is marked incomplete, so
a killed server leaves a folder that states its condition. Existing images are recognized,
so a scan can be resumed. `put` may be called from several threads. A name with folders,
an image of another shape or type than the scan's, and finishing while an image is missing
are errors.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Collection
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt
import tifffile

from flexdt.runtime.files.dataset_folder import put_texts, read_document, tiff_bytes
from flexdt.runtime.files.directory import Directory, Write, free_bytes, write_some
from flexdt.server.storage.disk_room import RESERVE_BYTES, require_last
from flexdt.twin.dataset import dataset_errors as ds
from flexdt.twin.dataset.file_names import DOCUMENT, SCRIPT, plain_name
from flexdt.twin.dataset.flexdt_json import DatasetDocument, ScanRecord

INTERRUPTED: Final = "the scan has not finished"
"""Reason for which an unfinished data set is incomplete."""


class DatasetWriter:
    """One data set being written.

    Args:
        root: the data directory; nothing outside it is ever written.
        record: the scan about to run; its name names the folder.
        script: the script byte for byte, or None.
        resume: go on with a folder that holds the same scan; without it such a folder is
            an error.
        sync, write: see `Directory`.

    Raises:
        DatasetNameError: the record's name or a file's is not plain.
        DatasetExistsError: the folder holds a data set already, or another one than to be
            resumed.
        DiskFullError: the missing images would not fit.
        DatasetWriteError: the folder cannot be written.
    """

    def __init__(
        self,
        root: Directory,
        record: ScanRecord,
        *,
        script: bytes | None = None,
        resume: bool = False,
        sync: bool = True,
        write: Write = write_some,
    ) -> None:
        """Make the data set's folder, or (`resume`) go on in it, and write script and
        texts.

        The data set is marked incomplete. The folder's descriptor is held until `close`;
        after an error it is released.

        Args:
            root: the data directory.
            record: the scan; its name names the folder.
            script: byte for byte; None for none.
            resume: allow a folder with files of the same scan (compared if it has
                `flexdt.json`, whose start and correction `record` takes over); its
                unfinished files are removed.
            sync, write: see `Directory`.

        Raises:
            DatasetError: a name that is not plain, files in the folder (or of another
                scan), or a full disk.
        """
        for file in record.files:
            plain_name(file)
        self.record = replace(record, complete=False, reason=record.reason or INTERRUPTED)
        self._files = root.folder(
            plain_name(record.name, "data set"), sync=sync, write=write
        )
        self._files.make()
        self._files.held()
        self.folder = self._files.path
        self._lock = threading.Lock()
        self._shapes = {
            file: block.camera.shape for block in record.blocks for file in block.files
        }
        try:
            self._present = self._prepare_folder(resume)
            self._check_room()
            if script is not None:
                self._files.put(SCRIPT, script)
            put_texts(self._files, self.record)
        except BaseException:
            self._files.close()
            raise

    @property
    def present(self) -> frozenset[str]:
        """Names of the complete images in the folder."""
        with self._lock:
            return frozenset(self._present)

    @property
    def missing(self) -> tuple[str, ...]:
        """Names of the missing images, in the order taken, each once."""
        present = self.present
        return tuple(dict.fromkeys(f for f in self.record.files if f not in present))

    def put(self, name: str, image: npt.NDArray[np.uint16]) -> None:
        """Write one image as a TIFF file, atomically, and count it as present.

        An image of that name is replaced.

        Args:
            name: its file name; one of the record's.
            image: uint16 (rows, cols).

        Raises:
            DatasetNameError: the name is not plain.
            DatasetWriteError: not an image of this scan, or the system cannot write.
            DiskFullError: no room; nothing of the file is left behind.
        """
        plain_name(name)
        expected = self._shapes.get(name)
        if expected is None:
            raise ds.DatasetWriteError(
                f"{name} is no image of scan {self.record.name}", {"asked": name}
            )
        if image.shape != expected or image.dtype != np.uint16:
            found = f"{image.dtype} of shape {image.shape}"
            raise ds.DatasetWriteError.instead(
                f"{name}: image is {found}", found, f"uint16 of shape {expected}"
            )
        data = tiff_bytes(image)
        require_last(self.folder, name, len(data))
        self._files.put(name, data)
        with self._lock:
            self._present.add(name)

    def finish(self, *, duration_s: float | None = None) -> None:
        """Mark the data set complete, once all images are safe on the disk.

        `duration_s`: of the scan as it ran [s]; None: as planned. Raises
        DatasetMissingError: an image is not there; DatasetWriteError.
        """
        missing = self.missing
        if missing:
            raise ds.DatasetMissingError(
                f"{self.folder}: {len(missing)} "
                f"of {len(self.record.files)} images are missing: {summary(missing)}",
                {"path": str(self.folder), "missing": list(missing[:100])},
            )
        self._write_end(True, "", duration_s)

    def mark_incomplete(self, reason: str, *, duration_s: float | None = None) -> None:
        """Write into all texts why it ended early."""
        self._write_end(False, reason, duration_s)

    def close(self) -> None:
        """Close the folder; the data set stays as it is marked."""
        self._files.close()

    def _prepare_folder(self, resume: bool) -> set[str]:
        """Check that the folder is empty or holds this scan, and remove unfinished files from
        it.

        Of an image only the header is read. With a document, `record` takes over its start and
        correction.

        `resume`: whether the folder may have files.
        Returns names of the images that are complete.
        Raises DatasetExistsError: it has files and the scan is not resumed, or those of another
        scan.
        """
        names = self._files.names()
        if names and not resume:
            raise ds.DatasetExistsError(
                f"{self.folder} holds {len(names)} files already; allowed: another name, or resume",
                {"path": str(self.folder), "files": len(names)},
            )
        if DOCUMENT in names:
            self._check_same()
        self._files.sweep()
        found = names & set(self.record.files)
        return {name for name in found if self._is_complete_image(name)}

    def _is_complete_image(self, name: str) -> bool:
        """Return whether the file holds an image of 16-bit pixels, of the planned shape,
        and with all bytes that its header claims.

        Only the header is read. False if it cannot be read.
        """
        try:
            with self._files.open(name) as file, tifffile.TiffFile(file) as tiff:
                page = tiff.pages[0]
                ends = zip(page.dataoffsets, page.databytecounts, strict=True)
                return (
                    tuple(page.shape) == self._shapes[name]
                    and page.dtype == np.uint16
                    and os.fstat(file.fileno()).st_size
                    >= max((o + n for o, n in ends), default=0)
                )
        except (OSError, tifffile.TiffFileError, IndexError, ValueError):
            return False

    def _check_same(self) -> None:
        """Check that the folder holds this scan, and take over its start and its
        correction in `record`.

        Frames, machine, profile and noise must be equal.

        Raises:
            DatasetExistsError: its document cannot be read, or is of another scan; names
                the first difference.
        """
        path = self.folder / DOCUMENT
        try:
            found = read_document(self._files)
        except (ds.DatasetError, OSError) as error:
            raise ds.DatasetExistsError(
                f"{path} cannot be read, so the scan cannot be resumed: {error}",
                {"path": str(path)},
            ) from None
        ours = DatasetDocument.of(self.record)
        for what, a, b in (
            ("frames", found.frames, ours.frames),
            ("machine", found.machine, ours.machine),
            ("profile", found.profile, ours.profile),
            ("noise", found.noise, ours.noise),
        ):
            if a != b:
                raise ds.DatasetExistsError(
                    f"{self.folder} holds another scan (its {what} differ); allowed: another name",
                    {"path": str(self.folder), "differs": what},
                )
        # The scan began then, and with that correction in force.
        self.record = replace(
            self.record, started=found.started, correction=found.correction_in_force()
        )

    def _check_room(self) -> None:
        """Check that the missing images (2 bytes a pixel) and `RESERVE_BYTES` fit on the
        disk.

        Nothing is checked where free space is unknown.

        Raises:
            DiskFullError: they do not fit.
        """
        missing = self.missing
        need = (
            sum(2 * self._shapes[f][0] * self._shapes[f][1] for f in missing)
            + RESERVE_BYTES
        )
        free = free_bytes(self.folder)
        if free is not None and free < need:
            raise ds.DiskFullError(
                f"{self.folder}: {len(missing)} images need {need} bytes, {free} bytes are free",
                {"path": str(self.folder), "bytes": need, "free": free},
            )

    def _write_end(self, complete: bool, reason: str, duration_s: float | None) -> None:
        """Write the texts with the end of the scan, after the images are safe on the
        disk.

        Both are on the disk when this returns; `record` has the end.

        Args:
            complete: whether all images are there.
            reason: why they are not, else "".
            duration_s: of the scan as it ran [s]; None keeps the record's.
        """
        if duration_s is None:
            length = self.record.duration_s
        else:
            length = duration_s
        self._files.sync()  # no power cut leaves a complete data set without its images
        self.record = replace(
            self.record, complete=complete, reason=reason, duration_s=length
        )
        put_texts(self._files, self.record)
        self._files.sync()


def summary(names: Collection[str]) -> str:
    """List the first five names and the number of others."""
    first = list(names)[:5]
    more = len(names) - len(first)
    return ", ".join(first) + (f" and {more} more" if more else "")
