"""`flexdt bench`: runs the project's own benchmarks, which are a separate program."""

from __future__ import annotations

from pathlib import Path

from flexdt.extending import Json, become, names, option


def bench(
    out: Path | None = option(None, "Write bench.json here.", metavar="DIR"),
    only: str | None = option(None, "Run these cases only.", metavar="NAME,NAME,..."),
    no_peers: bool = option(False, "Do not run other projectors.", "--no-peers"),
    list_: bool = option(False, "Name the cases, measure nothing.", "--list"),
    device: bool = option(
        False, "Measure a CUDA device against its targets and ASTRA.", "--device"
    ),
    json: Json = False,
) -> None:
    """Measure speed and accuracy, beside the peers that are installed."""
    given = {"out": out, "no-peers": no_peers, "list": list_, "device": device}
    more = [] if only is None else ["--only", *names(only)]
    become("flexdt_extensions.bench", {**given, "json": json}, more)
