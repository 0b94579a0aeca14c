"""Phantom and scene files put on the stage: what is taken, what is not, and what stands
there."""

from __future__ import annotations

import asyncio
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from stored_upload import completed

from flexdt.clients.client.flows import Ask
from flexdt.clients.client.twin_methods import upload_scene
from flexdt.phantoms import Phantom, PhantomError, Surface, bead_phantom, load_phantom
from flexdt.phantoms.files import phantom_files
from flexdt.phantoms.samples import as_phantom
from flexdt.runtime.files.directory import open_data
from flexdt.server.scans.stage import Stage
from flexdt.server.storage import mesh_workers
from flexdt.server.storage.sample_uploads import UploadHead
from flexdt.server.storage.stored_samples import SampleStore
from flexdt.twin.collision.convex_solids import Polytope
from flexdt.twin.errors import TwinError
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.projection.analytic_solids import Scene
from flexdt.twin.scanner.state import Sample
from tests.support.phantom_texts import BEAD_FILE, SCENE_FILE

BALL = {"kind": "sphere", "center": [0, 0, 5], "radius": 20, "material": "pmma"}


def sent(document: object, name: str = "thing") -> Phantom:
    text = document if isinstance(document, str) else json.dumps(document)
    return phantom_files.sent_scene(text.encode(), name=name)


def store_of(folder: Path, raw: bytes, form: str, name: str = "thing") -> SampleStore:
    store = SampleStore(open_data(folder))
    store.receive(
        UploadHead(name=name, kind="scene", format=form, total=len(raw)), 0, raw
    )
    return store


@pytest.mark.parametrize("form", ["toml", "json"])
@pytest.mark.daily(1)
def test_a_scene_is_read_apart_kept_and_read_again(tmp_path: Path, form: str) -> None:
    made = bead_phantom("normal", 3)
    raw = BEAD_FILE.encode() if form == "toml" else json.dumps(made.to_dict()).encode()
    store = store_of(tmp_path, raw, form)
    phantom = completed(store, "thing")
    assert phantom.name == "thing"
    assert len(phantom.beads) == (2 if form == "toml" else 3)
    again = SampleStore(open_data(tmp_path))  # as after a restart
    assert again.uploads == ("thing",)
    assert again.load("thing") == phantom


def test_a_scene_with_a_mesh_is_sent_whole(tmp_path: Path) -> None:
    trimesh.creation.box(extents=(2, 3, 4)).export(tmp_path / "handle.stl")
    file = tmp_path / "assembly.toml"
    file.write_text(SCENE_FILE)
    asked = next(upload_scene(file))
    assert isinstance(asked, Ask)
    data, head = (
        asked.params["data"],
        {"name": "assembly", "kind": "scene", "format": "json"},
    )
    assert isinstance(data, bytes)
    assert head.items() <= asked.params.items()
    found = phantom_files.sent_scene(data, name="assembly")
    assert found.scene == as_phantom(file).scene
    with pytest.raises(PhantomError, match="has no folder"):
        sent(SCENE_FILE)


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ("\xff", "not valid TOML"),
        ("[1, 2", "not valid TOML"),
        (
            {"schema": 1, "solid": [{**BALL, "material": "cheese"}]},
            "unknown material 'cheese'",
        ),
        ({"schema": 1, "solid": [{**BALL, "radius": -1}]}, "radius is -1"),
        ({"schema": 1, "solid": [{**BALL, "color": 3}]}, "unknown key 'color'"),
        ({"schema": 1, "solid": [BALL] * 501}, "501 solids; allowed: 500"),
        ({"schema": 1, "solid": [{**BALL, "center": [0, 0, 3000]}]}, "measures 6040 mm"),
        ({"schema": 1, "solid": []}, "nothing in it"),
        ({"schema": 2, "solid": [BALL]}, "schema is 2"),
    ],
)
def test_what_does_not_hold_is_refused_with_its_place(
    document: object, message: str
) -> None:
    with pytest.raises(TwinError, match=message):
        sent(document)


def test_an_open_mesh_inside_a_document_is_refused() -> None:
    ball = trimesh.creation.icosphere(subdivisions=1, radius=5)
    whole = Surface(ball.vertices, ball.faces, "abs", 0.02)
    made = Phantom("m", "", Scene(()), (10.0, 10.0, 10.0), surfaces=(whole, whole))
    assert len(sent(made.to_dict()).surfaces) == 2
    holed = Surface(ball.vertices, ball.faces[1:], "abs", 0.02)
    with pytest.raises(PhantomError, match="not closed"):
        sent(replace(made, surfaces=(holed,)).to_dict())


def test_a_size_that_is_said_too_small_does_not_hide_the_solids() -> None:
    document = load_phantom("normal-2").to_dict()
    document["size_mm"] = [1.0, 1.0, 1.0]
    assert sent(document).size_mm == (20.0, 40.0, 60.0)


def test_a_reader_that_takes_too_long_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    raw = json.dumps({"schema": 1, "solid": [BALL]}).encode()
    with monkeypatch.context() as hurried:
        hurried.setattr(mesh_workers, "TIMEOUT_S", 0.0)
        with pytest.raises(PhantomError, match="'thing' cannot be read"):
            mesh_workers.scene_apart(raw, name="thing")
    with pytest.raises(PhantomError, match="unknown material 'cheese'"):
        mesh_workers.scene_apart(raw.replace(b"pmma", b"cheese"), name="thing")


def test_the_pieces_on_the_stage_hold_every_round_solid(tmp_path: Path) -> None:
    """Random points of each surface lie inside the convex pieces; inscribed polyhedra fail
    this."""
    rng = np.random.default_rng(3)
    document = {
        "schema": 1,
        "solid": [
            BALL,
            {"kind": "cylinder", "center": [0, 0, -25], "radius": 15, "height": 30,
             "material": "Al@2.70"},
        ],
    }  # fmt: skip
    machine = builtin_machine()
    store = store_of(tmp_path, json.dumps(document).encode(), "json")
    asyncio.run(asyncio.to_thread(completed, store, "thing"))
    stage = Stage(machine, builtin_profile(machine.default_profile), store)
    pieces = stage.pieces(Sample("thing"))
    way = rng.normal(size=(400, 3))
    ball = np.array([0, 0, 5]) + 20 * way / np.linalg.norm(way, axis=1, keepdims=True)
    angle, height = rng.uniform(0, 2 * np.pi, 400), rng.uniform(-40, -10, 400)
    mantle = np.column_stack([15 * np.cos(angle), 15 * np.sin(angle), height])
    for point in np.concatenate([ball, mantle]):
        assert any(_holds(piece, point) for piece in pieces)


def _holds(piece: Polytope, point: np.ndarray) -> bool:
    a, b, c = (piece.vertices[piece.faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return bool((np.einsum("ij,ij->i", normals, point - a) <= 1e-6).all())
