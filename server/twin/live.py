"""Live images of the present pose while no scan runs, and the state.

Any change requests one projection, always of the newest pose; stale ones are never
computed. While an axis moves projections flow, and the last one is the final pose's. The
state is published on every change and regularly during motion. Nothing is computed
without subscribers.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any, assert_never

import numpy as np

from flexdt.protocol import RpcError, image
from flexdt.protocol.methods.image_messages import ImageOrigin, Projection
from flexdt.protocol.state_model import ImageFlags, SamplePlacement
from flexdt.runtime.log import log
from flexdt.server.imaging.projections import TrueGeometry
from flexdt.server.imaging.radiography import Radiography, flags_of
from flexdt.server.scans.twin_clock import TwinClock
from flexdt.server.twin.hub import Hub, ImageRequest
from flexdt.twin.dataset.normalise import binned_mean
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.offsets import NOMINAL
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.physics.chain import Radiograph
from flexdt.twin.physics.exposure import ExposureSettings
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.state import NamedCorrection, Sample, TubeSettings

FRAME_INTERVAL_S = 0.04
"""Least interval between live projections [real s]."""
STATE_INTERVAL_S = 0.025
RETRY_S = 1.0


@dataclass(frozen=True)
class SavedImage:
    """An image of a running scan: its data set, its number there, and its file."""

    dataset: str
    index: int
    file: str


@dataclass(frozen=True)
class Shot:
    """The state on which a live image depends."""

    time: float
    positions: tuple[tuple[str, float], ...]
    camera: CameraSettings
    sample: Sample
    tube: TubeSettings
    correction: NamedCorrection | None
    revision: str | None = None
    """Identifies the content of an uploaded sample."""
    saved: SavedImage | None = None
    """The file that it is saved as; None of a live image."""

    @classmethod
    def of(cls, scanner: ScannerTwin, now: float, revision: str | None = None) -> Shot:
        """Read from the scanner the state at `now` [twin s] on which an image depends.

        `revision`: of an uploaded sample's content; None if unknown.
        """
        return cls(
            time=now,
            positions=tuple(sorted(scanner.positions(now).items())),
            camera=scanner.camera,
            sample=scanner.sample,
            tube=scanner.tube,
            correction=scanner.correction,
            revision=revision,
        )

    @property
    def origin(self) -> ImageOrigin:
        """Settings of an image for the wire: sample, material, offset, X-rays, tube, camera,
        correction.

        No motor positions; an empty stage is None.
        """
        sample = self.sample
        tube = self.tube
        camera = self.camera
        return ImageOrigin(
            sample=sample.name or None,
            revision=self.revision,
            material=sample.material,
            offset=SamplePlacement(**asdict(sample.offset)),
            lit=self.lit,
            kV=tube.kV,
            power_W=tube.power_W,
            mode=camera.mode,
            exposure_ms=camera.exposure_ms,
            averages=camera.averages,
            roi=camera.roi.edges,
            correction=None if self.correction is None else self.correction.name,
            **({} if self.saved is None else asdict(self.saved)),
        )

    @property
    def lit(self) -> bool:
        """True if X-rays are on and warm."""
        return self.tube.ready(self.time)

    @property
    def exposure(self) -> ExposureSettings:
        """Settings of tube (kV, W, whether it is on) and camera (exposure, averages)."""
        camera = self.camera
        tube = self.tube
        return ExposureSettings(
            tube.kV, tube.power_W, camera.exposure_ms, camera.averages, self.lit
        )

    def same_image(self, other: Shot | None) -> bool:
        """Return whether another shot has the same image: all but its time; False for None."""
        return (
            other is not None
            and self.lit == other.lit
            and replace(self, time=0.0) == replace(other, time=0.0)
        )


def image_of(
    radiograph: Radiograph,
    cone: ConeVec,
    shot: Shot,
    view: ImageRequest,
    radiography: Radiography,
    rng: np.random.Generator | None,
) -> Projection:
    """Convert an image to its wire form.

    Binned counts are rounded means; the flags are those of the unbinned image without
    noise.

    Args:
        radiograph: the image without noise.
        cone: nominal geometry plus correction, n = 1, of the unbinned image.
        shot: pose, tube and camera.
        view: kind and binning; at least one pixel is left.
        radiography: model of the images.
        rng: noise of counts; None for no noise.
    """
    integrals = radiograph.shown
    factor = min(view.binning, *integrals.shape)
    match view.kind:
        case "counts":
            counts = radiography.counts(radiograph, shot.camera, shot.exposure, rng)
            if factor > 1:
                mean = binned_mean(counts.astype(np.float32), factor)
                counts = np.rint(mean).astype(np.uint16)
            value = image.encode(counts)
        case "line_integral":
            value = image.encode(binned_mean(integrals, factor))
        case _:
            assert_never(view.kind)
    if factor > 1:
        cone = cone.binned(factor, (integrals.shape[0], integrals.shape[1]))
    return Projection(
        **value,  # type: ignore[arg-type]
        cone_vec=cone.rows[0].tolist(),
        kind=view.kind,
        time=shot.time,
        flags=flags_of(radiography, radiograph, shot.camera, shot.exposure, shot.time),
        origin=shot.origin,
    )


@dataclass(eq=False, repr=False)
class LiveView:
    """Publishes the topic `projection` while no scan runs.

    Attributes:
        scanner, clock, hub, radiography: see their modules.
        quiet: whether a scan is making the images now (then this stays silent).
        revision: names the content of an uploaded sample.
        turn: held while an image is made in a thread: the loop waits for one interpreter
            lock, not for those of a crowd.
    """

    scanner: ScannerTwin
    clock: TwinClock
    hub: Hub
    radiography: Radiography
    quiet: Callable[[], bool]
    revision: Callable[[Sample], str | None] = lambda sample: None
    turn: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(1))

    def __post_init__(self) -> None:
        """Begin without an image and without a task."""
        self._changed = asyncio.Event()
        self._last: Shot | None = None
        self._count = 0
        self._seen: tuple[Radiograph, Shot] | ImageFlags | None = None
        self._made: tuple[Radiograph, ConeVec, Shot] | None = None
        self._showing: asyncio.Task[None] | None = None

    def changed(self, *, again: bool = False) -> None:
        """Request a new image after a change; `again` publishes it even if it is the
        same.
        """
        if again:
            self._last = None
        self._changed.set()

    def now(self) -> Shot:
        """Return the shot of the present pose, settings and sample; nothing is computed."""
        scanner = self.scanner
        return Shot.of(scanner, self.clock.now(), self.revision(scanner.sample))

    async def run(self) -> None:
        """Compute and publish images after each change and during motion, one at a time;
        end only by cancellation.

        There is at most one image in `FRAME_INTERVAL_S`. An image equal to the last one
        is not made again. Nothing is computed without subscribers or while a scan runs. A
        failure is logged and tried again after `RETRY_S`.
        """
        loop = asyncio.get_running_loop()
        while True:
            await self._changed.wait()
            self._changed.clear()
            while self.hub.wanted("projection") and not self.quiet():
                begun = loop.time()
                now = self.clock.now()
                moving = self.scanner.rest_time(now) > now
                shot = self.now()
                if not shot.same_image(self._last):
                    try:
                        await self._show(shot)
                    except (TwinError, RpcError, OSError) as error:
                        log("live projection failed", logging.WARNING, reason=str(error))
                        await asyncio.sleep(RETRY_S)
                        continue
                elif not moving:
                    break
                await asyncio.sleep(max(0.0, begun + FRAME_INTERVAL_S - loop.time()))

    async def shoot(
        self, shot: Shot, *, predicted: bool = False
    ) -> tuple[Radiograph, ConeVec]:
        """Compute the image of a shot without noise, and the shot's public geometry.

        The image has the scanner's true geometry, and becomes the one that the state's flags
        judge; not so with `predicted`.

        Args:
            shot: pose, tube and camera.
            predicted: compute the image with the public geometry, and leave the state's
                flags alone.

        Returns the radiograph without noise, and one row of cone_vec, nominal plus correction.
        Raises ProjectorUnavailable: the projector does not answer; GeometryError: a geometry no
        scanner can have.
        """
        scanner = self.scanner
        poses = scanner.poses_at(dict(shot.positions), shot.camera)
        cone = scanner.corrected(poses, shot.camera, shot.correction)
        known = NOMINAL
        if shot.correction is not None:
            known = shot.correction.parameters
        images = await self.radiography.take(
            shot.sample,
            poses,
            shot.camera,
            [shot.exposure],
            truth=TrueGeometry(known) if predicted else None,
        )
        if not predicted:
            self._seen = (images[0], shot)
        return images[0], cone

    def judge(self, radiograph: Radiograph, shot: Shot) -> None:
        """Take a scan's image as the one that `seen` describes."""
        self._seen = (radiograph, shot)

    @property
    def seen(self) -> ImageFlags | None:
        """Flags of the last image, such as saturation, computed at the first access; None
        before one.
        """
        if isinstance(self._seen, tuple):  # computed at the first access
            image, shot = self._seen
            self._seen = flags_of(
                self.radiography, image, shot.camera, shot.exposure, shot.time
            )
        return self._seen

    async def _show(self, shot: Shot) -> None:
        """Compute the image of a shot, remember the shot as the last, and publish the image."""
        radiograph, cone = await self.shoot(shot)
        self._last = shot
        await self._publish(radiograph, cone, shot)

    async def _publish(self, radiograph: Radiograph, cone: ConeVec, shot: Shot) -> None:
        """Make an image in each subscribed view, in a thread, publish it, and keep it for
        the flags in the state.

        The noise depends on the number of the image alone, so all its views agree. A view
        that is subscribed meanwhile is made when it is delivered.

        Args:
            radiograph: the image without noise.
            cone: its public geometry, one row.
            shot: pose, tube and camera; gives the event's time.
        """
        self._count += 1
        count = self._count
        views = self.hub.views("projection")

        def make(view: ImageRequest) -> object:
            """Make the image of a view, with the noise of this image's number."""
            rng = np.random.default_rng([count])
            return image_of(radiograph, cone, shot, view, self.radiography, rng)

        async with self.turn:
            made = await asyncio.to_thread(lambda: {view: make(view) for view in views})
        self._seen = (radiograph, shot)
        self.hub.publish(
            "projection", lambda view: made.get(view) or make(view), time=shot.time
        )

    def publish(self, radiograph: Radiograph, cone: ConeVec, shot: Shot) -> None:
        """Publish a scan's image to the subscribers; the newest one replaces older ones."""
        self._made = (radiograph, cone, shot)
        if self._showing is None or self._showing.done():
            self._showing = asyncio.create_task(self._publish_newest())

    async def _publish_newest(self) -> None:
        """Publish the image that was handed over last, and again as long as another has
        been handed over meanwhile; older ones are skipped.
        """
        while self._made is not None:
            made = self._made
            self._made = None
            await self._publish(*made)


@dataclass(eq=False, repr=False)
class StateFeed:
    """Publishes the topic `state` on every change and regularly during motion.

    Attributes:
        scanner, clock, hub: see their modules.
        render: makes the state.
        job_runs: whether a scan controls the time.
        ready: waits a moment while the state is just being written, so that subscribers
            are not told of every write.
    """

    scanner: ScannerTwin
    clock: TwinClock
    hub: Hub
    render: Callable[[], object]
    job_runs: Callable[[], bool]
    ready: Callable[[], Awaitable[None]]
    _changed: asyncio.Event = field(default_factory=asyncio.Event)

    def changed(self) -> None:
        """Request the publication of a changed state."""
        self._changed.set()

    async def run(self, settled: Callable[[], None]) -> None:
        """Publish the state after each change, during motion, and when X-rays become
        ready; end only by cancellation.

        During motion it is published every `STATE_INTERVAL_S` of real time, and once more
        at its end.

        Args:
            settled: called when motion has ended, or X-rays have become ready.
        """
        while True:
            await self._changed.wait()
            self._changed.clear()
            await self.ready()
            self._publish()
            moved = False
            while (rest := self.scanner.rest_time(self.clock.now())) > self.clock.now():
                moved = True
                if self.job_runs():
                    await asyncio.sleep(STATE_INTERVAL_S)
                else:  # at full speed this is what lets time go on
                    end = self.clock.at(rest)
                    await asyncio.wait([end], timeout=STATE_INTERVAL_S)
                    end.cancel()
                self._publish()
            if moved:
                settled()
                await self.ready()
                self._publish()  # the end may have come between the last one and the check
            await self._wait_until_warm(settled)

    async def _wait_until_warm(self, settled: Callable[[], None]) -> None:
        """Wait until X-rays are ready, then publish the state and call `settled`; another
        change ends the wait without either.

        It returns at once if X-rays are ready or off, or while a scan runs.

        Args:
            settled: called when they are ready.
        """
        tube = self.scanner.tube
        if tube.ready_in_s(self.clock.now()) and not self.job_runs():
            ready = self.clock.at(tube.ready_at)
            change = asyncio.ensure_future(self._changed.wait())
            waits: list[asyncio.Future[Any]] = [change, ready]
            await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
            change.cancel()
            ready.cancel()
            if not self._changed.is_set():
                self._publish()
                settled()

    def _publish(self) -> None:
        """Publish the state if anybody is subscribed to it."""
        if self.hub.wanted("state"):
            self.hub.publish("state", lambda _view: self.render())
