"""The camera as a detector: each trigger takes an image at the current pose into a TIFF
file.

This process writes the files into the folder that an ophyd-async path provider names, and
announces them as stream resources. For data sets that the twin itself writes, see
`flyer`.

One image is in each file, and files are numbered. The documents follow bluesky's own
convention for image sequences (mimetype `multipart/related;type=image/tiff`, a
`template`, one frame in each chunk), so its consolidators and Tiled find the files.

After a pause or a suspension the RunEngine repeats the triggers since the last
checkpoint, without a word to the detector. An image that no document names is then
replaced.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence
from pathlib import Path, PurePath
from typing import Final
from urllib.parse import quote

import numpy as np
import numpy.typing as npt
from bluesky.protocols import StreamAsset
from event_model import StreamDatum
from ophyd_async.core import (
    AsyncStatus,
    DetectorAcquireLogic,
    DetectorDataLogic,
    DetectorTriggerLogic,
    PathProvider,
    ReadableDataProvider,
    SignalDataProvider,
    SignalR,
    SignalRW,
    StandardDetector,
    StreamableDataProvider,
    StreamResourceDataProvider,
    StreamResourceInfo,
    TriggerInfo,
    soft_signal_r_and_setter,
)

from flexdt.extending import tiff_bytes, write_whole
from flexdt_extensions.bluesky.lab_connection import (
    LabConnection,
    ReadBeforeDescribed,
    settable,
)

MIMETYPE: Final = "multipart/related;type=image/tiff"


def folder_uri(folder: PurePath) -> str:
    """Return the URI of a folder, with the slash at its end that relative names need."""
    return f"file://localhost{quote(folder.as_posix())}/"


class Announcements(StreamResourceDataProvider):
    """Announces files as they appear, and counts the emitted documents.

    The RunEngine collects documents when it reads a detector and emits them with the
    event. If it is interrupted in between, it drops them. It completes those that it
    emits, which shows here.
    """

    _last: StreamDatum | None = None

    def count(self) -> int:
        """Return the number of events whose images the emitted documents name.

        If the RunEngine has dropped the last announcement, which shows by a descriptor
        that is not filled in, the count goes back to its first event and stays there.
        """
        if self._last is not None and not self._last["descriptor"]:
            self.last_emitted = self._last["indices"]["start"]
            self._last = None
        return self.last_emitted

    async def make_stream_docs(
        self, collections_written: int, collections_per_event: int
    ) -> AsyncIterator[StreamAsset]:
        """Yield the documents of the images since the last call, after going back to a
        dropped announcement; the last stream datum is kept for `count`.
        """
        self.count()
        async for asset in super().make_stream_docs(
            collections_written, collections_per_event
        ):
            if asset[0] == "stream_datum":
                self._last = asset[1]
            yield asset


def tiff_stream(
    data_key: str,
    folder: PurePath,
    template: str,
    shape: tuple[int, int],
    written: SignalR[int],
) -> Announcements:
    """Make the provider that announces files as they appear.

    Args:
        data_key: name of the images in a plan's data.
        folder: of the files, absolute.
        template: of their names: `scan_{:06d}.tif`.
        shape: (rows, columns) of an image.
        written: counts complete files.
    """
    uri = folder_uri(folder)
    resource = StreamResourceInfo(
        data_key=data_key,
        shape=shape,
        chunk_shape=(1, *shape),
        dtype_numpy="<u2",
        parameters={"template": template, "join_method": "concat"},
        source=uri,
    )
    return Announcements(uri, [resource], MIMETYPE, written)


class Roll:
    """Where images go: a numbered file each, complete before it is counted."""

    def __init__(self) -> None:
        """Begin without a folder, template or images; written and mean are signals at 0."""
        self.folder: Path | None = None
        self.template = ""
        self.written, self._set_written = soft_signal_r_and_setter(int, 0)
        self.mean, self._set_mean = soft_signal_r_and_setter(float, 0.0)
        self.count = 0
        self.turn = asyncio.Lock()
        """Held while a trigger takes its images; an interrupted trigger continues to
        its end."""

    def load(self, folder: PurePath, filename: str) -> None:
        """Begin a new series of images: make the folder if needed, name files
        FILENAME_000000.tif and on, and count from 0.
        """
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.template = f"{filename}_{{:06d}}.tif"
        self.rewind(0)

    def rewind(self, count: int) -> None:
        """Keep that many images; the next one replaces the one after them."""
        self.count = count
        self._set_written(count)

    async def keep(self, image: npt.NDArray[np.generic]) -> None:
        """Write an image of counts as the series' next TIFF, and set the signals `mean` and
        `written`.

        Raises:
            RuntimeError: no series has begun.
        """
        if self.folder is None:
            raise RuntimeError("the camera was triggered before it was prepared")
        file = self.folder / self.template.format(self.count)
        await asyncio.to_thread(
            write_whole, file, tiff_bytes(np.asarray(image, dtype=np.uint16))
        )
        self.count += 1
        self._set_mean(float(image.mean(dtype=np.float64)))
        self._set_written(self.count)


class _Triggering(DetectorTriggerLogic):
    """Exposure and number of images."""

    def __init__(self, exposure_ms: SignalRW[float]) -> None:
        self.exposure_ms = exposure_ms
        self.images = 1

    def config_sigs(self) -> set[SignalR[float]]:
        return {self.exposure_ms}

    async def prepare_internal(self, num: int, livetime: float, deadtime: float) -> None:
        if livetime > 0:
            await self.exposure_ms.set(livetime * 1000.0)
        self.images = num

    async def default_trigger_info(self) -> TriggerInfo:
        return TriggerInfo()


class _Acquiring(DetectorAcquireLogic):
    """The task that takes the images; its failure reaches the caller of the trigger."""

    def __init__(self, link: LabConnection, triggering: _Triggering, roll: Roll) -> None:
        self.link = link
        self.triggering = triggering
        self.roll = roll

    async def start_acquiring(self) -> None:
        for _ in range(max(1, self.triggering.images)):
            taken = await self.link.client.projection("counts")
            await self.roll.keep(taken.image)

    async def wait_for_idle(self) -> None:
        pass  # `start_acquiring` returns with the last image

    async def ensure_stopped(self) -> None:
        async with self.roll.turn:
            pass


class _Files(DetectorDataLogic):
    """The images, as a stream of TIFF files."""

    def __init__(self, link: LabConnection, where: PathProvider, roll: Roll) -> None:
        """Take the connection, the provider of paths, and the counters of images."""
        self.link = link
        self.where = where
        self.roll = roll
        self.announcements: Announcements | None = None

    async def prepare_unbounded(self, datakey_name: str) -> StreamableDataProvider:
        """Choose folder and names of the next images, begin a series there, and return
        the provider of their documents.

        The images' shape is that of the camera's present region.
        """
        info = self.where(datakey_name)
        self.roll.load(info.directory_path, info.filename)
        shape = (await self.link.fresh()).camera.shape
        self.announcements = tiff_stream(
            datakey_name,
            info.directory_path,
            self.roll.template,
            shape,
            self.roll.written,
        )
        return self.announcements

    async def stop(self) -> None:
        self.announcements = None


class _Mean(DetectorDataLogic):
    """The image's mean, a number to plot."""

    datakey_suffix = "-mean"

    def __init__(self, roll: Roll) -> None:
        self.roll = roll

    async def prepare_single(self, datakey_name: str) -> ReadableDataProvider:
        self.roll.mean.set_name(datakey_name)
        return SignalDataProvider(self.roll.mean)

    def get_hinted_fields(self, datakey_name: str) -> Sequence[str]:
        return [datakey_name]


class TwinCamera(ReadBeforeDescribed, StandardDetector):
    """The camera.

    Counts come as the panel gives them: X-rays off make a dark image.

    Args:
        link: to the twin.
        where: names folder and file of each series, e.g. `StaticPathProvider`.
        name: of the device.
    """

    def __init__(self, link: LabConnection, where: PathProvider, name: str = "") -> None:
        """Make the settings as signals and join the detector's parts.

        Signals are exposure [ms], averages, mode and region ("left top right bottom").

        Args:
            link: to the twin.
            where: gives folder and names of the files.
            name: of the device.
        """
        client = link.client
        self.exposure_ms = settable(
            link,
            "camera.exposure_ms",
            float,
            lambda v: client.set_camera(exposure_ms=v),
            "ms",
        )
        self.averages = settable(
            link, "camera.averages", int, lambda v: client.set_camera(averages=v)
        )
        self.mode = settable(
            link, "camera.mode", str, lambda v: client.set_camera(mode=v)
        )
        self.roi = settable(
            link,
            "camera.roi",
            str,
            lambda v: client.set_camera(roi=_edges(v)),
            get=lambda state: " ".join(map(str, state.camera.roi)),
        )
        super().__init__(name=name)
        self._roll = roll = Roll()
        self._triggering = _Triggering(self.exposure_ms)
        self._files = _Files(link, where, roll)
        self._staging: AsyncStatus[None] | None = None
        self.add_detector_logics(
            self._triggering,
            _Acquiring(link, self._triggering, roll),
            self._files,
            _Mean(roll),
        )
        self.add_config_signals(self.averages, self.mode, self.roi)

    def stage(self) -> AsyncStatus[None]:
        """Prepare for a new run."""
        self._staging = super().stage()
        return self._staging

    @AsyncStatus.wrap
    async def trigger(self) -> None:  # type: ignore[override]
        """Take an image, once a staging or trigger that was interrupted has ended.

        Images that no document names are overwritten.
        """
        if self._staging is not None:
            await (
                self._staging
            )  # the RunEngine does not wait for it again after an interruption
        async with self._roll.turn:
            if self._files.announcements is not None:
                self._roll.rewind(
                    self._files.announcements.count() * self._triggering.images
                )
            await super().trigger()


def _edges(text: str) -> tuple[int, int, int, int]:
    """Read "LEFT TOP RIGHT BOTTOM", also with commas.

    Raises:
        ValueError: it is of another form.
    """
    words = text.replace(",", " ").split()
    try:
        left, top, right, bottom = map(int, words)
    except ValueError:
        raise ValueError(f"ROI {text!r} is not 'LEFT TOP RIGHT BOTTOM'") from None
    return left, top, right, bottom
