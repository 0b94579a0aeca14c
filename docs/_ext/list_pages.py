"""Pages of the lists that code declares: codes of findings, limits of the servers."""

from __future__ import annotations

import re
from dataclasses import fields

LISTED = {
    "twin/script/problems.py": "findings.md",
    "twin/calibration/diagnose/__init__.py": "findings.md",
    "twin/plausibility/contradictions.py": "findings.md",
    "runtime/access.py": "limits.md",
    "twin/reconstruction/consistency/thresholds.py": "thresholds.md",
    "clients/cli/command_settings.py": "commands.md",
}
"""File of the repository that declares a list -> its page below `_generated/`."""


def findings() -> str:
    """List the codes of all checks, with what each means and the gravest it can be."""
    from flexdt.twin.calibration.diagnose import CalibrationCode
    from flexdt.twin.commissioning import CommissionCode
    from flexdt.twin.plausibility import PlausibilityCode
    from flexdt.twin.script.problems import ScriptCode

    out = [
        "# Codes of findings",
        "",
        "An error forbids the use of the input or withholds the result; a warning offers "
        "it. A finding may be milder than the gravest that its code can be, and its message "
        "says what to do.",
        "",
    ]
    for title, room in (
        ("Scripts", ScriptCode),
        ("Data and geometry", PlausibilityCode),
        ("Calibration", CalibrationCode),
        ("Commissioning", CommissionCode),
    ):
        out += [f"## {title}", "", "| code | gravest | means |", "|---|---|---|"]
        out += [f"| `{code}` | {code.gravest} | {code.meaning} |" for code in room]
        out.append("")
    return "\n".join(out)


def thresholds() -> str:
    """List the numbers that decide what is claimed of a volume, with their sources."""
    from flexdt.twin.reconstruction.consistency import thresholds as code

    out = [
        "# Thresholds of accuracy",
        "",
        "Numbers that decide what `volume.accuracy` claims, what is told of a scan, and what is "
        "warned of.",
        "",
        "| module | name | value | meaning | source |",
        "|---|---|---|---|---|",
    ]
    for one in code.thresholds():
        module = one.module.removeprefix("flexdt.twin.")
        source = "" if one.source is None else one.source.value
        cells = (f"`{module}`", f"`{one.name}`", one.value, one.meaning, source)
        out.append(f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |")
    return "\n".join(out)


def limits() -> str:
    """List what `--limit NAME=VALUE` takes, with the defaults."""
    from flexdt.runtime import access

    out = [
        "# Limits of the servers",
        "",
        "Set a limit with `--limit NAME=VALUE`, repeated as needed, on `flexdt up`, `twin`, "
        "`projector` (connection limits only) and `viewer` (page limits only). Sizes are in "
        "bytes.",
        "",
    ]
    for title, made in (
        ("Connections", access.ConnectionLimits()),
        ("A twin", access.TwinLimits()),
        ("The page", access.ViewerLimits()),
    ):
        meanings = attributes(type(made))
        out += [f"## {title}", "", "| limit | default | meaning |", "|---|---|---|"]
        for field in fields(made):
            value = getattr(made, field.name)
            shown = "none" if value is None else f"{value:,}".replace(",", " ")
            out.append(f"| `{field.name}` | {shown} | {meanings[field.name]} |")
        out.append("")
    return "\n".join(out)


def attributes(declared: type) -> dict[str, str]:
    """Return what a class's docstring says of each attribute."""
    text = (declared.__doc__ or "").partition("Attributes:")[2]
    parts = re.split(r"^ {8}(\w+): ", text, flags=re.MULTILINE)[1:]
    return {
        name: " ".join(said.split()).rstrip(".")
        for name, said in zip(parts[::2], parts[1::2], strict=True)
    }
