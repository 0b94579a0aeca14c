"""Acquila scan scripts: text to typed commands to a plan, each step plain data.

Names are looked up on first use, so importing one module of this folder loads only what that
module needs.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from flexdt.twin.script.commands import Script as Script
    from flexdt.twin.script.commands import Wait as Wait
    from flexdt.twin.script.compose import compose_script as compose_script
    from flexdt.twin.script.dry_run import check_plan as check_plan
    from flexdt.twin.script.dry_run import check_script as check_script
    from flexdt.twin.script.dry_run_report import html_report as html_report
    from flexdt.twin.script.parse import parse_script as parse_script
    from flexdt.twin.script.parse import read_script as read_script
    from flexdt.twin.script.planning.check_findings import Clearance as Clearance
    from flexdt.twin.script.planning.check_findings import Collision as Collision
    from flexdt.twin.script.planning.plan import CheckReport as CheckReport
    from flexdt.twin.script.planning.plan import ScanPlan as ScanPlan
    from flexdt.twin.script.planning.plan_values import Exposure as Exposure
    from flexdt.twin.script.planning.plan_values import PlanStep as PlanStep
    from flexdt.twin.script.planning.plan_values import SampleSize as SampleSize
    from flexdt.twin.script.planning.plan_values import StartState as StartState
    from flexdt.twin.script.planning.planner import plan_script as plan_script
    from flexdt.twin.script.planning.pose_plan import plan_poses as plan_poses
    from flexdt.twin.script.problems import ScriptCode as ScriptCode
    from flexdt.twin.script.problems import ScriptError as ScriptError
    from flexdt.twin.script.scan_request import ScanRequest as ScanRequest

_HOMES: Final = {
    "check_plan": "flexdt.twin.script.dry_run",
    "check_script": "flexdt.twin.script.dry_run",
    "CheckReport": "flexdt.twin.script.planning.plan",
    "Clearance": "flexdt.twin.script.planning.check_findings",
    "Collision": "flexdt.twin.script.planning.check_findings",
    "compose_script": "flexdt.twin.script.compose",
    "Exposure": "flexdt.twin.script.planning.plan_values",
    "html_report": "flexdt.twin.script.dry_run_report",
    "parse_script": "flexdt.twin.script.parse",
    "plan_poses": "flexdt.twin.script.planning.pose_plan",
    "plan_script": "flexdt.twin.script.planning.planner",
    "PlanStep": "flexdt.twin.script.planning.plan_values",
    "read_script": "flexdt.twin.script.parse",
    "SampleSize": "flexdt.twin.script.planning.plan_values",
    "ScanPlan": "flexdt.twin.script.planning.plan",
    "ScanRequest": "flexdt.twin.script.scan_request",
    "Script": "flexdt.twin.script.commands",
    "ScriptCode": "flexdt.twin.script.problems",
    "ScriptError": "flexdt.twin.script.problems",
    "StartState": "flexdt.twin.script.planning.plan_values",
    "Wait": "flexdt.twin.script.commands",
}

__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
