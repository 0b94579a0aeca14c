"""Image files of other formats than TIFF written byte by byte, for tests of the reader."""

import struct
import zlib

import numpy as np


def png_file(values: np.ndarray, kind: int = 0, chunks=()) -> bytes:
    """PNG of (rows, cols) or (rows, cols, samples); `chunks` (name, body) before its pixels."""

    def chunk(name: bytes, body: bytes) -> bytes:
        crc = zlib.crc32(name + body)
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", crc)

    bits = 8 * values.dtype.itemsize
    lines = b"".join(b"\0" + row.astype(f">u{bits // 8}").tobytes() for row in values)
    head = struct.pack(">IIBBBBB", values.shape[1], values.shape[0], bits, kind, 0, 0, 0)
    parts = [chunk(b"IHDR", head), *(chunk(n, b) for n, b in chunks)]
    parts += [chunk(b"IDAT", zlib.compress(lines)), chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def bmp_file(values: np.ndarray, *, down: bool = False, palette=None) -> bytes:
    """BMP of 8 bits (rows, cols), or of 24 or 32 (rows, cols, 3 or 4); rows from the lowest up
    unless `down`."""
    rows, cols = values.shape[:2]
    inside = 1 if values.ndim == 2 else values.shape[2]
    lines = [row.tobytes() for row in values.reshape(rows, -1)]
    lines = [line + bytes(-len(line) % 4) for line in lines]
    table = b""
    if inside == 1:
        ramp = palette if palette is not None else [(i, i, i) for i in range(256)]
        table = b"".join(bytes((*colour, 0)) for colour in ramp)
    body = b"".join(lines if down else lines[::-1])
    begin = 54 + len(table)
    info = struct.pack(
        "<IiiHHIIiiII", 40, cols, -rows if down else rows, 1, 8 * inside, 0, len(body), 0, 0,
        len(table) // 4, 0,
    )  # fmt: skip
    return (
        b"BM" + struct.pack("<IHHI", begin + len(body), 0, 0, begin) + info + table + body
    )


EDF_WORDS = {
    "u1": "UnsignedByte",
    "u2": "UnsignedShort",
    "i4": "SignedInteger",
    "f4": "FloatValue",
}


def edf_file(images, order: str = "<", **more: str) -> bytes:
    """EDF of images of one shape, each with a header of 512 bytes."""
    out = b""
    for k, image in enumerate(images):
        fields = {
            "HeaderID": f"EH:{k + 1:06d}:000000:000000", "Image": str(k + 1),
            "ByteOrder": "LowByteFirst" if order == "<" else "HighByteFirst",
            "DataType": EDF_WORDS[image.dtype.str[1:]], "Dim_1": str(image.shape[1]),
            "Dim_2": str(image.shape[0]), "Size": str(image.nbytes), **more,
        }  # fmt: skip
        text = "{\n" + "".join(f"{key} = {value} ;\n" for key, value in fields.items())
        out += (text.ljust(510) + "}\n").encode() + image.astype(
            order + image.dtype.str[1:]
        ).tobytes()
    return out


META_WORDS = {"u1": "MET_UCHAR", "u2": "MET_USHORT", "i4": "MET_INT", "f4": "MET_FLOAT"}


def meta_header(shape, kind: str, data: str = "LOCAL", **more: str) -> bytes:
    """Header of a MetaImage of an array of this shape."""
    fields = {
        "ObjectType": "Image", "NDims": str(len(shape)), "BinaryData": "True",
        "BinaryDataByteOrderMSB": "False", "ElementSpacing": " ".join(["1"] * len(shape)),
        "DimSize": " ".join(map(str, reversed(shape))), "ElementType": META_WORDS[kind], **more,
    }  # fmt: skip
    fields["ElementDataFile"] = data
    return "".join(f"{key} = {value}\n" for key, value in fields.items()).encode()


NRRD_WORDS = {"u1": "uint8", "u2": "ushort", "i4": "int32", "f4": "float"}


def nrrd_header(shape, kind: str, data: str | None = None, **more: str) -> bytes:
    """Header of an NRRD file of an array of this shape."""
    fields = {
        "type": NRRD_WORDS[kind], "dimension": str(len(shape)),
        "sizes": " ".join(map(str, reversed(shape))), "endian": "little", "encoding": "raw",
        **({"data file": data} if data else {}), **more,
    }  # fmt: skip
    return (
        "NRRD0004\n" + "".join(f"{k}: {v}\n" for k, v in fields.items()) + "\n"
    ).encode()


def npy_file(
    values: np.ndarray, fortran: bool = False, descr: str | None = None
) -> bytes:
    """NumPy's format, version 1.0."""
    said = {
        "descr": descr or values.dtype.str,
        "fortran_order": fortran,
        "shape": values.shape,
    }
    text = repr(said).encode()
    text = text.ljust((len(text) + 11 + 63) // 64 * 64 - 11) + b"\n"
    body = values.tobytes(order="F" if fortran else "C")
    return b"\x93NUMPY\x01\0" + struct.pack("<H", len(text)) + text + body
