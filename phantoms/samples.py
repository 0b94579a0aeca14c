"""Anything to scan as a phantom: arrays, meshes, files, solids, names, and lists of them.

`as_phantom` reads the samples of `flexdt.simulate` and of the command line.
`load_phantom` knows the phantoms that ship with the package, by name: `normal-7` is a
cuboid of Table 6.2 with seven beads.

The Shepp-Logan head phantom in three dimensions is ten additive ellipsoids, exact for
X-rays. Its attenuation is the table's contrast times that of water.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from flexdt.phantoms.beads import CUBOIDS_MM, DEFAULT_BEADS, bead_phantom, chiral_phantom
from flexdt.phantoms.bricks import lego_phantom
from flexdt.phantoms.checked_reading import PhantomError
from flexdt.phantoms.files import phantom_files as files
from flexdt.phantoms.files.mesh_files import (
    FORMATS,
    filled_mesh,
    mesh_phantom,
    voxel_phantom,
)
from flexdt.phantoms.gears import gear_phantom
from flexdt.phantoms.phantom import Phantom, assemble
from flexdt.phantoms.pieces import size_about_origin
from flexdt.phantoms.placement import Place, placed
from flexdt.phantoms.standard import ball_bar, ball_helix, ball_plate, two_rings
from flexdt.twin.attenuation.materials import material as material_of
from flexdt.twin.errors import UnknownNameError
from flexdt.twin.geometry.conventions import FloatArray, rotation_z
from flexdt.twin.projection import Volume
from flexdt.twin.projection.analytic_solids import Ellipsoid, Scene, Solid, Vector
from flexdt.twin.signatures import public

# Contrast, semi-axes (x, y, z), centre (x, y, z), turn about z [deg], in a unit of half
# the height. Ellipsoids: Shepp and Logan 1974 in Kak and Slaney's 3D form (1988);
# contrasts: Toft 1996.
_ELLIPSOIDS: Final = (
    (1.0, (0.6900, 0.920, 0.810), (0.0, 0.0, 0.0), 0.0),
    (-0.8, (0.6624, 0.874, 0.780), (0.0, -0.0184, 0.0), 0.0),
    (-0.2, (0.1100, 0.310, 0.220), (0.22, 0.0, 0.0), -18.0),
    (-0.2, (0.1600, 0.410, 0.280), (-0.22, 0.0, 0.0), 18.0),
    (0.1, (0.2100, 0.250, 0.410), (0.0, 0.35, -0.15), 0.0),
    (0.1, (0.0460, 0.046, 0.050), (0.0, 0.1, 0.25), 0.0),
    (0.1, (0.0460, 0.046, 0.050), (0.0, -0.1, 0.25), 0.0),
    (0.1, (0.0460, 0.023, 0.050), (-0.08, -0.605, 0.0), 0.0),
    (0.1, (0.0230, 0.023, 0.020), (0.0, -0.606, 0.0), 0.0),
    (0.1, (0.0230, 0.046, 0.020), (0.06, -0.605, 0.0), 0.0),
)
_CUBOID: Final = re.compile(r"([a-z]+)-([1-9][0-9]{0,3})")
FILLED_TOLERANCE: Final = 1e-3
"""Distance by which the filled part of a voxel may be outside 0 to 1."""
TEXT_SUFFIXES: Final = (".toml", ".json")
"""Suffixes of phantom and scene files."""
ALLOWED_FORMS: Final = (
    "a phantom or its name, the path of a file (TOML, JSON, "
    + ", ".join(FORMATS).upper()
    + "), a Volume, an array [z, y, x] with voxel_mm, a mesh with vertices and faces, "
    "a Scene or Solid, a dictionary as in a scene file, (any of these, material), "
    "or a list of them"
)
"""Kinds of samples, for error messages."""


@public
def shepp_logan(size_mm: float = 50.0) -> Phantom:
    """Make the Shepp-Logan phantom in a cube, [-1, 1] in its definition.

    An attenuation of 1 in the definition is that of water. The phantom's `size_mm` is the
    extent of the skull, which is smaller than the cube.

    Args:
        size_mm: side of the cube.

    Example:
        >>> len(shepp_logan(50.0).scene.solids)
        10
    """
    half = size_mm / 2.0
    water = material_of("water").mu_per_mm
    solids = []
    for contrast, semi_axes, center, turn_deg in _ELLIPSOIDS:
        rows = rotation_z(math.radians(turn_deg)).T.tolist()
        a, b, c = (half * s for s in semi_axes)
        x, y, z = (half * p for p in center)
        axes = (tuple(rows[0]), tuple(rows[1]), tuple(rows[2]))
        solids.append(
            Solid(Ellipsoid((x, y, z), (a, b, c), axes), "water", contrast * water)
        )
    skull = _ELLIPSOIDS[0][1]
    return Phantom(
        "shepp-logan",
        f"Shepp-Logan head phantom of ten ellipsoids in a {size_mm:g} mm cube, "
        "contrast times the attenuation of water",
        Scene(tuple(solids)),
        (size_mm * skull[0], size_mm * skull[1], size_mm * skull[2]),
        assumed=("attenuation 1 of the table is that of water", f"size {size_mm:g} mm"),
    )


_MAKERS: Final[Mapping[str, Callable[[], Phantom]]] = {
    "lego": lego_phantom,
    "shepp-logan": shepp_logan,
    "chiral": chiral_phantom,
    "gear": gear_phantom,
    "two-rings": two_rings,
    "helix": ball_helix,
    "ball-plate": ball_plate,
    "ball-bar": ball_bar,
}


def phantom_names() -> tuple[str, ...]:
    """List the names that `load_phantom` knows; each cuboid also as NAME-K with K beads.

    Example:
        >>> "lego" in phantom_names()
        True"""
    return (*CUBOIDS_MM, *_MAKERS)


def is_shipped(name: str) -> bool:
    """Return whether `load_phantom` knows `name`, a cuboid with K beads included.

    Example:
        >>> is_shipped("normal-7"), is_shipped("apple")
        (True, False)"""
    match = _CUBOID.fullmatch(name)
    return name in phantom_names() or (match is not None and match[1] in CUBOIDS_MM)


@public
def load_phantom(name: str) -> Phantom:
    """Make the phantom called `name`; a cuboid without a number has five beads.

    Names: special phantoms, cuboids, and cuboids with -K for K beads.

    Args:
        name: see `phantom_names`.

    Raises:
        UnknownNameError: lists the available names.

    >>> load_phantom("normal-7").beads.shape
    (7, 3)
    """
    if name in _MAKERS:
        return _MAKERS[name]()
    if name in CUBOIDS_MM:
        return bead_phantom(name, DEFAULT_BEADS)
    match = _CUBOID.fullmatch(name)
    if match is not None and match[1] in CUBOIDS_MM:
        return bead_phantom(match[1], int(match[2]))
    raise UnknownNameError.among(
        f"no phantom called {name!r}; there are",
        name,
        phantom_names(),
        ", and cuboids with K beads such as normal-3",
    )


def as_phantom(
    sample: object,
    *,
    material: str | Mapping[int, str] | None = None,
    voxel_mm: float | Vector | None = None,
    priority: Sequence[float] = (),
    place: Place = "keep",
) -> Phantom:
    """Convert a sample to a phantom.

    Args:
        sample: a Phantom or the name of one that ships; the path of a phantom or scene
            file, or of a mesh; a Volume; an array [z, y, x]; a mesh with `vertices` (n,
            3) and `faces` (m, 3) [mm], such as trimesh's; a Scene or Solid; a dictionary
            as in a scene file; a pair (any of these, material); or a list of them, which
            add up. All stay where they are.
        material: of a mesh (default: abs) or of an array. Without one an array holds
            attenuation [1/mm], with one the part of each voxel that the material fills (0
            to 1), and with several, {1: "pmma", 2: "steel"}, the label of what fills it
            (0: nothing).
        voxel_mm: edge of an array's voxels, one or along x, y, z [mm].
        priority: of each of a list: where meshes overlap, the one of the highest is there
            alone.
        place: "centred" puts the middle of the sample's box on the axis at the reference
            height; the description says by how much it was moved.

    Raises:
        PhantomError, UnknownNameError: names the sample and the allowed kinds.

    Example:
        >>> as_phantom([{"kind": "sphere", "center": [0, 0, 0], "radius": 5, "material": "pmma"}]
        ...            ).size_mm
        (10.0, 10.0, 10.0)
    """
    phantom = _one(sample, material, voxel_mm, priority)
    files.require_replaced(phantom, sample)
    return placed(phantom, place)


def _one(
    sample: object,
    material: str | Mapping[int, str] | None,
    voxel_mm: float | Vector | None,
    priority: Sequence[float] = (),
) -> Phantom:
    """Convert a sample of any kind to a phantom; see `as_phantom` for the kinds.

    In order: labels (mapping of materials), name or path, volume, array, mesh, (sample,
    material), then, without a material, phantom, solid or scene, document, and a sequence
    of parts.

    Args:
        sample, material, voxel_mm, priority: as for `as_phantom`.

    Raises:
        PhantomError: another kind of value.
    """
    given: Any = sample
    if isinstance(material, Mapping):
        return _labelled(sample, material, voxel_mm)
    if isinstance(sample, str | os.PathLike):
        return _named(os.fspath(sample), material)
    if isinstance(sample, Volume):
        return voxel_phantom(
            sample.data, sample.voxel_xyz, center_mm=sample.center_mm, material=material
        )
    if isinstance(sample, np.ndarray):
        return _array(sample, material, voxel_mm)
    if hasattr(sample, "vertices") and hasattr(sample, "faces"):
        return _mesh(given, material)
    if (
        isinstance(sample, tuple)
        and len(sample) == 2
        and isinstance(sample[1], str | Mapping)
    ):
        return _one(sample[0], sample[1], voxel_mm)
    _require_none(material, f"a {type(sample).__name__}")
    if isinstance(sample, Phantom):
        return sample
    if isinstance(sample, Solid | Scene):
        return _solids(Scene((sample,)) if isinstance(sample, Solid) else sample)
    if isinstance(sample, Mapping):
        if "kind" not in sample:
            return files.phantom_of(given)
        return _solids(Scene(files.solids_of(sample, "sample")))
    if isinstance(sample, Sequence) and sample:
        parts = [_one(each, None, voxel_mm) for each in sample]
        return assemble("scene", parts, priority=priority)
    raise PhantomError.instead(
        f"a sample cannot be {_shown(sample)}", _shown(sample), ALLOWED_FORMS
    )


def _require_none(material: str | None, what: str) -> None:
    """Raise PhantomError if `material` is given for `what`, which has its own."""
    if material is not None:
        message = f"{what} has its own materials; material is for a mesh or an array"
        raise PhantomError(message, {"asked": material, "allowed": None})


def _named(word: str, material: str | None) -> Phantom:
    """Make the phantom of a path or a shipped name.

    In order: a mesh by its suffix (material `abs` unless stated), a shipped name, a text
    file.

    Args:
        word: path of a file, or name.
        material: of a mesh.

    Raises:
        UnknownNameError: neither a file nor a shipped name.
        PhantomError: a material for anything but a mesh, or an invalid file.
    """
    path = Path(word)
    kind = path.suffix.lower()
    if kind.lstrip(".") in FORMATS:
        made_of = "abs" if material is None else material
        return mesh_phantom(path, material=made_of)
    _require_none(material, repr(word))
    if is_shipped(word):
        return load_phantom(word)
    if kind in TEXT_SUFFIXES or path.is_file():
        return files.read_phantom_file(path)
    raise UnknownNameError(
        f"no sample {word!r}: neither a phantom that ships "
        f"({', '.join(phantom_names())}) nor a "
        f"file ending with {', '.join(TEXT_SUFFIXES)}, {', '.join('.' + f for f in FORMATS)}",
        {"asked": word, "allowed": list(phantom_names())},
    )


def _array(
    values: np.ndarray[Any, Any], material: str | None, voxel_mm: float | Vector | None
) -> Phantom:
    """Make the phantom of an array: attenuation, or the part that `material` fills.

    Parts may be `FILLED_TOLERANCE` outside 0 to 1; attenuation has no limits here.

    Args:
        values: (z, y, x).
        material: of the filled part; None: the values are attenuation [1/mm].
        voxel_mm: spacing, one number or (x, y, z).

    Raises:
        PhantomError: no spacing, a dtype that is no real number or truth value, or parts
            outside 0 to 1.
    """
    if voxel_mm is None:
        raise PhantomError(
            "an array needs voxel_mm, the edge of its voxels [mm]; or give a Volume",
            {"asked": None, "allowed": "voxel_mm > 0"},
        )
    if values.dtype.kind not in "buif":
        kind = str(values.dtype)
        raise PhantomError.instead(f"an array of {kind} is no sample", kind, "numbers")
    data = values.astype(np.float32)
    if material is not None:
        low = float(data.min())
        high = float(data.max())
        if low < -FILLED_TOLERANCE or high > 1.0 + FILLED_TOLERANCE:
            raise PhantomError(
                f"with material={material!r} an array holds the part of each voxel that it fills, "
                f"0 to 1, and this one goes from {low:g} to {high:g}; "
                "for an array of labels give material={1: ...}",
                {"asked": [low, high], "allowed": [0, 1]},
            )
        data *= np.float32(material_of(material).mu_per_mm)
    return voxel_phantom(data, voxel_mm, material=material)


def _labelled(
    sample: object, names: Mapping[int, str], voxel_mm: float | Vector | None
) -> Phantom:
    """Make voxels of several materials from an array of labels or a Volume that holds
    them.

    Attenuation is that of the label's material; a label that is named need not occur.

    Args:
        sample: array of labels, or a Volume.
        names: label -> material of every label except 0, which is nothing.
        voxel_mm: spacing of an array; a Volume has its own.

    Raises:
        PhantomError: neither array nor Volume, an array without `voxel_mm`, a label
            without a material, a material for 0, or more than 255 labels.
    """
    if isinstance(sample, Volume):
        labels: Any = sample.data
    else:
        labels = sample
    if not isinstance(labels, np.ndarray) or labels.dtype.kind not in "buif":
        raise PhantomError(
            f"materials by label are for an array or a Volume, not for {_shown(sample)}",
            {"asked": _shown(sample), "allowed": "array, Volume"},
        )
    order = [0, *sorted(key for key in names if key != 0)]
    index = np.zeros(labels.shape, np.uint8)
    known = labels == 0
    for i, key in enumerate(order[1:256], 1):
        labelled = labels == key
        index[labelled] = i
        known |= labelled
    unknown = np.unique(labels[~known]).tolist()
    if unknown or 0 in names or len(order) > 256:
        raise PhantomError(
            f"labels {unknown or list(names)}: allowed are 0 for nothing "
            f"and the at most 255 that have a material ({', '.join(map(str, order[1:]))})",
            {"asked": unknown or list(names), "allowed": order},
        )
    mu = np.array(
        [0.0, *(material_of(names[key]).mu_per_mm for key in order[1:])], np.float32
    )
    if isinstance(sample, Volume):
        phantom = voxel_phantom(mu[index], sample.voxel_xyz, center_mm=sample.center_mm)
    else:
        phantom = _array(mu[index], None, voxel_mm)
    assert phantom.voxels is not None
    kinds = tuple(names[key] for key in order[1:])
    return replace(phantom, voxels=replace(phantom.voxels, labels=index, materials=kinds))


def _mesh(mesh: Any, material: str | None) -> Phantom:
    """Make the phantom of an object with vertices [mm] and faces, of `abs` or another
    material.

    Raises PhantomError: open, or of size 0 or too large.
    """
    import trimesh

    vertices: FloatArray = np.array(mesh.vertices, dtype=np.float64)
    return filled_mesh(
        trimesh.Trimesh(vertices, np.array(mesh.faces), process=False),
        material="abs" if material is None else material,
    )


def _solids(scene: Scene) -> Phantom:
    """Make the phantom of a scene, sized about the origin, without beads."""
    return Phantom(
        "scene", f"{len(scene.solids)} solids", scene, size_about_origin(scene)
    )


def _shown(sample: object) -> str:
    """Format a sample for error messages: type, and its text if that has at most 60 characters."""
    if sample is None:
        return "None"
    text = repr(sample)
    if len(text) <= 60:
        return f"{type(sample).__name__} {text}"
    return type(sample).__name__
