"""`python -m flexdt_extensions.bench`: run it and hand out the document."""

from __future__ import annotations

import json
import os
from pathlib import Path

from flexdt.extending import OneLine
from flexdt.measuring import gpu
from flexdt_extensions.bench.benchmark import case_names, listing, run_bench, to_stderr
from flexdt_extensions.bench.device_page import page, run_device_bench


def main() -> None:
    """Run the benchmark; the document goes to standard output or into DIR."""
    parser = OneLine(prog="flexdt bench", description=run_bench.__doc__)
    parser.add_argument("--json", action="store_true", help="print the document, nothing else")
    parser.add_argument("--out", type=Path, help="write bench.json here")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="these cases only")
    parser.add_argument("--no-peers", action="store_true", help="do not run other projectors")
    parser.add_argument("--list", action="store_true", help="name the cases, measure nothing")
    parser.add_argument("--device", action="store_true", help="a CUDA device: its targets, a page")
    options = parser.parse_args()
    if options.list:
        print("\n".join(listing()))
        return
    unknown = [name for name in options.only if name not in case_names()]
    if unknown:
        parser.error(f"no case {', '.join(unknown)}; there are: {', '.join(case_names())}")
    text = ""
    if options.device:
        found = gpu.availability()
        if not found.present:
            parser.error(f"--device needs a CUDA device: {found.reason}")
        document = run_device_bench(to_stderr)
        text = page(document)
    else:
        # Here and in the processes that this one starts.
        os.environ["NUMBA_DISABLE_CUDA"] = "1"
        with gpu.switched_off():
            document = run_bench(only=options.only, with_peers=not options.no_peers, tell=to_stderr)
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        name = "device" if options.device else "bench"
        (options.out / f"{name}.json").write_text(json.dumps(document, indent=1) + "\n", "utf-8")
        if text:
            (options.out / "device.md").write_text(text + "\n", "utf-8")
        to_stderr(f"wrote {name}.json into {options.out}")
    elif text and not options.json:
        print(text)
    if options.json:
        print(json.dumps(document))


if __name__ == "__main__":
    main()
