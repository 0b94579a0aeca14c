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
        return self._own[family] / self.units[family][:, None, None] ** 2

    def widest(self, family: int) -> FloatArray:
        """Return the largest width of each group, (g,), in units."""
        return self.families[family].widest * self.units[family]

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
            return one.rows[group]
        assert one.slopes is not None
        assert one.courses is not None
        courses = one.courses[group if len(one.courses) > 1 else 0]
        slopes = self.table.slopes[one.slopes[group]]
        out = np.einsum("snq,snc->nqc", slopes, courses)
        return out.reshape(-1, out.shape[2])

    def _products(self, family: int, block: int) -> FloatArray:
        one = self.families[family]
        columns = self._blocks[block]
        unit = self.units[family][:, None, None]
        if one.rows is not None:
            return np.einsum("gmc,mp->gcp", one.rows, columns, optimize=True) / unit
        assert one.slopes is not None
        assert one.courses is not None
        if block not in self._framed:
            n = self.table.n
            parts = columns.reshape(n, -1, columns.shape[1])
            self._framed[block] = np.matmul(
                np.ascontiguousarray(self.table.slopes.transpose(1, 0, 2)), parts
            )
        framed = self._framed[block]
        out: FloatArray | float = 0.0
        for s in range(one.slopes.shape[1]):
            part = framed[:, one.slopes[:, s]]
            if len(one.courses) == 1:
                n, g, p = part.shape
                each = one.courses[0, s].T @ part.reshape(n, g * p)
                out = out + each.reshape(-1, g, p).transpose(1, 0, 2)
            else:
                own = one.courses[:, s].transpose(0, 2, 1)
                out = out + np.matmul(own, part.transpose(1, 0, 2))
        return np.asarray(out) / unit

    def _squares(self, one: Family) -> FloatArray:
        if one.rows is not None:
            return np.matmul(one.rows.transpose(0, 2, 1), one.rows)
        assert one.slopes is not None
        assert one.courses is not None
        some, which = np.unique(one.slopes, axis=0, return_inverse=True)
        slopes = self.table.slopes[some]
        both = np.einsum("gsnq,gtnq->gstn", slopes, slopes, optimize=True)
        both = both[which.reshape(-1)]
        courses = np.broadcast_to(one.courses, (len(both), *one.courses.shape[1:]))
        g, s, n, c = courses.shape
        weighed = np.einsum("gstn,gtnd->gsnd", both, courses, optimize=True)
        return np.matmul(
            courses.reshape(g, s * n, c).transpose(0, 2, 1), weighed.reshape(g, s * n, c)
        )
