"""`flexdt bench`: runs the project's own benchmarks."""

from __future__ import annotations

import json
import os
from pathlib import Path

from flexdt.extending import Answer, CommandError, names, option

INVALID_OPTIONS = 2
"""Exit code of invalid options."""


def bench(
    out: Path | None = option(None, "Write bench.json here.", metavar="DIR"),
    only: str | None = option(None, "Run these cases only.", metavar="NAME,NAME,..."),
    no_peers: bool = option(False, "Do not run other projectors.", "--no-peers"),
    list_: bool = option(False, "Name the cases, measure nothing.", "--list"),
    device: bool = option(
        False, "Measure a CUDA device against its targets and ASTRA.", "--device"
    ),
) -> Answer:
    """Measure speed and accuracy of the projector, beside the peers that are installed.

    A CUDA device is not used, unless --device measures it alone: then --only and --no-peers
    have no effect, and DIR gets device.json and device.md.

    Yields:
        The document of --json; with --device and without DIR its page, too; with --list
        only names and lines of the cases.
    """
    from flexdt.measuring import gpu
    from flexdt_extensions.bench.benchmark import (
        case_names,
        listing,
        run_bench,
        to_stderr,
    )
    from flexdt_extensions.bench.device_page import page, run_device_bench

    if list_:
        yield case_names()
        yield from listing()
        return
    wanted = [] if only is None else names(only)
    if unknown := [name for name in wanted if name not in case_names()]:
        known = ", ".join(case_names())
        raise CommandError(
            f"no case {', '.join(unknown)}; there are: {known}", INVALID_OPTIONS
        )
    text = ""
    name = "bench"
    if device:
        found = gpu.availability()
        if not found.present:
            raise CommandError(
                f"--device needs a CUDA device: {found.reason}", INVALID_OPTIONS
            )
        document = run_device_bench(to_stderr)
        text = page(document)
        name = "device"
    else:
        # Here and in the processes that this one starts.
        os.environ["NUMBA_DISABLE_CUDA"] = "1"
        with gpu.switched_off():
            document = run_bench(only=wanted, with_peers=not no_peers, tell=to_stderr)
    yield document
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / f"{name}.json").write_text(json.dumps(document, indent=1) + "\n", "utf-8")
        if text:
            (out / "device.md").write_text(text + "\n", "utf-8")
        to_stderr(f"wrote {name}.json into {out}")
    elif text:
        yield text
