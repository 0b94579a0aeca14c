"""`flexdt job watch`: a client that calibrates while a job scans beads, and ends it in
time.

Each frame is fetched over the wire as soon as it is complete and fed to the online
calibration. Once that has an estimate, the server fits the present data set as `flexdt
calibrate` does, and only that fit ends the job. It detects beads twice, with the
phantom's body subtracted, so its sigmas are smaller than the online ones, by a factor
that is much the same a few frames later. The next fit is requested when the online sigmas
times that factor meet the tolerance, and not before an eighth more frames are complete.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import PurePath
from typing import Any, Final

import numpy as np

from flexdt.clients import FINAL_STATES, JobStatus, TwinClient
from flexdt.extending import Answer, Twin, argument, assignments, note, option
from flexdt.phantoms import load_phantom, phantom_names
from flexdt.twin.calibration import SIX, bead_model, detect_beads
from flexdt.twin.calibration.fit.priors import prior_widths
from flexdt.twin.calibration.pipeline import detector_for
from flexdt.twin.errors import UnknownNameError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.description import builtin_machine, profile_of
from flexdt_extensions.online import Online, begin, feed, require_estimated

POLL_S: Final = 0.2


@dataclass(frozen=True)
class Watched:
    """Result of a watched job.

    Attributes:
        job: its last status.
        frames: number of frames evaluated.
        sigmas: of the last fit of the server, edge units; None where it offers none.
        reached: whether that fit met the tolerance, and the job was ended for it.
    """

    job: JobStatus
    frames: int
    sigmas: Mapping[str, float | None]
    reached: bool


def watch(
    client: TwinClient,
    phantom: str,
    tolerance: Mapping[str, float],
    job: str | None = None,
    *,
    free: Sequence[str] = SIX,
    priors: Mapping[str, float] | None = None,
    tell: Callable[[Online], object] = lambda state: None,
) -> Watched:
    """Follow a job's frames, and end the job once the server's calibration from them is
    accurate enough.

    The server is asked for one when the estimate of this process is identifiable, and
    then when that estimate, scaled by the last answer, promises the tolerances, after an
    eighth more frames at the earliest.

    Args:
        client: of the twin that runs it; it need not be in control.
        phantom: the scanned one; one that ships.
        tolerance: parameter -> sufficient sigma, edge units.
        job: its id; None for the current one.
        free: parameters to estimate.
        priors: as of `flexdt calibrate`; None: the machine's, or the assumed ones of a
            machine that does not ship.
        tell: called with the estimate after each frame.

    Returns:
        How the job ended, with the last sigmas.

    Raises:
        TwinError: there is no such phantom, no tolerance, or one for a parameter not
            estimated.
    """
    require_estimated(free, tolerance)
    model = bead_model(load_phantom(phantom))
    state = begin(
        model, free, priors=_machine_priors(client) if priors is None else priors
    )
    sigmas: dict[str, float | None] = {}
    due = 0
    goal = dict.fromkeys(tolerance, math.inf)
    status = client.job_status(job)
    for name, image, row in _frames(client, status.job):
        pose = Poses.from_cone_vec(ConeVec(np.array([row])))
        state = feed(state, pose, detect_beads(image, detector_for(model, pose)))
        tell(state)
        seen = len(state.detections)
        if state.fit is None or seen < due or not state.done(goal):
            continue
        fit = client.fit_calibration([name], phantom, free, priors=priors)
        sigmas = {n: p.sigma for n, p in fit.parameters.items() if n in tolerance}
        if all(
            (s := sigmas.get(n)) is not None and s <= most
            for n, most in tolerance.items()
        ):
            words = ", ".join(
                f"{n} {s:.3g} of {tolerance[n]:g}" for n, s in sigmas.items()
            )
            reason = f"sigmas reached after {seen} frames: {words}"
            return Watched(client.abort_job(status.job, reason), seen, sigmas, True)
        due = seen + 1 + seen // 8
        now = state.sigmas()
        goal = {
            n: most * now[n] / (sigmas.get(n) or now[n]) for n, most in tolerance.items()
        }
    return Watched(client.job_status(status.job), len(state.detections), sigmas, False)


def _frames(client: TwinClient, job: str) -> Iterator[tuple[str, Any, Any]]:
    """Yield the projections of a job as they are complete, until it ends; look every
    `POLL_S`.

    Of a scan of more than 2000 images, the wire has as many that are spread evenly.

    Args:
        client: of the twin.
        job: its name.

    Yields:
        Name of the data set, line integrals (rows, cols) and nominal cone_vec (12).
    """
    seen = set[int]()
    while True:
        status = client.job_status(job)
        if status.state != "queued" and status.dataset:
            name = PurePath(status.dataset).name
            plan = client.dataset(name, 2000)
            for i, kind, there in zip(
                plan.indices, plan.kinds, plan.present, strict=True
            ):
                if kind == "projection" and there and i not in seen:
                    seen.add(i)
                    image, what = client.dataset_frame(name, i, "line_integral")
                    yield name, image, what.cone_vec
        if status.state in FINAL_STATES:
            return
        time.sleep(POLL_S)


def _machine_priors(client: TwinClient) -> dict[str, float]:
    """Return the prior widths of the twin's machine with its default profile, or the
    assumed general ones for a machine that does not ship.
    """
    try:
        machine = builtin_machine(client.server.machine)
    except UnknownNameError:
        return prior_widths()
    return prior_widths(machine, profile_of(machine))


def bead_phantoms(typed: str) -> list[str]:
    """List shipped phantoms that have beads, as completions."""
    names = (name for name in phantom_names() if name.startswith(typed.lower()))
    return [name for name in names if len(load_phantom(name).beads)]


def tolerances(typed: str) -> list[str]:
    """List the parameters that a calibration estimates, each with the sign before its
    sigma, as completions; after a comma those of a further one."""
    before, comma, last = typed.rpartition(",")
    return [f"{before}{comma}{name}=" for name in SIX if name.startswith(last)]


def watch_job(
    twin: Twin,
    phantom: str = argument(..., "PHANTOM", proposes=bead_phantoms),
    job: str | None = argument(None, "[JOB]"),
    stop_when: str = option(
        ...,
        "End the job at these sigmas (mm, deg).",
        metavar="P=SIGMA,...",
        proposes=tolerances,
    ),
) -> Answer:
    """End a scan of beads once its calibration is sure enough.

    PHANTOM is what is scanned. JOB: the current one if left out. The data set stays, says why
    it ended, and calibrates as far as it goes. A job whose sigmas are not reached runs to its
    end.

    Yields:
        What was found, and the job, as document of --json, then one line.
    """
    wanted = assignments(stop_when.split(","))

    def tell(state: Online) -> None:
        now = ", ".join(f"{n} {state.sigmas().get(n, 0):.3g}" for n in wanted)
        note(f"frame {len(state.detections)}: {now}")

    with twin() as client:
        found = watch(client, phantom, wanted, job, tell=tell)
    yield {**asdict(found), "job": found.job.model_dump()}
    met = "reached" if found.reached else "not reached"
    yield f"{found.job.job}: {found.job.state}, {found.frames} frames seen; the sigmas are {met}"
