"""The binary argument of `scanner set sample info`: the sample's size and names.

The layout was found in a published script and its settings files (no public specification;
assumed): big-endian, diameter [mm] as a double, then texts, each a 4-byte length and its bytes:
sample name, project, owner, and others. Data of another form are not an error, because the scan
itself does not use the argument.
"""

from __future__ import annotations

import math
import struct

from flexdt.twin.script.planning.plan import SampleSize

_MAX_DIAMETER_MM = 10_000.0


def sample_size(data: bytes) -> SampleSize | None:
    """The sample's diameter, or None if the data do not say one."""
    if len(data) < 12:
        return None
    (diameter,) = struct.unpack_from(">d", data)
    if not (math.isfinite(diameter) and 0.0 < diameter <= _MAX_DIAMETER_MM):
        return None
    return SampleSize(diameter, source="set sample info")
