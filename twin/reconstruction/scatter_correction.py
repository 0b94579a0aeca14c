"""Correction of a scan's line integrals for scatter, before reconstruction.

Beam hardening is in `beam_hardening.py`, flat field and logarithm in `flexdt.twin.dataset`,
rings in `consistency/ring_pattern.py`.

Scatter is computed from the scan itself: FDK gives the object's attenuation, the names of
its materials its scattering. That scatter is simulated (`flexdt.twin.physics.scatter`)
and subtracted from the measured signal, which gives a better volume, and so on until the
scatter stays (Zbijewski and Beekman, IEEE Trans. Med. Imaging 25 (2006) 817). Grids are
coarse, since scatter is smooth.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.attenuation.substances import tables
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.physics.chain import Chain, weights_of
from flexdt.twin.physics.scatter import Beam, Object, ScatterSettings, scan_scatter
from flexdt.twin.projection import Grid, Volume
from flexdt.twin.projection.operators import (
    as_cone_vec,
    check_projections,
    require_finite,
)
from flexdt.twin.reconstruction.acquisition.rectify import field_of_view
from flexdt.twin.reconstruction.acquisition.truncation import truncation_of
from flexdt.twin.reconstruction.beam_hardening import BLACK, hardening, require_apart
from flexdt.twin.reconstruction.feldkamp.fdk import fdk_parts

ROUNDS = 8
SETTLED = 0.01
"""Largest number of simulations and reconstructions, and the mean relative change of
the scatter at which they end."""
ROUND_DEG = 20.0
ROUND_NODES = 240
ROUND_ERROR = 0.05
"""Least angle step [deg], largest number of nodes and relative error of the
simulations in a round, which only have to find the object. The scatter that is
subtracted in the end is simulated by the settings."""
MOST = 0.9
OFTEN = 0.001
"""Largest part of a pixel's signal that counts as scatter, and the share of pixels
that may reach it without a warning."""
FINER: Final = 4
"""Voxels of FDK's grid, the complete field of view, per voxel of the settings' grid."""
AIR: Final = 0.15
"""Attenuation below which a voxel is empty, relative to the thinnest material's."""
UNLIKE: Final = 0.25
"""Relative difference of attenuation from which on the named materials are doubtful."""


@dataclass(frozen=True, eq=False)
class Scatterer:
    """The scattering object that was reconstructed from a scan.

    Attributes:
        thing: its voxels.
        changes: mean change of the scatter in each round, relative to its mean.
        doubts: doubts about the correction, in sentences.
    """

    thing: Object
    changes: tuple[float, ...]
    doubts: tuple[str, ...]


def without_scatter(
    line_integrals: npt.ArrayLike,
    cone_vec: ConeVec | npt.ArrayLike,
    chain: Chain,
    kV: float,
    settings: ScatterSettings | None = None,
) -> Float32Array:
    """Subtract the scatter from line integrals of a circular scan: finds the object
    (`scatterer_of`), simulates its scatter by the settings and subtracts it, at most
    `MOST` of a pixel's signal.

    Doubts about the correction are not reported; `scatterer_of` returns them.

    Args:
        line_integrals: (n, rows, cols), of the signal over the open beam's.
        cone_vec: ConeVec or (n, 12) [mm].
        chain: tube and panel, and the materials that the object is made of (see
            `scatterer_of`).
        kV: tube voltage.
        settings: of the simulation; None: the default ones.

    Returns:
        float32 (n, rows, cols).

    Raises:
        GeometryError: FDK cannot use the trajectory, or the source is in the object's
            box.
        LimitError: no material, two that attenuate alike, or no spectrum for `kV`.

    Example:
        >>> from flexdt.twin.attenuation.substances import Substance
        >>> from flexdt.twin.physics.chain import Chain
        >>> from flexdt.twin.physics.detector import Detector
        >>> scan = ConeVec.circular(sod=300, sdd=500, angles=36, shape=(20, 30), pixel=2)
        >>> chain = Chain(Detector(), substances=(Substance.of("water", "H2O", 1.0),))
        >>> air = np.zeros((36, 20, 30), np.float32)
        >>> bool(without_scatter(air, scan, chain, 90.0).any())
        False
    """
    cone = as_cone_vec(cone_vec)
    found = scatterer_of(line_integrals, cone, chain, kV, settings)
    stack = np.asarray(line_integrals, dtype=np.float32)
    beam = Beam.of(chain, kV)
    scatter = scan_scatter(found.thing, cone.rows, shape_of(stack), beam, settings)
    return np.stack(
        [subtracted(image, scatter.signal(i)) for i, image in enumerate(stack)]
    )


def subtracted(line_integrals: Float32Array, scatter: Float32Array) -> Float32Array:
    """Subtract scatter, in units of the open beam, from line integrals (rows, cols).

    These count up to `BLACK`; scatter up to `MOST` of the signal.
    """
    over = np.exp(np.minimum(line_integrals, np.float32(BLACK)))
    part = np.minimum(scatter * over, np.float32(MOST))
    return np.asarray(line_integrals - np.log1p(-part), dtype=np.float32)


def scatterer_of(
    line_integrals: npt.ArrayLike,
    cone_vec: ConeVec,
    chain: Chain,
    kV: float,
    settings: ScatterSettings | None = None,
) -> Scatterer:
    """Find the scattering object of a circular scan, in rounds of FDK, simulation and
    subtraction: until the scatter changes by less than `SETTLED`, at most `ROUNDS`.

    A voxel that attenuates as much as one of the materials is taken for it; one between
    two of them, or between one and air, for a mixture. Line integrals are straightened
    (beam hardening) as those of the material named first. The grid is the field of view,
    in at most about `FINER` times the settings' voxels. Rounds are simulated less exactly
    than the settings say.

    Args:
        line_integrals: float32 (n, rows, cols); coarse ones are enough.
        cone_vec: of the n views.
        chain: tube, panel and materials.
        kV: tube voltage.
        settings: of the simulation; None: the default ones.

    Returns:
        The object, the change in each round, and doubts, also if it did not settle.

    Raises:
        GeometryError: as `without_scatter`.
        LimitError: as `without_scatter`.
    """
    if settings is None:
        wanted = ScatterSettings()
    else:
        wanted = settings
    stack: Float32Array = check_projections(line_integrals, len(cone_vec))
    require_finite(stack)
    shape = shape_of(stack)
    whole = field_of_view(cone_vec, shape)
    coarser = (math.prod(whole.shape) / (FINER * wanted.voxels)) ** (1.0 / 3.0)
    grid = field_of_view(cone_vec, shape, whole.voxel_mm * max(1.0, coarser))
    (mu, straighten) = attenuations(chain, kV)
    beam = Beam.of(chain, kV)
    in_rounds = replace(
        wanted,
        step_deg=max(wanted.step_deg, ROUND_DEG),
        nodes=min(wanted.nodes, ROUND_NODES),
        error=max(wanted.error, ROUND_ERROR),
    )
    direct = stack
    before = np.zeros(())
    changes = list[float]()
    while True:
        volume = volume_of(straighten(direct), cone_vec, grid)
        thing = object_in(volume, chain, mu)
        scatter = scan_scatter(thing, cone_vec.rows, shape, beam, in_rounds)
        change = np.abs(scatter.nodes - before).mean() / max(scatter.nodes.mean(), 1e-300)
        changes.append(float(change))
        before = scatter.nodes
        images = [scatter.signal(i) for i in range(len(stack))]
        if changes[-1] < SETTLED or len(changes) == ROUNDS:
            break
        direct = np.stack([subtracted(*pair) for pair in zip(stack, images, strict=True)])
    dark = float(np.mean(np.asarray(images) * np.exp(stack) > MOST))
    doubts = doubts_about(dark, volume, chain, mu)
    if changes[-1] >= SETTLED:
        doubts.append(
            f"scatter still changes by {100 * changes[-1]:.1f} % after {ROUNDS} rounds"
        )
    return Scatterer(thing, tuple(changes), tuple(doubts))


def volume_of(stack: Float32Array, cone_vec: ConeVec, grid: Grid) -> Volume:
    """Reconstruct straightened line integrals by FDK with a Hann window, for the scatter
    estimate; truncated rows are continued, and voxels without a view are 0, as they scatter
    nothing.

    `stack`: (n, rows, cols); `cone_vec`: n views; `grid`: of the volume.
    """
    shape = shape_of(stack)
    truncation = truncation_of(stack.__getitem__, cone_vec, shape)
    volume = fdk_parts(
        lambda: [stack], cone_vec, shape, grid, "hann", None, truncation, outside=True
    )
    return replace(
        volume, data=np.nan_to_num(volume.data)
    )  # voxels without a view scatter nothing


def shape_of(stack: Float32Array) -> tuple[int, int]:
    """Return (rows, cols) of a stack."""
    return int(stack.shape[1]), int(stack.shape[2])


def attenuations(
    chain: Chain, kV: float
) -> tuple[FloatArray, Callable[[Float32Array], Float32Array]]:
    """Compute the materials' attenuation at the mean energy of the signal, and a function that
    straightens line integrals.

    Returns (m,) [1/mm], and a function that converts line integrals to those of the first
    material at that energy; of a monochromatic beam it returns them unchanged.
    Raises LimitError: no material, two that attenuate alike, or no spectrum for `kV`.
    """
    signal = weights_of(chain, kV)[0]
    energies = np.arange(len(signal))
    at = round(float(energies @ signal / signal.sum()))
    mu = np.array([one.attenuation()[at] for one in chain.substances])
    require_apart(chain.substances, mu)
    if chain.mono_keV is not None:
        return mu, lambda line_integrals: line_integrals
    keV = float(tables().energy_keV[at])
    return mu, hardening(chain.substances[0], kV, keV, chain.panel, chain.tube)


def object_in(volume: Volume, chain: Chain, mu: FloatArray) -> Object:
    """Convert the occupied box of a volume to amounts of the materials.

    A value between two materials is a mixture of both, one above the densest is more of
    it, and one below `AIR` times the thinnest material's is air.

    Args:
        volume: attenuations [1/mm].
        chain: its substances are the k materials.
        mu: (k,) their attenuations [1/mm].

    Returns:
        Amounts (nz, ny, nx, k), relative to the materials' densities, in the smallest box
        that holds the object; of the whole volume, all 0, if it is empty.
    """
    order = np.argsort(mu)
    knots = np.concatenate([[0.0], mu[order]])
    values = np.where(volume.data > AIR * knots[1], volume.data, np.float32(0.0))
    occupied = np.argwhere(values)
    size = np.array(values.shape)
    if len(occupied):
        box = occupied
    else:
        box = np.array([0 * size, size - 1])
    low = box.min(axis=0)
    high = box.max(axis=0) + 1
    values = values[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    amounts = np.empty((*values.shape, len(mu)), np.float32)
    for knot, material in enumerate(order, 1):
        amounts[..., material] = np.interp(values, knots, np.eye(len(knots))[knot])
    amounts *= np.maximum(values / np.float32(knots[-1]), np.float32(1.0))[..., None]
    shift = ((low + high - size) / 2.0)[::-1] * volume.voxel_xyz
    x, y, z = (float(c) for c in np.array(volume.center_mm) + shift)
    return Object(amounts, volume.voxel_xyz, (x, y, z), chain.substances)


def doubts_about(dark: float, volume: Volume, chain: Chain, mu: FloatArray) -> list[str]:
    """List doubts about a correction, in sentences; empty without doubts.

    Doubts are: more than `OFTEN` of the pixels nearly all scatter, nothing in the volume,
    or a 99th percentile that differs from the densest material by more than `UNLIKE`.

    Args:
        dark: share of the pixels whose signal would be nearly all scatter.
        volume: reconstructed without the scatter.
        chain: with the materials named.
        mu: (m,) their attenuation in the volume [1/mm].
    """
    out = []
    if dark > OFTEN:
        share = f"over {100 * MOST:g} % of the signal"
        out.append(f"scatter would be {share} in {100 * dark:.2g} % of the pixels")
    filled = volume.data[volume.data > AIR * max(float(volume.data.max()), 0.0)]
    if not len(filled):
        return [*out, "nothing in the field of view attenuates, so no scatter was found"]
    ratio = float(np.percentile(filled, 99)) / float(mu.max())
    if abs(ratio - 1.0) > UNLIKE:
        name = chain.substances[int(np.argmax(mu))].name
        voxel = volume.voxel_xyz[0]
        out.append(
            f"the densest part attenuates {ratio:.2g} times as much as {name}: either "
            f"it is not {name}, or it is smaller than {voxel:.2g} mm voxels"
        )
    return out
