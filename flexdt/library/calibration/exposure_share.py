"""How far a scan's script lets the object turn while a frame is exposed."""

from __future__ import annotations

from typing import Final

import numpy as np

from flexdt.library.datasets.image_set import ImageSet

STEP_SCAN: Final = "step scan"
"""Name in the scanner's settings text of a scan that stops for every image."""


def exposure_share(data: ImageSet) -> float | None:
    """Return the part of a step that the object turns while a frame is exposed.

    A smooth scan turns on, so the part is exposure times averages over the median time
    between two projections, at most 1. A scan that stops for every image turns by
    nothing: 0.

    Args:
        data: a scan with `flexdt.json` or the scanner's settings text.

    Returns:
        From 0 to 1; None where neither states it, or a smooth scan has fewer than two
        projections or no time between them.
    """
    document = data.document
    if document is None or "smooth" not in document.model_fields_set:
        settings = data.settings
        stepped = settings is not None and settings.scan_type == STEP_SCAN
        return 0.0 if stepped else None
    if not document.smooth:
        return 0.0
    frames = [frame for frame in document.frames if frame.kind == "projection"]
    if len(frames) < 2:
        return None
    between_s = float(np.median(np.diff([frame.time_s for frame in frames])))
    exposed_s = frames[0].exposure_ms * frames[0].averages / 1000.0
    if between_s > 0.0:
        return min(exposed_s / between_s, 1.0)
    return None
