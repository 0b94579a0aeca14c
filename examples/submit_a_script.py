"""Submit a scan script and watch it: progress events while it runs, the data set's name at the
end.

Start `flexdt up` in another terminal, then run `python examples/submit_a_script.py SCRIPT`.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from flexdt.clients import TwinClient


def main(script: str, host: str = "127.0.0.1", port: int = 55000) -> None:
    """Check a script on a twin and print its problems, then put the sample normal-5 on
    the stage, submit the script and print its progress until it has ended or is paused.

    It is submitted even if the check has found errors, and the clock runs at "max".

    Args:
        script: its file.
        host, port: of the twin.
    """
    text = Path(script).read_bytes()
    with TwinClient(host, port) as client:
        report = client.check_script(text)
        print(f"{report.frames} frames, {report.duration_s:.0f} s on the scanner's clock")
        for problem in report.problems:
            print(f"line {problem.line}: {problem.severity}: {problem.message}")

        client.set_sample("normal-5")
        job = client.submit_script(text, speed_up="max").job
        while (status := client.job_status(job)).state in ("queued", "running"):
            print(f"{status.frames_done} of {status.frames_total} frames: {status.what}")
            time.sleep(0.5)
        print(f"{status.state}: data set {status.dataset}")


if __name__ == "__main__":
    main(sys.argv[1], *sys.argv[2:3], *map(int, sys.argv[3:4]))
