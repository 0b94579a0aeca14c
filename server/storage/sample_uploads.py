"""Uploads of samples in progress.

They come in chunks, in order, are on disk without a name, and bounded in number and total
size. A client may begin uploads and never finish them, so nothing of them is held in
memory. When a bound is reached the oldest is dropped, and its sender's next chunk gets an
error about it. The files have no name, so a killed server leaves none behind.
"""

from __future__ import annotations

import logging
import threading
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Annotated, BinaryIO, Literal

from pydantic import Field, StringConstraints

from flexdt.phantoms.files.mesh_files import default_unit
from flexdt.protocol.fields import Payload
from flexdt.protocol.methods.scanner_messages import (
    LengthUnit,
    SamplePlace,
    SampleUpload,
)
from flexdt.runtime.files.directory import Directory, writing
from flexdt.runtime.log import log
from flexdt.server.storage.disk_room import DiskRoom, require_last
from flexdt.twin.dataset.dataset_errors import DatasetWriteError
from flexdt.twin.errors import LimitError

MAX_UPLOADS = 4
"""Largest number of uploads under way."""
MAX_UPLOAD_BYTES = 512 << 20


class UploadHead(SampleUpload):
    """Description of an upload: every chunk repeats it, and it is stored beside the bytes.

    Attributes:
        unit: of mesh coordinates.
        place: of a mesh; those of older servers were all centered.
        revision: names the content, in the document; those of older servers have none.
        observer: whether it came while another client had control; in the document.
    """

    schema_version: Literal[1] = Field(default=1, alias="schema")
    data: Payload = b""
    unit: LengthUnit = "mm"
    place: SamplePlace = "centred"
    revision: Annotated[str, StringConstraints(pattern="^[0-9a-f]{16}$")] | None = None
    observer: bool = False

    @classmethod
    def of(cls, chunk: SampleUpload) -> UploadHead:
        """Make the description of the upload that a chunk belongs to; a missing unit
        becomes the default of the format, and a missing place "keep".
        """
        given = chunk.model_dump(exclude={"start", "data"})
        unit = chunk.unit or default_unit(chunk.format)
        return cls.model_validate(given | {"unit": unit, "place": chunk.place or "keep"})


@dataclass(eq=False)
class Upload:
    """One upload under way: another one of the same name is another."""

    head: UploadHead
    file: BinaryIO
    received: int = 0


class Incoming:
    """All uploads under way; any thread may call.

    Args:
        folder: on whose disk they are; made with the first.
        limit: bytes of all of them together; more than the largest upload.
        room: on the disk; None for any.
    """

    def __init__(
        self, folder: Directory, limit: int, room: DiskRoom | None = None
    ) -> None:
        """Begin without uploads; all unfinished ones together may take `limit` bytes, and
        `room`.
        """
        self._folder = folder
        self._limit = limit
        self._disk = room
        self._open: dict[str, Upload] = {}
        self._lock = threading.Lock()

    def receive(self, head: UploadHead, start: int, data: bytes) -> tuple[int, Upload]:
        """Append a chunk to an upload's nameless file.

        Bytes that have come before are skipped, so a client may send a chunk again. A
        chunk at 0 of another file, or after a complete one, begins a new upload of that
        name. Uploads beyond `MAX_UPLOADS` or the byte limit drop the oldest. That a chunk
        stays within the total is checked by the caller.

        Args:
            head: description of the upload.
            start: place of the chunk [bytes].
            data: the chunk.

        Returns:
            Number of bytes received so far, and the upload that they are of.

        Raises:
            LimitError: a gap before this chunk, or the upload was dropped for newer ones.
            DiskFullError: it would leave no room for state and jobs.
            DatasetWriteError: the disk does not take it; the upload is given up.
        """
        with self._lock:
            known = self._open.get(head.name)
            if start == 0 and (
                known is None or known.head != head or known.received >= head.total
            ):
                known = self._begin(head)
            if known is None or known.head != head or start > known.received:
                if known is None or known.head != head:
                    received = 0
                else:
                    received = known.received
                raise self._gap(head.name, start, received)
            new = data[known.received - start :]
            self._make_room(head.name, len(new))
            try:
                if self._disk is not None:
                    require_last(self._disk.root.path, head.name, len(new))
                with self._writing():
                    left = memoryview(new)
                    while left:
                        left = left[known.file.write(left) :]
            except DatasetWriteError:
                self._close(head.name)
                raise
            known.received += len(new)
            return known.received, known

    def take(self, upload: Upload) -> tuple[UploadHead, bytes]:
        """Read a complete upload, and remove it and its file, even if reading fails.

        `upload`: as `receive` told it. Raises LimitError: it is not complete, as when
        another one was begun under its name; DatasetWriteError: its file cannot be read.
        """
        with self._lock:
            name = upload.head.name
            known = self._open.get(name)
            if known is not upload or known.received < known.head.total:
                raise self._gap(name, 0, 0 if known is None else known.received)
            try:
                with self._writing():
                    known.file.seek(0)
                    return known.head, known.file.read()
            finally:
                self._close(name)

    def _begin(self, head: UploadHead) -> Upload:
        """Begin an upload with a nameless file; its namesake, and the oldest uploads from
        `MAX_UPLOADS` on, are dropped.

        Raises:
            DiskFullError: no room for twice its size.
            DatasetWriteError: the folder or the file cannot be made.
        """
        self._close(head.name)
        if self._disk is not None:  # while it comes, and then under its name
            self._disk.require(f"the upload {head.name!r}", 2 * head.total)
        while len(self._open) >= MAX_UPLOADS:
            self._drop()
        self._folder.make()
        with self._writing():
            file = self._folder.nameless()
        self._open[head.name] = upload = Upload(head, file)
        return upload

    def _make_room(self, name: str, more: int) -> None:
        """Drop the oldest uploads but `name` until `more` bytes fit into the limit or no
        other is left.
        """
        while sum(o.received for o in self._open.values()) + more > self._limit:
            if all(other == name for other in self._open):
                break  # the largest upload alone always fits
            self._drop(but=name)

    def _drop(self, but: str | None = None) -> None:
        """Drop the oldest upload other than `but`, and log a warning.

        Raises:
            StopIteration: there is no such upload.
        """
        oldest = next(name for name in self._open if name != but)
        log(
            "an unfinished upload was dropped for newer ones",
            logging.WARNING,
            name=oldest,
            received=self._open[oldest].received,
        )
        self._close(oldest)

    def _close(self, name: str) -> None:
        """Forget an upload and close its nameless file, which deletes it; nothing if there
        is none.
        """
        known = self._open.pop(name, None)
        if known is not None:
            known.file.close()

    def _gap(self, name: str, start: int, received: int) -> LimitError:
        """Make, not raise, the error for a chunk at `start` where `received` is expected;
        it names the limits of unfinished uploads.
        """
        return LimitError(
            f"upload {name!r}: the chunk begins at {start}, but {received} bytes have come; "
            f"chunks come in order, from 0, and {MAX_UPLOADS} uploads and {self._limit} bytes "
            "are kept at a time: one begun before may have been dropped for newer ones",
            {"asked": start, "allowed": received},
        )

    def _writing(self) -> AbstractContextManager[None]:
        """Convert the system's errors inside the context, as `writing`."""
        path = self._folder.path
        return writing(path, f"the upload cannot be kept in {path}")
