"""One twin with several projectors: the same frames, and how many a second.

    python examples/several_projectors.py [--projectors N] [--frames N]

Starts N projectors of one thread and a twin on free ports of this machine, scans with the first
alone, with all, and with `flexdt up`, whose own projector is one more, and compares the images
byte for byte. On other machines start `flexdt projector
--host ADDRESS --token-file FILE` on each, and here `flexdt twin --projectors
HOST:PORT,HOST:PORT --projector-token-file FILE`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from flexdt.clients import TwinClient


def start(*words: str) -> tuple[subprocess.Popen[str], int]:
    """Start a `flexdt` process on a free port and wait for its ready line.

    Args:
        words: of the command line, without the port.

    Returns:
        The process, and its port.
    """
    command = [sys.executable, "-m", "flexdt.clients.cli", *words, "--port", "0"]
    child = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    assert child.stdout is not None
    return child, int(json.loads(child.stdout.readline())["port"])


def scan(
    ports: list[int], data: Path, frames: int, *how: str
) -> tuple[dict[str, str], float]:
    """Scan `frames` poses of one turn by a twin that shares its views among projectors,
    the stage at mag_obj 500 mm; the twin is ended afterwards.

    Args:
        ports: of the projectors on this machine.
        data: the twin's data directory.
        frames: of one turn.
        how: the command and its own options.

    Returns:
        File name -> SHA-256 of each image, and the time of the job [s].
    """
    pool = ",".join(f"127.0.0.1:{port}" for port in ports)
    twin, port = start(
        *how, "--projectors", pool, "--data", str(data), "--speed-up", "max"
    )
    try:
        poses = [{"rot_obj": 360.0 * i / frames} for i in range(frames)]
        with TwinClient(port=port) as client:
            client.move({"mag_obj": 500.0}, wait=True)
            begun = time.perf_counter()
            job = client.submit_trajectory(poses, name="scan", seed=1).job
            client.wait_job(job)
            took = time.perf_counter() - begun
    finally:
        twin.terminate()
        twin.communicate()
    found = sorted(data.glob("*scan*/*.tif"))
    return {f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in found}, took


def main() -> int:
    """Scan by one projector, by several, and by `flexdt up`, print the times, and compare
    the images.

    Returns:
        0 if all images are the same bytes, else 1.
    """
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--projectors", type=int, default=3)
    p.add_argument("--frames", type=int, default=60)
    o = p.parse_args()
    projectors = [start("projector", "--threads", "1") for _ in range(o.projectors)]
    ports = [port for _, port in projectors]
    try:
        with tempfile.TemporaryDirectory() as name:
            one, alone_s = scan(ports[:1], Path(name) / "one", o.frames, "twin")
            many, took = scan(ports, Path(name) / "many", o.frames, "twin")
            up, up_s = scan(
                ports,
                Path(name) / "up",
                o.frames,
                "up",
                "--no-viewer",
                "--projector-port",
                "0",
            )
    finally:
        for child, _ in projectors:
            child.terminate()
            child.communicate()
    same = one == many == up
    print(f"{len(one)} images: {alone_s:.1f} s by one projector, {took:.1f} s by {len(ports)}, "
          f"{up_s:.1f} s with flexdt up; bytes {'equal' if same else 'DIFFER'}")  # fmt: skip
    return 0 if one and same else 1


if __name__ == "__main__":
    sys.exit(main())
