"""TIFF files written byte by byte, for tests of the reader: nothing here is shared with it.

`tiff_file` takes samples as they are to be stored, and says of them what its arguments say. The
compressions are written from their descriptions (TIFF 6.0, sections 9, 13 and 14).
"""

import struct
import zlib

import numpy as np

TOP_LEFT = 1
SHORT, LONG, LONG8 = 3, 4, 16


def stored_of(shown: np.ndarray, orientation: int) -> np.ndarray:
    """The samples of a file of this orientation that is to be shown as `shown`: loops over
    pixels, after the table of TIFF 6.0, page 36 (what row 0 and column 0 of the file are)."""
    rows, cols = shown.shape[:2]
    row_is, col_is = {
        1: ("top", "left"), 2: ("top", "right"), 3: ("bottom", "right"), 4: ("bottom", "left"),
        5: ("left", "top"), 6: ("right", "top"), 7: ("right", "bottom"), 8: ("left", "bottom"),
    }[orientation]  # fmt: skip
    sideways = row_is in ("left", "right")
    out = np.zeros((cols, rows) if sideways else (rows, cols), shown.dtype)
    for r in range(rows):
        for c in range(cols):
            from_edge = {
                "top": r,
                "bottom": rows - 1 - r,
                "left": c,
                "right": cols - 1 - c,
            }
            out[from_edge[row_is], from_edge[col_is]] = shown[r, c]
    return out


def packed_rows(samples: np.ndarray, bits: int, order: str) -> list[bytes]:
    """Rows (rows, samples in a row) as bytes; bits that are no whole bytes are written most
    significant first, and each row begins with a byte."""
    if bits % 8 == 0 and bits <= 64 and bits not in (24,):
        kind = samples.dtype.kind
        return [row.astype(f"{order}{kind}{bits // 8}").tobytes() for row in samples]
    rows = []
    for row in samples:
        if bits == 24:
            ends = "little" if order == "<" else "big"
            rows.append(b"".join(int(v).to_bytes(3, ends) for v in row))
            continue
        digits = "".join(format(int(v), f"0{bits}b") for v in row)
        digits += "0" * (-len(digits) % 8)
        rows.append(bytes(int(digits[i : i + 8], 2) for i in range(0, len(digits), 8)))
    return rows


def packbits(raw: bytes) -> bytes:
    """Apple's run lengths, of the simplest kind: runs of at least three, else literals."""
    out, at = bytearray(), 0
    while at < len(raw):
        run = 1
        while run < 128 and at + run < len(raw) and raw[at + run] == raw[at]:
            run += 1
        if run >= 3:
            out += bytes((257 - run, raw[at]))
            at += run
            continue
        end = at + 1
        while (
            end < len(raw)
            and end - at < 128
            and raw[end : end + 3] != raw[end : end + 1] * 3
        ):
            end += 1
        out += bytes((end - at - 1,)) + raw[at:end]
        at = end
    return bytes(out)


def lzw(raw: bytes) -> bytes:
    """TIFF's LZW: codes of 9 to 12 bits, most significant first, one early."""
    digits, table, width, word = [], {}, 9, b""

    def put(code: int) -> None:
        digits.append(format(code, f"0{width}b"))

    put(256)
    table = {bytes((i,)): i for i in range(256)}
    next_code = 258
    for byte in raw:
        longer = word + bytes((byte,))
        if longer in table:
            word = longer
            continue
        put(table[word])
        table[longer] = next_code
        next_code += 1
        if next_code == 4095:
            put(256)
            table = {bytes((i,)): i for i in range(256)}
            next_code, width = 258, 9
        else:
            width = max(9, (next_code).bit_length())
        word = bytes((byte,))
    if word:
        put(table[word])
        next_code += 1
        width = max(9, next_code.bit_length())
    put(257)
    text = "".join(digits)
    text += "0" * (-len(text) % 8)
    return bytes(int(text[i : i + 8], 2) for i in range(0, len(text), 8))


COMPRESSIONS = {1: bytes, 5: lzw, 8: zlib.compress, 32946: zlib.compress, 32773: packbits}


def differences(samples: np.ndarray, inside: int) -> np.ndarray:
    """Predictor 2: each sample less the one of the pixel before it."""
    out = samples.copy()
    out[:, inside:] = samples[:, inside:] - samples[:, :-inside]
    return out


def float_rows(samples: np.ndarray, inside: int) -> list[bytes]:
    """Predictor 3: bytes of equal significance side by side, then their differences."""
    rows = []
    for row in samples:
        size = samples.dtype.itemsize
        raw = row.astype(f">f{size}").tobytes()
        planes = [raw[at + k] for k in range(size) for at in range(0, len(raw), size)]
        rows.append(
            bytes(
                (b - planes[i - inside]) % 256 if i >= inside else b
                for i, b in enumerate(planes)
            )
        )
    return rows


def tiff_file(
    pages, *, order="<", big=False, bits=None, compression=1, photometric=1, orientation=None,
    rows_per_strip=None, tile=None, planar=1, predictor=1, fill_order=None, extra=(),
    sample_format=None, more=(),
):  # fmt: skip
    """The bytes of a TIFF file of pages (rows, cols) or (rows, cols, samples), all alike.

    Args:
        more: further tags, (number, type, values).
    """
    letter = "<" if order == "<" else ">"
    marks = struct.pack(
        letter + "2sH", b"II" if order == "<" else b"MM", 43 if big else 42
    )
    if big:
        marks += struct.pack(letter + "HH", 8, 0)
    out = bytearray(marks + bytes(8 if big else 4))
    link = len(marks)
    for page in pages:
        samples = page[..., None] if page.ndim == 2 else page
        rows, cols, inside = samples.shape
        each = bits or 8 * samples.dtype.itemsize
        planes = (
            [samples[..., k : k + 1] for k in range(inside)] if planar == 2 else [samples]
        )
        places, sizes = [], []
        for plane in planes:
            high, wide = tile or (rows_per_strip or rows, cols)
            for top in range(0, rows, high):
                for left in range(0, cols, wide):
                    part = plane[top : top + high, left : left + wide]
                    if tile:
                        grown = np.zeros((high, wide, part.shape[2]), part.dtype)
                        grown[: part.shape[0], : part.shape[1]] = part
                        part = grown
                    flat = part.reshape(len(part), -1)
                    if predictor == 2:
                        flat = differences(flat, part.shape[2])
                    if predictor == 3:
                        lines = float_rows(flat, part.shape[2])
                    else:
                        lines = packed_rows(flat, each, order)
                    if compression == 32773:
                        raw = b"".join(map(packbits, lines))
                    else:
                        raw = COMPRESSIONS[compression](b"".join(lines))
                    if fill_order == 2:
                        raw = bytes(int(format(b, "08b")[::-1], 2) for b in raw)
                    out += bytes(len(out) % 2)
                    places.append(len(out))
                    sizes.append(len(raw))
                    out += raw
        kind = {"u": 1, "i": 2, "f": 3}[samples.dtype.kind]
        wide_type = LONG8 if big else LONG
        tags = [
            (256, LONG, [cols]), (257, LONG, [rows]), (258, SHORT, [each] * inside),
            (259, SHORT, [compression]), (277, SHORT, [inside]), *more,
        ]  # fmt: skip
        if photometric is not None:
            tags.append((262, SHORT, [photometric]))
        if fill_order:
            tags.append((266, SHORT, [fill_order]))
        if orientation is not None:
            tags.append((274, SHORT, [orientation]))
        if planar != 1:
            tags.append((284, SHORT, [planar]))
        if predictor != 1:
            tags.append((317, SHORT, [predictor]))
        if extra:
            tags.append((338, SHORT, list(extra)))
        if kind != 1 or sample_format:
            tags.append((339, SHORT, [sample_format or kind] * inside))
        if tile:
            tags += [(322, LONG, [tile[1]]), (323, LONG, [tile[0]])]
            tags += [(324, wide_type, places), (325, wide_type, sizes)]
        else:
            tags += [(273, wide_type, places), (279, wide_type, sizes)]
            tags.append((278, LONG, [rows_per_strip or rows]))
        entries = bytearray()
        slot = 8 if big else 4
        for number, form, values in sorted(tags):
            if isinstance(values, bytes):
                body, many = values, len(values)
            else:
                letters = {SHORT: "H", LONG: "I", LONG8: "Q"}[form]
                body = struct.pack(letter + letters * len(values), *values)
                many = len(values)
            if len(body) > slot:
                out += bytes(len(out) % 2)
                place = len(out)
                out += body
                body = struct.pack(letter + ("Q" if big else "I"), place)
            entries += struct.pack(letter + ("HHQ" if big else "HHI"), number, form, many)
            entries += body.ljust(slot, b"\0")
        out += bytes(len(out) % 2)
        struct.pack_into(letter + ("Q" if big else "I"), out, link, len(out))
        out += struct.pack(letter + ("Q" if big else "H"), len(tags)) + entries
        link = len(out)
        out += bytes(slot)
    return bytes(out)
