"""The streams of Zeiss's .txrm."""

from __future__ import annotations

from typing import Final

from flexdt.twin.dataset.format_table import (
    ANGLES,
    BEAM,
    GEOMETRY,
    FormatTable,
    dropped,
    noted,
    noted_all,
    used,
)

INFO: Final = "ImageInfo/"
ZEISS: Final = FormatTable(
    "Zeiss",
    "the readers CIL, dxchange, xrmreader and mbirjax; the format is unpublished, and no "
    "file from a real scanner was available",
    (
        used(f"{INFO}ImageHeight", "rows", "the images"),
        used(f"{INFO}ImageWidth", "columns", "the images"),
        used(f"{INFO}NoOfImages", "planned images", "the views"),
        used(f"{INFO}ImagesTaken", "images that were taken", "the views"),
        used(f"{INFO}DataType", "type of the pixels", "the images"),
        used(
            f"{INFO}XrayGeometry", "1: a cone beam", "checked; a parallel beam is refused"
        ),
        used(
            f"{INFO}StoRADistance",
            "source to axis of each view",
            "the geometry",
            "mm",
            of=GEOMETRY,
        ),
        used(
            f"{INFO}DtoRADistance",
            "axis to panel of each view",
            "the geometry",
            "mm",
            of=GEOMETRY,
        ),
        used(f"{INFO}PixelSize", "pixel at the axis", "the geometry", "um", of=GEOMETRY),
        used(
            f"{INFO}YPosition",
            "height of the stage",
            "checked; a helix is refused",
            "um",
            of=GEOMETRY,
        ),
        used(f"{INFO}Angles", "angle of each view", "the views", "deg", of=ANGLES),
        used(f"{INFO}Voltage", "voltage of the tube", "reconstruct with material=", "kV"),
        dropped(
            f"{INFO}CameraOffset",
            "shift of the camera",
            "a warning names its value",
            of=GEOMETRY,
        ),
        dropped(
            f"{INFO}CameraFineRotation",
            "roll of the camera",
            "a warning names its value",
            of=GEOMETRY,
        ),
        used(
            "ReconSettings/CenterShift",
            "shift of the axis",
            "the panel",
            "pixels",
            of=GEOMETRY,
        ),
        used(
            "Alignment/X-Shifts", "shift of each view", "the panel", "pixels", of=GEOMETRY
        ),
        used(
            "Alignment/Y-Shifts",
            "vertical shift of each view, positive upwards",
            "the panel",
            "pixels",
            of=GEOMETRY,
        ),
        used("ImageData*", "images", "the images"),
        used("ReferenceData/*", "open beam", "the flat image", of=BEAM),
        used("MultiReferenceData/*", "open beams", "the flat image", of=BEAM),
        *noted_all(
            "Current XrayVoltage XrayCurrent ExpTimes ExpTime Date FocusTarget "
            "MosiacMode MosiacRows MosiacColumns AbsorptionScaleFactor "
            "AbsorptionScaleOffset Temperature Energy SourceFilterName ObjectiveName "
            "OpticalMagnification CameraBinning CameraName CamPixelSize "
            "CameraNumberOfFramesPerImage "
            "HorizontalBin VerticalBin ReferenceFile DetectorBits SourceDriftInterval "
            "XPosition ZPosition OriginalDataRefCorrected",
            "how the scan was taken",
            under=INFO,
        ),
        *(
            noted(f"{group}/*", "the scanner's own", "other programs read none of it")
            for group in (
                "PositionInfo",
                "AutoRecon",
                "ReconSettings",
                "AcquisitionSettings",
                "GlobalMinMax",
                "SourceDriftInfo",
                "DetAssemblyInfo",
                "SampleInfo",
                "ThumbNail",
                "ImageFilters",
                "FilterInfo",
                "ConfigureBackup",
                "Angles",
            )
        ),
        *noted_all(
            "exeVersion Version fileVersion Alignment/MetrologyShiftsApplied "
            "Alignment/ReferenceShiftsApplied Alignment/StageShiftsApplied "
            "Alignment/EncoderSupport Alignment/X-Mean Alignment/Y-Mean",
            "of the file",
        ),
    ),
    "nothing is stated twice; of several groups of reference images, the first one that "
    "contains images is used.",
    example='fx.open("tooth.txrm")',
)
