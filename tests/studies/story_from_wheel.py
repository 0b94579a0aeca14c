"""Run the story's notebooks from the built wheel, in an environment of its own, and look at
what they show.

    python tests/studies/story_from_wheel.py [--here] [--write]
        [--wheel FILE] [--python PYTHON ...]

Builds the wheel of this tree (or takes FILE), installs it with the extra `notebook` into a new
environment of each PYTHON (this one, unless named), and executes `docs/story/*.ipynb` in a new
folder, one after the other, since each begins with the files of the one before. `--here` takes
the environment that this program runs in, as it is. `--write` keeps the outputs in `docs/story`.
Fails where a cell fails, shows nothing or "nan", a picture is empty or cut, or a notebook takes
longer than `MAX_S` of processor time.
"""

from __future__ import annotations

import argparse
import base64
import io
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).resolve().parents[2]
STORY: Final = ROOT / "docs" / "story"
MAX_S: Final = 180.0 * 2
"""Processor time of a notebook: three minutes on two cores."""
NEEDED: Final = ("nbclient>=0.10", "ipykernel>=6.29", "nbformat>=5.10")
UNSAID: Final = re.compile(r"\bnan\b|Traceback|object at 0x")
"""What no output may have."""
PICTURES: Final = re.compile(r"base64,[\w+/=]*")
"""Pictures within HTML."""
EXECUTE: Final = """
import sys, nbformat
from nbclient import NotebookClient
source, target = sys.argv[1:]
notebook = nbformat.read(source, as_version=4)
NotebookClient(notebook, timeout=600, kernel_name="python3").execute()
nbformat.write(notebook, target)
"""


def environment(folder: Path, wheel: Path, python: str) -> Path:
    """Make a clean environment with the wheel, and return its Python."""
    uv = [sys.executable, "-m", "uv"]
    subprocess.run([*uv, "venv", "-q", "--python", python, folder], check=True)
    own = folder / "bin" / "python"
    words = [*uv, "pip", "install", "-q", "--python", own, "-c", ROOT / "constraints.txt"]
    subprocess.run([*words, f"{wheel}[notebook]", *NEEDED], check=True)
    return own


def built(folder: Path) -> Path:
    """Build the wheel of this tree into a folder."""
    words = [
        sys.executable,
        "-m",
        "uv",
        "build",
        "-q",
        "--wheel",
        "--out-dir",
        folder,
        ROOT,
    ]
    subprocess.run(words, check=True)
    (wheel,) = folder.glob("flexdt-*.whl")
    return wheel


def faults_of(notebook: dict[str, Any]) -> Iterator[str]:
    """Yield what is wrong with a notebook's outputs."""
    shown = 0
    for number, cell in enumerate(notebook["cells"]):
        for output in cell.get("outputs", ()):
            if output["output_type"] == "error":
                yield f"cell {number}: {output['ename']}: {output['evalue']}"
            data = output.get("data", {})
            page = PICTURES.sub("", "".join(data.get("text/html", "")))
            said = "".join(output.get("text", "")), "".join(data.get("text/plain", ""))
            texts = (*said, page)
            for text in texts:
                if found := UNSAID.search(text):
                    yield f"cell {number} shows {found[0]!r}"
            shown += bool(data or "".join(texts).strip())
            if "image/png" in data:
                yield from faults_of_picture(number, base64.b64decode(data["image/png"]))
    if not shown:
        yield "nothing is shown"


def faults_of_picture(number: int, content: bytes) -> Iterator[str]:
    """Yield what is wrong with a picture: one grey, or ink on its edge, where it is cut."""
    import numpy as np
    from PIL import Image

    pixels = np.asarray(Image.open(io.BytesIO(content)).convert("L"), dtype=int)
    if np.ptp(pixels) < 50:
        yield f"cell {number}: a picture is empty"
    edges = np.concatenate([pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]])
    if (edges < 128).mean() > 0.002:
        yield f"cell {number}: a picture is cut"


def told(python: str, options: argparse.Namespace) -> list[str]:
    """Run the story on one Python, print the seconds, and return its faults."""
    faults = []
    with tempfile.TemporaryDirectory() as where:
        folder = Path(where)
        own = Path(python)
        if not options.here:
            wheel = options.wheel or built(folder / "dist")
            own = environment(folder / "env", wheel, python)
        work = folder / "work"
        work.mkdir()
        path = f"{own.parent}:/usr/bin:/bin"
        for source in sorted(STORY.glob("*.ipynb")):
            target = folder / source.name
            begun = used_s()
            done = subprocess.run(
                [own, "-c", EXECUTE, source, target], cwd=work, check=False,
                env={"PATH": path, "HOME": where, **passed_on(options.here)},
                capture_output=True, text=True,
            )  # fmt: skip
            seconds = used_s() - begun
            print(
                f"{python}: {source.stem}: {seconds:.0f} s of processor time", flush=True
            )
            if done.returncode:
                faults.append(f"{source.stem}: {done.stderr.strip().splitlines()[-1]}")
                print(done.stderr[-3000:])
                break
            notebook = json.loads(target.read_text("utf-8"))
            faults += [f"{source.stem}: {fault}" for fault in faults_of(notebook)]
            if seconds > MAX_S:
                faults.append(f"{source.stem}: {seconds:.0f} s, longer than {MAX_S:g} s")
            if options.write:
                source.write_text(plain(notebook), encoding="utf-8")
    return faults


def passed_on(here: bool) -> dict[str, str]:
    """Of the environment: where modules are if they are to be this tree's, and kernels."""
    names = ["NUMBA_NUM_THREADS", "FLEXDT_CACHE", *(["PYTHONPATH"] if here else [])]
    return {name: os.environ[name] for name in names if name in os.environ}


def plain(notebook: dict[str, Any]) -> str:
    """Write a notebook without what differs from run to run: times, and widgets, which need
    a program."""
    for cell in notebook["cells"]:
        cell.get("metadata", {}).pop("execution", None)
        if "outputs" in cell:
            cell["outputs"] = [o for o in cell["outputs"] if not passing(o)]
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            data.pop("application/vnd.jupyter.widget-view+json", None)
    notebook["metadata"].pop("widgets", None)
    return json.dumps(notebook, indent=1, ensure_ascii=False, sort_keys=True) + "\n"


def passing(output: dict[str, Any]) -> bool:
    """Whether an output is a bar of progress that has gone, or tells of kernels that are
    compiled once."""
    if output.get("name") == "stderr":
        return all("flexdt: " in line for line in "".join(output["text"]).splitlines())
    data = output.get("data", {})
    return "text/html" in data and not "".join(data["text/html"]).strip()


def used_s() -> float:
    """Return the processor time of ended children [s]."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def main() -> int:
    """Run the story on each Python; 1 where something is wrong."""
    parser = argparse.ArgumentParser(description="the story from the wheel")
    parser.add_argument("--here", action="store_true", help="in this environment")
    parser.add_argument("--write", action="store_true", help="keep the outputs")
    parser.add_argument("--wheel", type=Path, help="a wheel that is built already")
    parser.add_argument("--python", nargs="+", default=[sys.executable])
    options = parser.parse_args()
    faults = [fault for python in options.python for fault in told(python, options)]
    print(*faults, sep="\n")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
