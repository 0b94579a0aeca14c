"""Which of the conventions that programs use fits a scan's images."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import permutations
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.library.datasets.image_set import ImageSet
from flexdt.twin import long_work
from flexdt.twin.errors import GeometryError, TwinError, shape_words
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.long_work import Progress
from flexdt.twin.reconstruction.consistency.peer_conventions import (
    CHANGES,
    MAX_MISFIT,
    Fit,
    changed,
    fits,
    remaining,
)
from flexdt.twin.signatures import public

AS_GIVEN: Final = "as given"
OWN_ORDER: Final = (0, 1, 2)
NO_REST: Final = np.zeros(2)


@public
@dataclass(frozen=True, eq=False)
class Convention:
    """What `find_convention` found.

    Attributes:
        decided: the images fit one convention, and exclude the others.
        names: of the conventions that remain, in words; mirror images of one object count
            as one, and the first of them is named.
        odds: every convention -> probability that it fits so much worse than the best by
            chance; 1 for the best.
        geometries: of `names`, for the images as they are stored, once their axes are in
            `order`.
        order: axes of the images as (views, rows, columns): `np.transpose(images, order)`.
        cause: why the images do not decide; empty if they do.
    """

    decided: bool
    names: tuple[str, ...]
    odds: Mapping[str, float] = field(default_factory=dict)
    geometries: tuple[ConeVec, ...] = ()
    order: tuple[int, int, int] = OWN_ORDER
    cause: str = ""

    @property
    def geometry(self) -> ConeVec:
        """The geometry that fits.

        Raises TwinError: the images do not decide."""
        if not self.decided:
            raise TwinError(str(self))
        return self.geometries[0]

    def __str__(self) -> str:
        """Say what fits, or that the images do not decide, as one sentence."""
        if self.decided:
            return f"the images fit: {self.names[0]} (up to a mirror image of the object)"
        if not self.names:
            return f"the images do not decide: {self.cause}"
        out = len(self.odds) - len(self.names)
        left = f"; {out} others do not fit" if out > 0 else ""
        return f"the images do not decide between: {'; or '.join(self.names)}{left}"

    def __repr__(self) -> str:
        return f"<Convention: {self}>"


@public
def find_convention(
    images: ImageSet | npt.ArrayLike,
    geometry: ConeVec | None = None,
    *,
    progress: Progress = None,
) -> Convention:
    """Find which flips, sense of rotation, signs of offsets and order of axes fit images.

    Every combination of these changes of the geometry is compared: images are
    reconstructed as of it on a coarse copy, and the volume is projected again. The
    residuals in arcs of views decide; a convention is named if each other one would fit
    so much worse by chance in fewer than one of a hundred cases, all together.

    Mirror images of the object fit equally: columns counted the other way and a stage that
    turns the other way, for instance. Of those the one with the fewest changes is named.

    Args:
        images: a data set, or line integrals (views, rows, columns) in this or another
            order of axes.
        geometry: a circle or a helix about z, one view for each image; None for the data
            set's.
        progress: a bar after two seconds; False for no bar, or a function of the fraction
            done.

    Raises:
        TwinError: no axis of the images is as long as the geometry has views, or the
            geometry turns about no axis along z.

    Example:
        >>> import numpy as np
        >>> scan = ConeVec.circular(sod=100, sdd=200, angles=12, shape=(4, 5), pixel=1)
        >>> print(find_convention(np.zeros((12, 4, 5)), scan))
        the images do not decide: too few views or columns, or no object
    """
    stacks = list(_stacks(images, geometry))
    tried: list[tuple[tuple[int, int, int], ConeVec, list[Fit]]] = []
    with long_work.during("comparing conventions", progress) as advance:
        for k, (order, stack, cone) in enumerate(stacks):
            shape = (stack.shape[1], stack.shape[2])
            try:
                found = fits(stack.__getitem__, cone, shape)
            except GeometryError as error:
                raise TwinError(
                    f"conventions are compared of circles and helices about z: {error.message}"
                ) from None
            tried.append((order, cone, found))
            advance((k + 1) / len(stacks))
    return _best_of(tried)


def _best_of(
    tried: list[tuple[tuple[int, int, int], ConeVec, list[Fit]]],
) -> Convention:
    """Choose between the orders of axes that were tried, and within one.

    Orders are compared by their misfit alone: one that fits (`MAX_MISFIT`) excludes those
    that do not.
    """
    fitting = [one for one in tried if one[2] and one[2][0].misfit <= MAX_MISFIT]
    if not fitting:
        return Convention(False, (), cause=_cause([found for _, _, found in tried]))
    if len(fitting) > 1:
        names = tuple(_words(found[0], order) for order, _, found in fitting)
        return Convention(False, names, cause="several orders of axes fit")
    order, cone, found = fitting[0]
    left = list(remaining(found))
    odds = {_words(fit, order): fit.odds for fit in found}
    names = tuple(_words(fit, order) for fit in left)
    made = tuple(
        changed(cone, fit.combinations[0], NO_REST).with_shape(cone.detector_shape)
        for fit in left
    )
    cause = "" if len(left) == 1 else "several fit as well"
    return Convention(len(left) == 1, names, odds, made, order, cause)


def _cause(found: list[list[Fit]]) -> str:
    """Say why no convention fits."""
    if not any(found):
        return "too few views or columns, or no object"
    if all(one[0].arcs is None for one in found if one):
        return "a volume of so few views does not show whether images fit"
    return "no convention fits; is the axis elsewhere, or are views in another order?"


def _words(fit: Fit, order: tuple[int, int, int]) -> str:
    """Name the first combination of a fit, and the order of axes unless it is the usual."""
    changes = [CHANGES[name] for name in CHANGES if name in fit.combinations[0]]
    if order != OWN_ORDER:
        axes = dict(zip(order, ("views", "rows", "columns"), strict=True))
        changes.insert(0, f"axes are {', '.join(axes[k] for k in range(3))}")
    return ", ".join(changes) or AS_GIVEN


def _stacks(
    images: ImageSet | npt.ArrayLike, geometry: ConeVec | None
) -> Iterator[tuple[tuple[int, int, int], npt.NDArray[np.float32], ConeVec]]:
    """Yield each order of the axes that fits the geometry, with the images in it.

    Raises:
        TwinError: images without a geometry, of other dimensions, or of sizes that no
            order fits.
    """
    if isinstance(images, ImageSet):
        cone = images.geometry if geometry is None else geometry
        values = images.stack(range(len(images)))
        orders = [OWN_ORDER]
    elif geometry is None:
        raise TwinError("find_convention of an array needs geometry=, a ConeVec")
    else:
        cone = geometry
        values = np.asarray(images, dtype=np.float32)
        orders = [(a, b, c) for a, b, c in permutations(OWN_ORDER)]
    if values.ndim != 3:
        raise TwinError.of_shape("images", values.shape, ("views", "rows", "columns"))
    wanted = cone.shape[1:] if cone.shape is not None else None
    found = False
    for order in orders:
        sizes = tuple(values.shape[k] for k in order)
        if sizes[0] != len(cone) or (wanted is not None and sizes[1:] != wanted):
            continue
        found = True
        yield order, np.ascontiguousarray(values.transpose(order)), cone
    if not found:
        rest = "" if wanted is None else f" of {wanted[0]} x {wanted[1]} pixels"
        raise TwinError.instead(
            f"images of shape {shape_words(values.shape)}, a geometry of {len(cone)} views{rest}",
            list(values.shape),
            "axes of these sizes, in any order",
        )
