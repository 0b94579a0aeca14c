"""From nominal poses to line integrals: the one path on which the true geometry is used.

Adds the hidden truth, transforms into the sample's frame, makes sure that the projector
has the sample, and requests the projection. Images are the only results that depend on
the truth: it is read once and never shown. Calibration is to find it, so no reply, log
line, state, data set or printed form may carry it, and true geometries are handed out,
never the parameters.

A projector may serve several twins, whose samples may have equal names and different
contents, so it knows each as `NAME #digest of the content`. Of a sample that changes, the
version before the present one stays, for requests under way; older ones are removed.

Samples that have been taken apart stay in memory until others need it, the least recently
used go first. A sample on the stage, in a scan that has not ended, or being projected
stays in any case.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import math
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, Protocol, assert_never

import numpy as np

from flexdt.message_words import reason_of
from flexdt.phantoms import Phantom
from flexdt.phantoms.channels import Channel, attenuating, channels, scatter_object
from flexdt.phantoms.checked_reading import scene_to_dict
from flexdt.protocol import Code, RpcError
from flexdt.protocol.rpc_errors import too_large
from flexdt.runtime.files.limited_files import limited_text
from flexdt.runtime.wire_errors import ProjectorUnavailable
from flexdt.server.projector.volume_store import memory_of
from flexdt.server.storage.stored_samples import SampleStore
from flexdt.twin.errors import GeometryError, MachineFileError, TwinError
from flexdt.twin.geometry.cone_vec import ConeVec, check_cone_vec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.input_limits import InputLimitError, parse_toml
from flexdt.twin.machine.camera import CameraSettings, PixelGrid
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.physics.chain import PixelPaths
from flexdt.twin.physics.sampled_views import spot_views
from flexdt.twin.physics.scatter import Object
from flexdt.twin.projection import Body, TriangleMesh
from flexdt.twin.projection.analytic_solids import Scene
from flexdt.twin.projection.pixel_areas import Need, Within
from flexdt.twin.scanner.state import Sample, StagePlacement, require_before_source

MAX_TRUTH_VALUE = 1e6
"""Bound on the values of a truth file [mm, deg]; NaN and infinities are not below it."""
MAX_VERSIONS: Final = 2
"""Number of versions of a sample that the projector keeps."""
MAX_SAMPLES: Final = 64
"""Largest number of samples in memory, however small they are."""
Pieces = Literal["part", "material"]
"""How a sample is divided: by what attenuates, or by material."""
_Key = tuple[str, Pieces]


class TrueGeometry:
    """Turns nominal poses into the geometry that X-rays really see.

    Args:
        parameters: the misalignment; none by default.
    """

    __slots__ = ("__parameters",)

    def __init__(self, parameters: Offsets = NOMINAL) -> None:
        self.__parameters = parameters

    def __repr__(self) -> str:
        """Format without the values, which must not be logged."""
        return "TrueGeometry(hidden)"

    def require_applicable(self, machine: Machine, profile: Profile) -> None:
        """Check it as corrections are checked; no value is repeated.

        Args:
            machine: whose travel it must suit.
            profile: zero offsets.

        Raises:
            GeometryError: names a pose of the travel, if there is one, at which axis or
                panel are behind the source.
        """
        what = "the truth"
        camera = machine.detector.camera
        try:
            require_before_source(machine, profile, camera, self.__parameters, what)
        except GeometryError as error:
            pose = error.data.get("pose")
            place = "it is implausible"
            if isinstance(pose, dict):
                motors = ", ".join(f"{name} {x:g}" for name, x in pose.items())
                place = f"the rotation axis or the panel is behind the source at {motors}"
            raise GeometryError(
                f"the truth is no geometry of this machine: {place}",
                {
                    "check": "truth",
                    "pose": pose,
                    "allowed": "SOD and SDD > 0 at every pose",
                },
            ) from None

    def cone_vec(self, poses: Poses, placement: StagePlacement) -> ConeVec:
        """Compute the true geometry of each pose, in the frame of a sample at `placement`.

        Args:
            poses: nominal poses, n.
            placement: of the sample.

        Returns:
            The geometry of n views, which must not leave the server.
        """
        return placement.to_sample(poses.cone_vec(self.__parameters))


def load_truth(path: Path, data: Path) -> TrueGeometry:
    """Read the hidden misalignment from a truth file: TOML, parameter = value [mm, deg].

    Parameters that the file leaves out are zero. The path is resolved, so a link into
    the data directory is refused, too. Refused are unknown names, values that are not
    numbers (text, true, false), and values whose magnitude is not below
    `MAX_TRUTH_VALUE` (nan included).

    Args:
        path: the file.
        data: the data directory, which must not contain it.

    Returns:
        The true geometry.

    Raises:
        MachineFileError: file, key, and allowed values; no value of the file is
            repeated. Also for a file that cannot be read or is not TOML.
    """
    file = path.resolve()
    if file.is_relative_to(data.resolve()):
        raise MachineFileError(
            f"the truth file {path} lies inside the data directory {data}; it must not",
            {"file": str(path), "allowed": "outside the data directory"},
        )
    try:
        values = parse_toml(limited_text(file, "toml"), str(path))
    except OSError as error:
        raise MachineFileError(
            f"cannot read {path}: {reason_of(error)}", {"file": str(path)}
        ) from None
    except InputLimitError as error:
        raise MachineFileError(error.message, {"file": str(path)}) from None
    except ValueError:
        raise MachineFileError(f"{path}: not valid TOML", {"file": str(path)}) from None
    for name, value in values.items():
        if type(value) not in (int, float) or not abs(value) < MAX_TRUTH_VALUE:
            raise MachineFileError(
                f"{path}: {name}: the value must be a number below {MAX_TRUTH_VALUE:g}",
                {
                    "file": str(path),
                    "path": name,
                    "allowed": [-MAX_TRUTH_VALUE, MAX_TRUTH_VALUE],
                },
            )
    try:
        parameters = Offsets.from_edge({k: float(v) for k, v in values.items()})
    except TwinError as error:
        raise MachineFileError(f"{path}: {error.message}", {"file": str(path)}) from None
    return TrueGeometry(parameters)


class Projector(Protocol):
    """The part of the projector's client that projections need."""

    async def put(self, name: str, body: Body) -> object:
        """Store a body under a name."""

    async def remove(self, name: str) -> None:
        """Remove a body."""

    async def project(
        self, name: str, cone_vec: ConeVec, shape: tuple[int, int]
    ) -> Float32Array:
        """Compute line integrals, float32 (n, rows, cols)."""

    async def rays_needed(
        self,
        name: str,
        cone_vec: ConeVec,
        shape: tuple[int, int],
        need: tuple[Need, float],
    ) -> Within:
        """Find the pixels that need several rays."""

    async def paths_within(
        self, name: str, cone_vec: ConeVec, shape: tuple[int, int], within: Within
    ) -> Float32Array:
        """Compute line integrals along several rays of some pixels, float32 (rays,)."""


@dataclass(eq=False)
class _DividedSample:
    """A sample divided into its pieces.

    Attributes:
        phantom: it.
        found: its pieces, (body, factor) each, or channels.
        bodies: of these.
        names: the projector's for them; empty while it has not been sent.
        users: requests that it is being projected for.
    """

    phantom: Phantom
    found: Any
    bodies: list[Body]
    names: list[str] = field(default_factory=list)
    users: int = 0

    @property
    def nbytes(self) -> int:
        """Memory in this process [bytes]."""
        return sum(bytes_of(body) for body in self.bodies)


@dataclass(eq=False, repr=False)
class Imaging:
    """Line integrals of the sample on the stage.

    Attributes:
        projector: computes them.
        truth: hidden misalignment.
        samples: samples that may be on the stage.
        sensor: the detector.
        memory_limit: bytes of the samples that stay in memory; None for any.
        pinned: samples that stay in any case.
        room: bytes that a projector can have for a sample; None if not known.
    """

    projector: Projector
    truth: TrueGeometry
    samples: SampleStore
    sensor: PixelGrid
    memory_limit: int | None = None
    pinned: Callable[[], Collection[Sample]] = lambda: ()
    room: Callable[[], Awaitable[int | None]] | None = None

    def __post_init__(self) -> None:
        """Begin without divided samples, without a scatterer, and with nothing sent."""
        self._divided: dict[_Key, _DividedSample] = {}
        """Divided samples, the least recently used first."""
        self._versions: dict[str, list[str]] = {}
        self._scatterer: tuple[Phantom, Object] | None = None
        self._sending = asyncio.Lock()

    async def line_integrals(
        self,
        sample: Sample,
        poses: Poses,
        camera: CameraSettings,
        *,
        truth: TrueGeometry | None = None,
        need: Need | None = None,
    ) -> Float32Array:
        """Compute line integrals of `sample` at n nominal poses, in the true geometry.

        With `need`, pixels that an edge reaches have the line integral of the mean signal of
        several rays: intensities are averaged, as a panel does. The parts (solids, meshes,
        voxels) are projected one after the other and added up with their factors. The sample is
        sent to the projector where it is new there. An empty stage is answered without the
        projector, and its geometry is not checked.

        Args:
            sample, poses, camera: as `Radiography.take` has them.
            truth: instead of the hidden one; None for the hidden one.
            need: what pixels need for a small error; None for one ray a pixel.

        Returns float32 (n, rows, cols), dimensionless; zeros for an empty stage. The projector's
        own read-only array if the sample is a single part of factor 1.
        Raises ProjectorUnavailable: the projector does not answer; GeometryError: a geometry no
        scanner can have; RpcError: the projector refuses the sample.
        """
        if not sample.name:
            return np.zeros((len(poses), *camera.shape), dtype=np.float32)
        cone = (truth or self.truth).cone_vec(poses, sample.offset)
        check_cone_vec(cone, camera.pixels_mm(self.sensor))
        async with self._on_projector(sample, "part") as divided:
            factors = [factor for _, factor in divided.found]
            if factors == [1.0] and need is None:
                return await self.projector.project(divided.names[0], cone, camera.shape)
            if not factors:
                return np.zeros((len(cone), *camera.shape), dtype=np.float32)
            total = np.empty((len(cone), *camera.shape), dtype=np.float32)
            for i, (name, factor) in enumerate(zip(divided.names, factors, strict=True)):
                part = await self.projector.project(name, cone, camera.shape)
                _add(total, part, factor, first=i == 0)
            if need is not None:
                within, paths = await self._within(
                    divided, cone, camera.shape, need, factors
                )
                rays = paths[0]
                for i, factor in enumerate(factors):
                    _add(rays, paths[i], factor, first=i == 0)
                signals = await asyncio.to_thread(within.mean_signals, rays)
                total.reshape(-1)[within.pixels] = signals
            return total

    async def _within(
        self,
        divided: _DividedSample,
        cone: ConeVec,
        shape: tuple[int, int],
        need: Need,
        weights: Sequence[float],
    ) -> tuple[Within, Float32Array]:
        """Find the pixels that need several rays for any piece, and project all pieces along
        these.

        `divided`: the sample, on the projector; `cone`: n views; `shape`: detector (rows, cols);
        `need`: what pixels need; `weights`: of the pieces.
        Returns the pixels, and float32 (pieces, rays).
        """
        within = Within.joined(
            [
                await self.projector.rays_needed(name, cone, shape, (need, weight))
                for name, weight in zip(divided.names, weights, strict=True)
            ]
        )
        paths = np.empty((len(divided.names), int(within.starts[-1])), np.float32)
        for i, name in enumerate(divided.names):
            paths[i] = await self.projector.paths_within(name, cone, shape, within)
        return within, paths

    async def path_lengths(
        self,
        sample: Sample,
        poses: Poses,
        camera: CameraSettings,
        *,
        truth: TrueGeometry | None = None,
        spot: tuple[float, int] = (0.0, 1),
        need: Callable[[tuple[Channel, ...]], tuple[Need, Sequence[float]] | None] = (
            lambda channels: None
        ),
    ) -> tuple[tuple[Channel, ...], Float32Array, FloatArray, PixelPaths | None]:
        """Compute paths through each material of `sample` at n nominal poses.

        The geometry is checked before the focal spot is divided, for an empty stage
        too.

        Args:
            sample, poses, camera, truth: as for `line_integrals`.
            spot: size of the focal spot [mm] and number of its points from which rays
                start. With more than one point n is the number of poses times that of
                points: the views of a pose follow one another.
            need: gives, for the materials, what pixels need and the attenuation of each
                material; None for one ray a pixel.

        Returns:
            The materials (m), float32 (m, n, rows, cols) [mm], the true geometry
                (n, 12), which must not leave the server, and the paths in pixels with
                several rays. An empty stage has m = 0.

        Raises:
            ProjectorUnavailable, GeometryError, RpcError: as `line_integrals`.
        """
        cone = (truth or self.truth).cone_vec(poses, sample.offset)
        check_cone_vec(cone, camera.pixels_mm(self.sensor))
        if spot[1] > 1:
            cone = ConeVec(spot_views(cone.rows, *spot))
        if not sample.name:
            return (
                (),
                np.empty((0, len(cone), *camera.shape), dtype=np.float32),
                cone.rows,
                None,
            )
        async with self._on_projector(sample, "material") as divided:
            out = np.empty(
                (len(divided.names), len(cone), *camera.shape), dtype=np.float32
            )
            for i, name in enumerate(divided.names):
                out[i] = await self.projector.project(name, cone, camera.shape)
            wanted = await asyncio.to_thread(need, divided.found)
            if wanted is None:
                return divided.found, out, cone.rows, None
            areas = PixelPaths(*await self._within(divided, cone, camera.shape, *wanted))
            return divided.found, out, cone.rows, areas

    async def ray(self, sample: Sample, cone: ConeVec) -> dict[str, float]:
        """Compute the path of one ray through each material.

        Args:
            sample: on the stage, or that a scan is to show.
            cone: one view (n = 1) of a one-pixel detector, in the object's frame; its
                shape is replaced by (1, 1).

        Returns:
            Name of the material -> path [mm], zeros included; empty for an empty stage.

        Raises:
            ProjectorUnavailable, RpcError: as `nominal_paths`.
        """
        found, paths = await self.nominal_paths(sample, cone.with_shape((1, 1)))
        lengths = paths.sum(axis=(1, 2, 3)).tolist()
        return {part.material.name: x for part, x in zip(found, lengths, strict=True)}

    async def nominal_paths(
        self, sample: Sample, cone: ConeVec
    ) -> tuple[tuple[Channel, ...], Float32Array]:
        """Project each material along rays that nothing hidden moves.

        `sample`: on the stage, or that a scan is to show; `cone`: n views with the detector's
        shape, in the object's frame. Returns the materials (m), and float32 (m, n, rows, cols)
        [mm]; none for an empty stage. Raises ProjectorUnavailable: the projector does not
        answer; RpcError: the projector refuses the sample."""
        views, *grid = cone.shape
        if not sample.name:
            return (), np.empty((0, views, *grid), dtype=np.float32)
        async with self._on_projector(sample, "material") as divided:
            out = await self._along(divided, sample.offset.to_sample(cone))
            return divided.found, out

    async def nominal_integrals(self, sample: Sample, cone: ConeVec) -> Float32Array:
        """Compute line integrals along rays that nothing hidden moves.

        Each part is projected by itself, then all are added up with their factors.
        `sample` and `cone`: as for `nominal_paths`.
        Returns float32 (n, rows, cols), dimensionless; zeros for an empty stage.
        Raises ProjectorUnavailable, RpcError: as `nominal_paths`.
        """
        views, *grid = cone.shape
        if not sample.name:
            return np.zeros((views, *grid), dtype=np.float32)
        async with self._on_projector(sample, "part") as divided:
            parts = await self._along(divided, sample.offset.to_sample(cone))
            factors = np.array([factor for _, factor in divided.found], dtype=np.float32)
            return np.asarray(np.tensordot(factors, parts, axes=1), dtype=np.float32)

    async def _along(self, divided: _DividedSample, cone: ConeVec) -> Float32Array:
        """Project each piece of a divided sample along `cone`, one after the other.

        `divided`: the sample, on the projector; `cone`: n views in the sample's frame, with the
        detector's shape.
        Returns float32 (pieces, n, rows, cols), without the pieces' factors."""
        views, *grid = cone.shape
        out = np.empty((len(divided.names), views, *grid), dtype=np.float32)
        for i, name in enumerate(divided.names):
            out[i] = await self.projector.project(name, cone, cone.of_shape(None))
        return out

    async def scatterer(self, sample: Sample, voxels: int) -> Object:
        """Sample the materials of `sample` on a grid for scatter, or return the grid kept last.

        The grid of one phantom is kept: while the phantom is the same, later calls return it
        whatever `voxels` is. The sample is sent to the projector like for images. The grid is
        computed in a thread.

        `sample`: on the stage; not empty. `voxels`: approximate number of cubes of a new grid.
        Returns the grid of materials.
        """
        async with self._on_projector(sample, "material") as divided:
            phantom = divided.phantom
            if self._scatterer is None or self._scatterer[0] is not phantom:
                size = phantom.size_mm
                thing = await asyncio.to_thread(
                    scatter_object, divided.found, size, voxels
                )
                self._scatterer = phantom, thing
                return thing
            return self._scatterer[1]

    async def require_room(self, sample: Sample, pieces: Pieces) -> None:
        """Check that a scan's sample fits into memory: here, in addition to the pinned
        ones, and there.

        Nothing to check for an empty stage, and on a side without a known limit. The
        sample is divided, and its pieces are kept here; nothing is sent.

        Args:
            sample: that the scan is to show.
            pieces: how the scan takes it apart.

        Raises:
            RpcError: -32008, with the needed and the available memory.
        """
        if not sample.name:
            return
        async with self._sending:
            divided = await self._divide(sample, pieces)
        own_key = (_name(sample), pieces)
        if self.memory_limit is not None:
            others = sum(
                self._divided[key].nbytes for key in self._pinned_keys() if key != own_key
            )
            left = self.memory_limit - others
            if divided.nbytes > left:
                raise self._too_large(
                    sample, divided.nbytes, left, self.memory_limit, "the twin"
                )
        available = None
        if self.room is not None:
            available = await self.room()
        need = sum(memory_of(body) for body in divided.bodies)
        if available is not None and need > available:
            raise self._too_large(sample, need, available, available, "the projector")

    def _too_large(
        self, sample: Sample, need: int, left: int, limit: int, who: str
    ) -> RpcError:
        """Make (do not raise) the error -32008 for a sample that needs more memory than
        is left.

        Sizes are in bytes; `who` owns the memory.
        """
        error = too_large(
            f"the sample {sample.name!r} in the memory of {who}", need, max(0, left)
        )
        assert isinstance(error.data, dict)
        error.data.update(sample=sample.name, memory_limit=limit, option="--memory-limit")
        return error

    @asynccontextmanager
    async def _on_projector(
        self, sample: Sample, pieces: Pieces
    ) -> AsyncIterator[_DividedSample]:
        """Divide a sample, send it to the projector where it is new, and keep it there within
        the context.

        One sample is divided and sent at a time. Old samples beyond the limits are dropped, here
        and there (`_forget_old`); one in use is not. A sample that cannot be sent raises before
        the context begins.

        Args:
            sample: on the stage; not empty.
            pieces: "part" for bodies that attenuate, (body, factor) each; "material" for
                channels.

        Yields the pieces, with their names on the projector.
        """
        async with self._sending:
            divided = await self._divide(sample, pieces)
            divided.users += 1
            try:
                if not divided.names:
                    await self._send_bodies(divided, _name(sample), pieces)
                await self._forget_old()
            except BaseException:
                divided.users -= 1
                raise
        try:
            yield divided
        finally:
            divided.users -= 1

    async def _divide(self, sample: Sample, pieces: Pieces) -> _DividedSample:
        """Divide the sample as it is now, in a thread, or reuse its pieces; with
        `_sending` held.

        The sample becomes the most recently used. A new phantom under the same name is
        divided anew, and its names on the projector are then empty.

        Args:
            sample: on the stage, or of a scan.
            pieces: "part" or "material", as in `_on_projector`.

        Returns:
            The divided sample, kept in `_divided`.
        """
        key = (_name(sample), pieces)
        phantom = await asyncio.to_thread(self.samples.load, sample.name, sample.material)
        divided = self._divided.pop(key, None)
        if divided is None or divided.phantom is not phantom:
            found: Any
            match pieces:
                case "part":
                    found = await asyncio.to_thread(attenuating, phantom)
                    bodies = [body for body, _ in found]
                case "material":
                    found = await asyncio.to_thread(channels, phantom)
                    bodies = [channel.body for channel in found]
                case _:
                    assert_never(pieces)
            divided = _DividedSample(phantom, found, bodies)
        self._divided[key] = divided
        return divided

    async def _send_bodies(
        self, divided: _DividedSample, name: str, pieces: Pieces
    ) -> None:
        """Send the pieces of a sample, unless they are there, and record their names.

        A single part has the sample's name; others are numbered.
        """
        single = pieces == "part" and len(divided.bodies) == 1
        divided.names = [
            await self._ensure_sent(name if single else f"{name}, {pieces} {i}", body)
            for i, body in enumerate(divided.bodies)
        ]

    def _pinned_keys(self) -> set[_Key]:
        """List the keys of divided samples that must stay: those of `pinned`, divided either
        way."""
        names = {_name(sample) for sample in self.pinned()}
        return {key for key in self._divided if key[0] in names}

    async def _forget_old(self) -> None:
        """Drop the least recently used samples beyond the limits; with `_sending` held.

        Limits are `memory_limit` bytes (None: no limit) and `MAX_SAMPLES` samples. The
        newest, those that are pinned, and those in use are kept, even beyond the
        limits. All versions of a dropped sample are removed on the projector, too.
        """
        stays = self._pinned_keys()
        if self.memory_limit is None:
            limit_bytes = math.inf
        else:
            limit_bytes = self.memory_limit
        used = sum(divided.nbytes for divided in self._divided.values())
        newest = next(reversed(self._divided))
        for key, divided in list(self._divided.items()):
            if used <= limit_bytes and len(self._divided) <= MAX_SAMPLES:
                return
            if key in stays or key == newest or divided.users:
                continue
            used -= divided.nbytes
            del self._divided[key]
            for name in {named.rpartition(" #")[0] for named in divided.names}:
                await self._remove(name, 0)
                del self._versions[name]

    async def _ensure_sent(self, name: str, body: Body) -> str:
        """Ensure that the projector has the present version of a body; old versions are removed.

        At most `MAX_VERSIONS` of a body stay, the present one included. A version that was sent
        before is not sent again and counts as the newest. If the projector has no room, all
        bodies' versions but the newest are removed, and the body is sent once more.

        Args:
            name: of the body here.
            body: scene, mesh or volume.

        Returns its name on the projector, "NAME #HASH" with a hash of its content.
        Raises RpcError: -32008, the projector has no room even without old versions; or the
        projector refuses the body; ProjectorUnavailable: the projector does not answer.
        """
        named = f"{name} #{await asyncio.to_thread(digest_of, body)}"
        versions = self._versions.setdefault(name, [])
        if named not in versions:
            await self._remove(name, MAX_VERSIONS - 1)
            try:
                await self.projector.put(named, body)
            except RpcError as error:
                if error.code != Code.TOO_LARGE:
                    raise
                for other in self._versions:
                    await self._remove(other, 1)
                await self.projector.put(
                    named, body
                )  # older servers forget nothing by themselves
        versions[:] = [*(v for v in versions if v != named), named]
        return named

    async def _remove(self, name: str, left: int) -> None:
        """Remove all but the `left` newest versions of a body, the oldest first.

        They are removed on the projector and from the list here; errors of the
        projector are ignored.
        """
        versions = self._versions[name]
        while len(versions) > left:
            with suppress(
                ProjectorUnavailable, RpcError
            ):  # then it may have forgotten more
                await self.projector.remove(versions[0])
            versions.pop(0)


def _add(total: Float32Array, part: Float32Array, factor: float, *, first: bool) -> None:
    """Add factor * part to `total`, in place; the first part replaces what is there."""
    if not first:
        total += np.float32(factor) * part
    elif factor == 1.0:
        np.copyto(total, part)
    else:
        np.multiply(part, np.float32(factor), out=total)


def bytes_of(body: Body) -> int:
    """Return the memory that a body takes in this process [bytes]."""
    if isinstance(body, Scene | TriangleMesh):
        return memory_of(body)
    return body.data.nbytes


def digest_of(body: Body) -> str:
    """Hash everything of a body that images depend on: equal for equal contents, in every
    process.

    A scene is hashed as its dictionary, names included. A mesh: corners as float64,
    triangles as int64. A volume: shape, voxel size, center, and float32 values.

    Returns:
        The first 16 hexadecimal digits of the SHA-256.
    """
    if isinstance(body, Scene):
        sha = hashlib.sha256(
            json.dumps(scene_to_dict(body), default=np.ndarray.tolist).encode()
        )
    elif isinstance(body, TriangleMesh):
        sha = hashlib.sha256(body.vertices.astype("<f8").tobytes())
        sha.update(np.ascontiguousarray(body.faces, "<i8").data)
    else:
        grid = [body.shape, body.voxel_xyz, [float(c) for c in body.center_mm]]
        sha = hashlib.sha256(json.dumps(grid).encode())
        sha.update(np.ascontiguousarray(body.data, dtype="<f4").data)
    return sha.hexdigest()[:16]


def _name(sample: Sample) -> str:
    """Return a sample's name, with its material if it has another one."""
    if sample.material is None:
        return sample.name
    return f"{sample.name} of {sample.material}"
