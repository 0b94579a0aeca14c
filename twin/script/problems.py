"""Problems of a script: their codes, a collector, and the error that raises them.

Every reader of a script collects problems and continues, so that all are reported at
once. `ScriptError` carries them for callers that need a correct script.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Final

from pydantic import GetCoreSchemaHandler, GetPydanticSchema
from pydantic_core import core_schema as s

from flexdt.twin.errors import TwinError
from flexdt.twin.findings import (
    ERROR,
    WARNING,
    Finding,
    FindingCode,
    Findings,
    Place,
    Severity,
    error,
    warning,
)

ENTIRE = Place()
"""The place of a problem that no line has alone."""


class ScriptCode(FindingCode):
    """Codes of the problems of scripts, executed scripts and lists of poses."""

    SYNTAX = "syntax", ERROR, "a line that does not read"
    VALUE = "value", ERROR, "an argument that does not read"
    WAIT = "wait", ERROR, "a wait that does not exist, or that the command lacks"
    TRIGGER = "trigger", ERROR, "a wait for a trigger position that is missing"
    UNKNOWN_COMMAND = "unknown_command", ERROR, "a command that the component lacks"
    UNKNOWN_COMPONENT = "unknown_component", ERROR, "a component that the scanner lacks"
    EXECUTED_LOG = "executed_log", ERROR, "an executed script in place of one to run"
    ROI = "roi", ERROR, "a region that the detector lacks"
    MODE = "mode", ERROR, "a mode that the camera lacks"
    LIMIT = "limit", ERROR, "a setting or target beyond its limits"
    UNREACHABLE_TRIGGER = (
        "unreachable_trigger",
        ERROR,
        "a move that never passes its trigger",
    )
    XRAY_NEVER_READY = "xray_never_ready", ERROR, "a wait for X-rays that are off"
    NOTHING_TO_SAVE = "nothing_to_save", ERROR, "an image that was never taken is saved"
    PATH = "path", ERROR, "a path without the name of a file"
    COLLISION = "collision", ERROR, "parts touch on the way"
    LIMIT_CLAMPED = (
        "limit_clamped",
        WARNING,
        "a target beyond its limit is set to the limit",
    )
    FRAMES_UNSAID = "frames_unsaid", WARNING, "the number of frames is not set"
    AVERAGES_UNSAID = "averages_unsaid", WARNING, "the number of averages is not set"
    DEFAULT_ASSUMED = "default_assumed", WARNING, "a setting or place that nothing states"
    SAMPLE_OUT_OF_BEAM = "sample_out_of_beam", WARNING, "projections without the sample"
    SAMPLE_IN_FLAT = "sample_in_flat", WARNING, "flat images with the sample"
    TRUNCATED = "truncated", WARNING, "no image shows some side of the sample"
    SATURATED_PIXELS = "saturated_pixels", WARNING, "saturated pixels behind the sample"
    STARVED_PIXELS = "starved_pixels", WARNING, "starved pixels behind the sample"
    SATURATED_OPEN_BEAM = (
        "saturated_open_beam",
        WARNING,
        "the open beam saturates the panel",
        SATURATED_PIXELS,
    )
    STARVED_OPEN_BEAM = (
        "starved_open_beam",
        WARNING,
        "the open beam starves the panel",
        STARVED_PIXELS,
    )
    UNPREDICTED_PIXELS = (
        "unpredicted_pixels",
        WARNING,
        "pixels that are not predicted, and why",
    )
    NO_FLAT = "no_flat", WARNING, "a list of poses without a flat image"
    FLAT_PATH = "flat_path", WARNING, "no free path to the place of the flat image"
    XRAYS_OFF = "xrays_off", WARNING, "projections or flat images without X-rays"
    XRAYS_ON = "xrays_on", WARNING, "dark images with X-rays"
    RUN_UP = "run_up", WARNING, "the trigger is passed before full speed"
    SCAN_OVERRUN = "scan_overrun", WARNING, "the move ends before the images do"
    LATE_START = "late_start", WARNING, "images begin after the trigger"
    FRAME_ANGLES = "frame_angles", WARNING, "frames that do not make whole turns"
    NO_TRIGGER = "no_trigger", WARNING, "a move under images without a trigger"
    MOVING = "moving", WARNING, "an axis moves while an image is taken"
    STATIC_SEQUENCE = "static_sequence", WARNING, "nothing moves during a sequence"
    OVERWRITES = "overwrites", WARNING, "two images of one name"
    WAIT_MISSING = "wait_missing", WARNING, "no wait is written"
    TRIGGER_UNUSED = "trigger_unused", WARNING, "a trigger position without POS"
    CUSTOM_COMPONENT = "custom_component", WARNING, "a component that has no effect here"
    CUT_OFF = "cut_off", WARNING, "an executed script ends within a line"
    REPLY = "reply", WARNING, "a motor's reply that does not read"
    OTHER_MACHINE = "other_machine", WARNING, "an executed script of another machine"


_DOCUMENT: Final[Mapping[str, type[Any]]] = {
    "severity": Severity,
    "code": ScriptCode,
    "line": int,
    "column": int,
    "message": str,
}
"""Field of a problem's JSON form -> its type."""


def _read(documents: Iterable[Mapping[str, Any]]) -> Findings:
    """Make problems of their JSON forms, whose fields have been read."""
    return Findings(
        Finding(
            one["code"],
            one["severity"],
            one["message"],
            place=Place(one["line"], one["column"]),
        )
        for one in documents
    )


def _json_schema(_: object, handler: GetCoreSchemaHandler) -> s.CoreSchema:
    """Tell pydantic how problems go to JSON and back."""
    fields = {
        name: s.typed_dict_field(handler.generate_schema(kind))
        for name, kind in _DOCUMENT.items()
    }
    return s.no_info_after_validator_function(
        _read,
        s.list_schema(s.typed_dict_schema(fields)),
        serialization=s.plain_serializer_function_ser_schema(
            lambda problems: [one.to_dict() for one in problems]
        ),
    )


Problems = Annotated[Findings, GetPydanticSchema(_json_schema)]
"""Findings on a script; a list of `to_dict` in JSON."""


class WithProblems:
    """Base of values that have `problems`: the errors and the warnings among them."""

    problems: Problems

    @property
    def errors(self) -> Findings:
        """Problems that forbid running the script."""
        return self.problems.errors

    @property
    def warnings(self) -> Findings:
        """Problems that do not forbid running the script."""
        return self.problems.warnings


class ScriptError(TwinError):
    """A script that is not valid; `problems` has every error and warning, in line order."""

    def __init__(self, problems: Iterable[Finding]) -> None:
        """Make the error; the message lists the errors, `data` has all problems, in line order."""
        self.problems = Findings(problems).by_place()
        errors = self.problems.errors
        count = f"{len(errors)} error{'s' if len(errors) != 1 else ''}"
        text = "\n".join(map(str, errors))
        documents = [p.to_dict() for p in self.problems]
        super().__init__(f"the script has {count}:\n{text}", {"problems": documents})


class Collector:
    """Collects problems; each is about the command at `place`."""

    def __init__(self) -> None:
        """Begin without problems, at the entire script."""
        self.problems: list[Finding] = []
        self.place = ENTIRE

    def error(self, code: ScriptCode, message: str) -> None:
        """Add an error."""
        self.problems.append(error(code, message, place=self.place))

    def warn(self, code: ScriptCode, message: str) -> None:
        """Add a warning."""
        self.problems.append(warning(code, message, place=self.place))
