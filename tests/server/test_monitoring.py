"""Alerts and dashboard name figures, labels and states that the servers really show."""

from __future__ import annotations

import json
import re
import urllib.request
from pathlib import Path
from typing import Any, get_args

import pytest
import yaml
from lab import Process, Wire, fly_script, projector, twin

from flexdt.protocol.state_model import JobPhase

HOME = Path(__file__).resolve().parents[2] / "docker" / "monitoring"
WORDS = {
    "and",
    "or",
    "on",
    "by",
    "sum",
    "rate",
    "increase",
    "predict_linear",
    "histogram_quantile",
}
TARGET_LABELS = {"job", "instance"}
"""Prometheus adds them, and `up`."""
NAME = r"[a-zA-Z_:][a-zA-Z0-9_:]*"


def rules() -> list[dict[str, Any]]:
    (group,) = yaml.safe_load((HOME / "alerts.yaml").read_text())["groups"]
    return list(group["rules"])


def panels() -> list[dict[str, Any]]:
    return list(json.loads((HOME / "dashboard.json").read_text())["panels"])


def expressions() -> list[str]:
    drawn = [target["expr"] for panel in panels() for target in panel["targets"]]
    return drawn + [rule["expr"] for rule in rules()]


def parts(expression: str) -> tuple[set[str], set[str], set[tuple[str, str]]]:
    """Metrics, labels, and (label, pattern) of an expression."""
    for left, right in ("()", "[]", "{}"):
        assert expression.count(left) == expression.count(right), expression
    wanted = re.findall(rf'({NAME})(?:=~|!~|!=|=)"([^"]*)"', expression)
    bare = re.sub(r"\{[^}]*\}|\[[^\]]*\]|\"[^\"]*\"", " ", expression)
    labels = {
        x
        for inside in re.findall(r"\b(?:by|on) \(([^)]*)\)", bare)
        for x in inside.split(", ")
    }
    bare = re.sub(r"\b(?:by|on) \([^)]*\)", " ", bare)
    bare = re.sub(r"\b\d[\d.e]*\b", " ", bare)
    return (
        set(re.findall(NAME, bare)) - WORDS,
        labels | {n for n, _ in wanted},
        set(wanted),
    )


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[tuple[str, str]]]:
    """Each metric that a projector and a twin with a pool show, with its (label, value)s."""
    rays = projector("--http-port", 0)
    nobody = ("--projectors", "127.0.0.1:1")  # nobody listens there
    data = tmp_path_factory.mktemp("data")
    server = twin(rays.port, data, *nobody, "--speed-up", "max", "--http-port", 0)
    try:
        wire = Wire(server.port)
        wire.wait(
            wire.call("script.submit", text=fly_script(13), name="seen")["job"], "done"
        )
        found: dict[str, set[tuple[str, str]]] = {"up": set()}
        for process in (server, rays):
            for line in page(process).splitlines():
                name = re.match(NAME, line.removeprefix("# TYPE "))
                if name is not None and not line.startswith("# HELP"):
                    labels = re.findall(rf'({NAME})="([^"]*)"', line)
                    found.setdefault(name[0], set()).update(labels)
        return found
    finally:
        server.end()
        rays.end()


def page(process: Process) -> str:
    url = f"http://127.0.0.1:{process.ready['http_port']}/metrics"
    with urllib.request.urlopen(url, timeout=20) as answer:
        return str(answer.read().decode())


@pytest.mark.timeout(240)
@pytest.mark.slow
def test_every_figure_label_and_state_exists(
    shown: dict[str, set[tuple[str, str]]],
) -> None:
    # The reader of expressions finds what is wrong.
    assert parts('sum by (x) (rate(no_such{a="b"}[5m])) > 1e9') == (
        {"no_such"},
        {"x", "a"},
        {("a", "b")},
    )
    for expression in expressions():
        metrics, labels, wanted = parts(expression)
        assert metrics
        assert metrics <= shown.keys(), expression
        there = (
            {label for metric in metrics for label, _ in shown[metric]}
            | TARGET_LABELS
            | {"le"}
        )
        assert labels <= there, expression
        for label, pattern in wanted - {("job", "flexdt-.*")}:
            values = {v for metric in metrics for k, v in shown[metric] if k == label}
            if label == "code":
                values |= {"-32603"}  # none was made here
            assert any(re.fullmatch(pattern, value) for value in values), expression
    drawn = [t for panel in panels() for t in panel["targets"]]
    told = [(t["expr"], t["legendFormat"], r"\{\{(\w+)\}\}") for t in drawn]
    told += [
        (r["expr"], r["annotations"]["summary"], r"\$labels\.(\w+)") for r in rules()
    ]
    for expression, text, form in told:
        there = {k for m in parts(expression)[0] for k, _ in shown[m]} | TARGET_LABELS
        assert set(re.findall(form, text)) <= there, text


def test_states_in_alerts_are_states_of_jobs() -> None:
    named = [
        re.findall(r'flexdt_jobs\{state=~?"([^"]*)"', expression)
        for expression in expressions()
    ]
    states = {state for found in named for text in found for state in text.split("|")}
    assert states
    assert states <= set(get_args(JobPhase))


def test_files_hold_together() -> None:
    config = yaml.safe_load((HOME / "prometheus.yaml").read_text())
    assert all((HOME / file).is_file() for file in config["rule_files"])
    jobs = {scrape["job_name"] for scrape in config["scrape_configs"]}
    assert jobs
    assert all(re.fullmatch("flexdt-.*", job) for job in jobs), (
        "what the expressions select"
    )
    names = [rule["alert"] for rule in rules()]
    assert len(set(names)) == len(names)
    for rule in rules():
        assert rule["labels"]["severity"] in ("warning", "critical")
        assert re.fullmatch(r"\d+[smh]", rule.get("for", "1m"))
    taken: set[tuple[int, int]] = set()
    for number, panel in enumerate(panels(), 1):
        assert panel["id"] == number
        at = panel["gridPos"]
        cells = {(x, y) for x in range(at["x"], at["x"] + at["w"])
                 for y in range(at["y"], at["y"] + at["h"])}  # fmt: skip
        assert not cells & taken, panel["title"]
        assert at["x"] + at["w"] <= 24
        taken |= cells
