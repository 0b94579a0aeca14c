"""Experiment 4's synthetic twin on images: `flexdt study real --fidelity images`.

The computation is `flexdt.twin.calibration.studies.real_images`; here are the phantom, the beam and
the processes. It refuses to tell any scan another's truth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from flexdt.clients.executors import executor
from flexdt.phantoms import load_phantom
from flexdt.phantoms.materials import material
from flexdt.twin.calibration.beads import BeadModel, bead_model
from flexdt.twin.calibration.studies import real_images
from flexdt.twin.calibration.studies.real import scan_names
from flexdt.twin.calibration.studies.runs import Run, summary
from flexdt.twin.physics import Chain, EffectiveBeam, Panel, effective_beam
from flexdt.twin.physics.chain import weights_of

KILOVOLTS = 90.0
RealImagesTask = tuple[str, BeadModel, int, int, tuple[int, ...]]
"""Scan, beads as found, seed, frames, numbers of projections."""


def lego_beam() -> EffectiveBeam:
    """Effective energies of the tube's beam behind the LEGO phantom."""
    names = sorted({solid.material for solid in load_phantom("lego").scene.solids})
    signal, noise = weights_of(Chain(Panel()), KILOVOLTS)
    longest = [60.0 if name == "abs" else 2.5 for name in names]
    return effective_beam(signal, noise, [material(n).substance for n in names], longest)


def real_images_task(task: RealImagesTask) -> list[Run]:
    """One scan."""
    name, found, seed, frames, counts = task
    phantom = load_phantom("lego")
    return real_images.image_runs(
        name, phantom.scene, bead_model(phantom), found, lego_beam(), seed, frames=frames,
        counts=counts,
    )  # fmt: skip


def run_real_images(
    *,
    out: Path | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    seed: int = 1,
    tell: Callable[[str], None] | None = None,
    scans: Sequence[str] | None = None,
    frames: int = real_images.FRAMES,
    counts: Sequence[int] = real_images.COUNTS,
) -> dict[str, object]:
    """The first scan gives the beads, all scans are calibrated with them.

    Args:
        out, jobs, scheduler, seed, tell: as `study.run_study`.
        scans: names; None is all eleven.
        frames: images of a scan.
        counts: numbers of images to calibrate from.
    """
    phantom = load_phantom("lego")
    model = bead_model(phantom)
    found, _ = real_images.first_scan("Scan1", phantom.scene, model, lego_beam(), seed, frames)
    really = real_images.hidden_phantom(phantom.scene, model, seed)[1]
    chosen = scan_names() if scans is None else tuple(scans)
    work = [(name, found, seed, frames, tuple(counts)) for name in chosen]
    runs: list[Run] = []
    with executor(jobs, scheduler) as pool:
        results = map(real_images_task, work) if pool is None else pool.map(real_images_task, work)
        for name, some in zip(chosen, results, strict=True):
            runs += some
            if tell is not None:
                tell(f"{name}: {sum(r.success for r in some)} of {len(some)} runs succeed")
    document = summary("real", "images", runs)
    document["beads_off_truth_mm"] = real_images.off_truth(found, really).tolist()
    if out is not None:
        from flexdt.clients.study_report import write_study

        write_study(out, document, runs)
    return document
