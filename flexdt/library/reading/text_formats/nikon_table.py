"""The fields of Nikon's .xtekct, and of the lists of angles beside it."""

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

NIKON: Final = FormatTable(
    "Nikon",
    "CIL's NikonDataReader 25.0, TIGRE's NikonDataLoader and public .xtekct files",
    (
        used("Name", "name of the scan", "the data set's name"),
        used("Projections", "number of images", "the views"),
        used("SrcToObject", "source to axis", "the geometry", "mm", of=GEOMETRY),
        used("SrcToDetector", "source to panel", "the geometry", "mm", of=GEOMETRY),
        used("DetectorPixelsX", "columns", "the images are compared with it"),
        used("DetectorPixelsY", "rows", "the images are compared with it"),
        used("DetectorPixelSizeX", "pitch of columns", "the geometry", "mm", of=GEOMETRY),
        used("DetectorPixelSizeY", "pitch of rows", "the geometry", "mm", of=GEOMETRY),
        used(
            "AngularStep",
            "turn of the stage from view to view",
            "the views",
            "deg",
            of=ANGLES,
        ),
        used("InitialAngle", "angle of the first view", "the views", "deg", of=ANGLES),
        used(
            "ObjectOffsetX",
            "axis to the left of the central ray",
            "the axis",
            "mm",
            of=GEOMETRY,
        ),
        used(
            "ObjectRoll",
            "lean of the axis in the panel's plane",
            "the axis",
            "deg",
            of=GEOMETRY,
        ),
        used(
            "ObjectTilt",
            "lean of the axis along the beam",
            "the axis",
            "deg",
            of=GEOMETRY,
        ),
        used("CentreOfRotation", "the axis, at the panel", "the axis", "mm", of=GEOMETRY),
        used(
            "CentreOfRotationTop",
            "the axis at the uppermost row",
            "the axis",
            "mm",
            of=GEOMETRY,
        ),
        used(
            "CentreOfRotationBottom",
            "the same at the lowest row",
            "the axis",
            "mm",
            of=GEOMETRY,
        ),
        used("WhiteLevel", "counts of the open beam", "the flat image", of=BEAM),
        used("InputFolderName", "folder of the images", "the images"),
        used("Units", "unit of all lengths", "the geometry; without it mm", of=GEOMETRY),
        used(
            "_ctdata.txt/Angle",
            "measured angle of each view",
            "the views",
            "deg",
            of=ANGLES,
        ),
        used(".ang/Angle", "angle of each view", "the views", "deg", of=ANGLES),
        noted("_ctdata.txt/Time", "time of each view"),
        noted("_ctdata.txt/Projs", "number of images"),
        noted("_ctdata.txt/Frames", "exposures of each image"),
        noted("_ctdata.txt/Exposure", "exposure time"),
        *(
            dropped(
                f"DetectorOffset{axis}",
                "shift of the panel [mm]",
                "the panel is taken to stand at the central ray; `align` finds the axis",
                of=GEOMETRY,
            )
            for axis in "XY"
        ),
        dropped(
            "CoefX1",
            "linear term of CT Pro's beam hardening",
            "line integrals are not made straight; `material=` does that",
            neutral=("1", ""),
        ),
        *(
            dropped(
                f"CoefX{power}",
                "term of CT Pro's beam hardening",
                "line integrals are not made straight; `material=` does that",
            )
            for power in (0, 2, 3, 4)
        ),
        dropped(
            "Scale",
            "factor of CT Pro's line integrals",
            "line integrals are not scaled",
            neutral=("1", ""),
        ),
        dropped("Scattering", "scatter that CT Pro subtracts", "it is not subtracted"),
        dropped("BeamHardeningLUTFile", "table of line integrals", "it is not applied"),
        dropped(
            "Shuttling",
            "the panel moves between views",
            "the images are taken to be put back already",
            of=GEOMETRY,
        ),
        used("XraykV", "voltage of the tube", "reconstruct with material=", "kV"),
        noted("XrayuA", "current of the tube [uA]", "the white level stands for it"),
        noted("Filter_ThicknessMM", "filter", "`tube=` of reconstruct takes it"),
        noted("Filter_Material", "filter", "`tube=` of reconstruct takes it"),
        *noted_all(
            "RegionStartX RegionStartY RegionPixelsX RegionPixelsY",
            "CT Pro's region of interest",
            "whole images are read",
        ),
        *noted_all(
            "VoxelsX VoxelsY VoxelsZ VoxelSizeX VoxelSizeY VoxelSizeZ OffsetX OffsetY "
            "OffsetZ MaskRadius Scaling OutputUnits OutputType OutputFormat",
            "a figure of CT Pro's own volume",
        ),
        *noted_all(
            "AutomaticCentreOfRotation AutomaticGeometry FilterPreset FilterType "
            "CutOffFrequency Exponent Normalisation InterpolationType "
            "MedianFilterKernelSize ConvolutionKernelSize AutoScalingType "
            "ScalingMinimum ScalingMaximum LowPercentile HighPercentile "
            "ImportConversion TIFFScaling TimeStampFolder OutputSeparator "
            "OutputFolderName AutomaticCentreOfRotationOffsetZ1 "
            "AutomaticCentreOfRotationOffsetZ2",
            "a setting of CT Pro's own reconstruction",
        ),
        noted("InputSeparator", "in the images' names", "they are sorted by numbers"),
        noted("OperatorID", "person"),
        noted("DICOMTags", "tags for CT Pro's output"),
    ),
    "The first of these that is there: the measured angles of _ctdata.txt, those of .ang, "
    "InitialAngle and AngularStep; ObjectOffsetX and ObjectRoll before CentreOfRotationTop "
    "and Bottom, these before CentreOfRotation.",
    example='fx.open("part/part.xtekct")',
)
