"""`flexdt snap FILE`: a projection at the current pose, as TIFF (raw values) or PNG (windowed)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from flexdt.clients.cli.console import note
from flexdt.clients.cli.options import Answer, Twin, argument, option
from flexdt.clients.failure import CommandError

if TYPE_CHECKING:
    import numpy.typing as npt

    from flexdt.protocol.state_model import ImageFlags

SUFFIXES = (".tif", ".tiff", ".png")


def snap(
    twin: Twin,
    file: Path = argument(..., "FILE.{tif,png}"),
    kind: Literal["counts", "line_integral"] | None = option(
        None, "Write this kind; default: counts in a TIFF, integrals in a PNG."
    ),
    binning: int = option(1, "Average so many pixels a side.", min=1, max=32),
    marks: bool = option(True, "Colour saturated, starved and cut-off pixels of a PNG."),
) -> Answer:
    """Take a projection at the current pose.

    A TIFF holds the values as they come: uint16 counts unless said. A PNG is windowed to 8 bit,
    dense parts dark, and shows line integrals unless said, so X-rays may be off. It shows in colour
    what would be wrong with the exposure: saturated red, starved blue, cut-off edges yellow.
    """
    if file.suffix.lower() not in SUFFIXES:
        raise typer.BadParameter(f"{file.name}: the ending must be .tif or .png")
    if not file.absolute().parent.is_dir():
        raise CommandError(f"{file}: the folder does not exist")
    with twin() as client:
        wanted = kind or ("line_integral" if file.suffix.lower() == ".png" else "counts")
        tube = client.state().tube
        dark = wanted == "counts" and not (tube.on and tube.ready)
        colours = marks and file.suffix.lower() == ".png" and not dark
        taken = client.projection(kind=wanted, binning=binning, marks=colours)
    image = taken.image
    save(file, image, dark_is_dense=wanted == "line_integral", marks=taken.marks)
    if dark and not tube.on:
        note(
            "warning: X-rays are off, so this is a dark image; `flexdt tube --on` switches them on"
        )
    elif dark:
        note(f"warning: X-rays warm up (ready in {tube.ready_in_s:.1f} s): this is a dark image")
    elif taken.flags is not None:
        warn_of_exposure(taken.flags)
    flags = None if dark or taken.flags is None else taken.flags.model_dump()
    yield {"file": str(file), "dtype": str(image.dtype), "shape": image.shape,
           "cone_vec": taken.cone_vec, "kind": wanted, "flags": flags}  # fmt: skip
    rows, cols = image.shape
    yield f"{file}: {cols} x {rows} {image.dtype}"
    if taken.marks is not None:
        from flexdt.clients.datasets.pictures import legend

        yield from legend(taken.marks)


def warn_of_exposure(flags: ImageFlags) -> None:
    """Say which part of an image's pixels is saturated or starved, where it is worth saying."""
    from flexdt.twin.physics.exposure import NOTICED

    for name, share in (("saturated", flags.saturated), ("starved", flags.starved)):
        if share >= NOTICED:
            note(f"warning: {100 * share:.3g} % of the pixels are {name}")


def save(
    file: Path,
    image: npt.NDArray[Any],
    *,
    dark_is_dense: bool = False,
    marks: npt.NDArray[Any] | None = None,
) -> None:
    """Write an image as TIFF, or windowed to 8 bit as PNG, with its marks in colour.

    Raises:
        OSError: the file cannot be written.
    """
    if file.suffix.lower() == ".png":
        from flexdt.clients.datasets.pictures import png

        try:
            encoded = png(image, dark_is_dense=dark_is_dense, marks=marks)
        except ValueError as error:
            raise CommandError(f"{file}: {error}") from None
        file.write_bytes(encoded)
    else:
        import tifffile

        tifffile.imwrite(file, image)
