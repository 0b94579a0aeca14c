"""`sample.mesh`: the shape of what stands on the stage, for clients that draw it."""

from __future__ import annotations

import base64
import io
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import trimesh
from lab import Process, Wire, twin

from flexdt.clients.client.client import TwinClient
from flexdt.clients.client.twin_methods import MESH_FORMATS
from flexdt.phantoms import load_phantom
from flexdt.protocol import RpcError
from flexdt.server.scans.stage import Shapes

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def server(rays: Process, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Process]:
    process = twin(rays.port, tmp_path_factory.mktemp("data"), "--sample", "empty")
    yield process
    process.end()


def angle(height: float) -> Any:
    """An L, which no box and no hull is."""
    outline = [[0, 0], [30, 0], [30, 10], [10, 10], [10, 20], [0, 20]]
    triangles = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]
    return trimesh.creation.extrude_triangulation(outline, triangles, height)


def read(stl: bytes) -> Any:
    return trimesh.load(io.BytesIO(stl), file_type="stl")


def test_the_shape_of_an_upload_comes_back_and_its_revision_changes(
    server: Process,
) -> None:
    with TwinClient(port=server.port) as client:
        with pytest.raises(RpcError, match="nothing stands on the stage"):
            client.sample_mesh()
        revisions = []
        for height, place in ((8.0, "centred"), (8.0, "centred"), (9.0, "keep")):
            mesh = angle(height)
            raw = mesh.export(file_type="stl")
            sent = client.upload_mesh(raw, "angle", format="stl", unit="mm", place=place)
            client.set_sample(file="angle")
            revisions.append(client.state().sample.revision)
            got = read(client.sample_mesh())
            assert got.volume == pytest.approx(mesh.volume, rel=1e-5)
            # The middle of its box stands on the axis at the reference height, if asked for.
            half = np.array([15.0, 10.0, height / 2])
            by = -half if place == "centred" else 0.0 * half
            assert got.bounds == pytest.approx(mesh.bounds + by, abs=1e-4)
            said = sent.sample.description if sent.sample else ""
            assert ("moved by (-15, -10, -4) mm" in said) == (place == "centred")
        assert revisions[0] == revisions[1] != revisions[2]
        client.set_sample("normal-3")
        assert client.state().sample.revision is None
        shipped = read(client.sample_mesh())
        assert len(shipped.faces) == len(load_phantom("normal-3").mesh().faces)


@pytest.mark.parametrize("form", ["stl", "obj", "ply", "glb", "off"])
@pytest.mark.campaign(2)
def test_every_format_that_the_wire_names_is_read(server: Process, form: str) -> None:
    """As bytes in chunks, in the format's own unit and in another one, of a chosen material."""
    raw = angle(8.0).export(file_type=form)
    raw = raw.encode() if isinstance(raw, str) else raw
    with TwinClient(port=server.port) as client:
        assert form in MESH_FORMATS
        done = client.upload_mesh(
            raw, f"as-{form}", format=form, unit="mm", place="centred", material="pmma"
        )
        assert done.complete
        client.set_sample(file=f"as-{form}")
        sample = client.state().sample
        assert sample.size_mm == pytest.approx((30.0, 20.0, 8.0), rel=1e-5)
        assert sample.material == "pmma"
        client.set_sample("empty")
        if form == "stl":
            done = client.upload_mesh(raw, "unsaid", format=form)
            assert done.sample is not None
            # Of the box about the origin, at which the L has its corner.
            assert done.sample.size_mm == pytest.approx((60.0, 40.0, 16.0), rel=1e-5)
        elif form == "glb":  # metres
            with pytest.raises(RpcError, match="30000 mm in unit 'm'"):
                client.upload_mesh(raw, "unsaid", format=form)


def test_a_file_that_claims_what_it_has_not_is_an_error_and_nothing_more(
    server: Process,
) -> None:
    claim = (
        b'{"asset":{"version":"2.0"},"scenes":[{"nodes":[0]}],"nodes":[{"mesh":0}],'
        b'"meshes":[{"primitives":[{"attributes":{"POSITION":0}}]}],'
        b'"accessors":[{"componentType":5126,"count":30000000,"type":"VEC3"}]}'
    )
    claim += b" " * (-len(claim) % 4)
    raw = (
        struct.pack("<4sIII4s", b"glTF", 2, 20 + len(claim), len(claim), b"JSON") + claim
    )
    with TwinClient(port=server.port) as client:
        with pytest.raises(
            RpcError, match="not a readable GLB file: accessor 0"
        ) as refused:
            client.upload_mesh(raw, "claim", format="glb")
        assert refused.value.code == -32602
        assert "claim" not in [s.name for s in client.samples().samples]


def test_parts_are_bytes_of_the_whole(server: Process) -> None:
    wire = Wire(server.port)
    wire.call("sample.set", name="normal-3")
    whole = wire.call("sample.mesh", count=4 << 20)
    part = wire.call("sample.mesh", start=80, count=4)
    assert part["total"] == whole["total"]
    faces = int.from_bytes(base64.b64decode(part["data"]), "little")
    assert whole["total"] == 84 + 50 * faces
    beyond = wire.call("sample.mesh", start=whole["total"] + 5)
    assert beyond["data"] == ""
    assert wire.ask("sample.mesh", count=(4 << 20) + 1)["error"]["code"] == -32602
    wire.close()


def test_more_triangles_than_are_sent() -> None:
    phantom = load_phantom("normal-3")
    size = 84 + 50 * len(phantom.mesh().faces)
    assert len(Shapes(size).of("a", None, phantom).stl) == size
    with pytest.raises(RpcError) as refused:
        Shapes(size - 1).of("a", None, phantom)
    assert refused.value.code == -32008


def box(client: TwinClient, side: float) -> list[str]:
    mesh = trimesh.creation.box((side, side, side))
    stl = mesh.export(file_type="stl")
    return list(client.upload_mesh(stl, "thing", format="stl", unit="mm").warnings)


def test_another_file_under_the_same_name_is_what_stands_and_collides(
    server: Process,
) -> None:
    with TwinClient(port=server.port) as client:
        box(client, 10.0)
        client.set_sample(file="thing")
        client.set_clock("max")
        client.move({"mag_obj": 300.0}, wait=True)
        assert box(client, 20.0) == []
        assert client.state().sample.size_mm == pytest.approx((20.0, 20.0, 20.0))
        # 700 mm across reach from the axis into the source: it may not be put there.
        with pytest.raises(RpcError) as refused:
            box(client, 700.0)
        assert refused.value.code == -32002
        assert client.state().sample.size_mm == pytest.approx((20.0, 20.0, 20.0))
        client.move({"mag_obj": 310.0}, wait=True)
        assert box(client, 10.0) == []
        client.set_clock(1.0)
        client.move({"mag_obj": 290.0})
        client.set_sample("empty")


def test_others_do_not_change_what_stands_on_the_stage(server: Process) -> None:
    with TwinClient(port=server.port) as mine, TwinClient(port=server.port) as other:
        box(mine, 10.0)
        mine.set_sample(file="thing")  # takes control
        with pytest.raises(RpcError, match="controller"):
            box(other, 20.0)
        assert mine.state().sample.size_mm == pytest.approx((10.0, 10.0, 10.0))
        mine.set_sample("empty")
        box(other, 20.0)
