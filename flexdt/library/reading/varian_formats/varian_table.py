"""The fields of Varian's Scan.xml, and of its XIM images as xim/NAME and air/NAME."""

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

VARIAN: Final = FormatTable(
    "Varian",
    "TIGRE's Varian reader, RTK's reader of ProBeam and pylinac; from documentation, no "
    "file of Varian's seen",
    (
        used("SAD", "source to axis", "the geometry", "mm", of=GEOMETRY),
        used("SID", "source to panel", "the geometry", "mm", of=GEOMETRY),
        used("ImagerSizeX", "columns", "the images are compared with it"),
        used("ImagerSizeY", "rows", "the images are compared with it"),
        used("ImagerResX", "pitch of columns", "the geometry", "mm", of=GEOMETRY),
        used("ImagerResY", "pitch of rows", "the geometry", "mm", of=GEOMETRY),
        used("ImagerLat", "the panel aside", "it is compared", "mm", of=GEOMETRY),
        used("Bowtie", "a filter before the patient", "which image of the open beam"),
        used("xim/KVSourceRtn", "angle of the source", "the views", "deg", of=ANGLES),
        used(
            "xim/GantryRtn",
            "that of the gantry",
            "the views, 90 deg before",
            "deg",
            of=ANGLES,
        ),
        used("xim/KVDetectorLat", "the panel aside", "the geometry", "cm", of=GEOMETRY),
        used(
            "xim/KVDetectorLng",
            "the panel along the axis",
            "the geometry",
            "cm",
            of=GEOMETRY,
        ),
        used("xim/KVNormChamber", "reading of the beam's chamber", "scale of the images"),
        used("xim/KVSourceVrt", "source to axis", "it is compared", "cm", of=GEOMETRY),
        used(
            "xim/KVDetectorVrt",
            "axis to panel, below 0",
            "it is compared",
            "cm",
            of=GEOMETRY,
        ),
        used("xim/PixelWidth", "pitch of columns", "it is compared", "cm", of=GEOMETRY),
        used("xim/PixelHeight", "pitch of rows", "it is compared", "cm", of=GEOMETRY),
        used(
            "xim/KVKiloVolts", "voltage of the tube", "reconstruct with material=", "kV"
        ),
        used(
            "air/KVNormChamber",
            "that of the open beam",
            "scale of the open beam",
            of=BEAM,
        ),
        used(
            "air/KVSourceRtn",
            "angle of the source",
            "the open beam's views",
            "deg",
            of=BEAM,
        ),
        used(
            "air/GantryRtn", "that of the gantry", "the open beam's views", "deg", of=BEAM
        ),
        noted("air/*", "of the open beam's images", "of their calibration"),
        *(
            dropped(
                f"xim/{name}",
                what,
                "the panel and the source are taken to stand upright",
                of=GEOMETRY,
            )
            for name, what in (
                ("KVDetectorRtn", "roll of the panel"),
                ("KVDetectorPitch", "pitch of the panel"),
                ("KVSourcePitch", "pitch of the source"),
            )
        ),
        dropped(
            "xim/DataOffset", "a level below the counts", "the counts are taken as stored"
        ),
        dropped(
            "SourceAngleOffset",
            "angle of the source against the gantry [deg]",
            "KVSourceRtn has it, else 90 is taken",
            neutral=("", "90", "-90", "270"),
            of=ANGLES,
        ),
        *noted_all(
            "@schemaLocation @noNamespaceSchemaLocation @Version StartAngle "
            "StopAngle Velocity FrameRate Fan",
            "how the scan was taken",
            "the images say where each was taken",
        ),
        *noted_all(
            "KVMilliAmperes KVMilliSeconds KVFocalSpot KVFilter KVFoil "
            "KVCollimatorX1 KVCollimatorX2 KVCollimatorY1 KVCollimatorY2 KVCollimatorShape "
            "KVAirKermaStart KVAirKermaStop KVBeamHold KVBeamPulseCounter "
            "KVFluoroLevelControl KVAutoBrightnessControl",
            "of the beam",
            "`tube=` of reconstruct takes it",
            under="xim/",
        ),
        *noted_all(
            "CouchLat CouchLng CouchVrt CouchRtn CouchPit CouchRol",
            "where the couch stood",
            under="xim/",
        ),
        *noted_all(
            "MVDetectorLat MVDetectorLng MVDetectorVrt MVDetectorRtn MVDetectorPitch "
            "MVSourceVrt MVSourceRtn MVDoseRate MVEnergy MVBeamHold MVBeamPulseCounter "
            "MVDoseStart MVDoseStop MVCollimatorRtn MVCollimatorX1 MVCollimatorX2 "
            "MVCollimatorY1 MVCollimatorY2 MLCLeafsA MLCLeafsB MLCCarriageA MLCCarriageB "
            "MLCModelType ExternalBeam",
            "of the treatment beam",
            under="xim/",
        ),
        *noted_all(
            "StartTime StopTime AcquisitionId AcquisitionModeId AcquisitionNotes "
            "AcquisitionSystemVersion AcquisitionIntentId CalibrationSetId "
            "ImagePropertyVersionMajor ImagePropertyVersionMinor ImageSourceIndex "
            "SequenceNumber LastImage HistogramBinSize BitsPerPixel DICOMFrameNumber "
            "MotionCompensationHold",
            "of the image",
            under="xim/",
        ),
        noted("xim/MM*", "of breathing", "views are not sorted by it"),
    ),
    "KVSourceRtn before GantryRtn, KVDetectorLat before ImagerLat, other figures of "
    "Scan.xml before those of the images.",
    example='fx.open("part/Scan.xml")',
)
