"""A scan by trajectory over the twin's wire: Python's standard library alone, no flexdt.

    python examples/wire/trajectory.py [HOST [PORT [NAME]]]

Submits one pose a view, shows the job's progress and prints the data set's folder, which
`flexdt reconstruct FOLDER --out volume.tif` turns into a volume: dark and flat are in it.
"""

import json
import socket
import sys
import time

VIEWS = 24


class Twin:
    """One connection; a request and its answer are a line of JSON each."""

    def __init__(self, host: str, port: int) -> None:
        """Connect to a twin by TCP."""
        self.lines = socket.create_connection((host, port)).makefile(
            "rw", encoding="utf-8"
        )
        self.count = 0

    def call(self, method: str, **params: object) -> dict:
        """Send a request and return the result of its answer; events in between are
        skipped.

        Raises:
            SystemExit: the answer is an error, or the server closes the connection.
        """
        self.count += 1
        request = {"jsonrpc": "2.0", "id": self.count, "method": method, "params": params}
        self.lines.write(json.dumps(request) + "\n")
        self.lines.flush()
        for line in self.lines:
            answer = json.loads(line)
            if "method" in answer:
                continue
            if "error" in answer:
                raise SystemExit(f"{method}: {answer['error']['message']}")
            return answer["result"]
        raise SystemExit("the server closed the connection")


def main(
    host: str = "127.0.0.1", port: str = "55000", name: str = "by-trajectory"
) -> None:
    """Scan one turn of 24 poses on a twin, wait for the job's end, and print its
    warnings, state and data set.
    """
    twin = Twin(host, int(port))
    twin.call("session.hello", protocol="1.0", client="trajectory.py")
    twin.call("sample.set", name="normal-5")
    twin.call("camera.set", mode="HW4SW1High")
    poses = [
        {"rot_obj": i * 360.0 / VIEWS, "mag_obj": 600.0, "tra_obj": 0.0}
        for i in range(VIEWS)
    ]
    # `flat` is true if it is left out: the server moves the sample beside the beam and back, on
    # a path without a contact. A pose instead is a place where the beam is
    # free; false takes no flat.
    job = twin.call("trajectory.submit", poses=poses, exposure_ms=20.0, name=name)
    for warning in job["warnings"]:
        print("warning:", warning)
    status = twin.call("job.status", job=job["job"])
    while status["state"] in ("queued", "running", "paused"):
        time.sleep(0.2)
        status = twin.call("job.status", job=job["job"])
    print(
        f"{status['state']}: {status['frames_done']} of {status['frames_total']} projections"
    )
    print(job["dataset"])


if __name__ == "__main__":
    main(*sys.argv[1:])
