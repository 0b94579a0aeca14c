"""What the page says, read off its DOM, held against what the twin answers; nothing of the
page's own code decides here.

`contradictions` returns in words every statement that the wire denies.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from flexdt.clients.client.client import TwinClient
from flexdt.protocol.state_model import JobStatus, State

UNENDED = ("queued", "running", "paused")
READ = """() => {
  const text = (id) => document.getElementById(id)?.textContent.trim() ?? '';
  const shown = (id) => document.getElementById(id)?.offsetParent != null;
  const ids = ['connection', 'holder', 'beam', 'geometry-title', 'warnings', 'film-old',
    'film-beam', 'notes', 'job-name', 'job-state', 'job-what', 'job-frames', 'welcome-title',
    'near', 'stale', 'report', 'veil'];
  const buttons = ['job-pause', 'job-resume', 'job-abort', 'job-back'];
  const sample = document.getElementById('sample');
  const rows = [...document.querySelectorAll('#readouts dt')].map((dt) =>
    [dt.textContent.trim(), dt.nextElementSibling.textContent.trim()]);
  const picture = flexdt.store.image;
  const places = [];
  if (picture) {
    const [height, width] = picture.full;
    for (let k = 0; k < 60; k++) {
      const column = Math.floor(((k * 37) % 101) / 101 * width);
      const row = Math.floor(((k * 53) % 97) / 97 * height);
      places.push([column, row, flexdt.value(column, row)]);
    }
  }
  return {
    texts: Object.fromEntries(ids.map((id) => [id, text(id)])),
    shown: Object.fromEntries([...ids, ...buttons, 'scan-bar', 'record']
      .map((id) => [id, shown(id)])),
    sample: sample.classList.contains('typed') ? null : sample.value,
    rows: Object.fromEntries(rows),
    record: text('record-name'),
    session: flexdt.store.session,
    picture: picture && { kind: picture.kind, recorded: picture.recorded?.name ?? null,
      full: picture.full, code: picture.code, places },
  };
}"""


@dataclass
class Wire:
    """What the twin says at one moment.

    Attributes:
        state: its state.
        job: the scan that runs, waits or ended last; None for none.
        image: (rows, cols) line integrals of now; None where none can be made.
        stored: projections that the data set of `job` has.
    """

    state: State
    job: JobStatus | None
    image: Any = None
    stored: int | None = None


def asked(twin: TwinClient, image: bool = True) -> Wire:
    """The twin as it is now."""
    state = twin.state()
    jobs = twin.jobs().jobs
    going = [job for job in jobs if job.state in UNENDED]
    last = going[0] if going else (jobs[-1] if jobs else None)
    picture = np.asarray(twin.projection().image) if image and not going else None
    sets = {} if going else {one.name: one.present for one in twin.datasets().datasets}
    of_last = None if last is None else sets.get(Path(last.dataset or "").name)
    return Wire(state, last, picture, of_last)


@dataclass
class Checked:
    """What a report of the page was made of, by the wire."""

    facts: object = None
    asked: bool = field(default=False)


def begun_with(state: State) -> object:
    """What a script would begin with."""
    motors = {
        name: round(a.position, 2) for name, a in state.axes.items() if not a.virtual
    }
    correction = None if state.correction is None else state.correction.name
    camera = state.camera.model_dump()
    return (
        state.sample.model_dump(),
        motors,
        correction,
        camera,
        state.tube.kV,
        state.tube.power_W,
    )


def contradictions(page: Any, wire: Wire, projector: bool, checked: Checked) -> list[str]:
    """Statements of the page that the wire denies, in words.

    Args:
        page: that is read.
        wire: the twin at this moment, at rest.
        projector: whether one answers.
        checked: what the report on the page was made of.
    """
    said = page.evaluate(READ)
    texts, shown = said["texts"], said["shown"]
    found = [
        *of_connection(texts, projector),
        *of_machine(said, wire.state),
        *of_scan(said, wire),
    ]
    if said["picture"] is not None and wire.image is not None:
        found += of_picture(said, wire)
    if (
        shown["report"]
        and checked.asked
        and re.search("eady to run|Not ready", texts["report"])
    ):
        idle = wire.job is None or wire.job.state not in UNENDED
        differs = idle and checked.facts != begun_with(wire.state)
        if differs != shown["stale"]:
            found.append(f"report: stale is {shown['stale']}, and differs is {differs}")
    return found


def of_connection(texts: dict[str, str], projector: bool) -> list[str]:
    """Of the pill, while the twin answers."""
    wanted = "connected" if projector else "no images"
    found = (
        []
        if texts["connection"] == wanted
        else [f"pill: {texts['connection']}, not {wanted}"]
    )
    if ("No new images" in texts["warnings"]) == projector:
        found.append(
            f"warnings: {texts['warnings']}, and a projector answers: {projector}"
        )
    return found


def _read(part: str) -> str:
    """A part's name as the page has it."""
    return part.replace("_", " ").replace("xray", "X-ray")


def of_machine(said: dict[str, Any], state: State) -> list[str]:
    """Of the sample, the beam, control, distances and their heading."""
    texts, found = said["texts"], []

    def claim(right: bool, what: str) -> None:
        if not right:
            found.append(what)

    name = state.sample.name or "empty"
    claim(
        said["sample"] in (None, name, state.sample.name),
        f"sample: {said['sample']}, not {name}",
    )
    claim(
        ("ON" in texts["beam"] or "warm" in texts["beam"]) == state.tube.on, texts["beam"]
    )
    own = said["session"]
    claim(
        not own or own not in texts["notes"], f"a note names the reader: {texts['notes']}"
    )
    holder = state.controller
    words = (
        "nobody"
        if holder is None
        else "you control"
        if holder == said["session"]
        else holder
    )
    claim(words in texts["holder"], f"holder: {texts['holder']}, not {words}")
    if said["shown"]["record"]:
        wanted = f"Geometry of {said['record']}"
        claim(texts["geometry-title"].startswith(wanted), texts["geometry-title"])
    else:
        g = state.geometry
        claim(texts["geometry-title"] == "Geometry now", texts["geometry-title"])
        for row, mm in (("SOD", g.SOD_mm), ("SDD", g.SDD_mm)):
            claim(
                abs(float(said["rows"][row].split()[0]) - mm) < 0.011,
                f"{row}: {said['rows'][row]}",
            )
        off = said["rows"]["beam"] == "off"
        claim(off != state.tube.on, f"beam: {said['rows']['beam']}")
    mm, pair = state.safety.clearance_mm, state.safety.pair
    if mm is not None and pair:
        near = re.search(r"([\d.]+) mm", texts["near"])
        close = near is not None and abs(float(near[1]) - mm) < 0.11
        claim(
            close and all(_read(part) in texts["near"] for part in pair),
            f"near: {texts['near']}",
        )
    if said["shown"]["welcome-title"] and state.sample.name:
        claim(state.sample.name in texts["welcome-title"], texts["welcome-title"])
    return found


def of_scan(said: dict[str, Any], wire: Wire) -> list[str]:
    """Of the line of the scan: its state, who ended it, what stands where, what may be
    pressed."""
    texts, shown, job, found = said["texts"], said["shown"], wire.job, []
    if job is None or (not shown["scan-bar"] and job.state not in UNENDED):
        return (
            ["a scan is shown, and there is none"]
            if job is None and shown["scan-bar"]
            else []
        )
    if not shown["scan-bar"]:
        return [f"{job.job} is {job.state}, and no scan is shown"]
    if texts["job-name"] != (job.name or job.job):
        return [f"the scan shown is {texts['job-name']}, not {job.name}"]
    done = re.match(r"\d+", texts["job-frames"])
    if wire.stored is not None and done and int(done[0]) != wire.stored:
        found.append(f"scan: {texts['job-frames']}, and {wire.stored} on the disk")
    if not texts["job-state"].startswith(job.state):
        found.append(f"scan: {texts['job-state']}, not {job.state}")
    if job.state == "aborted" and job.ended_by:
        name = job.ended_by.rpartition(" #")[0]
        own = (said["session"] or "").rpartition(" #")[0]
        whose = ["you"] if job.ended_by == said["session"] else [name]
        if name == own:  # of this tab before a reload, or of another person of that name
            whose.append("you")
        if not any(texts["job-state"] == f"aborted by {who}" for who in whose):
            found.append(f"scan: {texts['job-state']}, by {job.ended_by}")
    if job.state in ("aborted", "failed", "incomplete"):
        off = "X-rays are off" in texts["job-what"]
        if off == wire.state.tube.on:
            found.append(f"scan: {texts['job-what']}, and X-rays: {wire.state.tube.on}")
        for motor, value in re.findall(
            r"\b([a-z]+_[a-z]+) at (-?[\d.]+)", texts["job-what"]
        ):
            if abs(wire.state.axes[motor].position - float(value)) > 0.02:
                found.append(f"scan: {motor} at {value}")
    if shown["job-abort"] != (job.state in UNENDED) or shown["job-resume"] != (
        job.state != "done"
    ):
        found.append(f"buttons of a scan that is {job.state}: {shown}")
    return found


def of_picture(said: dict[str, Any], wire: Wire) -> list[str]:
    """Of the radiograph: what is not of now is called old, and what is of now is not."""
    picture, shown = said["picture"], said["shown"]
    if picture["recorded"] is not None or picture["kind"] != "line_integral":
        return []
    rows, cols = picture["full"]
    same = (rows, cols) == wire.image.shape
    if same:
        step = 1 if picture["code"] == "deflate" else 2
        values = [
            (value, wire.image[row // step * step : row // step * step + step,
                               column // step * step : column // step * step + step].mean())
            for column, row, value in picture["places"] if not math.isnan(value)
        ]  # fmt: skip
        tolerance = 1e-3 if step == 1 else 0.02 * max(1.0, float(wire.image.max()))
        same = all(abs(a - b) < tolerance for a, b in values)
    if not same and not shown["film-old"]:
        return ["the radiograph is not of now, and is not called old"]
    lit = wire.state.tube.on and wire.state.tube.ready
    if same and not shown["film-old"] and shown["film-beam"] == lit:
        return [
            f"beam over the radiograph: {said['texts']['film-beam']}, and it is lit: {lit}"
        ]
    return []


def pictured_of(state: State) -> tuple[object, object]:
    """What an image of this state shows: the sample, and everything else that changes it."""
    motors = {
        name: round(a.position, 2) for name, a in state.axes.items() if not a.virtual
    }
    correction = None if state.correction is None else state.correction.name
    sample = state.sample
    return (sample.name, sample.revision), (motors, correction, state.camera.mode)


def of_old_picture(page: Any, before: tuple[object, object], state: State) -> list[str]:
    """Of the radiograph while none can be made: made of `before`, and called old where
    that is gone."""
    said, now = page.evaluate(READ), pictured_of(state)
    picture = said["picture"]
    if picture is None or picture["recorded"] is not None or before == now:
        return []
    if state.sample.name is None and all(value == 0.0 for *_, value in picture["places"]):
        return []  # an empty stage is computed without a projector
    tag = said["texts"]["film-old"] if said["shown"]["film-old"] else ""
    if not tag or (before[0] != now[0]) != ("sample" in tag):
        return [
            f"the radiograph is of {before[0]}, now is {now[0]}, and it is called {tag!r}"
        ]
    return []
