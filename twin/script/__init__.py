"""Acquila scan scripts: text to typed commands to a plan, each step plain data."""

from flexdt.twin.script.commands import Script, Wait
from flexdt.twin.script.compose import compose_script
from flexdt.twin.script.dry_run import check_plan, check_script
from flexdt.twin.script.dry_run_report import html_report
from flexdt.twin.script.parse import parse_script, read_script
from flexdt.twin.script.planning.check_findings import Clearance, Collision
from flexdt.twin.script.planning.plan import CheckReport, ScanPlan
from flexdt.twin.script.planning.plan_values import (
    Exposure,
    PlanStep,
    SampleSize,
    StartState,
)
from flexdt.twin.script.planning.planner import plan_script
from flexdt.twin.script.planning.pose_plan import plan_poses
from flexdt.twin.script.problems import ScriptCode, ScriptError
from flexdt.twin.script.scan_request import ScanRequest

__all__ = [
    "CheckReport",
    "Clearance",
    "Collision",
    "Exposure",
    "PlanStep",
    "SampleSize",
    "ScanPlan",
    "ScanRequest",
    "Script",
    "ScriptCode",
    "ScriptError",
    "StartState",
    "Wait",
    "check_plan",
    "check_script",
    "compose_script",
    "html_report",
    "parse_script",
    "plan_poses",
    "plan_script",
    "read_script",
]
