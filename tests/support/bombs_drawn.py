"""Small files that ask for much: twenty kinds, each drawn anew, and the doors that they come to.

A bomb is at most some megabytes, but for what must be long to be one, and claims, inflates to or
makes a parser do many times its size.
"""

from __future__ import annotations

import json
import random
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

Rng = random.Random


@dataclass(frozen=True)
class Bomb:
    """One file or folder, and what is done with it.

    Attributes:
        path: of the file or folder.
        library: a statement of `import flexdt as fx`; P is the path.
        command: arguments of `flexdt`; {P} is the path, {OUT} a folder.
        upload: how a client brings it to a twin: as a mesh of this format or a "scene"; "dataset"
            where it lies in the data directory; "" not at all.
        harmless: whether it may also be read, within the same limits.
    """

    path: Path
    library: str
    command: tuple[str, ...]
    upload: str = ""
    harmless: bool = False


def _npy(shape: object, data: bytes = b"", descr: str = "<f8") -> bytes:
    """An .npy whose head claims any shape."""
    head = repr({"descr": descr, "fortran_order": False, "shape": shape}).ljust(117)
    return (
        b"\x93NUMPY\x01\x00"
        + struct.pack("<H", len(head) + 1)
        + f"{head}\n".encode()
        + data
    )


def _file(folder: Path, name: str, data: bytes | str) -> Path:
    path = folder / name
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return path


def _import(form: str) -> tuple[str, ...]:
    return ("import", "{P}", "--format", form, "--out", "{OUT}/geometry.json")


GEOMETRY = "fx.ConeVec.load(P)"
MESH = "fx.phantoms.mesh_phantom(P)"
MACHINE = ("machine", "check", "{P}")


def npy_claim(rng: Rng, folder: Path) -> Bomb:
    """A head that claims up to 1e15 values."""
    shape = (10 ** rng.randint(11, 14), 12)
    return Bomb(
        _file(folder, "g.npy", _npy(shape, bytes(96))), GEOMETRY, _import("astra")
    )


def npz_inflated(rng: Rng, folder: Path) -> Bomb:
    """Two megabytes that are two gigabytes."""
    path = folder / "g.npz"
    block = _npy((1 << 23,), bytes(64 << 20))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for i in range(rng.randint(8, 33)):
            archive.writestr(f"a{i}.npy", block)
    return Bomb(path, GEOMETRY, _import("tomosipo"))


def npz_many(rng: Rng, folder: Path) -> Bomb:
    """An archive of tens of thousands of arrays."""
    path = folder / "g.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for i in range(rng.randint(20_000, 60_000)):
            archive.writestr(f"{i}.npy", b"")
    return Bomb(path, GEOMETRY, _import("cil"))


def toml_deep_key(rng: Rng, folder: Path) -> Bomb:
    """A key of 20 000 parts."""
    key = ".".join("k" * rng.randint(5_000, 20_000))
    return Bomb(_file(folder, "m.toml", f"{key} = 1\n"), "fx.machine(P)", MACHINE)


def toml_wide(rng: Rng, folder: Path) -> Bomb:
    """Unknown keys by the hundred thousand."""
    lines = "".join(f"k{i} = {i}\n" for i in range(rng.randint(100_000, 900_000)))
    return Bomb(_file(folder, "m.toml", lines), "fx.machine(P)", MACHINE)


def toml_solids(rng: Rng, folder: Path) -> Bomb:
    """A scene of very many solids."""
    solid = '[[solid]]\nkind="sphere"\ncenter=[0,0,0]\nradius=1\nmaterial="abs"\n'
    text = 'schema=1\nname="many"\n' + solid * rng.randint(40_000, 60_000)
    path = _file(folder, "scene.toml", text)
    return Bomb(path, "fx.phantoms.as_phantom(P)", ("expose", "--sample", "{P}"), "scene")


def json_document(rng: Rng, folder: Path) -> Bomb:
    """A wrong flexdt.json of up to 95 MB: hundreds of thousands of wrong frames."""
    wrong = json.dumps(rng.choice([{}, {"file": 7, "cone_vec": ["x"] * 12}, []]))
    size = rng.choice([10, 40, 95]) << 20
    frames = ",".join([wrong] * (size // (len(wrong) + 1)))
    data = folder / "wrong"
    data.mkdir()
    _file(data, "flexdt.json", f'{{"schema": 1, "frames": [{frames}]}}')
    _file(data, "scan_000000.tif", b"II*\0")
    return Bomb(data, "fx.open(P)", ("align", "{P}"), "dataset")


def json_deep(rng: Rng, folder: Path) -> Bomb:
    """Lists in lists, a million deep."""
    depth = rng.randint(200_000, 1_000_000)
    return Bomb(
        _file(folder, "g.json", "[" * depth + "]" * depth), GEOMETRY, _import("ctsimu")
    )


def json_rows(rng: Rng, folder: Path) -> Bomb:
    """A geometry of far too many numbers."""
    rows = ",".join(["0"] * rng.randint(3_000_000, 9_000_000))
    text = f'{{"kind": "flexdt geometry", "schema": 1, "cone_vec": [[{rows}]]}}'
    return Bomb(_file(folder, "g.json", text), GEOMETRY, _import("ctsimu"))


def _tiff(
    rows: int, columns: int, strips: list[tuple[int, int]], data: bytes, packing: int = 8
) -> bytes:
    """A TIFF whose strips, (offset, length), lie anywhere in `data`, which begins at 8."""
    n = len(strips)
    lists = 8 + len(data)
    table = lists + 8 * n
    entries = [
        (256, 4, 1, columns), (257, 4, 1, rows), (258, 3, 1, 16), (259, 3, 1, packing),
        (262, 3, 1, 1), (273, 4, n, lists if n > 1 else strips[0][0]), (277, 3, 1, 1),
        (278, 4, 1, max(1, rows // n)),
        (279, 4, n, lists + 4 * n if n > 1 else strips[0][1]),
    ]  # fmt: skip
    head = b"II*\0" + struct.pack("<I", table)
    offsets = struct.pack(f"<{n}I", *(s[0] for s in strips))
    lengths = struct.pack(f"<{n}I", *(s[1] for s in strips))
    ifd = struct.pack("<H", len(entries))
    ifd += b"".join(struct.pack("<HHII", *entry) for entry in entries) + bytes(4)
    return head + data + offsets + lengths + ifd


def _images(
    folder: Path, image: bytes, shape: tuple[int, int] = (64, 64)
) -> tuple[Path, str, tuple[str, ...]]:
    """A folder of three such images with a geometry for them."""
    data = folder / "images"
    data.mkdir()
    for i in range(3):
        _file(data, f"scan_{i:06d}.tif", image)
    _file(data, "io000000.tif", image)
    turn = f"fx.ConeVec.circular(sod=100, sdd=200, angles=3, shape={shape}, pixel=0.01)"
    library = f"d = fx.read_tiffs(P, {turn}); d.counts()"
    _file(folder, "vectors.txt", "0 -100 0 0 100 0 1 0 0 0 0 -1\n" * 3)
    command = ("calibrate", "--frames", "{P}", "--geometry", str(folder / "vectors.txt"),
               "--phantom", "lego")  # fmt: skip
    return data, library, command


def tiff_shared(rng: Rng, folder: Path) -> Bomb:
    """Up to 16 000 strips that name one stream; each inflates to less than the claim."""
    rows = rng.randint(4_000, 16_000)
    stream = zlib.compress(bytes(2 * 8_000 * rng.randint(50, 900)), 9)
    image = _tiff(rows, 8_000, [(8, len(stream))] * rows, stream)
    return Bomb(*_images(folder, image, (rows, 8_000)))


def tiff_claim(rng: Rng, folder: Path) -> Bomb:
    """Thirty thousand pixels a side of a hundred bytes."""
    side = rng.randint(20_000, 60_000)
    stream = zlib.compress(bytes(100_000), 9)
    return Bomb(*_images(folder, _tiff(side, side, [(8, len(stream))], stream)))


def tiff_inflated(rng: Rng, folder: Path) -> Bomb:
    """A small image whose one strip inflates to a gigabyte."""
    stream = zlib.compress(bytes(rng.randint(300, 1000) << 20), 1)
    return Bomb(*_images(folder, _tiff(64, 64, [(8, len(stream))], stream)))


def obj_groups(rng: Rng, folder: Path) -> Bomb:
    """A tetrahedron with tens of thousands of groups or materials."""
    word = rng.choice(["usemtl", "g", "o", "s"])
    lines = ["v 0 0 0", "v 9 0 0", "v 0 9 0", "v 0 0 9"]
    faces = ["f 1 3 2", "f 1 2 4", "f 2 3 4", "f 1 4 3"]
    lines += [
        line
        for i in range(rng.randint(10_000, 40_000))
        for line in (f"{word} {i}", faces[i % 4])
    ]
    path = _file(folder, "part.obj", "\n".join(lines))
    return Bomb(path, MESH, ("phantom", "make", "{OUT}/p.json", "--mesh", "{P}"), "obj",
                harmless=True)  # fmt: skip


def _mesh(folder: Path, kind: str, data: bytes) -> Bomb:
    command = ("phantom", "make", "{OUT}/p.json", "--mesh", "{P}")
    return Bomb(_file(folder, f"part.{kind}", data), MESH, command, kind)


def stl_claim(rng: Rng, folder: Path) -> Bomb:
    """A head that announces four thousand million triangles."""
    count = rng.randint(10**8, 2**32 - 1)
    return _mesh(folder, "stl", bytes(80) + struct.pack("<I", count) + bytes(50))


def ply_claim(rng: Rng, folder: Path) -> Bomb:
    """A header that announces as many vertices, or a list without an end."""
    head = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {rng.randint(10**8, 10**12)}\nproperty float x\nproperty float y\n"
        "property float z\nelement face 1\nproperty list int int vertex_indices\nend_header\n"
    )
    return _mesh(folder, "ply", head.encode() + bytes(64))


def off_claim(rng: Rng, folder: Path) -> Bomb:
    """An OFF file that announces more than it holds."""
    text = f"OFF\n{rng.randint(10**7, 10**10)} {rng.randint(10**7, 10**10)} 0\n0 0 0\n"
    return _mesh(folder, "off", text.encode())


def glb_nodes(rng: Rng, folder: Path) -> Bomb:
    """One mesh that thousands of nodes draw."""
    count = rng.randint(2_000, 20_000)
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": list(range(count))}],
        "nodes": [{"mesh": 0}] * count,
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0}}] * rng.randint(1, 50)}
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = (
        struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", 36, b"BIN\0")
        + bytes(36)
    )
    return _mesh(folder, "glb", b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body)


def xml_entities(rng: Rng, folder: Path) -> Bomb:
    """A billion laughs, or millions of elements."""
    if rng.random() < 0.5:
        names = [
            f'<!ENTITY a{i} "{f"&a{i - 1};" * 10 if i else "ha"}">' for i in range(10)
        ]
        text = f"<!DOCTYPE r [{''.join(names)}]><r>&a9;</r>"
    else:
        some = "<Projection/>" * rng.randint(2_100_000, 4_000_000)
        text = (
            f'<RTKThreeDCircularGeometry version="3">{some}</RTKThreeDCircularGeometry>'
        )
    return Bomb(
        _file(folder, "g.xml", text), "fx.ConeVec.load(P, pixel=1.0)", _import("rtk")
    )


def table_long(rng: Rng, folder: Path) -> Bomb:
    """A table of numbers longer than any scan."""
    row = " ".join(["1.5"] * 12) + "\n"
    text = row * rng.randint(1_500_000, 2_000_000)
    return Bomb(_file(folder, "g.txt", text), GEOMETRY, _import("astra"))


def script_long(rng: Rng, folder: Path) -> Bomb:
    """A script of millions of lines."""
    text = "rot_obj\tmove absolute\t1\t0\tACK\t\t\r\n" * rng.randint(2_100_000, 3_000_000)
    path = _file(folder, "scan.txt", text)
    return Bomb(path, "fx.plan(P)", ("check", "{P}"), "")


def settings_long(rng: Rng, folder: Path) -> Bomb:
    """The settings of a scan with a line that does not end."""
    data = folder / "scan"
    data.mkdir()
    _file(data, "scan.xtekct", "[XTekCT]\nName=" + "a" * (rng.randint(17, 60) << 20))
    return Bomb(data / "scan.xtekct", "fx.open(P)", ("align", "{P}"))


def endless(rng: Rng, folder: Path) -> Bomb:
    """A device that never ends, under a name that says what it is."""
    name, library, command = rng.choice([
        ("m.toml", "fx.machine(P)", MACHINE),
        ("g.json", GEOMETRY, _import("ctsimu")),
        ("g.csv", GEOMETRY, _import("csv")),
        ("scan.txt", "fx.plan(P)", ("check", "{P}")),
    ])  # fmt: skip
    path = folder / name
    path.symlink_to("/dev/zero")
    return Bomb(path, library, command)


KINDS: dict[str, Callable[[Rng, Path], Bomb]] = {
    make.__name__: make
    for make in (
        npy_claim, npz_inflated, npz_many, toml_deep_key, toml_wide, toml_solids, json_document,
        json_deep, json_rows, tiff_shared, tiff_claim, tiff_inflated, obj_groups, stl_claim,
        ply_claim, off_claim, glb_nodes, xml_entities, table_long, script_long, settings_long,
        endless,
    )
}  # fmt: skip
"""Name -> how one is drawn into a folder."""


def mib(path: Path) -> float:
    """Size of a file, or of all in a folder [MiB]."""
    files = [path] if path.is_file() else [p for p in path.rglob("*") if p.is_file()]
    return sum(p.stat().st_size for p in files) / 2**20
