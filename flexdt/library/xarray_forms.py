"""Images and volumes as xarray's objects, with coordinates and units."""

from __future__ import annotations

from typing import Any

from flexdt.library.datasets.image_set import ImageSet
from flexdt.library.optional.extras import package
from flexdt.twin.exchange.number_tables import VECTOR_NAMES
from flexdt.twin.projection.volume import Volume


def images_to_xarray(data: ImageSet) -> Any:
    """Convert a data set's line integrals to a DataArray; see `DataSet.to_xarray`.

    Dimensions are view, row, column; geometry vectors [mm], angles [deg] and file names
    are coordinates of each view, not attributes.

    Raises:
        TwinError: xarray is not installed.
    """
    xarray = package("xarray", "to_xarray")
    rows = data.geometry.rows
    return xarray.DataArray(
        data.line_integrals(),
        dims=("view", "row", "column"),
        name="line_integrals",
        coords={
            "angle": ("view", data.angles_deg, {"units": "deg"}),
            **{
                n: ("view", c, {"units": "mm"})
                for n, c in zip(VECTOR_NAMES, rows.T, strict=True)
            },
            "file": ("view", [frame.file for frame in data.frames]),
        },
        attrs={"title": data.name, "units": "1"},
    )


def volume_to_xarray(volume: Volume) -> Any:
    """Return a volume as a DataArray (z, y, x) with places [mm]; see `Volume.to_xarray`. The
    values are shared.

    Raises TwinError: xarray is not installed.
    """
    xarray = package("xarray", "to_xarray")
    places = zip("xyz", volume.centers(), strict=True)
    coords = {axis: (axis, values, {"units": "mm"}) for axis, values in places}
    attrs = {"units": "1/mm"}
    return xarray.DataArray(volume.data, coords, tuple("zyx"), "attenuation", attrs)
