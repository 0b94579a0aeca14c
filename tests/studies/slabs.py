"""`flexdt reconstruct --scheduler`: speed, kills and memory.

    python tests/studies/slabs.py WHAT

speed   1, 2 and 4 worker processes of one thread: seconds, and whether the bytes are equal.
kills   SIGKILL of workers, client and scheduler at random moments; what is killed is started again,
        until the volume is there. It is compared byte for byte, and so is each slab that is
        there at a kill. Options: --kills N, --seed N.
memory  a volume of four times the address space (`ulimit -v`) that each process is allowed:
        --limit MIB.

All is compared with what one undisturbed worker made. Exit code 1 when anything differs or
is lost. --views, --panel ROWS,COLS and --side choose the scan and the volume's voxels a side;
the default, that of docs/evidence/reconstruction.json, is 360 views of 380 x 478 into 256.
Processes are started and judged from outside; the scan alone is made by flexdt.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import os
import random
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from lab import machine

SINGLE = {
    **dict.fromkeys(
        ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"
    ),
    "MALLOC_ARENA_MAX": "1",  # each thread's arena takes 64 MiB of address space, used or not
}
WITHIN_S = 1200.0
"""When to give up on a process that neither works nor ends."""


class Cluster:
    """A scheduler and workers of one thread, each a process of its own that can be killed."""

    def __init__(self, folder: Path, workers: int, limit: int | None = None) -> None:
        """Start a scheduler and workers.

        Args:
            folder: for the log and the workers' files.
            workers: how many.
            limit: of each process's memory [bytes]; None for none.
        """
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.folder, self.limit = folder, limit
        self.scheduler = self._scheduler()
        self.workers = [self._worker() for _ in range(workers)]

    @property
    def address(self) -> str:
        return f"tcp://127.0.0.1:{self.port}"

    def _scheduler(self) -> subprocess.Popen[bytes]:
        """Start the scheduler and wait until it listens.

        Raises:
            RuntimeError: it ends before, or does not within WITHIN_S.
        """
        child = self._start("scheduler", "--host", "127.0.0.1", "--port", str(self.port))
        until = time.monotonic() + WITHIN_S
        while child.poll() is None and time.monotonic() < until:
            with (
                contextlib.suppress(OSError),
                socket.create_connection(("127.0.0.1", self.port)),
            ):
                return child
            time.sleep(0.1)
        raise RuntimeError(
            f"no scheduler: {(self.folder / 'dask.log').read_text()[-2000:]}"
        )

    def _worker(self) -> subprocess.Popen[bytes]:
        """Start a worker of one thread without a nanny; it is not waited for."""
        return self._start(
            "worker", self.address, "--nthreads", "1", "--no-nanny",
            "--memory-limit", "0", "--local-directory", str(self.folder),
        )  # fmt: skip

    def _start(self, *words: str) -> subprocess.Popen[bytes]:
        """Start a part of dask with limited memory; the log is shared."""
        with (self.folder / "dask.log").open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", "dask", *words, "--no-dashboard"],
                stdout=log,
                stderr=log,
                env={**os.environ, **SINGLE},
                preexec_fn=limiter(self.limit),
            )

    def mend(self) -> None:
        """Start again what has ended."""
        if self.scheduler.poll() is not None:
            self.scheduler = self._scheduler()
        self.workers = [w if w.poll() is None else self._worker() for w in self.workers]

    def end(self) -> None:
        for child in (*self.workers, self.scheduler):
            child.kill()
            child.wait()


def limiter(limit: int | None):  # type: ignore[no-untyped-def]
    """What a process does before it begins: allow itself so many bytes of address space."""
    if limit is None:
        return None
    return lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def command(scan: Path, out: Path, side: int, *more: str) -> list[str]:
    return [sys.executable, "-m", "flexdt.clients.cli", "reconstruct", str(scan), "--out", str(out),
            "--shape", f"{side},{side},{side}", "--voxel", f"{48.0 / side:.6g}", *more]  # fmt: skip


def start(
    words: list[str], log: Path, limit: int | None = None
) -> subprocess.Popen[bytes]:
    """Start a command in single threads, its output to a log.

    Args:
        words: the command.
        log: overwritten.
        limit: of its memory [bytes]; None for none.
    """
    with log.open("wb") as file:
        return subprocess.Popen(
            words,
            stdout=file,
            stderr=file,
            env={**os.environ, **SINGLE},
            preexec_fn=limiter(limit),
        )


def digests(folder: Path) -> dict[str, str]:
    """Digest of each file under its final name."""
    return {
        str(f.relative_to(folder)): hashlib.sha256(f.read_bytes()).hexdigest()
        for f in folder.rglob("*")
        if f.is_file()
    }


def make_scan(folder: Path, views: int, panel: tuple[int, int]) -> Path:
    """Counts of a random blob."""
    import numpy as np

    import flexdt as fx

    rng = np.random.default_rng(1)
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, 32)] * 3, indexing="ij")
    values = 0.02 * (x * x + y * y + z * z < 0.8) * (1 + rng.random((32, 32, 32)))
    rows, cols = panel
    geometry = fx.ConeVec.circular(
        sod=600, sdd=1059, angles=views, shape=panel, pixel=105.0 / max(rows, cols)
    )
    fx.simulate(fx.Volume(values.astype(np.float32), 1.4), geometry, noise=1).save(
        folder / "scan"
    )
    return folder / "scan"


def speed(folder: Path, scan: Path, side: int) -> bool:
    """Seconds with 1, 2 and 4 processes."""
    whole = undisturbed(folder, scan, side)
    same, first = True, 0.0
    for count in (1, 2, 4):
        cluster = Cluster(folder, count)
        try:
            out = folder / f"by-{count}.zarr"
            # A first one on a coarse grid, so that imports and compiled kernels are loaded.
            warm = command(
                scan, folder / f"warm-{count}.zarr", 32, "--scheduler", cluster.address
            )
            subprocess.run(warm, check=True, capture_output=True)
            begun = time.monotonic()
            words = command(scan, out, side, "--scheduler", cluster.address)
            subprocess.run(words, check=True, capture_output=True)
            seconds = time.monotonic() - begun
        finally:
            cluster.end()
        equal = digests(out) == whole
        same, first = same and equal, first or seconds
        print(f"{count} processes: {seconds:.1f} s, {first / seconds:.2f} times as fast as one, "
              f"bytes {'equal' if equal else 'DIFFER'}", flush=True)  # fmt: skip
    return same


def undisturbed(folder: Path, scan: Path, side: int) -> dict[str, str]:
    """Digests of what all others must be."""
    out = folder / "undisturbed.zarr"
    cluster = Cluster(folder, 1)
    try:
        words = command(scan, out, side, "--scheduler", cluster.address)
        subprocess.run(words, check=True, capture_output=True)
    finally:
        cluster.end()
    return digests(out)


def kills(folder: Path, scan: Path, side: int, count: int, seed: int) -> bool:
    """Kill at random until `count` processes are killed and the last volume is there."""
    rng = random.Random(seed)
    whole = undisturbed(folder, scan, side)
    killed = {"worker": 0, "client": 0, "scheduler": 0}
    volumes = runs = wrong = 0
    codes: dict[int, int] = {}
    cluster = Cluster(folder, 2)
    out, log = folder / "v.zarr", folder / "client.log"
    begun = time.monotonic()
    try:
        while True:
            cluster.mend()
            client = start(command(scan, out, side, "--scheduler", cluster.address), log)
            runs += 1
            until = time.monotonic() + WITHIN_S
            while client.poll() is None and time.monotonic() < until:
                if sum(killed.values()) >= count:
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        client.wait(0.5)
                    cluster.mend()
                    continue
                with contextlib.suppress(subprocess.TimeoutExpired):
                    client.wait(rng.uniform(0.0, 6.0))
                    break
                victim = rng.choice(("worker", "worker", "client", "scheduler"))
                killed[victim] += 1
                target = {"worker": rng.choice(cluster.workers), "client": client,
                          "scheduler": cluster.scheduler}[victim]  # fmt: skip
                target.send_signal(signal.SIGKILL)
                target.wait()
                wrong += judged(folder, whole)
                cluster.mend()
            if client.poll() is None:
                client.kill()
                wrong += 1
                print("a client neither worked nor ended", flush=True)
            code = client.wait()
            codes[code] = codes.get(code, 0) + 1
            said = log.read_text()
            if (
                "Traceback" in said
                or "internal error" in said
                or code not in (0, 1, 4, -9)
            ):
                wrong += 1
                print(f"exit code {code}: {said[:700]} ... {said[-700:]}", flush=True)
            if code == 1 and "workers died" not in said:
                wrong += 1
                print(said[-500:], flush=True)
            if not out.exists():
                continue
            volumes += 1
            if digests(out) != whole:
                wrong += 1
                print(f"volume {volumes} differs", flush=True)
            if sum(killed.values()) >= count:
                break
            out.rename(folder / f"done-{volumes}.zarr")
    finally:
        cluster.end()
    left = [file.name for file in folder.glob(".*")]
    wrong += len(left)
    print(f"{killed['worker']} workers, {killed['client']} clients and {killed['scheduler']} "
          f"schedulers killed in {runs} runs (exit codes {codes}) within "
          f"{time.monotonic() - begun:.0f} s: {volumes} volumes made, {wrong} things wrong, "
          f"left {left}, seed {seed}")  # fmt: skip
    return not wrong


def judged(folder: Path, whole: dict[str, str]) -> int:
    """How many files under a final name are not the local command's."""
    bad = 0
    for store in folder.glob(".v.zarr.*.part/volume.zarr"):
        with contextlib.suppress(FileNotFoundError):  # it is being moved to its place
            found = {n: d for n, d in digests(store).items() if "/c/" in n}
            bad += sum(whole[name] != digest for name, digest in found.items())
    return bad


def memory(folder: Path, scan: Path, limit: int) -> bool:
    """A volume of four times the limit of each process."""
    side = 64 * round((4 * limit / 4) ** (1 / 3) / 64 + 0.499)
    cluster = Cluster(folder, 1, limit)
    log = folder / "client.log"
    try:
        begun = time.monotonic()
        out = folder / "large.zarr"
        client = start(
            command(scan, out, side, "--scheduler", cluster.address), log, limit
        )
        try:
            code = client.wait()
        finally:
            client.kill()
    finally:
        cluster.end()
    print(f"{side}^3 voxels, {4 * side**3 / 2**30:.2f} GiB, by processes of "
          f"{limit / 2**30:.2f} GiB of address space: exit code {code}, "
          f"{time.monotonic() - begun:.0f} s")  # fmt: skip
    if code:
        print(log.read_text()[-1500:], (folder / "dask.log").read_text()[-1500:])
    return code == 0


def main() -> int:
    """Make a scan and study speed, kills or memory, as the command line says; 1 if it
    failed.
    """
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("what", choices=("speed", "kills", "memory"))
    p.add_argument("--views", type=int, default=360)
    p.add_argument("--panel", default="380,478")
    p.add_argument("--side", type=int, default=256)
    p.add_argument("--kills", type=int, default=50)
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--limit", type=int, default=1024, help="MiB")
    o = p.parse_args()
    rows, cols = (int(n) for n in o.panel.split(","))
    print(f"{o.what}: {o.views} views of {rows} x {cols}. {machine()}.", flush=True)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that no process is left
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        folder = Path(name)
        scan = make_scan(folder, o.views, (rows, cols))
        if o.what == "speed":
            good = speed(folder, scan, o.side)
        elif o.what == "kills":
            good = kills(folder, scan, o.side, o.kills, o.seed)
        else:
            good = memory(folder, scan, o.limit << 20)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
