"""The fields of Bruker SkyScan's .log."""

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

RECONSTRUCTION: Final = "Reconstruction"
"""Section of NRecon's settings, whose keys are its name, a slash and theirs."""


SKYSCAN: Final = FormatTable(
    "SkyScan",
    "public .log files of the 1076 to 1278 and TIGRE's BrukerDataLoader; no images of "
    "Bruker's were at hand",
    (
        used("Filename Prefix", "beginning of the images' names", "the images"),
        used("Number of Files", "number of images", "the views"),
        used("Number of Rows", "rows", "the images are compared with it"),
        used("Number of Columns", "columns", "the images are compared with it"),
        used(
            "Object to Source (mm)", "source to axis", "the geometry", "mm", of=GEOMETRY
        ),
        used(
            "Camera to Source (mm)", "source to panel", "the geometry", "mm", of=GEOMETRY
        ),
        used(
            "Image Pixel Size (um)",
            "pixel at the axis, from which the panel's follows",
            "the geometry",
            "um",
            of=GEOMETRY,
        ),
        used(
            "Camera Pixel Size (um)",
            "pixel of the panel, unbinned",
            "it is compared, or taken without Image Pixel Size",
            "um",
            of=GEOMETRY,
        ),
        used(
            "Camera binning", "pixels that are joined", "the panel's pixel", of=GEOMETRY
        ),
        used(
            "Optical Axis (line)",
            "row of the source's plane, from the lowest row, 0",
            "the panel's height",
            of=GEOMETRY,
        ),
        used(
            "Rotation Step (deg)", "turn from view to view", "the views", "deg", of=ANGLES
        ),
        used(
            "Scanning Start Angle",
            "angle of the first view",
            "the views",
            "deg",
            of=ANGLES,
        ),
        used(
            "Rotation Direction",
            "CC as TIGRE reads it, CW the other way",
            "the views; the wrong one mirrors the volume",
            of=ANGLES,
        ),
        used(
            "Use 360 Rotation", "a full turn or half of one", "it is compared", of=ANGLES
        ),
        used(
            "Reference Intensity",
            "counts of the open beam",
            "the open beam, before depth",
            of=BEAM,
        ),
        used("Depth (bits)", "of the counts", "the open beam, 2^depth - 1", of=BEAM),
        used("Image Format", "TIFF or BMP", "the images"),
        used(
            "*.csv/shifts",
            "shift of each view [unbinned pixels]",
            "the panel's place",
            of=GEOMETRY,
        ),
        refused(
            "Scanning Trajectory",
            "ROUND or another",
            "give geometry= for a helix",
            neutral=("", "round"),
            of=GEOMETRY,
        ),
        dropped(
            "Random Movement",
            "views are shifted at random against rings",
            "without a .csv of shifts the images are taken to be put back",
            of=GEOMETRY,
        ),
        dropped(
            "Image Rotation",
            "turn of the camera [deg]",
            "the panel is taken to stand upright; `align` finds its roll",
            of=GEOMETRY,
        ),
        *(
            dropped(
                name,
                "width over height of a pixel",
                "pixels are taken to be square",
                neutral=("1", ""),
                of=GEOMETRY,
            )
            for name in ("Camera X/Y Ratio", "CameraXYRatio")
        ),
        dropped(
            "Number Of Horizontal Offset Positions",
            "parts of a wide image",
            "the images are taken to be joined",
            neutral=("1", ""),
        ),
        dropped(
            "Number of connected scans",
            "parts of a tall object",
            "this file is one of them; open the others by their own",
            neutral=("1", "0", ""),
        ),
        dropped(
            "Camera Offset",
            "the camera stands aside",
            "the axis is taken in the middle column; `align` finds it",
            of=GEOMETRY,
        ),
        dropped(
            "Table Feed (micron)",
            "rise of the sample from view to view",
            "a circle is taken; give geometry= for a helix",
            of=GEOMETRY,
        ),
        dropped(
            "List mode",
            "views in an order of their own",
            "even steps are taken",
            of=ANGLES,
        ),
        dropped(
            f"{RECONSTRUCTION}/Postalignment",
            "shift of the axis in NRecon [pixels]",
            "its sign is not documented: the axis is taken in the middle column; `align` "
            "or `fx.find_convention` decides",
            of=GEOMETRY,
        ),
        dropped(
            f"{RECONSTRUCTION}/Sub-scan post alignment*",
            "the same of parts [pixels]",
            "the axis is taken in the middle column; `align` finds it",
            of=GEOMETRY,
        ),
        *noted_all(
            f"{RECONSTRUCTION}/Pseudo-parallel projection calculated",
            "a setting of NRecon",
            divider="; ",
        ),
        *noted_all(
            "Flat Field Correction; Geometrical Correction; Median Filtering; "
            "Vertical Object Position (mm); Scanning position; FF updating interval",
            "undone in the images already",
            divider="; ",
        ),
        *noted_all(
            "Image crop origin X; Image crop origin Y; Partial Width; "
            "Current scan number; Number of lines to be reconstructed",
            "of the part",
            "whole images are read",
            divider="; ",
        ),
        used(
            "Source Voltage (kV)",
            "voltage of the tube",
            "reconstruct with material=",
            "kV",
        ),
        *noted_all(
            "Source Current (uA); Filter; Source Type; "
            "Source focus mode; Source target type; External Filter; Filter assembly",
            "of the tube",
            "`tube=` of reconstruct takes it",
            divider="; ",
        ),
        *noted_all(
            "Scanner; Instrument S/N; Hardware version; Software; Software Version; "
            "Embedded Controller Version; Home Directory; Camera; Camera Type; "
            "Camera position; Camera temperature; User Name; Computer Name; "
            "Data Directory; Study Date and Time; Scan duration; Estimated scan time; "
            "Gantry direction; Type Of Motion; Type of Detector Motion; Type Of Scan; "
            "Filename Index Length; Frame Index Length; Scaled Image Pixel Size (um); "
            "Linear pixel value; Exposure (ms); Frame Averaging; Screen LUT; "
            "Incl.in lifting (um/mm); Suggested HU - Calibration; Maximum vertical TS; "
            "Focal Position; File name convention/Filename Index Length; "
            "File name convention/Filename Prefix",
            "words, places and times",
            divider="; ",
        ),
        *noted_all(
            "Reconstruction Program; Program Version; Program Home Directory; "
            "Reconstruction engine; Engine version; Reconstruction from batch; "
            "Reconstruction servers; Reconstruction mode; Reconstruction option; "
            "Postalignment Applied; Connected Reconstruction (parts); "
            "Sub-scan scan length*; Used extra*; Dataset Origin; Dataset Prefix; "
            "Dataset Directory; Output Directory; Time and Date; First Section; "
            "Last Section; Reconstruction duration per slice (seconds); "
            "Total reconstruction time*; Section to Section Step; Sections Count; "
            "Result File Type; Result File Header Length (bytes); "
            "Result Image Width (pixels); Result Image Height (pixels); "
            "Pixel Size (um); Reconstruction Angular Range (deg); Use 180+; "
            "Angular Step (deg); Smoothing; Smoothing kernel; "
            "Ring Artifact Correction; Draw Scales; Object Bigger than FOV; "
            "Reconstruction from ROI; ROI Top (pixels); ROI Bottom (pixels); "
            "ROI Left (pixels); ROI Right (pixels); ROI reference length; "
            "Filter cutoff relative to Nyquist frequency; Filter type; "
            "Filter type description; Filter type meaning*; Undersampling factor; "
            "Threshold for defect pixel mask (%); Beam Hardening Correction (%); "
            "CS Static Rotation (deg); CS Static Rotation Total(deg); "
            "Minimum for CS to Image Conversion; Maximum for CS to Image Conversion; "
            "HU Calibration; BMP LUT; Cone-beam Angle Horiz.(deg); "
            "Cone-beam Angle Vert.(deg); Automatic matching*; Automatic fusion; "
            "Scanner; Step of Rotation",
            "NRecon's own",
            "it is not repeated",
            divider="; ",
            under=f"{RECONSTRUCTION}/",
        ),
    ),
    "Image Pixel Size before Camera Pixel Size and binning; Reference Intensity before "
    "Depth; the shifts of a .csv beside the images before Random Movement.",
    example='fx.open("part/part.log")',
)
