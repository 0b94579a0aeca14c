"""What stands on the stage, for everyone who must know its shape: collisions, checks, states.

Convex pieces and sizes of samples follow from the phantoms and are worked out once. A guard is
made for one sample and one correction; another of either is another guard.
"""

from __future__ import annotations

from collections import OrderedDict

from flexdt.phantoms import Phantom
from flexdt.server.storage.stored_samples import Phantoms
from flexdt.twin.collision.collision_scene import Scene, build_scene
from flexdt.twin.collision.convex_solids import Polytope
from flexdt.twin.collision.guard import SceneGuard
from flexdt.twin.collision.sample_hull import convex_pieces
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.scanner.safety import Guard
from flexdt.twin.scanner.state import Placement, Sample
from flexdt.twin.script.planning.plan import SampleSize

KEPT = 8


class Stage:
    """Shapes of samples on the stage of a machine.

    Args:
        machine, profile: whose stage.
        samples: what may stand on it.
    """

    def __init__(self, machine: Machine, profile: Profile, samples: Phantoms) -> None:
        self._machine, self._profile, self._samples = machine, profile, samples
        self._scenes: OrderedDict[tuple[_Content, Offsets], Scene] = OrderedDict()
        self._pieces: OrderedDict[_Content, tuple[Polytope, ...]] = OrderedDict()

    def beside(self, samples: Phantoms) -> Stage:
        """The same stage with other samples; what is worked out is shared, by their revisions."""
        other = Stage(self._machine, self._profile, samples)
        other._scenes, other._pieces = self._scenes, self._pieces
        return other

    def phantom(self, sample: Sample) -> Phantom | None:
        """The phantom behind a sample; None for an empty stage.

        Raises:
            UnknownNameError, LimitError, PhantomError: see `SampleStore.load`.
        """
        return self._samples.load(sample.name, sample.material) if sample.name else None

    def revision(self, sample: Sample) -> str | None:
        """Names what the upload of a sample shows, once it has been read; None for others."""
        return self._samples.revision(sample.name)

    def pieces(self, sample: Sample) -> tuple[Polytope, ...]:
        """Convex pieces that hold the sample, object frame; it may take a second."""
        before = self._content(sample)
        pieces = self._pieces.get(before)
        if pieces is None:
            phantom = self.phantom(sample)
            pieces = () if phantom is None else _pieces(phantom, sample.offset)
            now = self._content(sample)  # the revision is known once an upload has been read
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

    def scene(self, sample: Sample, parameters: Offsets = NOMINAL) -> Scene | None:
        """What may touch what with this sample; None where the machine has no components.

        Args:
            sample: what stands there.
            parameters: the correction in force; bodies sit where it says they are.
        """
        if not self._machine.components:
            return None
        pieces = self.pieces(sample)
        key = (self._content(sample), parameters)
        scene = self._scenes.get(key)
        if scene is None:
            scene = build_scene(self._machine, self._profile, pieces, parameters)
            self._scenes[key] = scene
            while len(self._scenes) > KEPT:
                self._scenes.popitem(last=False)
        return scene

    def guard(self, sample: Sample, parameters: Offsets = NOMINAL) -> Guard | None:
        """What sweeps every motion with this sample; None where the machine has no components.

        Args:
            sample: what stands there.
            parameters: the correction in force.
        """
        scene = self.scene(sample, parameters)
        return None if scene is None else SceneGuard(scene)

    def _content(self, sample: Sample) -> _Content:
        return sample, self.revision(sample)


_Content = tuple[Sample, str | None]
"""A sample and what its upload held: another file may come under the same name."""


def _pieces(phantom: Phantom, offset: Placement) -> tuple[Polytope, ...]:
    return convex_pieces(
        phantom.mesh(around=True), rotation=offset.rotation, offset=(offset.x, offset.y, offset.z)
    )
