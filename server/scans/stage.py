"""The sample on the stage, for all users of its shape: collisions, ways around them,
checks, drawings.

Convex pieces and sizes of samples follow from the phantoms and are worked out once. A guard is
made for one sample and one correction; another of either is another guard. Clients that draw
get binary STL in mm, in the sample's own frame.

A move around obstacles is free moves one after the other, found before the first one starts.
The way is planned from where the motors will rest; every leg goes through the scanner's own
guard again. Any other command to the motors ends it. The search is
`flexdt.twin.collision.obstacle_path`.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from flexdt.phantoms import Phantom
from flexdt.protocol.rpc_errors import too_large
from flexdt.server.scans.twin_clock import TwinClock
from flexdt.server.storage.stored_samples import ReceivedSample, SampleStore
from flexdt.twin.collision.collision_scene import CollisionScene, build_scene
from flexdt.twin.collision.convex_pieces import convex_pieces
from flexdt.twin.collision.convex_solids import Polytope
from flexdt.twin.collision.guard import SceneGuard
from flexdt.twin.collision.obstacle_path import free_moves
from flexdt.twin.errors import CollisionError, SafetyError, TwinError
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.motion import profiles as motion
from flexdt.twin.scanner.safety import Guard, require_ready
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.state import Sample, StagePlacement
from flexdt.twin.script.planning.plan_values import SampleSize

MAX_CACHED_SCENES = 8
MAX_BYTES: Final = 64 << 20
STL_HEADER_BYTES = 84
"""Size of binary STL before the faces [bytes]."""
STL_FACE_BYTES = 50
"""Size of each face of binary STL [bytes]."""
_Content = tuple[Sample, str | None]
"""A sample and the revision of its upload: another file may get the same name."""


class Stage:
    """Shapes of samples on the stage of a machine.

    Args:
        machine, profile: whose stage.
        samples: available samples.
    """

    def __init__(self, machine: Machine, profile: Profile, samples: SampleStore) -> None:
        """Begin with empty caches of scenes and of convex pieces."""
        self._machine = machine
        self._profile = profile
        self._samples = samples
        self._scenes: OrderedDict[tuple[_Content, Offsets], CollisionScene] = (
            OrderedDict()
        )
        self._pieces: OrderedDict[_Content, tuple[Polytope, ...]] = OrderedDict()

    def phantom(self, sample: Sample) -> Phantom | None:
        """Load the phantom of a sample; None for an empty stage.

        Raises UnknownNameError, LimitError, PhantomError: see `SampleStore.load`."""
        if sample.name:
            return self._samples.load(sample.name, sample.material)
        return None

    def revision(self, sample: Sample) -> str | None:
        """Return the revision of a sample's upload, once it has been read; None for others."""
        return self._samples.revision(sample.name)

    def pieces(
        self, sample: Sample, upload: ReceivedSample | None = None
    ) -> tuple[Polytope, ...]:
        """Compute convex pieces that contain the sample, object frame [mm]; may take a
        second.

        The pieces of the last `MAX_CACHED_SCENES` samples are remembered, but not those
        of a file that was replaced meanwhile.

        Args:
            sample: on the stage.
            upload: next upload under the sample's name; None for the present one.

        Returns:
            The pieces; empty for an empty stage or a sample without matter.
        """
        before = self._content(sample, upload)
        pieces = self._pieces.get(before)
        if pieces is None:
            if upload is None:
                phantom = self.phantom(sample)
            else:
                phantom = upload.standing
            if phantom is not None:
                pieces = _convex_pieces_of(phantom, sample.offset)
            else:
                pieces = ()
            # The revision is known once an upload has been read.
            now = self._content(sample, upload)
            if before[1] not in (None, now[1]):
                return pieces  # another file came under the name meanwhile
            self._pieces[now] = pieces
            while len(self._pieces) > MAX_CACHED_SCENES:
                self._pieces.popitem(last=False)
        return pieces

    def size(self, sample: Sample) -> SampleSize | None:
        """Compute the cylinder that contains the sample at every angle, from its shape
        where it is placed; may take a second, as `pieces`.

        Returns:
            The size; None for an empty stage. A sample without matter has the size that
            its phantom states.
        """
        phantom = self.phantom(sample)
        if phantom is None:
            return None
        source = f"sample {sample.name}"
        corners = [piece.vertices for piece in self.pieces(sample)]
        if not corners:  # a sample without matter
            return SampleSize.around(phantom.size_mm, source, sample.offset)
        return SampleSize.of_points(np.concatenate(corners), source)

    def scene(
        self,
        sample: Sample,
        parameters: Offsets = NOMINAL,
        upload: ReceivedSample | None = None,
    ) -> CollisionScene | None:
        """Build the scene of bodies that may collide, or return a remembered one.

        The last `MAX_CACHED_SCENES` scenes are remembered, by content and placement of the
        sample and by parameters.

        `sample`: on the stage; `parameters`: applied correction, which moves the bodies;
        `upload`: as for `pieces`.
        Returns the scene; None for a machine without components.
        """
        if not self._machine.components:
            return None
        pieces = self.pieces(sample, upload)
        key = (self._content(sample, upload), parameters)
        scene = self._scenes.get(key)
        if scene is None:
            scene = build_scene(self._machine, self._profile, pieces, parameters)
            self._scenes[key] = scene
            while len(self._scenes) > MAX_CACHED_SCENES:
                self._scenes.popitem(last=False)
        return scene

    def guard(
        self,
        sample: Sample,
        parameters: Offsets = NOMINAL,
        upload: ReceivedSample | None = None,
    ) -> Guard | None:
        """Create the guard that sweeps every motion; None without components."""
        scene = self.scene(sample, parameters, upload)
        if scene is None:
            return None
        return SceneGuard(scene)

    def _content(self, sample: Sample, upload: ReceivedSample | None) -> _Content:
        """Return what a cache knows a sample by: the sample, and the revision of its file."""
        return sample, upload.shown if upload else self.revision(sample)


def _convex_pieces_of(phantom: Phantom, offset: StagePlacement) -> tuple[Polytope, ...]:
    """Divide a phantom's outer mesh, placed by `offset`, into convex pieces, object frame [mm]."""
    return convex_pieces(
        phantom.mesh(around=True),
        rotation=offset.rotation,
        offset=(offset.x, offset.y, offset.z),
    )


@dataclass(frozen=True)
class Shape:
    """Mesh of a sample as binary STL, with the revision of its upload."""

    name: str
    revision: str | None
    stl: bytes


class Shapes:
    """Cache of the last requested shape."""

    def __init__(self, limit: int = MAX_BYTES) -> None:
        """Begin with an empty cache; a mesh may have `limit` bytes."""
        self._limit = limit
        self._kept: Shape | None = None

    def known(self, name: str, revision: str | None) -> Shape | None:
        """Return the last requested shape if it is this one, else None."""
        kept = self._kept
        same = kept is not None and (kept.name, kept.revision) == (name, revision)
        return kept if same else None

    def of(self, name: str, revision: str | None, phantom: Phantom) -> Shape:
        """Make the mesh of `phantom` as binary STL, or return the remembered one of that
        name and revision; may take a second.

        Only the last one is remembered.

        Raises:
            RpcError: -32008, the file would be larger than the limit.
        """
        if (kept := self.known(name, revision)) is not None:
            return kept
        mesh: Any = phantom.mesh()
        size = STL_HEADER_BYTES + STL_FACE_BYTES * len(mesh.faces)
        if size > self._limit:
            raise too_large("the sample's mesh", size, self._limit)
        self._kept = Shape(name, revision, mesh.export(file_type="stl"))
        return self._kept


@dataclass(frozen=True)
class Way:
    """A planned move: consecutive legs, total time [s], and why it is not a direct move."""

    legs: tuple[Mapping[str, float], ...]
    duration_s: float
    warnings: tuple[str, ...]


@dataclass(eq=False, repr=False)
class ObstacleMoves:
    """Plans and executes paths around obstacles, one at a time.

    Attributes:
        scanner, clock, stage: see their modules.
        changed: called when a leg has started.
    """

    scanner: ScannerTwin
    clock: TwinClock
    stage: Stage
    changed: Callable[[], None]
    _task: asyncio.Task[None] | None = None
    _commands: int = 0

    def cancel(self) -> None:
        """Stop planning and start no further leg; the present one ends."""
        self._commands += 1
        if self._task is not None:
            self._task.cancel()
            self._task = None

    async def plan(
        self,
        targets: Mapping[str, float],
        *,
        relative: bool = False,
        shortest: bool = False,
    ) -> Way:
        """Plan a free way from where the motors will rest.

        Nothing moves. The way has a warning if it goes around something.
        `targets`: axis -> target [mm, deg]; `relative`: whether targets are distances from where
        the motors will rest; `shortest`: whether a rotation may take the shorter way.
        Raises UnknownNameError, LimitError, SafetyError: as a move; CollisionError: no free way
        was found; nothing moves; SafetyError: another command came meanwhile; nothing moves.
        """
        commands = self._commands
        way = await self._find_way(targets, relative=relative, shortest=shortest)
        if commands != self._commands:
            raise SafetyError(
                "another command came while the way was being planned; nothing moves",
                {"asked": dict(targets), "allowed": "asking again"},
            )
        return way

    async def _find_way(
        self, targets: Mapping[str, float], *, relative: bool, shortest: bool
    ) -> Way:
        """Resolve targets and find moves to them that touch nothing; the search runs in a
        thread.

        Without components, or if it is free, the direct move is the way; else it has
        several legs, each of one or several axes.

        Args:
            targets: axis -> target [mm, deg].
            relative: whether targets are distances from where the motors will rest.
            shortest: whether a rotation may take the shorter way.

        Returns:
            The way; with a warning where it goes around something.

        Raises:
            SafetyError: motion is not allowed now.
            LimitError: a target beyond the travel.
            CollisionError: no free way was found; names the bodies.
        """
        scanner = self.scanner
        require_ready(scanner.safety, "motion")
        goal = scanner.resolve(
            targets, self.clock.now(), relative=relative, shortest=shortest
        )
        start = scanner.final_positions()
        scene = await asyncio.to_thread(
            self.stage.scene, scanner.sample, scanner.parameters
        )
        if scene is None:
            return self._timed_way(start, [goal])
        found, contact = await asyncio.to_thread(
            free_moves, scene, scanner.machine, start, goal, scanner.paces
        )
        if found is not None and len(found) <= 1:
            return self._timed_way(start, found)
        if contact is None:
            pair = ("?", "?")
        else:
            pair = contact.pair
        if found is None:
            raise CollisionError(
                f"no free way to {_text(goal)} was found: "
                f"{' and '.join(pair)} would collide on the direct one",
                {
                    "asked": dict(goal),
                    "pair": list(pair),
                    "last_free": {} if contact is None else dict(contact.last_free),
                    "allowed": "a target or an order of moves without contact",
                },
            )
        order = "; then ".join(_text(leg) for leg in found)
        warning = f"{' and '.join(pair)} would collide on the direct way; going {order}"
        return self._timed_way(start, found, warning)

    def go(self, way: Way) -> asyncio.Task[None]:
        """Set off; the task is done when the last leg has ended, or fails where one cannot
        go."""
        self.cancel()
        self._task = asyncio.create_task(self._follow_legs(way))
        return self._task

    async def _follow_legs(self, way: Way) -> None:
        """Wait for the motors' rest, move along the legs of a way one after the other,
        and wait for the rest after the last.

        `changed` is called when a leg has started.

        Raises:
            SafetyError: after the first leg other motion has begun or motion was stopped;
                no further leg starts.
            TwinError: a leg is refused, as a move.
        """
        scanner = self.scanner
        clock = self.clock
        own_programme: int | None = None
        """Number of the last leg's programme, to detect other motion."""
        for leg in way.legs:
            await clock.at_rest(scanner.rest_time)
            if own_programme is not None and scanner.programmes != own_programme:
                raise SafetyError(
                    "other motion has begun or motion was stopped; no further leg starts",
                    {"asked": dict(leg), "allowed": "asking again"},
                )
            scanner.move(leg, clock.now())
            own_programme = scanner.programmes
            self.changed()
        await clock.at_rest(scanner.rest_time)

    def _timed_way(
        self,
        start: Mapping[str, float],
        legs: Sequence[Mapping[str, float]],
        *warnings: str,
    ) -> Way:
        """Make the `Way` of legs from `start`, with its total time at the motors' rates.

        A leg takes as long as its slowest motor; legs follow one another.

        Args:
            start: axis -> position [mm, deg].
            legs: targets of each leg, in order.
            *warnings: for the requester.
        """
        seconds = 0.0
        here = dict(start)
        for leg in legs:
            moves = {axis: (here[axis], 0.0, value) for axis, value in leg.items()}
            ends = [
                motion.move(*m, *self.scanner.settings(a), 0.0).end
                for a, m in moves.items()
            ]
            seconds += max(ends, default=0.0)
            here.update(leg)
        return Way(tuple(legs), seconds, warnings)


async def wait_for_way(task: asyncio.Task[None]) -> list[str]:
    """Wait for the end of the task that moves along a way, and list what ended it early.

    The task is not canceled if this wait is.

    Returns one warning if it was canceled or refused a leg; [] if it arrived.
    Raises Exception: any error of the task but a TwinError.
    """
    await asyncio.wait([task])
    if task.cancelled():
        return ["another command ended the way before its last leg"]
    error = task.exception()
    if error is None:
        return []
    if isinstance(error, TwinError):
        return [error.message]
    raise error


def _text(leg: Mapping[str, float]) -> str:
    """Format targets as "axis=value, ..."."""
    return ", ".join(f"{axis}={value:g}" for axis, value in leg.items())
