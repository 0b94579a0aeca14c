"""The surface of one page's volume in that page's own scenes.

It stands on the stage only while what it was made of is what stands there; otherwise the page may
ask for it as a ghost, which has another color and carries the volume's name.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt
import viser

from flexdt.clients.viewer.scenes.world import MM
from flexdt.protocol.state_model import SampleState, State
from flexdt.twin.geometry.conventions import FloatArray

SURFACE: Final = (70, 190, 255)
GHOST: Final = (255, 176, 32)
GHOST_OPACITY: Final = 0.35
NODE: Final = "/object/surface"
NAME_NODE: Final = f"{NODE}/name"
SAME_MM: Final = 5e-3
"""Largest difference of places of a sample that pages do not tell apart [mm, deg]."""
Manner = Literal["stands", "ghost"]


@dataclass(frozen=True)
class MadeOf:
    """What a volume or an image was made of; `offset` is None where the data set does not say."""

    sample: str
    revision: str | None
    material: str | None
    offset: Mapping[str, float] | None
    correction: str | None

    @classmethod
    def of(cls, told: Mapping[str, Any]) -> MadeOf:
        """Read it from the facts of the reconstruction's process, or from the twin's answer."""
        return cls(**{name: told[name] for name in cls.__dataclass_fields__})


def fits(made: MadeOf, state: State) -> bool:
    """Check that a volume is of what stands on the stage, under the correction in force."""
    now = None if state.correction is None else state.correction.name
    return made.correction == now and same_sample(made, state.sample)


def same_sample(made: MadeOf, sample: SampleState) -> bool:
    """Check that a scan's sample stands on the stage: name, content, material and place.

    That of a data set which does not say where its sample stood does not.
    """
    if made.offset is None:
        return False
    if (made.sample, made.revision) != (sample.name or "", sample.revision):
        return False
    if sample.name and made.material != sample.material:
        return False
    places = sample.offset.model_dump()
    return all(abs(made.offset[n] - at) <= SAME_MM for n, at in places.items())


@dataclass(frozen=True, eq=False)
class StageVolume:
    """A surface, its data set and what that was made of.

    Attributes:
        name: of the data set.
        vertices_mm: (v, 3) [mm, object frame].
        faces: (f, 3), outward.
        made: of what.
    """

    name: str
    vertices_mm: FloatArray
    faces: npt.NDArray[np.int32]
    made: MadeOf

    def manner(self, state: State | None, asked: bool) -> Manner | None:
        """Choose how it is drawn: on the stage where it fits, as a ghost where asked for,
        else not at all.
        """
        if state is not None and fits(self.made, state):
            return "stands"
        return "ghost" if asked else None


class StageDrawing:
    """What is drawn of volumes in each frame's own scene, as long as the frame is open."""

    def __init__(self) -> None:
        """Start with nothing drawn."""
        self._drawn: WeakKeyDictionary[viser.ClientHandle, tuple[StageVolume, Manner]] = (
            WeakKeyDictionary()
        )

    def show(
        self,
        clients: Iterable[viser.ClientHandle],
        volume: StageVolume | None,
        manner: Manner | None,
    ) -> None:
        """Draw a volume in some frames in a manner, in place of what was drawn there; None
        of either: nothing. A frame that has it already is sent nothing.
        """
        for client in clients:
            before = self._drawn.get(client)
            wanted = None
            if volume is not None and manner is not None and len(volume.faces):
                wanted = volume, manner
            if before == wanted:
                continue
            with client.atomic():
                for node in (NAME_NODE, NODE):
                    if (old := client.scene.get_handle_by_name(node)) is not None:
                        old.remove()
                if wanted is not None:
                    _draw(client, *wanted)
            if wanted is None:
                self._drawn.pop(client, None)
            else:
                self._drawn[client] = wanted


def _draw(client: viser.ClientHandle, volume: StageVolume, manner: Manner) -> None:
    """Add the surface, and the name of a ghost above it; lengths become [m]."""
    vertices = (volume.vertices_mm * MM).astype(np.float32)
    ghost = manner == "ghost"
    client.scene.add_mesh_simple(
        NODE,
        vertices,
        np.asarray(volume.faces, dtype=np.uint32),
        color=GHOST if ghost else SURFACE,
        opacity=GHOST_OPACITY if ghost else None,
        side="double",
        cast_shadow=False,
        receive_shadow=False,
    )
    if ghost:
        top = vertices[:, 2].max()
        middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        client.scene.add_label(
            NAME_NODE,
            f"ghost: {volume.name}",
            position=(float(middle[0]), float(middle[1]), float(top)),
        )
