"""script.*, trajectory.* and job.*: scans."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Final, Literal

from annotated_types import Ge, Le, Len, MaxLen, MinLen
from pydantic import FailFast, Field, model_validator

from flexdt.protocol import fields as f
from flexdt.protocol.codec import Codec
from flexdt.protocol.connection import MAX_ANSWER
from flexdt.protocol.method import Method, command, read
from flexdt.protocol.state_model import JobStatus

Moments = Annotated[
    int,
    Ge(1),
    Le(64),
    Field(description="moments averaged within the exposure of an image taken in motion"),
    f.Integral,
]

Seed = Annotated[
    int | None,
    Field(ge=0, le=2**63 - 1, description="of the noise; made up if left out"),
    f.Integral,
]

ScriptText = Annotated[str, MaxLen(8 * 2**20)]
CHECK_LIMITS: Final[Mapping[str, float]] = {
    "seconds": 120,
    "memory_bytes": 4 << 30,
    "report_bytes_json": MAX_ANSWER[Codec.JSON],
    "report_bytes_msgpack": MAX_ANSWER[Codec.MSGPACK],
}
"""Limits of parsing, planning and sweeping a script or poses: time [s], memory and report
[bytes]."""


class ScriptInput(f.Params):
    """An Acquila script, as text or (byte for byte) as base64."""

    text: ScriptText | None = None
    data_base64: ScriptText | None = None
    name: f.Name | None = None
    """name of the data set; made up if left out"""
    speed_up: f.SpeedUp | None = None
    """for this job; the clock's if left out"""
    motion_samples: Moments = 1
    seed: Seed = None

    @model_validator(mode="after")
    def _one(self) -> ScriptInput:
        """Check that exactly one of text and data_base64 is given."""
        if (self.text is None) == (self.data_base64 is None):
            raise ValueError("give either text or data_base64")
        return self


class TrajectoryInput(f.Params):
    """Poses to go through, one image each (thesis 4.6.2)."""

    poses: Annotated[list[f.Targets], FailFast(), MinLen(1), MaxLen(200_000)]
    """each: axis -> value [mm or deg]; axes left out stay"""
    exposure_ms: f.Exposure | None = None
    flat: bool | f.Targets = True
    """the flat image: at a place beside the beam that the server finds (true), at this pose, or
    not at all (false)"""
    name: f.Name | None = None
    speed_up: f.SpeedUp | None = None
    motion_samples: Moments = 1
    seed: Seed = None


class JobRef(f.Params):
    """Which job; the current or last one if left out."""

    job: Annotated[f.ShortText, Len(1, 120)] | None = None


class JobAbort(JobRef):
    """Which job, and why it ends."""

    reason: Annotated[
        f.ShortText | None,
        Field(description="is written into the data set; none says aborted"),
    ] = None


class JobForget(f.Params):
    """Which ended jobs to forget: one, or all that ended so long ago."""

    job: Annotated[f.ShortText, Len(1, 120)] | None = None
    """that has ended"""
    days: Annotated[float, Ge(0), Le(1e6)] | None = None
    """instead: all jobs that ended at least so many days ago; 0: all that have ended"""

    @model_validator(mode="after")
    def _one(self) -> JobForget:
        """Check that exactly one of job and days is given."""
        if (self.job is None) == (self.days is None):
            raise ValueError("give either job or days")
        return self


class JobList(f.Part):
    """Which jobs to list; all without parameters."""


class JobForgetResult(f.Result):
    """The jobs that are not known any more; their data sets stay."""

    jobs: list[str]


class Problem(f.Result):
    """Something about a script, with its place."""

    severity: Literal["error", "warning"]
    code: str
    line: int | None = None
    column: int | None = None
    message: str


class CheckStep(f.Result):
    """A step of the plan."""

    line: int | None = None
    start_s: float
    duration_s: float
    what: str


class CheckCollision(f.Result):
    """A contact that the plan would run into."""

    line: int | None = None
    time_s: float
    pair: list[str]
    last_free: dict[str, float]


class CheckResult(f.Result):
    """The dry-run report: the same document as `flexdt check --json`."""

    ok: bool
    problems: list[Problem]
    steps: list[CheckStep]
    duration_s: float
    frames: int
    bytes: int
    collisions: list[CheckCollision] = Field(default_factory=list)
    min_clearance_mm: float | None = None
    """of parts in relative motion"""
    min_clearance_pair: list[str] | None = None
    """the two parts that come so close"""


class SubmitResult(f.Result):
    """The job that was made."""

    job: str
    dataset: str | None = None
    warnings: list[str] = Field(default_factory=list)


class JobListResult(f.Result):
    """Jobs, oldest first."""

    jobs: list[JobStatus]
    total: int | None = None
    """jobs that there are; null from an earlier server"""


SCRIPT_CHECK = read(
    "script.check",
    ScriptInput,
    CheckResult,
    "parse, plan and check a script",
    limits=CHECK_LIMITS,
    bulky=True,
)
SCRIPT_SUBMIT = command(
    "script.submit",
    ScriptInput,
    SubmitResult,
    "run a script as a job",
    limits=CHECK_LIMITS,
    bulky=True,
)
TRAJECTORY_CHECK = read(
    "trajectory.check",
    TrajectoryInput,
    CheckResult,
    "plan and check poses",
    limits=CHECK_LIMITS,
    bulky=True,
)
TRAJECTORY_SUBMIT = command(
    "trajectory.submit",
    TrajectoryInput,
    SubmitResult,
    "run poses as a job",
    limits=CHECK_LIMITS,
    bulky=True,
)
JOB_STATUS = read("job.status", JobRef, JobStatus, "how far a job is")
JOB_PAUSE = command(
    "job.pause", JobRef, JobStatus, "pause a job; a frame under exposure is taken again"
)
JOB_RESUME = command(
    "job.resume", JobRef, JobStatus, "return to the pose of the pause and go on"
)
JOB_STEP = command("job.step", JobRef, JobStatus, "run a paused job for one step")
JOB_ABORT = Method(
    "job.abort", JobAbort, JobStatus, "end a job, its data set incomplete", urgent=True
)
JOB_LIST = read(
    "job.list", JobList, JobListResult, "all jobs or a part of them, oldest first"
)
JOB_FORGET = command(
    "job.forget", JobForget, JobForgetResult, "forget ended jobs; data sets stay"
)
