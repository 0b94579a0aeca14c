"""Acquila scan scripts: text to typed commands to a plan, each step plain data."""

from flexdt.twin.motion.axis_path import AxisPath
from flexdt.twin.script.commands import Command, Script, Wait
from flexdt.twin.script.parse import parse_script, read_script
from flexdt.twin.script.planning.dry_run import (
    CheckReport,
    Clearance,
    Collision,
    CollisionCheck,
    check_poses,
    check_script,
)
from flexdt.twin.script.planning.dry_run_report import html_report
from flexdt.twin.script.planning.plan import (
    Exposure,
    ExposureGroup,
    FlyScan,
    SampleSize,
    ScanPlan,
    Settings,
    StartState,
    Step,
)
from flexdt.twin.script.planning.planner import plan_poses, plan_script
from flexdt.twin.script.problems import Problem, ScriptError

__all__ = [
    "AxisPath",
    "CheckReport",
    "Clearance",
    "Collision",
    "CollisionCheck",
    "Command",
    "Exposure",
    "ExposureGroup",
    "FlyScan",
    "Problem",
    "SampleSize",
    "ScanPlan",
    "Script",
    "ScriptError",
    "Settings",
    "StartState",
    "Step",
    "Wait",
    "check_poses",
    "check_script",
    "html_report",
    "parse_script",
    "plan_poses",
    "plan_script",
    "read_script",
]
