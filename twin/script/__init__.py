"""Acquila scan scripts: text to typed commands to a plan, each step plain data."""

from flexdt.twin.script.commands import Script, Wait
from flexdt.twin.script.compose import ScanRequest, compose_script
from flexdt.twin.script.dry_run import CheckReport, Clearance, Collision, check_plan, check_script
from flexdt.twin.script.dry_run_report import html_report
from flexdt.twin.script.parse import parse_script, read_script
from flexdt.twin.script.plan import Exposure, PlanStep, SampleSize, ScanPlan, StartState
from flexdt.twin.script.planner import plan_poses, plan_script
from flexdt.twin.script.problems import ScriptError, ScriptProblem

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
    "ScriptError",
    "ScriptProblem",
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
