"""Scripts and poses parsed, planned and swept: here when they are light, else in a worker
process.

The answer to a check comes back encoded, a plan in pieces that are each unpickled in a
moment, so that the loop's interpreter is never held for long. The limits of one check are
`MAX_CHECK_S` and `MEMORY_BYTES`; a larger one is refused with the limit.
"""

from __future__ import annotations

import asyncio
import gc
import json
import math
import pickle
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from typing import Any, Final, TypeVar, assert_never

from flexdt.protocol import Codec
from flexdt.protocol.codec import write_json, write_msgpack
from flexdt.protocol.connection import MAX_ANSWER
from flexdt.protocol.methods.job_messages import CHECK_LIMITS
from flexdt.protocol.rpc_errors import Code, RpcError, too_large
from flexdt.runtime.fair_turns import FairTurns
from flexdt.runtime.process import ServerLoop
from flexdt.runtime.workers import Workers
from flexdt.server.scans.scan_record import PoseList, ScanSource
from flexdt.twin.collision.collision_scene import build_scene
from flexdt.twin.collision.convex_solids import Polytope
from flexdt.twin.collision.obstacle_path import free_moves
from flexdt.twin.collision.plan_report import collision_check
from flexdt.twin.findings import Finding, Findings, error
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.physics.predicted_beam import Physics
from flexdt.twin.script import (
    CheckReport,
    Clearance,
    ScanPlan,
    StartState,
    dry_run,
    plan_poses,
)
from flexdt.twin.script.parse import LIGHT_BYTES, is_light
from flexdt.twin.script.planning.plan_values import SampleSize
from flexdt.twin.script.planning.sample_findings import (
    SampleForecast,
    SampleProbe,
    sample_probes,
    sample_problems,
)
from flexdt.twin.script.problems import ScriptCode

MAX_WAITING_CHECKS: Final = 64
"""Largest number of checks that wait, but for the controller's."""
MAX_PARALLEL_CHECKS: Final = 2
"""Largest number of checks in worker processes at a time; others wait."""
MAX_CHECK_S: Final = float(CHECK_LIMITS["seconds"])
MEMORY_BYTES: Final = int(CHECK_LIMITS["memory_bytes"])
MAX_PROBLEMS: Final = 1000
"""Largest number of problems listed by an error or a job's warnings; others are
counted."""
STEP_BYTES: Final = 100
"""Least size of a step in a report without its texts [bytes]."""
ANSWER_PIECE: Final = 1 << 18
"""Size of a report's portions [bytes]: 50 MB are never copied at once."""
PARTS_A_PIECE: Final = 250
"""Number of parts of a plan that are unpickled at a time."""
_T = TypeVar("_T")


@dataclass(frozen=True)
class CheckInput:
    """A scan to be checked, and the conditions of the check.

    Attributes:
        source: script or poses.
        machine, profile, start: the scanner before.
        size: of the sample the beam sees.
        pieces, parameters: bodies of the sample, and the applied correction.
        physics: model of images, for the counts of the open beam.
        clock_left_s: until the end of the twin's clock; plans do not depend on it [s].
    """

    source: ScanSource
    machine: Machine
    profile: Profile
    start: StartState
    size: SampleSize | None
    pieces: Sequence[Polytope]
    parameters: Offsets
    physics: Physics = "ideal"
    clock_left_s: float = field(default=math.inf, compare=False)

    @property
    def light(self) -> bool:
        """True if the check is too short to pay for another process: small script or few poses."""
        script = self.source.script
        if self.source.poses is None:
            return is_light(script)
        return len(self.source.poses.text) <= LIGHT_BYTES

    def report(self, bytes_at_most: int | None = None, swept: bool = True) -> CheckReport:
        """Parse, plan and check the scan, `swept` for collisions if there are components;
        blocks.

        Moves between poses then go around obstacles. `bytes_at_most`: of a swept report.
        Problems of the scan are in it. Raises RpcError: -32008, it would be larger;
        nothing is swept then.
        """
        report = self._report(bytes_at_most, swept)
        if report.plan.duration_s <= self.clock_left_s:
            return report
        said = (
            f"the scan takes {report.plan.duration_s:.6g} s, and the twin's clock ends in "
            f"{self.clock_left_s:.6g} s; a twin that is started anew begins at 0 s"
        )
        late = Findings([*report.problems, error(ScriptCode.LIMIT, said)])
        return replace(report, problems=late.by_place())

    def _report(self, bytes_at_most: int | None, swept: bool) -> CheckReport:
        """Make the report of a scan whose time is no matter; as `report`."""
        source = self.source
        machine = self.machine
        sweep: dry_run.CollisionCheck | None = None
        if swept and machine.components:
            sweep = _refusing_large(
                collision_check(self.pieces, self.parameters), bytes_at_most
            )
        if source.poses is None:
            return dry_run.check_script(
                source.script,
                machine,
                self.profile,
                start=self.start,
                sample=self.size,
                collision=sweep,
                physics=self.physics,
            )
        plan = plan_poses(
            source.poses.decoded(),
            machine,
            self.profile,
            source.exposure_ms,
            start=self.start,
            sample=self.size,
            flat=source.flat,
            route=self.free_moves if sweep else None,
        )
        return dry_run.check_plan(plan, (), sweep, physics=self.physics)

    def free_moves(
        self, start: Mapping[str, float], goal: Mapping[str, float]
    ) -> list[dict[str, float]] | None:
        """Find moves without a contact for the machine and sample of this check.

        `start`: axis -> position [mm, deg]; `goal`: axis -> target.
        Returns moves in order, each axis -> position; None if none were found.
        """
        scene = build_scene(self.machine, self.profile, self.pieces, self.parameters)
        begin = self.start
        paces = {
            axis: (begin.speeds[axis], begin.accelerations[axis]) for axis in begin.speeds
        }
        return free_moves(scene, self.machine, start, goal, paces)[0]


@dataclass(frozen=True, eq=False)
class Checked:
    """Result of a successful check: the plan with its certificate.

    Attributes:
        check_input: the checked input. Nothing else enters a plan, so a scan with an equal
            input has this plan and needs no other check.
        plan: of the scan.
        warnings: in words.
    """

    check_input: CheckInput
    plan: ScanPlan
    warnings: list[str]


class Checks:
    """Runs the checks of one server; `close` must be called at the end.

    Args:
        apart: whether long checks run in other processes.
    """

    def __init__(self, apart: bool = True) -> None:
        """Set up checks in worker processes, or (`apart` False) all in this process."""
        self._apart = apart
        self._workers = Workers(
            MAX_PARALLEL_CHECKS, MEMORY_BYTES, MAX_CHECK_S, MAX_WAITING_CHECKS
        )
        self._last: Checked | None = None
        # Light checks of many clients take turns, so that a scan always finds a worker thread.
        self._turn = FairTurns(MAX_PARALLEL_CHECKS)

    async def report(
        self, check_input: CheckInput, codec: Codec, seen: SampleForecast | None = None
    ) -> Sequence[bytes]:
        """Compute the dry-run report, encoded in portions. `check_input`: the scan and its
        conditions; `codec`: of the answer; `seen`: the pixels behind the sample on the stage.
        Raises RpcError: -32008, it is larger than an answer may be or takes too long."""
        if self._runs_here(check_input):
            return await self._threaded(lambda: _encoded(check_input, codec, seen))
        return await self._workers.ask(_encoded, _bare(check_input), codec, seen)

    async def probes(self, check_input: CheckInput) -> tuple[SampleProbe, ...]:
        """Choose the rays of a scan's projections behind which its counts are predicted.

        The scan is planned, without a sweep for collisions: a light one in a thread of this
        process, others in a worker.
        Raises RpcError: -32008, planning takes too long or too much memory."""
        if self._runs_here(check_input):
            return await self._threaded(lambda: probes_of(check_input))
        [packed] = await self._workers.ask(packed_probes, _bare(check_input))
        found: tuple[SampleProbe, ...] = pickle.loads(packed)
        return found

    async def runnable(self, check_input: CheckInput) -> Checked:
        """Parse, plan and sweep a scan, in a thread here or in a worker process, and
        return its plan if it may run.

        The last result is kept for one more request with an equal input: a job that
        begins with the position, sample and correction that it was submitted with has the
        plan checked then.

        Args:
            check_input: the scan, with everything that its check depends on.

        Returns:
            The plan and its warnings.

        Raises:
            RpcError: -32005 or -32002, it may not run; -32008, it takes too long or too
                much memory.
        """
        last = self._last
        self._last = None
        if (
            last is not None
            and last.check_input == check_input
            and last.plan.duration_s <= check_input.clock_left_s
        ):
            return last
        if self._runs_here(check_input):
            plan, warnings = await self._threaded(lambda: planned(check_input))
        else:
            said, *parts = await self._workers.ask(in_pieces, _bare(check_input))
            warnings = json.loads(said)
            one_twin = isinstance(asyncio.get_running_loop(), ServerLoop)
            if one_twin:
                # What is garbage would be kept for ever by `freeze`. This pass looks at what
                # was made since the last one alone, some milliseconds.
                gc.collect()
            plan = await asyncio.to_thread(
                _rebuilt_plan, parts, check_input.machine, check_input.profile
            )
            if one_twin:
                gc.freeze()  # a million objects that are no garbage, see `announce`
        self._last = Checked(check_input, plan, warnings)
        return self._last

    def _runs_here(self, check_input: CheckInput) -> bool:
        """Return whether to check in a thread: light scans, while no process is free."""
        return not self._apart or (check_input.light and not self._workers.ready)

    async def _threaded(self, do: Callable[[], _T]) -> _T:
        """Call `do` in a thread, after its turn among light checks, and return its value."""
        async with self._turn:
            return await asyncio.to_thread(do)

    def close(self) -> None:
        """End the processes."""
        self._workers.close()


def planned(check_input: CheckInput) -> tuple[ScanPlan, list[str]]:
    """Check a scan and return its plan and its warnings in words; blocks.

    There are at most `MAX_PROBLEMS` warnings, and then one with the number of those left out.
    Raises RpcError: -32005 or -32002, it may not run.
    """
    report = check_input.report()
    require_runnable(report)
    warnings = [p.placed_text for p in report.warnings[:MAX_PROBLEMS]]
    left = len(report.warnings) - MAX_PROBLEMS
    return report.plan, [*warnings, f"and {left} more"] if left > 0 else warnings


def in_pieces(check_input: CheckInput) -> list[bytes]:
    """Check in the worker: returns the warnings as JSON, then the plan in pieces."""
    plan, warnings = planned(check_input)
    return [json.dumps(warnings).encode(), *_pickled_pieces(plan)]


def _bare(check_input: CheckInput) -> CheckInput:
    """Return the input without the text that lists its poses, which only people read; the
    input of a script is returned unchanged.
    """
    source = check_input.source
    if source.poses is None:
        return check_input
    return replace(
        check_input,
        source=replace(source, script=b"", poses=PoseList(source.poses.text, b"")),
    )


def probes_of(check_input: CheckInput) -> tuple[SampleProbe, ...]:
    """Choose the rays of a scan's projections; none of a scan with errors. Blocks."""
    report = check_input.report(swept=False)
    return () if report.errors else sample_probes(report.plan)


def packed_probes(check_input: CheckInput) -> list[bytes]:
    """Choose the rays of a scan's projections in a worker process, pickled."""
    return [pickle.dumps(probes_of(check_input))]


def _encoded(
    check_input: CheckInput, codec: Codec, seen: SampleForecast | None = None
) -> list[bytes]:
    """Compute a dry-run report and encode it, in pieces of `ANSWER_PIECE` bytes; runs in
    a worker.

    Args:
        check_input: the scan to be checked.
        codec: of the connection that asked.
        seen: the prediction behind the sample, whose problems join a report without
            errors; None without.

    Returns:
        The pieces, in order.

    Raises:
        RpcError: -32008, the report is larger than an answer may be.
    """
    most = MAX_ANSWER[codec]
    found = check_input.report(most)
    if seen is not None and not found.errors:
        more = sample_problems(seen, found.problems)
        found = replace(found, problems=found.problems.and_also(more).by_place())
    report = found.to_dict()
    match codec:
        case Codec.JSON:
            data = write_json(report)
        case Codec.MSGPACK:
            data = write_msgpack(report)
        case _:
            assert_never(codec)
    if len(data) > most - 1000:  # room for the frame around it
        raise too_large("a report", len(data), most - 1000)
    return [data[at : at + ANSWER_PIECE] for at in range(0, len(data), ANSWER_PIECE)]


def _refusing_large(
    sweep: dry_run.CollisionCheck, most: int | None
) -> dry_run.CollisionCheck:
    """Wrap a sweep so that it refuses a plan, before the sweep, whose report would be too large.

    Without a limit the sweep is only called.

    Args:
        sweep: finds the collisions of a plan.
        most: largest size of the report [bytes]; None for no limit.

    Returns the wrapped sweep, which raises RpcError -32008 before it sweeps such a plan.
    """

    def bounded(
        plan: ScanPlan, machine: Machine, profile: Profile, size: SampleSize | None
    ) -> Clearance:
        """Sweep a plan; raise RpcError -32008 instead if the size of its report,
        estimated from the steps, is above the limit.
        """
        size_of = sum(STEP_BYTES + len(s.what) + len(s.assumed_from) for s in plan.steps)
        if most is not None and size_of > most:
            raise too_large("a report", f"more than {size_of}", most)
        return sweep(plan, machine, profile, size)

    return bounded


def require_runnable(report: CheckReport) -> None:
    """Return if the plan may run, else raise an error with the report's problems.

    The error has the problems that `_worst` selects, and of collisions the first
    `MAX_PROBLEMS` and their number.

    Args:
        report: of the scan.

    Raises:
        RpcError: -32005, errors other than collisions; -32002, collisions alone.
    """
    if report.ok:
        return
    problems = report.problems
    errors = problems.errors
    other = errors.without(ScriptCode.COLLISION)
    if other:
        first = other[0]
        more = ""
        if len(errors) > 1:
            more = f" (and {len(errors) - 1} more)"
        raise RpcError(
            Code.SCRIPT_INVALID,
            f"the script does not hold: line {first.line}: {first.message}{more}",
            [p.to_dict() for p in _worst(problems)],
        )
    if report.clearance is not None:
        hits = list(report.clearance.collisions)
    else:
        hits = []
    first_hit = hits[0]
    raise RpcError(
        Code.COLLISION,
        f"line {first_hit.line}: {' and '.join(first_hit.pair)} would collide after "
        f"{first_hit.time_s:.3f} s",
        {
            "asked": "a scan",
            "collisions": [x.to_dict() for x in hits[:MAX_PROBLEMS]],
            "collisions_in_all": len(hits),
            "problems": [p.to_dict() for p in _worst(problems)],
            "allowed": "a path without contact",
        },
    )


def _worst(problems: Findings) -> Sequence[Finding]:
    """Select as many problems as may be listed, errors before warnings, in their order."""
    if len(problems) <= MAX_PROBLEMS:
        return problems
    return problems.errors[:MAX_PROBLEMS]


# A plan in pieces ---------------------------------------------------------------------------------


def _pickled_pieces(plan: ScanPlan) -> list[bytes]:
    """Pickle a plan, without machine and profile, in pieces small enough to be read at
    once.

    Args:
        plan: of a scan.

    Returns:
        First the pickled dict of its short fields, then pickled pairs (field, "axis NAME"
        or "files N"; at most `PARTS_A_PIECE` of its parts), in order; an empty field has
        one piece.
    """
    rest = {f.name: getattr(plan, f.name) for f in fields(plan)}
    for name in ("machine", "profile"):
        del rest[name]
    axes = {f"axis {axis}": parts for axis, parts in rest.pop("trajectories").items()}
    files = {f"files {i}": group.files for i, group in enumerate(plan.groups)}
    rest["groups"] = tuple(replace(group, files=()) for group in plan.groups)
    long = (
        {name: parts for name, parts in rest.items() if isinstance(parts, tuple)}
        | axes
        | files
    )
    short = {name: value for name, value in rest.items() if name not in long}
    pieces = [
        (name, parts[at : at + PARTS_A_PIECE])
        for name, parts in long.items()
        for at in range(0, max(len(parts), 1), PARTS_A_PIECE)
    ]
    return [pickle.dumps(short), *map(pickle.dumps, pieces)]


def _rebuilt_plan(pieces: list[bytes], machine: Machine, profile: Profile) -> ScanPlan:
    """Rebuild the plan that `_pickled_pieces` pickled.

    Garbage collection is off meanwhile. It runs in a thread, so that other work runs
    between pieces.

    Args:
        pieces: of `_pickled_pieces`, all and in order.
        machine, profile: of the plan, which its pieces lack.
    """
    with _no_collection():
        short = pickle.loads(pieces[0])
        long: dict[str, list[Any]] = {}
        for piece in pieces[1:]:
            name, parts = pickle.loads(piece)
            long.setdefault(name, []).extend(parts)
        whole: dict[str, Any] = {name: tuple(parts) for name, parts in long.items()}
        axes = {name[5:]: whole.pop(name) for name in long if name.startswith("axis ")}
        files = [whole.pop(name) for name in long if name.startswith("files ")]
        groups = zip(whole.pop("groups"), files, strict=True)
        return ScanPlan(
            machine=machine,
            profile=profile,
            trajectories=axes,
            groups=tuple(replace(group, files=names) for group, names in groups),
            **short,
            **whole,
        )


@contextmanager
def _no_collection() -> Iterator[None]:
    """Disable the collector of cyclic garbage within the context; it is enabled again
    only if it was before.

    A million new objects would start it repeatedly, and each pass holds the interpreter.
    """
    on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if on:
            gc.enable()
