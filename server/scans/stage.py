"""What stands on the stage, for everyone who must know its shape: collisions, checks, drawings.

Convex pieces and sizes of samples follow from the phantoms and are worked out once. A guard is
made for one sample and one correction; another of either is another guard. Clients that draw get
binary STL in mm, in the sample's own frame.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Any, Final

from flexdt.phantoms import Phantom
from flexdt.protocol.rpc_errors import too_large
from flexdt.server.storage.stored_samples import ReceivedSample, SampleStore
from flexdt.twin.collision.collision_scene import CollisionScene, build_scene
from flexdt.twin.collision.convex_solids import Polytope, convex_pieces
from flexdt.twin.collision.guard import SceneGuard
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.scanner.safety import Guard
from flexdt.twin.scanner.state import Sample, StagePlacement
from flexdt.twin.script.plan import SampleSize

KEPT = 8
MAX_BYTES: Final = 64 << 20
HEADER, FACE = 84, 50
"""Bytes of binary STL: before the faces, and of each."""


class Stage:
    """Shapes of samples on the stage of a machine.

    Args:
        machine, profile: whose stage.
        samples: what may stand on it.
    """

    def __init__(self, machine: Machine, profile: Profile, samples: SampleStore) -> None:
        self._machine, self._profile, self._samples = machine, profile, samples
        self._scenes: OrderedDict[tuple[_Content, Offsets], CollisionScene] = OrderedDict()
        self._pieces: OrderedDict[_Content, tuple[Polytope, ...]] = OrderedDict()

    def phantom(self, sample: Sample) -> Phantom | None:
        """The phantom behind a sample; None for an empty stage.

        Raises:
            UnknownNameError, LimitError, PhantomError: see `SampleStore.load`.
        """
        return self._samples.load(sample.name, sample.material) if sample.name else None

    def revision(self, sample: Sample) -> str | None:
        """Names what the upload of a sample shows, once it has been read; None for others."""
        return self._samples.revision(sample.name)

    def pieces(self, sample: Sample, upload: ReceivedSample | None = None) -> tuple[Polytope, ...]:
        """Convex pieces that hold the sample, object frame; it may take a second.

        Args:
            sample: on the stage.
            upload: to come under the sample's name; None for what is there.
        """
        before = self._content(sample, upload)
        pieces = self._pieces.get(before)
        if pieces is None:
            phantom = self.phantom(sample) if upload is None else upload.standing
            pieces = () if phantom is None else _pieces(phantom, sample.offset)
            # The revision is known once an upload has been read.
            now = self._content(sample, upload)
            if before[1] not in (None, now[1]):
                return pieces  # another file came under the name meanwhile
            self._pieces[now] = pieces
            while len(self._pieces) > KEPT:
                self._pieces.popitem(last=False)
        return pieces

    def size(self, sample: Sample) -> SampleSize | None:
        """The cylinder about the axis that holds the sample."""
        phantom = self.phantom(sample)
        if phantom is None:
            return None
        return SampleSize.around(phantom.size_mm, f"sample {sample.name}", sample.offset)

    def scene(
        self, sample: Sample, parameters: Offsets = NOMINAL, upload: ReceivedSample | None = None
    ) -> CollisionScene | None:
        """What may touch what with this sample; None where the machine has no components.

        Args:
            sample: what stands there.
            parameters: the correction in force; bodies sit where it says they are.
            upload: as for `pieces`.
        """
        if not self._machine.components:
            return None
        pieces = self.pieces(sample, upload)
        key = (self._content(sample, upload), parameters)
        scene = self._scenes.get(key)
        if scene is None:
            scene = build_scene(self._machine, self._profile, pieces, parameters)
            self._scenes[key] = scene
            while len(self._scenes) > KEPT:
                self._scenes.popitem(last=False)
        return scene

    def guard(
        self, sample: Sample, parameters: Offsets = NOMINAL, upload: ReceivedSample | None = None
    ) -> Guard | None:
        """What sweeps every motion with this sample; None where the machine has no components.

        Args:
            sample: what stands there.
            parameters: the correction in force.
            upload: as for `pieces`.
        """
        scene = self.scene(sample, parameters, upload)
        return None if scene is None else SceneGuard(scene)

    def _content(self, sample: Sample, upload: ReceivedSample | None) -> _Content:
        return sample, upload.shown if upload else self.revision(sample)


_Content = tuple[Sample, str | None]
"""A sample and what its upload held: another file may come under the same name."""


def _pieces(phantom: Phantom, offset: StagePlacement) -> tuple[Polytope, ...]:
    return convex_pieces(
        phantom.mesh(around=True), rotation=offset.rotation, offset=(offset.x, offset.y, offset.z)
    )


@dataclass(frozen=True)
class Shape:
    """The mesh of a sample as binary STL, and the revision of the upload that it was made of."""

    name: str
    revision: str | None
    stl: bytes


class Shapes:
    """The last shape asked for; kept until another sample's is."""

    def __init__(self, limit: int = MAX_BYTES) -> None:
        self._limit = limit
        self._kept: Shape | None = None

    def known(self, name: str, revision: str | None) -> Shape | None:
        """A shape that was made already."""
        kept = self._kept
        return kept if kept is not None and (kept.name, kept.revision) == (name, revision) else None

    def make(self, name: str, revision: str | None, phantom: Phantom) -> Shape:
        """The shape of `phantom`; it may take a second.

        Raises:
            RpcError: -32008, more triangles than are sent.
        """
        mesh: Any = phantom.mesh()
        size = HEADER + FACE * len(mesh.faces)
        if size > self._limit:
            raise too_large("the sample's mesh", size, self._limit)
        self._kept = Shape(name, revision, mesh.export(file_type="stl"))
        return self._kept
