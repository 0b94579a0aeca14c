"""The fields of YXLON's ScanParameter.xml; names are the elements below the cone beam's."""

from __future__ import annotations

from typing import Final

from flexdt.twin.dataset.format_table import (
    ANGLES,
    BEAM,
    GEOMETRY,
    FormatTable,
    dropped,
    noted_all,
    refused,
    used,
)

YXLON: Final = FormatTable(
    "YXLON",
    "TIGRE's YXLONDataLoader; from documentation, no file of YXLON's seen",
    (
        used("PixelSize/Width", "pitch of columns", "the geometry", "mm", of=GEOMETRY),
        used("PixelSize/Height", "pitch of rows", "the geometry", "mm", of=GEOMETRY),
        used("ProjectionSize/Width", "columns", "the images are compared with it"),
        used("ProjectionSize/Height", "rows", "the images are compared with it"),
        used(
            "ProjectionBitdepth",
            "bits of the counts",
            "the open beam, 2^bits - 1",
            of=BEAM,
        ),
        used(
            "ScanTrajectory/PixelPitch",
            "unit of the trajectory",
            "the geometry",
            "mm",
            of=GEOMETRY,
        ),
        used(
            "ScanTrajectory/Fdd",
            "source to panel",
            "the geometry",
            "PixelPitch",
            of=GEOMETRY,
        ),
        used(
            "ScanTrajectory/Fod",
            "source to axis",
            "the geometry",
            "PixelPitch",
            of=GEOMETRY,
        ),
        used("ScanTrajectory/NumberOfProjections", "number of images", "the views"),
        used(
            "ScanTrajectory/StartAngle",
            "angle of the first view",
            "the views",
            "deg",
            of=ANGLES,
        ),
        used(
            "ScanTrajectory/Rotation", "turn of all views", "the views", "deg", of=ANGLES
        ),
        used("Voltage", "voltage of the tube", "reconstruct with material=", "kV"),
        refused(
            "ScanTrajectory@type",
            "kind of trajectory",
            "give geometry= for another than a circle",
            neutral=("circletrajectory", ""),
            of=GEOMETRY,
        ),
        dropped(
            "ScanTrajectory/YoCenter",
            "shift of the axis [PixelPitch]",
            "its sign is not documented: the axis is taken in the middle column; `align` or "
            "`fx.find_convention` decides",
            of=GEOMETRY,
        ),
        *(
            dropped(
                f"DejustmentParameter/{name}",
                what,
                "it is taken as 0; `align` finds the axis and the panel's roll",
                of=GEOMETRY,
            )
            for name, what in (
                ("HorizontalDetectorOffset", "shift of the panel [PixelPitch]"),
                ("VerticalDetectorOffset", "the same upwards [PixelPitch]"),
                ("DetectorTiltA", "turn of the panel [deg]"),
                ("DetectorTiltB", "turn of the panel [deg]"),
                ("DetectorTiltC", "turn of the panel [deg]"),
            )
        ),
        dropped(
            "DetectorOrientation",
            "turn of the images",
            "they are taken as they are stored",
            neutral=("original", "", "0"),
        ),
        dropped(
            "DetectorFlipDirections",
            "mirrored images",
            "they are taken as they are stored",
        ),
        *noted_all(
            "Name Comment Date Version Manufacturer @Version @schemaLocation "
            "@noNamespaceSchemaLocation",
            "words",
        ),
        *noted_all(
            "Current FilterMaterial FilterThickness IntegrationTime",
            "of the exposure",
            "`tube=` of reconstruct takes it",
        ),
    ),
    "this format states nothing twice.",
    example='fx.open("part/ScanParameter.xml")',
)
