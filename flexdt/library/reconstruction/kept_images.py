"""Images that are read once; those needed again are kept, in memory or on disk.

The file has no name from its first byte on (Windows deletes it when it is closed), so it
goes with the process, even after a kill.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any, Final, cast

import numpy as np

from flexdt.library.datasets.image_set import Arrays, Counts, CountsReader, ImageSet
from flexdt.message_words import reason_of
from flexdt.twin.geometry.conventions import Float32Array

ALL_ROWS: Final = slice(None)


class ImagesInMemory:
    """Images by number, in memory."""

    def __init__(self) -> None:
        self._images: dict[int, Float32Array] = {}

    def put(self, number: int, image: Float32Array) -> None:
        """Keep an image (rows, cols), in place of the one that has this number."""
        self._images[number] = image

    def get(self, number: int, rows: slice = ALL_ROWS) -> Float32Array:
        """Return rows of a kept image."""
        return self._images[number][rows]

    def close(self) -> None:
        """Drop all images."""
        self._images.clear()


class ImagesOnDisk:
    """Images by number, in a file without a name.

    Args:
        folder: of the file.
        most_pixels: of an image.

    Raises:
        OSError: the file cannot be made.
    """

    def __init__(self, folder: Path, most_pixels: int) -> None:
        """Open a temporary file in `folder`, without a buffer, for images of at most
        `most_pixels` each (float32).
        """
        self._folder = folder
        self._most_bytes = 4 * most_pixels
        self._shapes: dict[int, tuple[int, int]] = {}
        # Without a buffer: images are larger than one.
        self._file: IO[bytes] = TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115 (see close)

    def put(self, number: int, image: Float32Array) -> None:
        """Keep an image, as `ImagesInMemory.put`.

        An image kept under this number before is overwritten; other types are converted
        to float32.

        Raises:
            OSError: it cannot be written; names the folder.
        """
        left = np.ascontiguousarray(image, np.float32).reshape(-1).view(np.uint8).data
        try:
            self._file.seek(number * self._most_bytes)
            while left:
                left = left[self._file.write(left) :]
        except OSError as error:
            raise self._disk_error(error) from None
        self._shapes[number] = image.shape[0], image.shape[1]

    def get(self, number: int, rows: slice = ALL_ROWS) -> Float32Array:
        """Return rows of a kept image, as `ImagesInMemory.get`.

        Raises:
            OSError: it cannot be read; names the folder.
            KeyError: no image was kept under this number.
        """
        height, width = self._shapes[number]
        first, last, _ = rows.indices(height)
        out = np.empty((last - first, width), np.float32)
        left = out.reshape(-1).view(np.uint8).data
        try:
            self._file.seek(number * self._most_bytes + 4 * first * width)
            while left:
                count = self._read_into(left)
                left = left[count:]
        except OSError as error:
            raise self._disk_error(error) from None
        return out

    def close(self) -> None:
        """Delete the file."""
        self._file.close()

    def _read_into(self, buffer: memoryview) -> int:
        """Read bytes into a buffer, at least one, up to its size; returns how many.

        Raises OSError: the file ends too early.
        """
        count: int = self._file.readinto(buffer)  # type: ignore[attr-defined]
        if not count:
            raise OSError(5, "the file of kept images ends too early")
        return count

    def _disk_error(self, error: OSError) -> OSError:
        place = f"{self._folder} (images kept for a while)"
        return OSError(error.errno, reason_of(error), place)


class CountsOnce:
    """Counts of a data set's frames, each read once from its file.

    Args:
        read: gives the counts of a frame by its index.
    """

    def __init__(self, read: Callable[[int], Counts]) -> None:
        self._read = read
        self._looked_at: dict[int, Counts] = {}
        self._latest: dict[int, Counts] = {}

    def looked_at(self, index: int) -> Counts:
        """Return counts and hold them until they are read by index."""
        if index not in self._looked_at:
            self._looked_at[index] = self._read(index)
        return self._looked_at[index]

    def __getitem__(self, index: int) -> Counts:
        """Return counts of an image, and hold the newest two images, as a correction of
        detector lag takes the frame before.

        An image that was looked at earlier is not read again, but then forgotten.
        """
        if index not in self._latest:
            counts = self._looked_at.pop(index, None)
            newest = list(self._latest.items())[-1:]
            self._latest = {
                **dict(newest),
                index: self._read(index) if counts is None else counts,
            }
        return self._latest[index]

    def read_by(self, dataset: ImageSet) -> ImageSet:
        """Return the data set with its counts read through this object, each once.

        A data set in memory is returned as it is, and images looked at before are dropped.
        """
        held = dataset.arrays or Arrays(None)
        if held.counts is not None:  # in memory already
            self._looked_at.clear()
            return dataset
        return replace(dataset, arrays=replace(held, counts=cast(CountsReader, self)))


class KeptImages:
    """The images of a scan, each read once; a context manager.

    An image is kept as it was read until `prepared` replaces it.

    Args:
        read: gives an image (rows, cols) by its number.
        store: keeps them.
        told: called after each image that is read.
    """

    def __init__(
        self,
        read: Callable[[int], Float32Array],
        store: ImagesInMemory | ImagesOnDisk,
        told: Callable[[], None],
    ) -> None:
        """Take the function that reads an image, the store, and a function that is called after
        each reading.
        """
        self._read = read
        self._store = store
        self._told = told
        self._as_read: set[int] = set()
        self._prepared: set[int] = set()

    def image(self, number: int, *, again: bool) -> Float32Array:
        """Return an image as it was read.

        An image that was kept is not read again; after a reading the function of progress
        is called.

        Args:
            number: of the image.
            again: keep it for a further call; otherwise it is read again then.

        Raises:
            ValueError: its prepared image has replaced it.
        """
        if number in self._prepared:
            raise ValueError(
                f"image {number} is kept as prepared, no longer as it was read"
            )
        if number in self._as_read:
            return self._store.get(number)
        image = self._read(number)
        self._told()
        if again:
            self._store.put(number, image)
            self._as_read.add(number)
        return image

    def prepared(
        self, number: int, prepare: Callable[[int], Float32Array], rows: slice = ALL_ROWS
    ) -> Float32Array:
        """Return rows of a prepared image, preparing and keeping it the first time.

        `number`: of the image; `prepare`: gives it by its number; `rows`: of it.
        """
        if number in self._prepared:
            return self._store.get(number, rows)
        image = prepare(number)
        self._store.put(number, image)
        self._prepared.add(number)
        return image[rows]

    def __enter__(self) -> KeptImages:
        return self

    def __exit__(self, *_: Any) -> None:
        self._store.close()
