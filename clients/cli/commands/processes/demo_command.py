"""`flexdt demo`: the main job from end to end, on this machine, with nothing prepared."""

from __future__ import annotations

import time
from pathlib import Path

from flexdt.clients.cli.console import note, say
from flexdt.clients.cli.options import Answer, option


def demo(
    out: Path = option(Path("flexdt-demo"), "Write everything to this folder.", metavar="DIR"),
    no_viewer: bool = option(False, "Exit when the work is done, without a viewer.", "--no-viewer"),
    truth: Path | None = option(
        None, "Hide this misalignment; default: a random one.", metavar="FILE"
    ),
    json: bool = False,
) -> Answer:
    """Do the main job: script, scan, data set, calibration.

    Starts the servers on free ports, scans the LEGO bead phantom with the example script,
    accelerated, calibrates from the data set, and says what was done, where the files are and how
    the result compares with the hidden truth. With the viewer it stays up until Ctrl-C.
    """
    from flexdt.clients.cli.commands.processes.demonstration import run_demo

    def stay(url: str) -> None:
        note(f"the lab is at {url}; Ctrl-C ends the demonstration")
        try:
            while True:
                time.sleep(3600.0)
        except KeyboardInterrupt:
            note("")

    yield run_demo(out, truth, note if json else say, None if no_viewer else stay)
