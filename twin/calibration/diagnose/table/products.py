"""Products of the columns of groups with themselves and with others, each made once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexdt.twin.calibration.diagnose.table.group import Family
from flexdt.twin.calibration.diagnose.table.linearised import Linearised
from flexdt.twin.geometry.conventions import FloatArray


class Products:
    """Products of the columns of families of groups, at one table.

    Columns of a group are divided by its unit, the root mean square over all coordinates of
    what weights of 1 shift: widths of all causes are then standard deviations of positions.
    """

    def __init__(self, table: Linearised, families: Sequence[Family]) -> None:
        """Prepare; products are made when they are asked for."""
        self.table = table
        self.families = tuple(families)
        self._blocks: list[FloatArray] = []
        self._framed: dict[int, FloatArray] = {}
        self._cross: dict[tuple[int, int], FloatArray] = {}
        self._own = [self._squares(f) for f in self.families]
        count = max(table.count, 1.0)
        self.units = [
            np.sqrt(np.einsum("gcc->g", own) / count) + 1e-150 for own in self._own
        ]
        self._known: dict[tuple[int, int], int] = {}

    def own(self, family: int) -> FloatArray:
        """Return the products of the columns of each group, (g, c, c), in units."""
        return np.asarray(self._own[family] / self.units[family][:, None, None] ** 2)

    def widest(self, family: int) -> FloatArray:
        """Return the largest width of each group, (g,), in units."""
        return np.asarray(self.families[family].widest * self.units[family])

    def block(self, columns: FloatArray) -> int:
        """Take columns (2 n k, p) up, and return their number for `cross`."""
        self._blocks.append(columns)
        return len(self._blocks) - 1

    def group_block(self, family: int, group: int) -> int:
        """Return the number of the block of a group's columns, in units."""
        if (family, group) not in self._known:
            rows = self.rows(family, group) / self.units[family][group]
            self._known[family, group] = self.block(rows)
        return self._known[family, group]

    def columns(self, block: int) -> FloatArray:
        """Return the columns of a block, (2 n k, p)."""
        return self._blocks[block]

    def cross(self, family: int, block: int) -> FloatArray:
        """Return the products of each group's columns, in units, with a block, (g, c, p)."""
        if (family, block) not in self._cross:
            self._cross[family, block] = self._products(family, block)
        return self._cross[family, block]

    def rows(self, family: int, group: int) -> FloatArray:
        """Make the columns of a group, (2 n k, c), weighted, for weights in its own unit."""
        one = self.families[family]
        if one.rows is not None:
            return np.asarray(one.rows[group])
        assert one.slopes is not None
        assert one.courses is not None
        course, piece = divmod(group, len(one.slopes))
        slopes = self.table.slopes[one.slopes[piece]]
        out = np.einsum("snq,snc->nqc", slopes, one.courses[course])
        return np.asarray(out.reshape(-1, out.shape[2]))

    def _products(self, family: int, block: int) -> FloatArray:
        one = self.families[family]
        columns = self._blocks[block]
        unit = self.units[family][:, None, None]
        if one.rows is not None:
            crossed = np.einsum("gmc,mp->gcp", one.rows, columns, optimize=True)
            return np.asarray(crossed / unit)
        assert one.slopes is not None
        assert one.courses is not None
        if block not in self._framed:
            n = self.table.n
            parts = columns.reshape(n, -1, columns.shape[1])
            self._framed[block] = np.matmul(
                np.ascontiguousarray(self.table.slopes.transpose(1, 0, 2)), parts
            )
        framed = self._framed[block]
        count, s, n, c = one.courses.shape
        out: FloatArray | float = 0.0
        for i in range(s):
            # Each course with each slope: the first change slowest.
            course = one.courses[:, i].transpose(0, 2, 1).reshape(count * c, n)
            part = framed[:, one.slopes[:, i]]
            each = course @ part.reshape(n, -1)
            each = each.reshape(count, c, len(one.slopes), -1)
            out = out + each.transpose(0, 2, 1, 3).reshape(-1, c, each.shape[3])
        return np.asarray(np.asarray(out) / unit, dtype=np.float64)

    def _squares(self, one: Family) -> FloatArray:
        if one.rows is not None:
            return np.asarray(np.matmul(one.rows.transpose(0, 2, 1), one.rows))
        assert one.slopes is not None
        assert one.courses is not None
        slopes = self.table.slopes[one.slopes]
        both = np.einsum("gsnq,gtnq->gstn", slopes, slopes, optimize=True)
        s, n, c = one.courses.shape[1:]
        out = []
        for course in one.courses:
            weighed = np.einsum("gstn,tnd->gsnd", both, course, optimize=True)
            out.append(course.reshape(s * n, c).T @ weighed.reshape(-1, s * n, c))
        return np.asarray(np.concatenate(out))
