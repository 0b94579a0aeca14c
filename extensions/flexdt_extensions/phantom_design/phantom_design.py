"""`flexdt phantom design`: bead places, compared with the spiral's, and how to build
them.

The search itself is `bead_search`. This module turns a request into poses and seats,
checks the forecast by fits to noisy simulated points, and writes the result.

The building instructions are a drawing and a list of steps for each brick of a stack, or
for each height at which a block holds beads.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from flexdt.extending import CommandError
from flexdt.library.figures import COLOURS, DPI, blank, require_plots, svg
from flexdt.library.report_page import bullets, heading, page, paragraph, table
from flexdt.phantoms import Phantom, cuboid_with_beads, spiral_positions
from flexdt.phantoms.bricks import Brickwork, lego_phantom
from flexdt.twin.calibration import IN_IMAGES, BeadModel, Prediction
from flexdt.twin.calibration.fit.weak_directions import BOUND, TOLERANCE, unit_of
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.camera import CameraSettings
from flexdt_extensions.phantom_design.bead_search import (
    Design,
    design,
    forecast,
    measured_spread,
    share_identified,
    stated,
)
from flexdt_extensions.phantom_design.information_table import (
    CRITERIA,
    Criterion,
    PlannedScans,
)
from flexdt_extensions.phantom_design.seats import (
    grid_seats,
    seats_of,
    stack_phantom,
    tubes_at,
)

if TYPE_CHECKING:
    import trimesh
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from flexdt.twin.machine.description import Machine, Profile

Tell = Callable[[str], None]
GRID_STEP_MM = 4.0
"""Step of the seats of a free design, before beads are moved off them."""


@dataclass(frozen=True)
class BeadHolder:
    """Holder of the beads.

    Attributes:
        bricks: a LEGO stack, or None for a block.
        size_mm: of the block.
        material: of the block.
    """

    bricks: Brickwork | None
    size_mm: tuple[float, float, float]
    material: str = "abs"


@dataclass(frozen=True)
class DesignRequest:
    """Number, kind and criterion of the beads to place; see `design`."""

    beads: int = 5
    radius_mm: float = 1.0
    bead_material: str = "steel"
    per_brick: int | None = None
    criterion: Criterion = "a"
    starts: int = 8
    seed: int = 1
    trials: int = 60


def circle_poses(
    machine: Machine,
    placements: Sequence[tuple[float, float]],
    sdd_mm: float,
    frames: int,
) -> tuple[Poses, tuple[int, int]]:
    """Compute one turn per placement (SOD, lateral), beam through the phantom's middle.

    Args:
        machine: with its default camera.
        placements: (SOD, lateral shift) [mm].
        sdd_mm: source-detector distance [mm].
        frames: of each turn.

    Returns:
        Poses of all frames, and the detector's shape (rows, cols).

    Raises:
        CommandError: a SOD that is not between 0 and the SDD, or values that are not
            finite.
    """
    for sod, lateral in placements:
        if not (0.0 < sod < sdd_mm < math.inf and math.isfinite(lateral)):
            raise CommandError(
                f"SOD {sod:g} mm, lateral {lateral:g} mm and SDD {sdd_mm:g} mm; "
                "allowed: finite, 0 < SOD < SDD"
            )
    camera = machine.detector.camera
    pitch = camera.pixel_mm(machine.detector.pixels)
    angle = 2.0 * math.pi * np.arange(frames) / frames
    parts = [
        Poses.upright([0, 0, 0], [lateral, sod, 0], [0, sdd_mm, 0], pitch, angle)
        for sod, lateral in placements
    ]
    return Poses.concatenate(parts), camera.shape


def script_poses(
    text: str, machine: Machine, profile: Profile
) -> tuple[Poses, tuple[int, int]]:
    """Plan a script and compute its projections' poses, the phantom's middle at the
    sample's height.

    Args:
        text: the script.
        machine, profile: to plan it with.

    Returns:
        Poses, and the detector's shape (rows, cols).

    Raises:
        ScriptError: the script does not hold.
        CommandError: it takes no projection, or changes the camera between them.
    """
    from flexdt.twin.machine.kinematics import poses
    from flexdt.twin.script import parse_script, plan_script

    plan = plan_script(parse_script(text), machine, profile)
    shots = [e for e in plan.exposures if e.kind == "projection"]
    cameras: list[CameraSettings] = []
    for shot in shots:
        if shot.camera not in cameras:
            cameras.append(shot.camera)
    if len(cameras) != 1:
        raise CommandError(
            f"the script takes {len(shots)} projections with {len(cameras)} camera settings; a "
            "design needs projections with one setting"
        )
    names = shots[0].positions
    table = {name: np.array([s.positions[name] for s in shots]) for name in names}
    return poses(machine, profile, cameras[0], table), cameras[0].shape


def run_design(
    body: BeadHolder,
    scans: PlannedScans,
    request: DesignRequest,
    *,
    out: Path | None = None,
    tell: Tell,
) -> dict[str, Any]:
    """Search a design, compare it with the spiral, check both by fits, and write `out`.

    `gain` is the spiral's score over the design's; None if the spiral does not determine
    the geometry. Fits are made only with two or more trials.

    Args:
        body: holder of the beads.
        scans: planned.
        request: number of beads, criterion, trials and seed.
        out: folder for the files of `write`; None writes nothing.
        tell: called with each line of progress.

    Returns:
        The document of `--json`: request, `design`, `spiral`, `gain`, `assumed` and, if
        written, `files`.

    Raises:
        TwinError: the beads do not fit, every set is ambiguous, or `out` is given without
            matplotlib.
    """
    if out is not None:
        require_plots()
    tell(f"criterion: {CRITERIA[request.criterion]}")
    found = _search(body, scans, request)
    phantom = _phantom(body, found, request)
    spiral, spiral_name = _spiral(body, request)
    ours = BeadModel(phantom.beads, phantom.bead_radius_mm, name=phantom.name)
    theirs = BeadModel(spiral, np.array(request.radius_mm), name=spiral_name)
    tell(f"checking the forecast with {request.trials} fits of each")
    entries: list[dict[str, Any]] = []
    for model in (ours, theirs):
        guess = forecast(model, scans, request.criterion)
        measured = None
        if request.trials >= 2 and math.isfinite(guess.worst):
            measured = measured_spread(
                model, scans, trials=request.trials, seed=request.seed
            )
        entries.append(
            {
                "name": model.name,
                "beads": model.beads.tolist(),
                "score": guess.score,
                "sigmas": guess.sigmas,
                "image_sigmas": guess.image_sigmas,
                "measured": measured,
                **_said(stated(model, scans)),
                "shadows_used": guess.used,
                "determined": guess.worst <= BOUND / TOLERANCE["mm"],
                "identified": share_identified(model, scans, seed=request.seed),
            }
        )
    gain = None
    if entries[1]["determined"]:
        gain = entries[1]["score"] / entries[0]["score"]
    document: dict[str, Any] = {
        "criterion": request.criterion,
        "criterion_text": CRITERIA[request.criterion],
        "frames": len(scans.poses),
        "noise_px": scans.noise_px,
        "bead_tolerance_mm": scans.bead_tolerance_mm,
        "free": list(scans.free),
        "priors": dict(scans.widths),
        "trials": request.trials,
        "seed": request.seed,
        "discarded": found.discarded,
        "design": entries[0],
        "spiral": entries[1],
        "gain": gain,
        "assumed": list(phantom.assumed),
    }
    if out is not None:
        document["files"] = write(out, phantom, body, request, document)
    return document


def verdict(document: dict[str, Any]) -> str:
    """Compare the design's score with that of the thesis's spiral in a sentence; states
    if the spiral does not determine the geometry (no gain).
    """
    name = document["spiral"]["name"]
    gain = document["gain"]
    if gain is None:
        return f"{name} does not determine the geometry in this scan (its shadows hide each other)"
    return f"score {document['criterion_text']}: {gain:.2f} times better than {name}"


def table_rows(document: dict[str, Any]) -> list[tuple[str, ...]]:
    """Make the rows of the comparison: optimized effects in the images, then the
    parameters.

    Args:
        document: of `run_design`.

    Returns:
        Name, unit, predicted and measured of the design and what `flexdt calibrate` states
        of it (half of the scans less; in brackets the range of eight in ten), predicted and
        measured of the spiral, and the gain: the spiral's prediction divided by the
        design's ("-" where the document has no gain), as text.
    """
    ours = document["design"]
    theirs = document["spiral"]
    return [
        (
            f"{name} (optimized)" if kind == "image_sigmas" else name,
            IN_IMAGES[name] if kind == "image_sigmas" else unit_of(name),
            f"{sigma:.3g}",
            _of(ours["measured"], name),
            _with_range(ours, name),
            f"{theirs[kind][name]:.3g}",
            _of(theirs["measured"], name),
            "-" if document["gain"] is None else f"{theirs[kind][name] / sigma:.2f}",
        )
        for kind in ("image_sigmas", "sigmas")
        for name, sigma in ours[kind].items()
    ]


HEADER = (
    "parameter", "unit", "design", "measured", "calibrate states", "spiral", "measured", "gain",
)  # fmt: skip


def write(
    out: Path,
    phantom: Phantom,
    body: BeadHolder,
    request: DesignRequest,
    document: dict[str, Any],
) -> list[str]:
    """Write phantom.json, phantom.stl, build.html, one PNG for each brick or level, and
    design.json.

    Existing files of these names are overwritten.

    Args:
        out: folder, made if need be.
        phantom: the design.
        body: holder of the beads.
        request: radius of the beads.
        document: of `run_design`.

    Returns:
        Names of the files.
    """
    out.mkdir(parents=True, exist_ok=True)
    names = ["phantom.json", "phantom.stl", "build.html"]
    (out / "phantom.json").write_text(json.dumps(phantom.to_dict()), encoding="utf-8")
    _solid(phantom, body).export(out / "phantom.stl", file_type="stl")
    if body.bricks is None:
        word = "level"
        drawings = level_drawings(body.size_mm, phantom.beads, request.radius_mm)
    else:
        word = "brick"
        drawings = brick_drawings(body.bricks, phantom.beads, request.radius_mm)
    sections: list[str] = []
    for k, drawing in enumerate(drawings, 1):
        names.append(f"{word}-{k}.png")
        (out / names[-1]).write_bytes(drawing.png())
        sections += [
            heading(drawing.title, level=2),
            drawing.svg(),
            bullets(drawing.steps),
        ]
    (out / "build.html").write_text(_page(phantom, sections, document), encoding="utf-8")
    names.append("design.json")
    (out / "design.json").write_text(
        json.dumps({**document, "files": names}, indent=1), encoding="utf-8"
    )
    return names


def _search(body: BeadHolder, scans: PlannedScans, request: DesignRequest) -> Design:
    """Search for the best bead places in a body: seats of its bricks, or a grid in the
    block.

    In a block the grid has a step of about `GRID_STEP_MM`, a bead's radius of material
    stays around the beads, and they may then be moved off it.

    Args:
        body: bricks or block.
        scans: planned ones.
        request: number and radius of beads, criterion and so on.
    """
    radius = request.radius_mm
    where = dict[str, Any]()
    if body.bricks is not None:
        seats = seats_of(body.bricks, radius)
        places = seats.places
        where = {"slots": seats.brick, "per_slot": request.per_brick}
    else:
        # A skin of a bead's radius stays round the beads, so that they are held.
        places = grid_seats(body.size_mm, 2.0 * radius, GRID_STEP_MM)
        where = {"bounds_mm": np.asarray(body.size_mm) / 2.0 - 2.0 * radius}
    return design(
        places,
        radius,
        request.beads,
        scans,
        criterion=request.criterion,
        starts=request.starts,
        seed=request.seed,
        **where,
    )


def _phantom(body: BeadHolder, found: Design, request: DesignRequest) -> Phantom:
    """Build the phantom of a design: a stack of bricks, or a block.

    Its name is "designed-K"; materials are noted as assumed.

    Args:
        body: holder of the beads.
        found: places of the beads.
        request: number, radius and material of the beads.
    """
    name = f"designed-{request.beads}"
    if body.bricks is not None:
        return stack_phantom(
            body.bricks, name, found.beads, request.radius_mm, request.bead_material
        )
    made = cuboid_with_beads(
        name,
        body.size_mm,
        found.beads,
        request.radius_mm,
        body_material=body.material,
        bead_materials=(request.bead_material,) * request.beads,
        description=f"{request.beads} {request.bead_material} beads where they determine most in a "
        f"block of {body.material}",
    )
    return replace(
        made, assumed=(f"body of {body.material}, beads of {request.bead_material}",)
    )


def _spiral(
    body: BeadHolder, request: DesignRequest
) -> tuple[npt.NDArray[np.float64], str]:
    """Return the thesis's beads (k, 3) [mm] for the same body and number, and the name of
    the set: its LEGO phantom for that stack and five beads, else a spiral within the
    walls.
    """
    if body.bricks == Brickwork() and request.beads == 5:
        return lego_phantom().beads, "lego (thesis 6.5.1)"
    size = body.size_mm
    if body.bricks is not None:
        wall = body.bricks.measures["wall_mm"]
        size = (size[0] - 2 * wall, size[1] - 2 * wall, size[2])
    return spiral_positions(
        size, request.beads, request.radius_mm
    ), "spiral of the same size"


def _solid(phantom: Phantom, body: BeadHolder) -> trimesh.Trimesh:
    """Build the mesh for the STL file: bricks and beads; without bricks the block with
    beads as cavities.
    """
    mesh = phantom.mesh()
    if body.bricks is not None:
        return mesh
    import trimesh.util

    block, *balls = (part.mesh for part in phantom.parts())
    for ball in balls:
        ball.invert()
    return cast("trimesh.Trimesh", trimesh.util.concatenate([block, *balls]))


def _page(phantom: Phantom, sections: Sequence[str], document: dict[str, Any]) -> str:
    """Make the HTML page of the building instructions.

    With verdict, table of sigmas, drawings, bead places, criterion and assumptions.

    Args:
        phantom: the design.
        sections: HTML of the drawings and steps.
        document: of `run_design`.
    """
    beads = [
        f"bead {k + 1}: ({x:+.2f}, {y:+.2f}, {z:+.2f}) mm"
        for k, (x, y, z) in enumerate(phantom.beads.tolist())
    ]
    title = f"How to build {phantom.name}"
    lead = [
        phantom.description,
        f"Predicted and measured standard deviations ({document['trials']} fits to noisy "
        f"simulated points, {document['noise_px']} px, {document['frames']} frames); gain is "
        "the spiral's divided by the design's.",
        verdict(document),
    ]
    notes = [
        "Beads in the object's frame (x right, y away from the source, z up): "
        f"{'; '.join(beads)}",
        f"Chosen by: {document['criterion_text']}",
        f"Assumed: {'; '.join(phantom.assumed)}",
    ]
    rows = table(HEADER, table_rows(document))
    body = [*map(paragraph, lead), rows, *sections, *map(paragraph, notes)]
    return page(title, [heading(title), *body])


def _of(measured: dict[str, float] | None, name: str) -> str:
    if measured is None:
        return "-"
    return f"{measured[name]:.3g}"


def _said(found: Prediction | None) -> dict[str, Any]:
    """Return what scans state (`stated`), and the range of eight in ten (`stated_ranges`),
    by quantity; None where they do not determine the geometry.
    """
    if found is None:
        return {"stated": None, "stated_ranges": None}
    return {
        "stated": found.sigmas | found.image_sigmas,
        "stated_ranges": {name: list(ends) for name, ends in found.ranges.items()},
    }


def _with_range(entry: Mapping[str, Any], name: str) -> str:
    if entry["stated"] is None:
        return "-"
    text = f"{entry['stated'][name]:.3g}"
    low, high = (f"{end:.3g}" for end in entry["stated_ranges"][name])
    return text if low == high else f"{text} ({low} to {high})"


SCALE_PX_MM = 12.0
"""Scale of the drawings [pixels/mm]."""
MARGIN_MM = 5.5
BRICK = "#f2d16b"
HOLE = "#fffaf0"
TUBE = "#e3b93f"
LINE = "#7a6420"
BEAD = COLOURS[1]


@dataclass(frozen=True)
class Drawing:
    """One drawing of the instructions.

    Attributes:
        title: of the drawing.
        figure: to scale, x to the right and y down [mm] from the middle.
        steps: instructions, one line each.
    """

    title: str
    figure: Figure
    steps: tuple[str, ...]

    def svg(self) -> str:
        """Convert to an SVG element."""
        return svg(self.figure)

    def png(self) -> bytes:
        """Convert to a PNG file."""
        file = io.BytesIO()
        self.figure.savefig(file, format="png", dpi=DPI)
        return file.getvalue()


def brick_drawings(
    work: Brickwork, beads: npt.NDArray[np.float64], radius: float
) -> Iterator[Drawing]:
    """Draw each brick, seen from below, lowest brick first.

    The steps give for every bead its distances from the outer faces and the lower edge
    [mm], or say that there is none.

    Args:
        work: the stack.
        beads: centers (k, 3) in the object's frame [mm].
        radius: of a bead [mm].
    """
    v = work.measures
    wide, deep, _ = work.size_mm
    owner = np.floor((beads[:, 2] - work.floor(0)) / v["brick_height_mm"]).astype(int)
    for brick in range(work.bricks):
        # Seen from below with +x to the right, the source's side (-y) is at the top.
        axes = _sheet(wide, deep, top="towards the source", bottom="towards the detector")
        _rectangle(axes, wide - 2 * v["wall_mm"], deep - 2 * v["wall_mm"], HOLE)
        for x, y in tubes_at(work).tolist():
            _disc(axes, x, y, v["tube_outer_diameter_mm"] / 2, TUBE)
            _disc(axes, x, y, v["tube_inner_diameter_mm"] / 2, HOLE)
        steps = []
        for k in np.flatnonzero(owner == brick):
            x, y, z = beads[k].tolist()
            _bead(axes, x, y, radius, int(k) + 1)
            if y < 0:
                edge = "towards the source"
            else:
                edge = "away from the source"
            side = "left" if x < 0 else "right"
            steps.append(
                f"bead {k + 1}: centre {wide / 2 - abs(x):.2f} mm from the {side} outer face, "
                f"{deep / 2 - abs(y):.2f} mm from the outer face {edge}, "
                f"{z - work.floor(brick):.2f} mm above the brick's lower edge"
            )
        lowest = " (lowest)" if brick == 0 else ""
        yield Drawing(
            f"Brick {brick + 1} of {work.bricks}{lowest}, seen from below",
            axes.get_figure(root=True),  # type: ignore[arg-type]
            tuple(steps) or ("no bead in this brick",),
        )


def level_drawings(
    size: Sequence[float], beads: npt.NDArray[np.float64], radius: float
) -> Iterator[Drawing]:
    """Draw each height at which a block holds beads, seen from above, lowest first.

    The steps give each bead's place from the axis [mm], and where to interrupt the print.
    Heights that agree in a thousandth of a millimeter are one.

    Args:
        size: of the block along x, y and z [mm].
        beads: centers (k, 3) in the object's frame [mm].
        radius: of a bead [mm].
    """
    wide, deep, tall = size
    for z in sorted({round(float(b), 3) for b in beads[:, 2]}):
        axes = _sheet(wide, deep, top="towards the detector", bottom="towards the source")
        steps = []
        for k in np.flatnonzero(np.isclose(beads[:, 2], z, atol=6e-4)):
            x, y, _ = beads[k].tolist()
            _bead(axes, x, -y, radius, int(k) + 1)
            steps.append(
                f"bead {k + 1}: x = {x:+.2f} mm, y = {y:+.2f} mm from the axis; interrupt the "
                f"print {z + tall / 2:.2f} mm above the lowest face and press the bead in"
            )
        yield Drawing(
            f"{z + tall / 2:.2f} mm above the lowest face, seen from above",
            axes.get_figure(root=True),  # type: ignore[arg-type]
            tuple(steps),
        )


def _sheet(wide: float, deep: float, top: str, bottom: str) -> Axes:
    """Draw the outline of a brick or block [mm] on axes that fill a new figure, y
    downwards, its edges named; returns the axes.
    """
    w = wide + 2 * MARGIN_MM
    h = deep + 2 * MARGIN_MM
    figure = blank(w * SCALE_PX_MM, h * SCALE_PX_MM)
    figure.set_layout_engine("none")
    axes = figure.add_axes((0, 0, 1, 1), xlim=(-w / 2, w / 2), ylim=(h / 2, -h / 2))
    axes.set_axis_off()
    _rectangle(axes, wide, deep, BRICK)
    _label(axes, 0, -deep / 2 - 3.0, f"edge {top}")
    _label(axes, 0, deep / 2 + 3.0, f"edge {bottom}")
    _label(axes, -wide / 2 - 2.8, 0, "left", 1.3)
    _label(axes, wide / 2 + 2.8, 0, "right", 1.3)
    return axes


def _rectangle(axes: Axes, wide: float, deep: float, fill: str) -> None:
    from matplotlib.patches import Rectangle

    axes.add_patch(Rectangle((-wide / 2, -deep / 2), wide, deep, fc=fill, ec=LINE))


def _disc(
    axes: Axes, x: float, y: float, radius: float, fill: str, above: int = 1
) -> None:
    from matplotlib.patches import Circle

    axes.add_patch(Circle((x, y), radius, fc=fill, ec=LINE, zorder=above))


def _bead(axes: Axes, x: float, y: float, radius: float, number: int) -> None:
    """Draw a bead [mm] as a disc with its number, over a cross."""
    reach = 2.2 * radius
    axes.plot([x - reach, x + reach], [y, y], color=LINE, lw=1.0)
    axes.plot([x, x], [y - reach, y + reach], color=LINE, lw=1.0)
    _disc(axes, x, y, radius, BEAD, above=3)  # over the cross
    _label(axes, x, y, str(number), 1.3)


def _label(axes: Axes, x: float, y: float, text: str, size_mm: float = 1.5) -> None:
    axes.text(x, y, text, ha="center", va="center", size=size_mm * SCALE_PX_MM, zorder=4)
