"""Faults of calibration data: the codes of what frames, beads, angles and residuals show."""

from __future__ import annotations

from flexdt.twin.findings import ERROR, WARNING, Finding, FindingCode


class CalibrationCode(FindingCode):
    """Codes of the findings of a calibration; an error withholds its numbers."""

    FRAMES_MISSING = (
        "frames_missing",
        ERROR,
        "frames that are missing, or whose files do not read",
    )
    FRAMES_DARK = "frames_dark", ERROR, "frames without light"
    FRAMES_REPEATED = (
        "frames_repeated",
        ERROR,
        "frames that are copies of the frame before",
    )
    FRAMES_EMPTY = "frames_empty", WARNING, "frames that show no bead"
    UNDETERMINED = "undetermined", ERROR, "the images do not determine what was asked for"
    NO_BEADS = "no_beads", ERROR, "no bead is seen in any frame"
    ONE_BEAD = "one_bead", ERROR, "no frame shows more than one bead"
    WRONG_PHANTOM = "wrong_phantom", ERROR, "the spots do not fit the phantom"
    MIRRORED_PHANTOM = "mirrored_phantom", ERROR, "the mirror image of the phantom fits"
    PHANTOM_UPSIDE_DOWN = "phantom_upside_down", ERROR, "the phantom stands on its head"
    PHANTOM_LEANS = "phantom_leans", WARNING, "the phantom leans on the stage"
    REMOUNTED = "remounted", ERROR, "the phantom was moved between two frames"
    AMBIGUOUS = "ambiguous", ERROR, "the beads cannot be told apart"
    BEADS_MISSING = "beads_missing", WARNING, "beads that no frame shows"
    ANGLE_ENDPOINT = (
        "angle_endpoint",
        ERROR,
        "angles by n - 1 frames in place of n, or the reverse",
    )
    ANGLE_SCALE = "angle_scale", ERROR, "the frames' angles are off by a factor"
    ANGLE_REVERSED = (
        "angle_reversed",
        ERROR,
        "the stage turns the other way than the angles say",
    )
    NOT_TURNING = (
        "not_turning",
        ERROR,
        "the object does not turn although the angles say so",
    )
    ANGLE_TURN = "angle_turn", ERROR, "the frames cover another turn than the angles say"
    ANGLES_WRONG = "angles_wrong", ERROR, "the frames' angles differ from the stated ones"
    ANGLE_STEP = (
        "angle_step",
        ERROR,
        "the object turns too far, or less, between two frames",
    )
    FRAME_NUMBERS = "frame_numbers", ERROR, "frames are lost, doubled or in a wrong order"
    IMAGE_MIRRORED = "image_mirrored", ERROR, "the images are mirrored left to right"
    IMAGE_UPSIDE_DOWN = "image_upside_down", ERROR, "the images are upside down"
    IMAGE_TURNED = "image_turned", ERROR, "the images are turned by 180 deg"
    EXTRA_SPOTS = "extra_spots", ERROR, "balls that are none of the phantom's"
    HELD_UNCHECKED = (
        "held_unchecked",
        WARNING,
        "exact values that the images cannot check",
    )
    LAG = "lag", WARNING, "the camera shows part of the frame before"
    DARK_TOO_BRIGHT = "dark_too_bright", ERROR, "light is missing in all images"
    BLURRED = "blurred", WARNING, "the blur is wide beside the balls"
    BEAD_SIZE = "bead_size", ERROR, "the balls have another size than the phantom's"
    IMPLAUSIBLE_OFFSET = "implausible_offset", ERROR, "an offset that no mount can cause"
    HELD_PARAMETER = "held_parameter", ERROR, "a parameter that is held is contradicted"
    PRIORS_NARROW = (
        "priors_narrow",
        WARNING,
        "detector and axis are further off than the priors",
    )
    LENGTHS_DISAGREE = (
        "lengths_disagree",
        WARNING,
        "told lengths, of motors or the phantom, disagree",
    )
    BEAD_TOLERANCE = "bead_tolerance", WARNING, "beads that are a little off their model"
    BEADS_MOVED = "beads_moved", ERROR, "beads move against the others during the scan"
    BEAD_DISPLACED = (
        "bead_displaced", ERROR, "a bead is elsewhere than the model has it",
        EXTRA_SPOTS,
    )  # fmt: skip
    FRAMES_INCONSISTENT = (
        "frames_inconsistent",
        ERROR,
        "some frames contradict the others",
    )
    DRIFT = "drift", ERROR, "something moves during the scan"
    VIBRATION = "vibration", ERROR, "the beads of a frame err together"
    BEAD_ERRORS = "bead_errors", WARNING, "single beads err smoothly as the object turns"
    OTHER_MOTION = (
        "other_motion",
        WARNING,
        "another motion than the asked one was followed",
    )
    MOTION_OPEN = "motion_open", WARNING, "motions that the images do not tell apart"
    PHANTOM_STRAINED = (
        "phantom_strained",
        WARNING,
        "the phantom has another shape, or leans",
    )
    EXPOSURE_ARC = "exposure_arc", ERROR, "the object turns while a frame is exposed"
    ROWS_IN_TURN = (
        "rows_in_turn",
        WARNING,
        "the object turns while the rows of a frame are read",
    )
    PIXEL_PITCH = "pixel_pitch", WARNING, "a wrong size of the pixels would look alike"
    CAUSES_OPEN = "causes_open", WARNING, "causes that the images do not tell apart"
    PANEL_DISTORTED = "panel_distorted", WARNING, "the panel distorts its picture"
    WOBBLE = "wobble", ERROR, "the axis leans to and fro as it turns"
    MISFIT = "misfit", ERROR, "no cause explains the residuals"
    TOO_MANY_OUTLIERS = "too_many_outliers", ERROR, "too many positions were left out"
    SPOTS_UNCONFIRMED = (
        "spots_unconfirmed",
        ERROR,
        "the second measurement finds few of the spots",
    )
    BODY_ELSEWHERE = (
        "body_elsewhere",
        WARNING,
        "the phantom's body is not where it is described",
    )
    BODY_DIFFERS = "body_differs", WARNING, "the body attenuates otherwise than described"
    SATURATED = (
        "saturated", WARNING, "the open beam fills the detector",
        BEAD_SIZE,
    )  # fmt: skip


OF_RESIDUALS = frozenset(
    (
        CalibrationCode.DRIFT,
        CalibrationCode.VIBRATION,
        CalibrationCode.BEAD_ERRORS,
        CalibrationCode.BEAD_DISPLACED,
        CalibrationCode.TOO_MANY_OUTLIERS,
        CalibrationCode.BEAD_TOLERANCE,
    )
)
"""Codes of findings about residuals: they hold for that fit alone."""
OF_MOTION = frozenset(
    (
        CalibrationCode.DRIFT,
        CalibrationCode.VIBRATION,
        CalibrationCode.ANGLES_WRONG,
        CalibrationCode.WOBBLE,
    )
)
"""Codes of findings on what is elsewhere from frame to frame."""


def listed(finding: Finding | None) -> list[Finding]:
    """Make a list of one finding; empty for `None`."""
    return [] if finding is None else [finding]
