"""Contradictions in what is sent to the servers are refused or told on the wire as in Python."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

import flexdt as fx
from flexdt.protocol import Codec
from flexdt.protocol.methods.calibration_messages import DatasetGet
from flexdt.server.projector.service import serve_projector
from flexdt.server.storage.past_scans import TwinContext, work
from flexdt.twin.machine.description import builtin_machine, profile_of

pytestmark = pytest.mark.usefixtures("on_processor")

SCAN = fx.ConeVec.circular(sod=60, sdd=100, angles=4, shape=(6, 8), pixel=1)
BODY = np.full((4, 4, 4), 0.02, np.float32)


def answers(*messages: dict[str, Any]) -> list[Any]:
    """Replies of a projector of its own, by msgpack alone."""

    async def main() -> list[Any]:
        server = await serve_projector(memory_limit=1 << 24)
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
        out = []
        for number, message in enumerate(messages):
            body = msgpack.packb({"jsonrpc": "2.0", "id": number, **message})
            writer.write(len(body).to_bytes(4, "big") + body)
            size = int.from_bytes(await reader.readexactly(4), "big")
            out.append(msgpack.unpackb(await reader.readexactly(size)))
        writer.close()
        await server.close()
        return out

    return asyncio.run(main())


def put(values: np.ndarray[Any, Any]) -> dict[str, Any]:
    grid = {"shape": list(values.shape), "voxel_mm": [1, 1, 1]}
    data = values.astype("<f4").tobytes()
    return {"method": "volume.put", "params": {"name": "v", "grid": grid, "data": data}}


def project(rows: np.ndarray[Any, Any]) -> dict[str, Any]:
    asked = {"volume": "v", "cone_vec": rows.tolist(), "detector": [6, 8]}
    return {"method": "project", "params": asked}


@pytest.mark.parametrize(
    ("values", "refused", "told"),
    [
        (BODY, "", ""),
        (BODY - 1000.0, "Hounsfield units", ""),
        (np.where(BODY > 0, 3000.0, 0.0), "", "gray values"),
        (BODY + np.nan, "not finite", ""),
    ],
)
def test_a_volume_that_is_no_attenuation(
    values: np.ndarray[Any, Any], refused: str, told: str
) -> None:
    [reply] = answers(put(values))
    if refused:
        assert reply["error"]["code"] == -32602
        assert refused in reply["error"]["message"]
    else:
        warnings = reply["result"].get("warnings", [])
        assert len(warnings) == bool(told)
        assert all(told in one for one in warnings)


def _still(rows: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    rows = rows.copy()
    rows[:, :3] = 0.0
    return rows


@pytest.mark.parametrize(
    ("change", "refused", "told"),
    [
        (lambda rows: rows, "", ""),
        (lambda rows: rows * np.r_[[1e-3] * 6, [1.0] * 6], "are all lengths in mm", ""),
        (_still, "SOD is 0", ""),
        (lambda rows: rows * 1e-3, "", "source is inside the box"),
        (lambda rows: rows + np.r_[[900.0, 900.0, 900.0] * 2, [0.0] * 6], "", "no ray"),
    ],
)
def test_a_geometry_that_no_scanner_has(
    change: Callable[[np.ndarray[Any, Any]], np.ndarray[Any, Any]],
    refused: str,
    told: str,
) -> None:
    _, reply = answers(put(BODY), project(change(SCAN.rows)))
    if refused:
        assert reply["error"]["code"] == -32602
        assert refused in reply["error"]["message"]
    else:
        warnings = reply["result"].get("warnings", [])
        assert len(warnings) == bool(told)
        assert all(told in one for one in warnings)


@pytest.mark.parametrize(
    ("spans", "told"), [(360.0, ""), (2 * np.pi, "radians"), (0.0, "")]
)
def test_a_past_scan_tells_what_contradicts_it(
    tmp_path: Path, spans: float, told: str
) -> None:
    """By `dataset.get`, of the geometry in its document."""
    angles = np.linspace(0.0, spans, 40, endpoint=False)
    scan = fx.ConeVec.circular(sod=60, sdd=100, angles=angles, shape=(6, 8), pixel=1)
    images = np.full((40, 6, 8), 900, np.uint16)
    flat = np.full((6, 8), 1000, np.uint16)
    data = fx.DataSet.from_arrays(images, scan, dark=np.zeros_like(flat), flat=flat)
    data.save(tmp_path / "past")
    machine = builtin_machine("flexray")
    documents = (machine.model_dump(mode="json", by_alias=True),
                 profile_of(machine, None).model_dump(mode="json"))  # fmt: skip
    around = TwinContext("", *documents)
    pieces = work(tmp_path, DatasetGet(name="past"), around, Codec.JSON)
    warnings = json.loads(b"".join(pieces))["warnings"]
    assert bool(warnings) == bool(told)
    assert all(told in one and str(tmp_path) not in one for one in warnings)
