"""Attacks by files: meshes, voxels and images that are not what they say."""

from __future__ import annotations

import base64
import json
import os
import struct
import threading
import time
from typing import Any

import numpy as np
from attack_ground import Ground, attack, code_of, stl, upload
from lab import Plain, Wire


@attack("hostile STL: random bytes, a false count, not a number, huge coordinates")
def hostile_stl(g: Ground) -> str:
    wire = g.wire()
    nan = bytearray(stl(12))
    nan[96:100] = struct.pack("<f", float("nan"))
    big = bytearray(stl(12))
    big[96:100] = struct.pack("<f", 3e38)
    raws = [
        stl(1000),
        stl(12, claimed=0xFFFFFFFF),
        bytes(nan),
        bytes(big),
        b"solid x\n" * 100_000,
        b"solid x\nfacet normal 0 0 0\nouter loop\nvertex a b c\n" * 10,
        b"\0" * 84,
        b"x",
    ]
    codes = [code_of(upload(wire, f"bad{i}", raw, format="stl")) for i, raw in enumerate(raws)]
    assert set(codes) <= {-32602, -32001, -32008}, codes
    assert not [n for n in wire.call("sample.list")["samples"] if n["name"].startswith("bad")]
    return "-32602, nothing is kept"


def glb(count: int, nodes: int = 1, corners: int = 0, **accessor: Plain) -> bytes:
    """A GLB file whose mesh claims `count` vertices, has `corners` and stands `nodes` times."""
    binary = np.random.default_rng(3).random(3 * corners).astype("<f4").tobytes()
    document = {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": list(range(nodes))}],
        "nodes": [{"mesh": 0}] * nodes,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"componentType": 5126, "count": count, "type": "VEC3", **accessor}],
        "bufferViews": [{"buffer": 0, "byteLength": len(binary)}],
        "buffers": [{"byteLength": len(binary)}],
    }  # fmt: skip
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text
    body += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


@attack("hostile GLB, PLY and OFF: counts without bytes, a mesh in 10 000 places, other files")
def hostile_meshes(g: Ground) -> str:
    ply = b"ply\nformat %s 1.0\nelement vertex 4000000000\nproperty float x\nend_header\n1\n"
    raws = [
        ("glb", glb(30_000_000)),
        ("glb", glb(30_000_000, corners=3, bufferView=0)),
        ("glb", glb(300_000, nodes=10_000, corners=300_000, bufferView=0)),
        ("glb", glb(3, corners=3, bufferView=0).replace(b'"bufferView"', b'"bufferVuew"')),
        ("glb", b"glTF" + b"\xff" * 100),
        ("ply", ply % b"ascii"),
        ("ply", ply % b"binary_little_endian"),
        ("ply", b"ply\n" * 100_000),
        ("off", b"OFF\n4000000000 4000000000 0\n0 0 0\n"),
        ("off", b"OFF\n1 1 0\n0 0 0\n1000000000 0\n"),
    ]
    worst, done = 0.0, threading.Event()

    def watch() -> None:
        nonlocal worst
        while not done.is_set():
            worst = max(worst, g.twin.children_mb())
            time.sleep(0.01)

    thread = threading.Thread(target=watch)
    thread.start()
    wire = g.wire()
    try:
        codes = [
            code_of(upload(wire, f"bad{i}", raw, format=form)) for i, (form, raw) in enumerate(raws)
        ]
    finally:
        done.set()
        thread.join()
    assert set(codes) == {-32602}, codes
    assert not [n for n in wire.call("sample.list")["samples"] if n["name"].startswith("bad")]
    assert 0.0 < worst < 1000.0, worst
    return f"-32602, nothing is kept; their readers took {worst:.0f} MB at most"


@attack("a 100 MB text file as a mesh, while others ask")
def big_mesh(g: Ground) -> str:
    worst, done = 0.0, threading.Event()

    def watch() -> None:
        nonlocal worst
        other = g.wire()
        while not done.is_set():
            begun = time.perf_counter()
            other.call("session.ping")
            worst = max(worst, time.perf_counter() - begun)
            time.sleep(0.01)

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        rng = np.random.default_rng(1)
        line = "".join(f"v {a} {b} {c}\n" for a, b, c in rng.integers(0, 99, (1000, 3)))
        faces = "".join(f"f {a} {b} {c}\n" for a, b, c in rng.integers(1, 999, (1000, 3)))
        raw = (line + faces).encode() * (100_000_000 // len(line + faces))
        wire = Wire(g.twin.port, timeout_s=300)
        begun = time.monotonic()
        answer = upload(wire, "large", raw, format="obj")
        took = time.monotonic() - begun
    finally:
        done.set()
        thread.join()
    assert code_of(answer) in (-32602, -32008), answer
    return (
        f"{code_of(answer)} after {took:.0f} s; twin now {g.twin.memory_mb():.0f} MB; slowest ping "
        f"of another client {1000 * worst:.0f} ms"
    )


@attack("pickles as meshes and voxels")
def pickles(g: Ground) -> str:
    import pickle

    mark = g.root / "executed"

    class Bomb:
        def __reduce__(self) -> Any:
            return (os.mkdir, (str(mark),))

    wire = g.wire()
    raw = pickle.dumps(Bomb())
    for form in ("stl", "obj", "ply", "glb", "off"):
        assert "error" in upload(wire, "bomb", raw, format=form)
    voxels = {"kind": "voxels", "format": "raw", "shape": [1, 1, len(raw) // 4 + 1],
              "voxel_mm": [1.0, 1.0, 1.0]}  # fmt: skip
    assert "error" in upload(wire, "bomb", raw, **voxels)
    assert not mark.exists()
    return "-32602, nothing runs"


@attack("voxels that claim 10^15 of them")
def huge_voxels(g: Ground) -> str:
    wire = g.wire()
    answer = wire.ask(
        "sample.upload", name="v", kind="voxels", format="raw", total=4 * 10**15,
        data=base64.b64encode(b"\0" * 64).decode(), shape=[10**5] * 3, voxel_mm=[1.0, 1.0, 1.0],
    )  # fmt: skip
    assert code_of(answer) == -32008, answer
    answer = wire.ask(
        "sample.upload", name="v", kind="voxels", format="raw", total=64,
        data=base64.b64encode(b"\0" * 64).decode(), shape=[10**9] * 3, voxel_mm=[1.0, 1.0, 1.0],
    )  # fmt: skip
    assert "error" in answer
    return "-32008 before any memory is taken"


def retag(raw: bytearray, values: dict[int, int]) -> None:
    """Give tags of a small little-endian TIFF other values."""
    for tag, value in values.items():
        at = next(i for t in (3, 4) if (i := raw.find(struct.pack("<HHI", tag, t, 1))) >= 0)
        raw[at : at + 12] = struct.pack("<HHII", tag, 4, 1, value)


@attack("TIFF files: claims of 10^10 pixels, decompression bombs, cut off, rubbish")
def hostile_tiff(g: Ground) -> str:
    import io
    import resource
    import zlib

    import tifffile

    from flexdt.clients.dataset_files import read_image
    from flexdt.twin.dataset.errors import DatasetError

    honest = io.BytesIO()
    tifffile.imwrite(honest, np.zeros((64, 64), np.uint16), metadata=None)
    whole = honest.getvalue()
    vast = io.BytesIO()  # the head of a huge image without its pixels
    tifffile.imwrite(vast, np.zeros((3, 5), np.uint16), metadata=None)
    claims = bytearray(vast.getvalue())
    retag(claims, {256: 100_000, 257: 100_000})  # width and length
    bomb = io.BytesIO()
    tifffile.imwrite(bomb, np.zeros((64, 64), np.uint16), metadata=None, compression="zlib")
    packed = bytearray(bomb.getvalue())
    evil = zlib.compress(b"\0" * (1 << 30), 9)
    retag(packed, {279: len(evil), 273: len(packed)})  # the strip's length and place
    files = {"claims": bytes(claims), "bomb": bytes(packed) + evil, "cut": whole[:200],
             "rubbish": np.random.default_rng(2).bytes(5000), "empty": b""}  # fmt: skip
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for name, raw in files.items():
        path = g.root / f"{name}.tif"
        path.write_bytes(raw)
        try:
            read_image(path)
        except DatasetError:
            continue
        raise AssertionError(f"{name} was read")
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    assert grown < 200, grown
    kib = len(evil) >> 10
    return f"refused, {kib} KiB that inflate to 1 GiB included; {grown:.0f} MB more memory"


@attack("uploads that are begun and never ended")
def open_uploads(g: Ground) -> str:
    before = g.twin.memory_mb()
    part = base64.b64encode(b"\0" * (4 << 20)).decode()
    wire = g.wire()
    for i in range(60):
        wire.ask("sample.upload", name=f"open{i}", format="stl", total=200 << 20, data=part)
    wire.close()
    grown = g.twin.memory_mb() - before
    assert grown < 120, grown
    return f"a few are kept, older ones dropped; {max(0.0, grown):.0f} MB more after 240 MB"
