"""The fields of the FleX-ray scanner's own texts: `scan settings.txt`, `data settings XRE.txt`."""

from __future__ import annotations

from typing import Final

from flexdt.twin.dataset.file_names import SCAN_SETTINGS, XRE_SETTINGS
from flexdt.twin.dataset.format_table import (
    ANGLES,
    GEOMETRY,
    Field,
    FormatTable,
    noted,
    noted_all,
    used,
)

MOTORS: Final = (
    "mag_obj mag_det rot_obj tra_obj tra_det tra_tube ver_tube ver_det ver_obj mag_tube "
    "mag_det_phys PI_X PI_Y X Y Z R CX CY"
)
"""Motors of scanners that write such texts; those of a machine that is given count, too."""
FOUND: Final = "the geometry: motors and a profile reproduce it, or it is the geometry"


def _motors(under: str = "") -> tuple[Field, ...]:
    """Make the fields of the motors, which follow `under`."""
    return tuple(
        used(f"{under}{name}", "where a motor stood", "the geometry", of=GEOMETRY)
        for name in MOTORS.split()
    )


SETTINGS_TEXT: Final = FormatTable(
    SCAN_SETTINGS,
    "the scanner's own files",
    (
        used("SOD", "source to axis", FOUND, "mm", of=GEOMETRY),
        used("SDD", "source to panel", FOUND, "mm", of=GEOMETRY),
        used("COR", "column of the axis, from the edge", FOUND, "pixels", of=GEOMETRY),
        used("HC", "column of the central ray", FOUND, "pixels", of=GEOMETRY),
        used("VC", "row of the central ray", FOUND, "pixels", of=GEOMETRY),
        used("Binned pixel size", "pixel of the images", FOUND, "mm", of=GEOMETRY),
        used("Voxel size", "pixel at the axis", "it is compared", "um", of=GEOMETRY),
        used("Magnification", "SDD / SOD", "it is compared", of=GEOMETRY),
        used("ROI (LTRB)", "region of the panel", "the geometry", "pixels", of=GEOMETRY),
        used("Imaging mode", "binning of the panel", "the geometry", of=GEOMETRY),
        *_motors(),
        used("# projections", "number of images", "the views", of=ANGLES),
        used("Start angle", "angle of the first image", "the views", "deg", of=ANGLES),
        used("Last angle", "angle of the last image", "the views", "deg", of=ANGLES),
        used("Tube voltage", "voltage of the tube", "reconstruct with material=", "kV"),
        used("Scanner name", "which scanner", "its motors and profiles"),
        used("Scanner type", "which scanner, and its number", "its motors and profiles"),
        used("ScanID", "name of the scan", "the data set's name"),
        used("SCRIPT CANCELLED!", "the scan ended early", "it is incomplete"),
        *noted_all(
            "BatchID; Project; START; STOP; SCAN DURATION; Operator; Sample name; "
            "Sample owner; Application area; Sample size; Comment; Acquila version; "
            "Script summary",
            "words and times",
            divider="; ",
        ),
        *noted_all(
            "X-ray tube; Tube power; Vacuum level; Filter; Focus mode; Target current; "
            "Filament status; Filament mode; Output mode; Preheating time",
            "of the tube",
            "`tube=` of reconstruct takes it",
            divider="; ",
        ),
        *noted_all(
            "Camera; Exposure time (ms); Number of averages; Original pixel size; "
            "Binning value; scan type; # pre flat fields; # post flat fields; "
            "# offset images; Reference images every; Axis for flat field movement",
            "how the images were taken",
            divider="; ",
        ),
    ),
    "SOD, SDD and the pixel before Voxel size and Magnification; of a line that stands twice "
    "the first; mag_det_phys before mag_det.",
    example='fx.open("scan")',
)
XRE_TEXT: Final = FormatTable(
    XRE_SETTINGS,
    "the scanner's own files",
    (
        *(
            used(f"CT-parameters IN/{name}", what, FOUND, unit, of=GEOMETRY)
            for name, what, unit in (
                ("SOD", "source to axis", "mm"), ("SDD", "source to panel", "mm"),
                ("COR", "column of the axis, from the edge", "pixels"),
                ("HC", "column of the central ray", "pixels"),
                ("VC", "row of the central ray", "pixels"),
            )
        ),
        used("Camera settings/Binned pixelsize (mm)", "pixel of the images", FOUND, "mm",
             of=GEOMETRY),
        used("Camera settings/ROI", "region of the panel", "the geometry", of=GEOMETRY),
        used("Camera settings/Imaging mode", "binning of the panel", "the geometry",
             of=GEOMETRY),
        *_motors("motor positions/"),
        used("CT-parameters IN/Start angle", "angle of the first image", "the views", "deg",
             of=ANGLES),
        used("CT-parameters IN/Last angle", "angle of the last image", "the views", "deg",
             of=ANGLES),
        used("Acquisition settings/total projections", "number of images", "the views",
             of=ANGLES),
        used("Acquisition settings/nr of sections", "circles of the scan",
             "more than one is refused"),
        used("Tube settings/kV set value", "voltage of the tube",
             "reconstruct with material=", "kV"),
        used("Scan info/Scanner name", "which scanner", "its motors and profiles"),
        used("Scan info/scanner type", "which scanner", "its motors and profiles"),
        used("Scan info/scanID", "name of the scan", "the data set's name"),
        used("Scan info/Succeeded", "whether the scan ended well", "else it is incomplete"),
        noted("Acquisition settings/Rotation mode", "smooth or in steps"),
        noted("POIs/*", "named places in the world", "motors and profile have them"),
        *noted_all(MOTORS, "where a motor was sent", under="Acquisition settings/"),
        noted("Acquisition settings/Flat field axis", "which moved for flat images"),
        noted("Acquisition settings/Flat Field position", "where it stood for them"),
        noted("Acquisition settings/Scan position", "where it stood for the scan"),
        *noted_all(
            "name; data format",
            "how the scan was taken",
            divider="; ",
            under="Scantype/",
        ),
        *noted_all(
            "Sample name; Project; Application area; Owner; Comment; Contact "
            "person; Diameter (mm); Height (mm)",
            "of the sample",
            divider="; ",
            under="Sample info/",
        ),
        *noted_all(
            "Scan name; Operator; Acquila version; scanner S/N; BatchID; Start; "
            "Stop; Duration; Error",
            "words and times",
            divider="; ",
            under="Scan info/",
        ),
        *noted_all(
            "Tube name; Focus mode; Output mode; Current set value; Current actual "
            "value; kV actual value; Target current set value; Target current "
            "actual value; Target power set value; Target power actual value; "
            "Vacuum level; Filament status; Interlock; Defocussed; Xray stable; "
            "SerialNumber",
            "of the tube",
            divider="; ",
            under="Tube settings/",
        ),
        *noted_all(
            "Camera name; Exposure time (ms); Nr. of averages; Nr. of frames; "
            "Unbinned pixelsize (mm); Binning value; Columns; Rows; SerialNumber",
            "of the camera",
            divider="; ",
            under="Camera settings/",
        ),
        *noted_all(
            "script settings set; Vertical mode; CTaxis; Path; File base name; "
            "projs_per_360; CT start angle; CT stop angle; DI_FF_frequency; nr DI "
            "before; nr DI after; nr FF before; nr FF after; nr pre refs; nr post "
            "refs; nr averages refs; time lapse pause (s); pause before scan (s); "
            "pause before DI (s); pause before IO (s); set kV; tube kV; set power; "
            "tube power; set focus mode; Focus Mode; Keep X-ray on; Conditioning "
            "frequency; Refresh tube; Exposure time (ms); readout time (ms); nr of "
            "averages; Imaging mode; ROI; Set sample position; Top at VC; Bottom at "
            "VC; rotation speed; rotation acc; vertical speed; vertical acc; Goto "
            "ref after scan; Log tubestatus",
            "how the scan was taken",
            divider="; ",
            under="Acquisition settings/",
        ),
        *noted_all(
            "time; number offset images; number gain images; number projections; "
            "data path; basename; import ROI; import binning; import binning "
            "method; import use slope/offset; import first projection; import last "
            "projection; import projections; import decimate value; X-position; "
            "X-direction; Y-position; Y-direction; Z-position; Z-direction; "
            "projection pixel size; recon path; BitsPerSample; Slope; Offset",
            "the maker's own data set",
            divider="; ",
            under="Data set settings/",
        ),
        *noted_all(
            "Direction; Pixel size; bhc; Tilt; zmin; zmax; x_start; x_end; y_start; "
            "y_end; Interpolate; Resolution; Voxel size; z_start; z_end; Min grey "
            "value; Max grey value; Recon mode; ZP factor; Filter type; Filter "
            "level; Min CT value; Max CT value; Spot filter; bhc2; Ring level; Ring "
            "kernel; Ring blocks; Prompt scaling; Spot kernel; Phase mu; Phase "
            "delta; Edge correction factor; Square recon; Scatter; Clipping value; "
            "EFOV filter; Original number of columns; EFOV axis; FilterEdgeWidth",
            "the maker's own reconstruction",
            divider="; ",
            under="CT-parameters IN/",
        ),
    ),
    "scan settings.txt before this text.",
    example='fx.open("scan")',
)  # fmt: skip
TEXTS: Final = (SETTINGS_TEXT, XRE_TEXT)
