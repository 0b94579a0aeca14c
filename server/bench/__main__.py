"""`python -m flexdt.server.bench`: run it and hand out the document, the tables and the plot."""

from __future__ import annotations

import json
from pathlib import Path

from flexdt.process_settings import OneLine
from flexdt.server.bench.benchmark import case_names, listing, merged, run_bench, to_stderr
from flexdt.server.bench.markdown_table import into_page, tables
from flexdt.server.bench.plot import figure


def main() -> None:
    """Run the benchmark; the document goes to standard output or into DIR."""
    parser = OneLine(prog="flexdt bench", description=run_bench.__doc__)
    parser.add_argument("--json", action="store_true", help="print the document, nothing else")
    parser.add_argument("--out", type=Path, help="write bench.json, bench.md and bench.svg here")
    parser.add_argument(
        "--page", type=Path, help="renew on this Markdown page the figures of what was run"
    )
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="these cases only")
    parser.add_argument("--no-peers", action="store_true", help="do not run other projectors")
    parser.add_argument("--quick", action="store_true", help="C1 and C1-tilt without the rest")
    parser.add_argument("--list", action="store_true", help="name the cases, measure nothing")
    options = parser.parse_args()
    if options.list:
        print("\n".join(listing()))
        return
    unknown = [name for name in options.only if name not in case_names()]
    if unknown:
        parser.error(f"no case {', '.join(unknown)}; there are: {', '.join(case_names())}")
    only = ["C1", "C1-tilt"] if options.quick else options.only
    document = run_bench(
        only=only,
        with_peers=not options.no_peers,
        extra=not options.quick,
        tell=to_stderr,
    )
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "bench.json").write_text(json.dumps(document, indent=1) + "\n", "utf-8")
        (options.out / "bench.svg").write_text(figure(document), "utf-8")
        (options.out / "bench.md").write_text(tables(document) + "\n", "utf-8")
        to_stderr(f"wrote bench.json, bench.md and bench.svg into {options.out}")
    if options.page is not None:
        picture = options.page.parent / "images" / "bench.svg"
        picture.parent.mkdir(exist_ok=True)
        # What was not run now stays as it was: the page's document lies beside its picture.
        kept = picture.with_suffix(".json")
        if kept.exists():
            document = merged(json.loads(kept.read_text("utf-8")), document)
        kept.write_text(json.dumps(document, indent=1) + "\n", "utf-8")
        picture.write_text(figure(document), "utf-8")
        page = options.page.read_text("utf-8")
        options.page.write_text(into_page(page, document, "images/bench.svg"), "utf-8")
        to_stderr(f"renewed the figures of {options.page}")
    if options.json:
        print(json.dumps(document))


if __name__ == "__main__":
    main()
