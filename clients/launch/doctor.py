"""Checks of an installation, one function for each.

Compiled kernels are judged by their result (a sphere, whose shadow is known in closed form),
not by their presence. The only thing written is a temporary file in the data directory.
"""

from __future__ import annotations

import os
import platform
import re
import socket
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Final, Literal

from flexdt.message_words import reason_of
from flexdt.runtime.files.directory import memory_bytes
from flexdt.runtime.files.whole_files import free_bytes, nearest_there
from flexdt.twin import kernel_threads

Verdict = Literal["ok", "warning", "error"]
WORST_ERROR: Final = 1e-5
"""Largest allowed deviation of the float32 kernels from the closed form, relative to
its maximum."""
LITTLE_ROOM_BYTES: Final = 5 << 30
SLOW_SYNC_S: Final = 0.05
TOTAL_COMPILE_S: Final = 40
"""Processor time for which the groups of `compile_ahead` compile, in all [s]; about, of one core
of 2023."""


@dataclass(frozen=True)
class CheckOutcome:
    """Result of one check; `advice` where something can be done."""

    what: str
    verdict: Verdict
    found: str
    advice: str = ""


def examine(data: Path, ports: Sequence[tuple[str, int]]) -> Iterator[CheckOutcome]:
    """Run all checks, one after the other; a check that fails is an error among the
    results.

    Order: python, packages, kernels, kernel cache, threads, memory, gpu, each port, disk.
    Each check runs only when its result is requested. The error of a check that fails has
    its name, and the exception's type and text.

    Args:
        data: the data directory, which need not exist.
        ports: name of a server ("twin", for one) and the port it is to listen on.

    Yields:
        One result for each check.
    """
    checks: list[tuple[str, Callable[[], CheckOutcome]]] = [
        ("python", python),
        ("packages", packages),
        ("kernels", kernels),
        ("kernel cache", kernel_cache),
        ("threads", threads),
        ("memory", memory),
        ("gpu", gpu),
    ]
    checks += [(f"port {port}", partial(listening, name, port)) for name, port in ports]
    checks.append(("disk", partial(disk, data)))
    for name, check in checks:
        try:
            yield check()
        except Exception as error:  # the other checks go on
            yield CheckOutcome(name, "error", f"{type(error).__name__}: {error}")


def python() -> CheckOutcome:
    """Report interpreter, version, platform and flexdt's version; always "ok"."""
    found = f"{platform.python_implementation()} {platform.python_version()}, {platform.system()}"
    return CheckOutcome(
        "python", "ok", f"{found} {platform.machine()}, flexdt {version('flexdt')}"
    )


def packages() -> CheckOutcome:
    """Check that all required packages of flexdt are installed; those of extras are not
    checked.

    An "ok" lists the versions, an "error" the missing packages. Advice for missing ones:
    pip install flexdt.
    """
    have = []
    lack = []
    for name in needed():
        try:
            have.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            lack.append(name)
    if lack:
        return CheckOutcome(
            "packages", "error", f"missing: {', '.join(lack)}", "pip install flexdt"
        )
    return CheckOutcome("packages", "ok", ", ".join(have))


def needed() -> tuple[str, ...]:
    """Names of the packages that every installation of flexdt has."""
    lines = requires("flexdt") or []
    wanted = [line for line in lines if "extra" not in line.partition(";")[2]]
    return tuple(re.split(r"[^A-Za-z0-9._-]", line, maxsplit=1)[0] for line in wanted)


def kernels() -> CheckOutcome:
    """Compile and run the projector, and compare the shadow of a sphere with its closed
    form.

    A sphere of radius 10 mm and 0.02 /mm is projected to 33 x 47 pixels; the deviation is
    relative to the shadow's maximum.

    Returns:
        An error with the advice to reinstall numba where the largest deviation exceeds
        `WORST_ERROR`, otherwise "ok", never a warning; each states the deviation and the
        time of the first use [s], which compiles.
    """
    import numpy as np

    from flexdt.twin.projection import project_scene
    from flexdt.twin.projection.analytic_solids import Scene, Solid, Sphere

    radius = 10.0
    mu = 0.02
    source = -400.0
    detector = 600.0
    scene = Scene((Solid(Sphere((0.0, 0.0, 0.0), radius), "test", mu),))
    shape = (33, 47)
    pitch = 1.0
    row = np.array(
        [[0, source, 0, 0, detector, 0, pitch, 0, 0, 0, 0, -pitch]], dtype=np.float64
    )
    begun = time.perf_counter()
    image = project_scene(scene, row, shape)[0]
    first = time.perf_counter() - begun
    x = (np.arange(shape[1]) - (shape[1] - 1) / 2) * pitch
    z = ((shape[0] - 1) / 2 - np.arange(shape[0]))[:, None] * pitch
    ray = np.stack(np.broadcast_arrays(x, detector - source, z), axis=-1)
    ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    away = np.linalg.norm(np.cross(ray, [0.0, source, 0.0]), axis=-1)
    right = 2.0 * mu * np.sqrt(np.maximum(radius**2 - away**2, 0.0))
    worst = float(np.abs(image - right).max() / right.max())
    found = f"a sphere's shadow is right to {worst:.1e}; first use took {first:.1f} s"
    if worst > WORST_ERROR:
        return CheckOutcome(
            "kernels", "error", found, "reinstall numba; see docs/performance.md"
        )
    return CheckOutcome("kernels", "ok", found)


def kernel_cache() -> CheckOutcome:
    """Report where compiled kernels are kept and what first use will compile; a warning if
    they cannot be kept."""
    from flexdt.runtime.kernels import compile_ahead, kernel_files

    files = kernel_files.opened()
    place = files.writable()
    missing = [
        name for name in compile_ahead.GROUPS if not compile_ahead.is_compiled(name)
    ]
    if missing:
        cost = (
            f"first use compiles {', '.join(missing)} (some {TOTAL_COMPILE_S} s for all)"
        )
    else:
        cost = "nothing is left to compile"
    if place is None:
        return CheckOutcome(
            "kernel cache",
            "warning",
            f"no folder can be written ({files.told()}); each process: {cost}",
            "set FLEXDT_CACHE to a folder of your own",
        )
    found = f"{place.folder} ({place.chosen_by}); {cost}"
    return CheckOutcome(
        "kernel cache", "ok", found, "flexdt kernels compile" if missing else ""
    )


def threads() -> CheckOutcome:
    """Report usable cores, numba's threads, layer and (of OpenMP) waiting policy; a
    warning if threads are fewer than usable cores.

    Usable are the cores of the process's affinity, or all where the system has none.
    """
    import numba

    usable = os.cpu_count()
    if hasattr(os, "sched_getaffinity"):
        usable = len(os.sched_getaffinity(0))
    found = f"{usable} of {os.cpu_count()} cores usable, {numba.get_num_threads()} numba threads"
    found += f", threading layer {numba.threading_layer()}"
    if numba.threading_layer() == "omp":
        found += f", waiting {kernel_threads.waiting}"
    if usable is not None and numba.get_num_threads() < usable:
        return CheckOutcome(
            "threads", "warning", found, "NUMBA_NUM_THREADS is below the cores"
        )
    return CheckOutcome("threads", "ok", found)


def memory() -> CheckOutcome:
    """Report the machine's memory: "ok" above 3 GiB, else "warning"."""
    total = memory_bytes()
    found = f"{total / 2**30:.1f} GiB; the projector holds volumes up to half of it"
    return CheckOutcome("memory", "ok" if total > 3 << 30 else "warning", found)


def gpu() -> CheckOutcome:
    """Report the CUDA device, or why the processor computes; without a device "ok", only
    a failing one is a warning.

    "failed" in the device's reason makes the warning.
    """
    from flexdt.twin.projection.gpu import availability

    found = availability()
    if found.present:
        computes = f"{found.reason} computes"
    else:
        computes = f"the processor: {found.reason}"
    return CheckOutcome("gpu", "warning" if "failed" in found.reason else "ok", computes)


def listening(what: str, port: int) -> CheckOutcome:
    """Check that a port is free for a server, or find the twin that listens there.

    A warning if something else listens; a twin that answers is "ok". The port is bound
    for a moment on 127.0.0.1, then freed. "ok" if it is free, or if a twin answers within
    2 s (also one that requires a token); the warning advises another port.

    Args:
        what: name of the server; "twin" is greeted where the port is in use.
        port: on the loopback.
    """
    name = f"port {port}"
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError as error:
            taken = error
        else:
            return CheckOutcome(name, "ok", f"free for the {what}")
    if what == "twin":
        answer = _greeting(port)
    else:
        answer = ""
    if answer:
        return CheckOutcome(name, "ok", f"{answer} listens")
    advice = f"fine if that is your {what}; else choose another port"
    return CheckOutcome(name, "warning", f"in use ({reason_of(taken)})", advice)


def disk(data: Path) -> CheckOutcome:
    """Check that data sets can be written: free space, rights, time to flush 1 MiB.

    An error if it cannot be written, a warning with little room or a slow disk; nothing
    stays there. Limits: below `LITTLE_ROOM_BYTES` (5 GiB) free, or more than
    `SLOW_SYNC_S` (0.05 s) to flush 1 MiB; little room is reported first.

    Args:
        data: the data directory; a temporary file is written there, or in its nearest
            parent.
    """
    folder = nearest_there(data)
    try:
        with tempfile.NamedTemporaryFile(dir=folder) as file:
            file.write(b"\0" * (1 << 20))
            file.flush()
            begun = time.perf_counter()
            os.fsync(file.fileno())
            took = time.perf_counter() - begun
        free = free_bytes(folder)
    except OSError as error:
        return CheckOutcome(
            "disk", "error", f"{folder} cannot be written: {reason_of(error)}", "--data"
        )
    found = f"{folder}: {free / 2**30:.1f} GiB free, 1 MiB reaches the disk in {1000 * took:.1f} ms"
    if free < LITTLE_ROOM_BYTES:
        return CheckOutcome(
            "disk", "warning", found, "a scan of 1500 frames takes 2 to 4 GiB"
        )
    if took > SLOW_SYNC_S:
        return CheckOutcome(
            "disk", "warning", found, "slow; scans at full speed will wait for it"
        )
    return CheckOutcome("disk", "ok", found)


def _greeting(port: int) -> str:
    """Greet the twin on `port` and return its name and protocol; "a twin that wants a
    token" if it refuses for lack of one, "" on any other failure.

    Waits at most 2 s for an answer.
    """
    from flexdt.clients.client.client import TwinClient
    from flexdt.protocol import Code, RpcError

    try:
        with TwinClient(port=port, name="flexdt doctor", timeout_s=2.0) as twin:
            return f"{twin.server.server} (protocol {twin.server.protocol})"
    except RpcError as error:
        if error.code == Code.NOT_AUTHORISED:
            return "a twin that wants a token"
        return ""
    except OSError:
        return ""
