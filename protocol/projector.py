"""Parameters and results of the projector server's methods.

Arrays travel as image values; `cone_vec` may also be a list of rows. A result larger than
a frame comes in parts: notifications `part` {request, start, data} with `start` counted
in elements of the C-ordered result, then the response with `parts` instead of `data`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Final, Literal

import numpy as np
from annotated_types import Ge, Gt, Le, Len, MaxLen
from pydantic import BeforeValidator, Field, InstanceOf, TypeAdapter, model_validator
from pydantic.json_schema import WithJsonSchema

from flexdt.protocol import fields as f
from flexdt.protocol import image
from flexdt.protocol.field_checks import require_extent
from flexdt.protocol.method import AnyMethod, Method, read
from flexdt.protocol.methods.document_messages import Discovery
from flexdt.protocol.methods.scanner_messages import Bytes
from flexdt.protocol.methods.session_messages import Hello, HelloResult
from flexdt.protocol.rpc_errors import Code, RpcError, invalid_params, problem

MAX_VIEWS: Final = 100_000
MAX_CORNERS: Final = 1 << 27
"""Vertices, or triangles, of a mesh."""
MAX_MM: Final = 1e7
"""Farthest that anything is from the origin; also the longest u and v."""
MAX_MARK: Final = 31
"""Largest mark of a pixel: 16 x 16 rays."""
MAX_LISTED_NAMES: Final = 50
"""Number of volumes that an error lists, those used last."""
UNKNOWN_VOLUME: Final = "unknown volume"
"""What the problem of a volume that is not there says, in the error's data."""
Coordinate = Annotated[float, Ge(-MAX_MM), Le(MAX_MM)]
_ROW = Annotated[list[Coordinate], Len(12, 12)]
_ROWS_SCHEMA: Final = TypeAdapter(Annotated[list[_ROW], Len(1, MAX_VIEWS)]).json_schema()
_IMAGE_SCHEMA: Final = {"type": "object", "required": ["dtype", "shape", "data"]}
Detector = Annotated[tuple[f.Side, f.Side], Field(strict=False)]
"""(rows, columns)."""
Place = Annotated[tuple[Coordinate, Coordinate, Coordinate], Field(strict=False)]
"""(x, y, z) [mm]."""


def _rows(value: object) -> object:
    """Convert rows of cone_vec to a float64 array (n, 12), contiguous.

    Values that are float64 and contiguous are not copied; integers and other floats are
    converted.

    Args:
        value: an image value {dtype, shape, data}, or a list of rows of numbers.

    Raises:
        ValueError: another shape, truth values, no row or more than `MAX_VIEWS`, or a
            number that is not finite or beyond `MAX_MM`; names the first such row.
    """
    try:
        array = np.asarray(image.decode(value) if isinstance(value, Mapping) else value)
    except RpcError as error:
        raise ValueError(error.message) from None
    except (TypeError, ValueError, OverflowError):
        raise ValueError("cone_vec must be rows of twelve numbers") from None
    if array.dtype.kind not in "fiu" or array.ndim != 2 or array.shape[1] != 12:
        raise ValueError(
            f"cone_vec has shape {list(array.shape)}; allowed: [n, 12] numbers"
        )
    if isinstance(value, list) and any(type(x) is bool for row in value for x in row):
        raise ValueError("cone_vec holds a truth value; allowed: [n, 12] numbers")
    if not 0 < len(array) <= MAX_VIEWS:
        raise ValueError(f"{len(array)} rows of cone_vec; allowed: 1 to {MAX_VIEWS}")
    sound = (np.abs(array) <= MAX_MM).all(axis=1)  # false for NaN and inf
    if not sound.all():
        raise ValueError(
            f"cone_vec row {int(np.argmin(sound))} is not finite and within {MAX_MM:g} mm"
        )
    return np.ascontiguousarray(array, dtype=np.float64)


def _stack(value: object) -> object:
    """Convert an image value to projections, float32 of shape (n, rows, cols), read-only.

    Values are not checked; bytes are not copied.

    Raises:
        ValueError: no image value, another type or shape, or an empty one.
    """
    if not isinstance(value, Mapping):
        raise ValueError("projections must be an image value {dtype, shape, data}")
    try:
        array = image.decode(value)
    except RpcError as error:
        raise ValueError(error.message) from None
    if array.dtype != np.float32 or array.ndim != 3 or 0 in array.shape:
        raise ValueError("projections must be float32 of shape [n, rows, cols]")
    return array


def _buffer(value: object) -> object:
    """View a `data` field, raw or base64, as a read-only memoryview.

    Raises ValueError: neither.
    """
    try:
        return memoryview(image.payload(value)).toreadonly()
    except RpcError as error:
        raise ValueError(error.message) from None


ConeVecs = Annotated[
    InstanceOf[np.ndarray],
    BeforeValidator(_rows),
    WithJsonSchema({"anyOf": [_ROWS_SCHEMA, _IMAGE_SCHEMA]}),
]
"""(n, 12) float64 [mm], object frame."""

Stack = Annotated[
    InstanceOf[np.ndarray], BeforeValidator(_stack), WithJsonSchema(_IMAGE_SCHEMA)
]
"""(n, rows, cols) float32."""

Buffer = Annotated[
    InstanceOf[memoryview],
    BeforeValidator(_buffer),
    WithJsonSchema({"type": "string", "contentEncoding": "base64"}),
]
"""Bytes, not copied."""


class VoxelGrid(f.Params):
    """Voxels without values."""

    shape: f.VoxelShape
    voxel_mm: f.VoxelPitch
    center_mm: Place = (0.0, 0.0, 0.0)

    @property
    def nbytes(self) -> int:
        """Size on the wire [bytes]."""
        return 4 * math.prod(self.shape)

    @model_validator(mode="after")
    def _extent(self) -> VoxelGrid:
        """Check that no side is too long."""
        require_extent(self.shape, self.voxel_mm)
        return self


class MeshSize(f.Params):
    """A closed mesh of triangles without its numbers.

    Its bytes are float64 [vertices, 3] in mm, then int32 [triangles, 3], indices of vertices,
    counter-clockwise seen from outside.
    """

    vertices: Annotated[int, Ge(4), Le(MAX_CORNERS), f.Integral]
    triangles: Annotated[int, Ge(4), Le(MAX_CORNERS), f.Integral]

    @property
    def nbytes(self) -> int:
        """Size of the mesh's numbers on the wire [bytes]."""
        return 24 * self.vertices + 12 * self.triangles


class VolumePut(f.Params):
    """A chunk of voxels (float32 [z, y, x], attenuation [1/mm]) or of a mesh, or an analytic
    scene.

    The first chunk has start 0 and begins afresh; the volume replaces its namesake when all
    bytes have come. Projections of a mesh are path lengths [mm].
    """

    name: f.VolumeName
    scene: dict[str, Any] | None = None
    """{solids: [{shape: {kind, ...}, material, mu_per_mm}]}"""
    grid: VoxelGrid | None = None
    mesh: MeshSize | None = None
    start: Bytes = 0
    """position of this chunk [bytes]"""
    data: Buffer | None = None
    evictable: bool = False
    """may be forgotten, the least recently used first, where memory is needed for others"""

    @model_validator(mode="after")
    def _one(self) -> VolumePut:
        """Check that exactly one of scene, grid and mesh is given, and data where it
        belongs.

        A scene has none. Raises ValueError.
        """
        if sum(one is not None for one in (self.scene, self.grid, self.mesh)) != 1:
            raise ValueError("give one of scene, grid, mesh")
        if (self.scene is None) != (self.data is not None):
            raise ValueError("data goes with grid or mesh")
        return self


class VolumeRef(f.Params):
    """Which volume."""

    name: f.VolumeName


class Within(f.Params):
    """Pixels along several rays of which line integrals are wanted."""

    pixels: Buffer
    """int64, little-endian: places in images (n, rows, cols), growing"""
    marks: Buffer
    """uint8, of each pixel, 1 to 31: 2 n - 1 for n x n rays, 2 n for n x (n + 1)"""

    @property
    def places(self) -> np.ndarray:
        """The pixels, int64."""
        return np.frombuffer(self.pixels, "<i8")

    @property
    def each(self) -> np.ndarray:
        """Mark of each, uint8."""
        return np.frombuffer(self.marks, np.uint8)

    @model_validator(mode="after")
    def _fitting(self) -> Within:
        """Check that each pixel is named once, in order, with its rays."""
        if self.pixels.nbytes != 8 * self.marks.nbytes:
            raise ValueError("pixels are eight bytes each, marks one")
        places, marks = self.places, self.each
        if places.size and (places[0] < 0 or (np.diff(places) <= 0).any()):
            raise ValueError("pixels are not growing from 0 on")
        if marks.size and not 1 <= marks.min() <= marks.max() <= MAX_MARK:
            raise ValueError(
                f"marks are {marks.min()} to {marks.max()}; allowed: 1 to {MAX_MARK}"
            )
        return self


class Project(f.Params):
    """Line integrals of a volume."""

    volume: f.VolumeName
    cone_vec: ConeVecs
    detector: Detector
    within: Within | None = None
    """along several rays of these pixels, float32 (rays,), those of a pixel in a row"""
    key: Annotated[f.ShortText, MaxLen(300)] | None = None
    """interactive: a newer request with this key replaces one that waits"""


class RaysNeeded(f.Params):
    """Rays that the pixels of a view need, because edges are in their way."""

    volume: f.VolumeName
    cone_vec: ConeVecs
    detector: Detector
    error: Annotated[float, Gt(0.0), Le(1e9)]
    """permitted on an edge (standard deviation)"""
    counts: bool = False
    """of signals as a part of the open beam's, not of line integrals"""
    weight: Annotated[float, Ge(0.0), Le(1e9)] = 1.0
    """attenuation of a unit of the volume's projection"""


class Backproject(f.Params):
    """The adjoint of `project`; with `into` it is added to a named volume instead of
    answered."""

    cone_vec: ConeVecs
    grid: VoxelGrid
    into: f.VolumeName | None = None
    projections: Stack


class Cancel(f.Params):
    """A request of this connection that is no longer wanted."""

    request: (
        Annotated[int, Ge(0), Le(2**64 - 1), f.Integral] | Annotated[str, Len(0, 1000)]
    )


class VolumeInfo(f.Result):
    """A named volume."""

    name: str
    kind: Literal["voxels", "mesh", "scene"]
    bytes: int
    """memory it takes"""
    shape: list[int] | None = None
    """(z, y, x)"""
    voxel_mm: f.Triple | None = None
    center_mm: f.Triple | None = None
    solids: int | None = None
    triangles: int | None = None


class PutResult(f.Result):
    """How much has come."""

    name: str
    received: int
    total: int
    complete: bool
    warnings: list[str] = Field(default_factory=list)
    """doubts about the volume, such as gray values in the place of attenuation"""


class VolumeList(f.Result):
    """Stored volumes, memory used and its limit [bytes]."""

    volumes: list[VolumeInfo]
    memory_used: int
    memory_limit: int


class Removed(f.Result):
    """Whether there was such a volume."""

    removed: bool


class Array(f.Result):
    """An image value, or (with `parts`) the description of one sent in parts."""

    dtype: Literal["float32", "uint32"]
    shape: list[int]
    parts: int | None = None
    data: Buffer | None = None
    warnings: list[str] = Field(default_factory=list)
    """doubts about a geometry and its volume, such as meters for mm"""


class Cancelled(f.Result):
    """Whether the request was still there to be canceled."""

    cancelled: bool


class Health(f.Result):
    """How the server is."""

    instance: str
    """changes when the server restarts"""
    version: str
    backend: str
    threads: int
    uptime_s: float
    clients: int
    waiting: int
    """requests in the queue"""
    views: int
    """projected so far"""
    superseded: int
    volumes: int
    memory_used: int
    memory_limit: int
    memory_evictable: int | None = None
    """part of memory_used that is freed when needed"""
    working: str | None = None
    """what takes long now, such as a kernel that compiles"""


PROJECTOR_METHODS: Final[Mapping[str, AnyMethod]] = {
    m.name: m
    for m in (
        read(
            "session.hello", Hello, HelloResult, "introduce the client; bring the token"
        ),
        read("volume.put", VolumePut, PutResult, "store a named volume or scene"),
        read("volume.get", VolumeRef, Array, "read a named volume of voxels back"),
        read("volume.list", f.Empty, VolumeList, "the volumes there are"),
        read("volume.remove", VolumeRef, Removed, "forget a volume"),
        read("project", Project, Array, "line integrals, float32 (n, rows, cols)"),
        read(
            "rays",
            RaysNeeded,
            Array,
            "pixels that need several rays, uint32 (k,): of each view 32 x place + mark, then 0",
        ),
        Method(
            "backproject", Backproject, Array, "the adjoint of project, float32 (z, y, x)"
        ),
        read("health", f.Empty, Health, "how the server is"),
        read("cancel", Cancel, Cancelled, "give up a request of this connection"),
        read("rpc.discover", f.Empty, Discovery, "this table as an OpenRPC document"),
    )
}
"""Every method of the projector server, by name."""


def unknown_volume(name: str, there: Sequence[str]) -> RpcError:
    """Make (do not raise) the error -32602 for an unknown volume.

    It lists the last `MAX_LISTED_NAMES` of those `there`, and how many others there are.
    """
    last = sorted(there[-MAX_LISTED_NAMES:])
    older = len(there) - len(last)
    more = f" and {older} others" if older else ""
    return invalid_params(
        f"no volume {name!r}; there are: {', '.join(last) or 'none'}{more}",
        [problem("volume", UNKNOWN_VOLUME, name)],
        last,
    )


def volumes_there(error: RpcError, name: str) -> list[str] | None:
    """Return the volumes that an error of `unknown_volume` lists; None for any other error.

    Args:
        error: that a projector answered, of any data.
        name: of the volume that was asked for.
    """
    match error.data:
        case {
            "problems": [{"path": "volume", "message": str(why), "asked": str(asked)}],
            "allowed": [*there],
        } if (error.code, why, asked) == (Code.INVALID_PARAMS, UNKNOWN_VOLUME, name):
            return [str(one) for one in there]
    return None
