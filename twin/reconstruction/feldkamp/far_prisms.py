"""Rows whose continuation reaches far beyond the panel, filtered in two parts.

Far from the panel a weighed row is a mixture of its two bands' prisms and nothing else: the ray's
length, by which rows are divided, is a factor of the prism's path as well. So a band's prism is
filtered once a view instead of once a row, and what the panel saw in a shorter transform.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.reconstruction.feldkamp.fdk_views import Views
from flexdt.twin.reconstruction.feldkamp.filtering import (
    filtered,
    padded_length,
    shortened,
)

MAX_LENGTH_SHARE: Final = 0.8
"""Largest length of the shorter transform, over that of whole rows, for which two parts pay."""


@dataclass(frozen=True, eq=False)
class NearColumns:
    """The columns of rows that hold more than prisms, or whose filtered values are needed.

    Attributes:
        columns: among those that go into the filter.
        response: of the same filter, for rows of these columns.
    """

    columns: slice
    response: Float32Array

    @classmethod
    def of(cls, views: Views) -> NearColumns | None:
        """Find the columns of some views, from the first to the last that is kept, on the
        panel, or fading out, and shorten the filter's response to them.

        Returns:
            None if no columns beyond the panel go into the filter, or if the shorter
            transform is longer than `MAX_LENGTH_SHARE` of whole rows' transform.
        """
        if not views.wider:
            return None
        fading = np.flatnonzero(views.beyond.fade)
        panel = views.before, views.before + views.images.shape[2]
        first = min(views.kept.start, *panel, *fading[:1].tolist())
        last = max(views.kept.stop, *panel, *(fading[-1:] + 1).tolist())
        reach = max(last - views.kept.start, views.kept.stop - first)
        response = shortened(views.response, reach)
        length = padded_length(response)
        if length > MAX_LENGTH_SHARE * padded_length(views.response):
            return None
        return cls(slice(first, last), response)

    def far(self, views: Views) -> Float32Array:
        """Weigh the bands' prisms in all other columns (0 in the near ones) and filter them with
        the response of whole rows.

        `views`: n views with whole rows, before they are cut to the near columns.
        Returns float32 (n, bands, columns that are kept), to be added to the rows by bands.
        """
        lengths = views.prism_lengths()
        n, bands, wide = lengths.shape
        weighed = np.zeros((n, bands, padded_length(views.response)), np.float32)
        weighed[..., :wide] = lengths * views.factors[:, None]
        weighed[..., self.columns] = 0.0
        return np.ascontiguousarray(filtered(weighed, views.response)[..., views.kept])
