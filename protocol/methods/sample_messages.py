"""sample.*: the sample on the stage, and uploads."""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le
from pydantic import Field, model_validator

from flexdt.protocol import fields as f
from flexdt.protocol.method import Method, by_hand, read
from flexdt.protocol.methods.document_messages import Placement
from flexdt.protocol.state_model import SampleState

Bytes = Annotated[int, Ge(0), Le(2**53)]
"""A place in, or a size of, something sent in parts [bytes]."""

MESH_CHUNK = 4 << 20
"""Bytes of a mesh in one answer: below a frame, also as base64."""

LengthUnit = Literal["um", "mm", "cm", "m", "inch"]


class SampleSet(f.Params):
    """Which sample stands on the stage: a shipped phantom's name, or an uploaded file's."""

    name: f.Name | None = None
    file: f.Name | None = None
    """name under which it was uploaded"""
    material: f.Material | None = None
    offset: Placement | None = None

    @model_validator(mode="after")
    def _one(self) -> SampleSet:
        if (self.name is None) == (self.file is None):
            raise ValueError("give either name or file")
        return self


class SampleMesh(f.Params):
    """A part of the shape of the sample on the stage."""

    start: Bytes = 0
    """first byte"""
    count: Annotated[int, Ge(1), Le(MESH_CHUNK)] = 1 << 20
    """bytes at most"""


class SampleUpload(f.Params):
    """A chunk of a mesh, of voxels or of a scene; the sample exists when all bytes have come."""

    name: f.Name
    kind: Literal["mesh", "voxels", "scene"] = "mesh"
    format: Literal["stl", "obj", "ply", "glb", "off", "raw", "json", "toml"]
    """raw: float32 little-endian voxels [z, y, x] of attenuation [1/mm]; json, toml: the text of a
    phantom or scene file"""
    total: Annotated[Bytes, Gt(0)]
    """size of the whole [bytes]"""
    start: Bytes = 0
    """position of this chunk [bytes]"""
    data: f.Payload
    unit: LengthUnit | None = None
    """of mesh coordinates; left out: m for glb, mm for the others"""
    material: f.Material | None = None
    shape: f.VoxelShape | None = None
    """(z, y, x) of voxels"""
    voxel_mm: f.VoxelPitch | None = None
    """(x, y, z)"""

    @model_validator(mode="after")
    def _fits(self) -> SampleUpload:
        if self.start + len(self.data) > self.total:
            raise ValueError(f"chunk ends at {self.start + len(self.data)}, total is {self.total}")
        own = {"raw": "voxels", "json": "scene", "toml": "scene"}.get(self.format, "mesh")
        if self.kind != own:
            raise ValueError(f"format {self.format} is for kind {own}, not {self.kind}")
        if self.kind == "scene" and self.material is not None:
            raise ValueError("a scene has its own materials")
        if self.kind == "voxels" and (self.shape is None or self.voxel_mm is None):
            raise ValueError("voxels need shape and voxel_mm")
        if self.shape is not None and self.voxel_mm is not None:
            f.require_extent(self.shape, self.voxel_mm)
        return self


class SampleResult(f.Result):
    """What stands on the stage now."""

    sample: SampleState
    warnings: list[str] = Field(default_factory=list)


class SampleInfo(f.Result):
    """A sample that could be set."""

    name: str
    kind: Literal["phantom", "mesh", "voxels", "scene"] = "phantom"
    description: str = ""
    size_mm: f.Triple | None = None
    uploaded: bool = False


class SampleListResult(f.Result):
    """All samples, and the materials a mesh may be made of."""

    samples: list[SampleInfo]
    materials: list[str] = Field(default_factory=list)


class UploadResult(f.Result):
    """How much of an upload has come."""

    name: str
    received: int
    """bytes so far"""
    complete: bool
    sample: SampleInfo | None = None
    warnings: list[str] = Field(default_factory=list)


class SampleMeshResult(f.Result):
    """A part of a mesh: binary STL, mm, in the sample's own frame (before its offset)."""

    name: str
    revision: str | None = None
    format: Literal["stl"] = "stl"
    total: int
    """size of the whole [bytes]"""
    start: int
    """position of this part [bytes]"""
    data: f.Payload


SAMPLE_SET = by_hand("sample.set", SampleSet, SampleResult, "put a sample on the stage")
SAMPLE_LIST = read("sample.list", f.Empty, SampleListResult, "the samples there are")
SAMPLE_MESH = read("sample.mesh", SampleMesh, SampleMeshResult,
                   "the shape of the sample on the stage")  # fmt: skip
SAMPLE_UPLOAD = Method("sample.upload", SampleUpload, UploadResult,
                       "send a mesh, voxels or a scene in chunks", bulky=True)  # fmt: skip
