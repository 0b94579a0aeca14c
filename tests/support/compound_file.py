"""OLE2 files (Microsoft's compound file format, [MS-CFB]), written for tests of their reader.

Version 3: sectors of 512 bytes, small streams in mini sectors of 64, a file allocation table
for each. At most 7 MB, so that the header lists all sectors of the table.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping

SECTOR, MINI, CUTOFF = 512, 64, 4096
FREE, END, TABLE, NOBODY = 0xFFFFFFFF, 0xFFFFFFFE, 0xFFFFFFFD, 0xFFFFFFFF
STORAGE, STREAM, ROOT = 1, 2, 5


def compound_file(streams: Mapping[str, bytes]) -> bytes:
    """Write a compound file (OLE2, version 3) with these streams.

    Streams below CUTOFF bytes go into the small sectors. A storage holds streams only, no
    storages.

    Args:
        streams: contents by path; a path is "storage/stream" or "stream".

    Returns:
        The bytes of the file.

    Raises:
        AssertionError: the streams need a larger allocation table than a header can list.
    """
    tree: dict[str, dict[str, bytes] | bytes] = {}
    for path, content in streams.items():
        *folder, name = path.split("/")
        if folder:
            inside = tree.setdefault(folder[0], {})
            assert isinstance(inside, dict)
            inside[name] = content
        else:
            tree[name] = content

    table: list[int] = []  # the file allocation table
    sectors = bytearray()
    mini_table: list[int] = []
    mini = bytearray()

    def kept(content: bytes, size: int, chains: list[int], where: bytearray) -> int:
        """Append a content as a chain of sectors.

        Returns:
            The number of its first sector; END for an empty content.
        """
        first, count = len(chains), -(-len(content) // size)
        chains += [first + i + 1 for i in range(count - 1)] + [END] * (count > 0)
        where += content.ljust(count * size, b"\0")
        return first if count else END

    # Each entry: name, kind, left, right, child, first sector, size.
    entries: list[list[object]] = [["Root Entry", ROOT, NOBODY, NOBODY, NOBODY, END, 0]]

    def placed(inside: Mapping[str, dict[str, bytes] | bytes]) -> int:
        """Add the entries of a storage, those inside it included, as a balanced tree.

        Entries are in the order of the length of their names, then of their capitals.

        Returns:
            The number of the tree's root; NOBODY if the storage is empty.
        """
        names = sorted(inside, key=lambda n: (len(n), n.upper()))
        places = {}
        for name in names:
            content = inside[name]
            places[name] = len(entries)
            if isinstance(content, dict):
                entries.append([name, STORAGE, NOBODY, NOBODY, NOBODY, 0, 0])
                entries[places[name]][4] = placed(content)
            else:
                small = len(content) < CUTOFF
                chain = (MINI, mini_table, mini) if small else (SECTOR, table, sectors)
                entries.append([name, STREAM, NOBODY, NOBODY, NOBODY,
                                kept(content, *chain), len(content)])  # fmt: skip

        def middle(some: list[str]) -> int:
            """Join entries to a balanced tree and return the number of its root; NOBODY
            of none.
            """
            if not some:
                return NOBODY
            half = len(some) // 2
            entry = entries[places[some[half]]]
            entry[2], entry[3] = middle(some[:half]), middle(some[half + 1 :])
            return places[some[half]]

        return middle(names)

    entries[0][4] = placed(tree)
    entries[0][5:] = [kept(bytes(mini), SECTOR, table, sectors), len(mini)]
    listed = b"".join(_entry(*entry) for entry in entries)
    listed += _entry("", 0, NOBODY, NOBODY, NOBODY, 0, 0) * (-len(entries) % 4)
    directory = kept(listed, SECTOR, table, sectors)
    words = struct.pack(f"<{len(mini_table)}I", *mini_table)
    mini_sectors = -(-len(words) // SECTOR)
    words = words.ljust(mini_sectors * SECTOR, b"\xff")
    mini_first = kept(words, SECTOR, table, sectors)

    own = 1
    while own * (SECTOR // 4) < len(table) + own:
        own += 1
    assert own <= 109, "the header has no room for the list of so large a file"
    first = len(table)
    table += [TABLE] * own
    sectors += struct.pack(f"<{len(table)}I", *table).ljust(own * SECTOR, b"\xff")
    head = struct.pack(
        "<8s16sHHHHH6x9I", bytes.fromhex("d0cf11e0a1b11ae1"), bytes(16), 0x3E, 3, 0xFFFE,
        9, 6, 0, own, directory, 0, CUTOFF, mini_first, mini_sectors, END, 0,
    )  # fmt: skip
    places = [*range(first, first + own), *[FREE] * (109 - own)]
    return head + struct.pack("<109I", *places) + bytes(sectors)


def _entry(
    name: str, kind: int, left: int, right: int, child: int, first: int, size: int
) -> bytes:
    """Pack one directory entry of 128 bytes; all are black, without class, flags or
    dates.
    """
    text = name.encode("utf-16-le")
    black = 1
    return struct.pack(
        "<64sHBBIII16sIQQIQ", text, len(text) + 2 if name else 0, kind, black, left, right, child,
        bytes(16), 0, 0, 0, first, size,
    )  # fmt: skip
