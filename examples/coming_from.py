"""The pages for users of other programs, run: each peer's lines beside ours, smaller.

    python examples/coming_from.py [astra cil gvxr tigre ...]

Takes the code blocks of docs/coming-from/ as they stand, makes panel, views and volume small,
runs ours, then runs each peer's line by line. A line that fails (nothing installed, no CUDA
device) is reported and the others go on, so that a peer's geometry is compared even where it
cannot project. Prints JSON: for each block its lines, the peer's version, how many statements
ran, the first error, and how far its result is from ours.

gvxr needs Mesa's software OpenGL where there is no graphics card: see
tests/studies/compare_gvxr.py.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import io
import json
import os
import re
import tempfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

import flexdt as fx

PAGES = Path(__file__).resolve().parents[1] / "docs" / "coming-from"
BLOCK = re.compile(r":caption: ([^\n]+)\n\n(.*?)```", re.DOTALL)
SMALLER = {"360": "40", "760": "38", "956": "48", "0.1496": "2.0", "256": "24", "0.2": "1.0",
           "51.2": "24.0", "25.6": "12.0"}  # fmt: skip
"""Numbers of the pages -> numbers of the runs: a panel of 38 x 48, 40 views, 24 voxels a
side."""
PACKAGES = {
    "ASTRA": "astra-toolbox",
    "gVXR": "gvxr",
    "TIGRE": "pytigre",
}
MONO_KEV = 60.0
"""One energy, so that the two sides differ by geometry alone."""
ON_THE_CARD = re.compile(
    r"_gpu\(|astra\.algorithm|\bA\(|\bA\.T\(|tsa\.|ts\.operator\("
    r"|\bProjectionOperator\(|FDK\w*\("
)
"""Calls of ASTRA, tomosipo and CIL that end the process where there is no CUDA device."""


def blocks(page: str) -> dict[str, str]:
    """Return caption -> code of a page's blocks, with views, pixels and voxels made
    smaller by `SMALLER`.
    """
    text = (PAGES / f"{page}.md").read_text(encoding="utf-8")
    numbers = re.compile(
        r"(?<![\w.])(" + "|".join(map(re.escape, SMALLER)) + r")(?![\w.])"
    )
    return {
        caption: numbers.sub(lambda found: SMALLER[found[0]], code)
        for caption, code in BLOCK.findall(text)
    }


def given() -> dict[str, Any]:
    """Return the names that the blocks presuppose, and write the files that they read
    into the working directory.

    The names are `array`, a volume (24, 24, 24), and `spectrum`; the files a mesh,
    vectors and line integrals.
    """
    array = np.zeros((24, 24, 24), np.float32)
    array[6:18, 6:18, 6:18] = 0.05
    array[8:11, 13:16, 15:18] = 0.0
    part = [trimesh.creation.cone(8, 20), trimesh.creation.box((4, 6, 8))]
    part[1].apply_translation((14, 2, 3))
    trimesh.util.concatenate(part).export("part.stl")
    scan = fx.ConeVec.circular(sod=400, sdd=800, angles=24, shape=(24, 28), pixel=4.8)
    np.save("vectors.npy", scan.rows)
    np.save("line_integrals.npy", fx.project("shepp-logan", scan))
    return {"array": array, "spectrum": [(MONO_KEV, 1e6)]}


def has_card() -> bool:
    """Return whether ASTRA is installed and finds a CUDA device."""
    try:
        import astra
    except ImportError:
        return False
    return bool(astra.use_cuda())


def run(code: str, names: dict[str, Any]) -> dict[str, object]:
    """Run code statement by statement, without its output; after an error the next
    statement is run.

    Without a CUDA device statements that need one count as an error.

    Args:
        code: of a block.
        names: global names, which the code changes.

    Returns:
        `statements` and `ran`, counts, and `error`, the first one with its line, or None.
    """
    statements, error, ran, card = ast.parse(code).body, None, 0, has_card()
    for statement in statements:
        try:
            if not card and ON_THE_CARD.search(ast.unparse(statement)):
                raise RuntimeError("needs a CUDA device")
            with contextlib.redirect_stdout(io.StringIO()):
                exec(compile(ast.Module([statement], []), "<page>", "exec"), names)
            ran += 1
        except Exception as failed:
            text = (str(failed).strip().splitlines() or [""])[-1][:120]
            error = error or f"line {statement.lineno}: {type(failed).__name__}: {text}"
    return {"statements": len(statements), "ran": ran, "error": error}


def spread_mm(rows: np.ndarray, wanted: fx.ConeVec, upwards: bool) -> float:
    """Compute the largest difference of two geometries [mm]; `upwards`: v of the other points
    upwards."""
    ours = wanted.rows.copy()
    ours[:, 9:] *= -1 if upwards else 1
    return float(np.abs(rows - ours).max()) if rows.shape == ours.shape else float("nan")


def cil_rows(theirs: dict[str, Any]) -> np.ndarray:
    """Return the geometry (n, 12) of CIL's `scan`, as CIL gives it to ASTRA for its
    `volume`.
    """
    from cil.plugins.astra.utilities import convert_geometry_to_astra_vec_3D

    rows: np.ndarray = convert_geometry_to_astra_vec_3D(theirs["volume"], theirs["scan"])[
        1
    ]["Vectors"]
    return rows


def compared(peer: str, theirs: dict[str, Any], ours: dict[str, Any]) -> dict[str, float]:
    """Compare a peer's results with flexdt's: geometry [mm], projections, images or
    volume.

    Args:
        peer: name of the program.
        theirs: names after the code of its block.
        ours: names after the code of flexdt's block.

    Returns:
        Largest differences `geometry_mm`, `there_and_back_mm` (tomosipo's geometry converted
        and back) and `projections`; `mean_difference_part` and, with its images mirrored,
        `mean_difference_part_if_mirrored`, over the mean of flexdt's; `rms_error_part`, over
        the true volume's largest value. A result that the peer did not make is left out.
    """
    out: dict[str, float] = {}
    turn, scan = ours.get("turn"), theirs.get("scan")
    if scan is not None and turn is not None:
        if peer == "ASTRA":
            out["geometry_mm"] = spread_mm(
                fx.ConeVec.from_astra(scan).rows, turn, upwards=True
            )
        elif peer == "tomosipo":
            out["geometry_mm"] = spread_mm(
                fx.ConeVec.from_tomosipo(scan).rows, turn, upwards=True
            )
            again = fx.ConeVec.from_tomosipo(turn.to_tomosipo())
            out["there_and_back_mm"] = spread_mm(again.rows, turn, upwards=False)
        elif peer == "CIL":
            out["geometry_mm"] = spread_mm(cil_rows(theirs), turn, upwards=False)
    if peer in ("ASTRA", "tomosipo") and "projections" in theirs:
        other = np.asarray(theirs["projections"]).swapaxes(0, 1)[:, ::-1]
        out["projections"] = float(np.abs(other - ours["projections"]).max())
    if peer == "gVXR" and "data" in ours and len(theirs.get("images", ())) == len(turn):
        tube = fx.Tube(mono_keV=MONO_KEV)
        mine = fx.simulate(ours["part"], turn, tube=tube).line_integrals()
        other = -np.log(np.stack(theirs["images"]))
        mirrored = np.abs(mine - other[:, :, ::-1]).mean()
        out["mean_difference_part"] = float(np.abs(mine - other).mean() / mine.mean())
        out["mean_difference_part_if_mirrored"] = float(mirrored / mine.mean())
    if peer == "CIL with flexdt" and "found" in theirs:
        rest = np.asarray(theirs["found"]) - ours["array"]
        out["rms_error_part"] = float(np.sqrt(np.mean(rest**2)) / ours["array"].max())
    return out


def named(peer: str) -> str | None:
    """Return the installed version of a peer; None if it is not installed."""
    try:
        return version(PACKAGES.get(peer, peer.split()[0].lower()))
    except PackageNotFoundError:
        return None


def page(name: str) -> dict[str, object]:
    """Run all blocks of a page in a temporary folder, flexdt's first, and compare them.

    Returns:
        Caption -> lines of code, peer's version, the result of `run`, and differences.
    """
    here = os.getcwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            ours, out = given(), {}
            for caption, code in sorted(
                blocks(name).items(), key=lambda b: b[0] != "flexdt"
            ):
                peer = caption.split(",")[0]
                lines = sum(bool(line.strip()) for line in code.splitlines())
                start = ours if peer in ("flexdt", "CIL with flexdt") else given()
                names = ours if peer == "flexdt" else dict(start)
                found = {"lines": lines, "version": named(peer), **run(code, names)}
                out[caption] = {**found, **compared(peer, names, ours)}
            return out
        finally:
            os.chdir(here)


def main() -> None:
    """Run the named pages, or all, and print the results as JSON."""
    every = sorted(path.stem for path in PAGES.glob("*.md") if blocks(path.stem))
    parser = argparse.ArgumentParser(
        description="the pages for users of other programs, run"
    )
    parser.add_argument("pages", nargs="*", default=every, choices=every)
    print(json.dumps({name: page(name) for name in parser.parse_args().pages}, indent=1))


if __name__ == "__main__":
    main()
