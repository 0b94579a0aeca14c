"""`flexdt bench`: the projector against its peers, its accuracy, and where its speed ends.

`run_bench(...)` returns the document that `flexdt bench --json` prints. Everything that is
compared runs in one process and one run, turn by turn, so that ratios survive a noisy machine.
"""

from flexdt_extensions.bench.benchmark import run_bench

__all__ = ["run_bench"]
