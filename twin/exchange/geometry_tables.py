"""The fields of geometry files: RTK, ASTRA, tomosipo, CIL, TIGRE, LEAP, flexDATA, csv, CTSimU."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from flexdt.twin.dataset.format_table import (
    ANGLES,
    GEOMETRY,
    Field,
    FormatTable,
    Role,
    dropped,
    noted,
    noted_all,
    refused,
    used,
)

NO_JAWS: Final = ("1.7976931348623157e308", "1.79769313486232e+308", "1.79769e+308", "")
"""Places of jaws that hide nothing: RTK writes the largest number."""
ONE: Final = "this format states nothing twice."


def placed(names: str, meaning: str, unit: str = "mm") -> tuple[Field, ...]:
    """Make fields of the geometry of one meaning; names are divided by blanks."""
    return tuple(
        used(name, meaning, "the geometry", unit, of=GEOMETRY) for name in names.split()
    )


RTK: Final = FormatTable(
    "RTK",
    "RTK's page on its geometry, its XML reader and files of its own programs",
    (
        noted("@version", "3, another is refused"),
        used("GantryAngle", "turn about RTK's y", "the views", "deg", of=ANGLES),
        *placed("OutOfPlaneAngle", "turn about the panel's rows", "deg"),
        *placed("InPlaneAngle", "turn in the panel's plane", "deg"),
        *placed("SourceToIsocenterDistance", "source to the origin, along the normal"),
        *placed("SourceToDetectorDistance", "source to panel; 0 is a parallel beam"),
        *placed("SourceOffsetX SourceOffsetY", "source aside, along the panel"),
        *placed("ProjectionOffsetX ProjectionOffsetY", "image aside, along the panel"),
        *placed("Matrix", "projection matrix, the same again"),
        refused(
            "RadiusCylindricalDetector",
            "radius of a curved panel [mm]",
            "flexdt has flat panels only",
        ),
        *(
            dropped(
                f"Collimation{name}",
                "edge of the collimator on the panel [mm]",
                "pixels behind it are taken as they were measured",
                neutral=NO_JAWS,
            )
            for name in ("UInf", "USup", "VInf", "VSup")
        ),
    ),
    "numbers of a view before those for all views; a matrix and numbers that differ by more "
    "than 0.05 pixels are refused.",
    example='fx.ConeVec.load("scan.xml", pixel=0.15)',
)
ASTRA: Final = FormatTable(
    "ASTRA",
    "ASTRA's documentation of cone_vec, and .geom files published on Zenodo with their images",
    (
        *placed("vectors", "12 numbers a view: source, panel, u, v", "one unit"),
        dropped("comment", "text after #", "no unit or shape is taken from it"),
    ),
    ONE,
    example='fx.ConeVec.load("scan.geom", shape=(760, 956))',
)
TOMOSIPO: Final = FormatTable(
    "tomosipo",
    "tomosipo's `ts.cone_vec`",
    (
        *placed("shape", "rows and columns of the panel", ""),
        *placed("src_pos det_pos", "source and panel (z, y, x)", "one unit"),
        *placed("det_v det_u", "steps from row to row and column to column", "one unit"),
    ),
    ONE,
    example='fx.ConeVec.load("scan.npz")',
)
CIL: Final = FormatTable(
    "CIL",
    "CIL's `create_Cone3D_Flex` and `set_panel`",
    (
        *placed("source_position_set detector_position_set", "places of each view"),
        *placed(
            "detector_direction_x_set detector_direction_y_set", "unit directions", ""
        ),
        *placed("num_pixels", "columns and rows", ""),
        *placed("pixel_size", "of columns and rows"),
        *placed("origin", "corner of the first pixel", ""),
    ),
    ONE,
    example='fx.ConeVec.load("scan.cil")',
)
TIGRE: Final = FormatTable(
    "TIGRE",
    "TIGRE's demo d03 and its `geometry` class",
    (
        used("angles", "angle of each view", "the views", "rad", of=ANGLES),
        *placed("DSO DSD", "source to axis and to panel"),
        *placed("offOrigin offDetector", "shift of the volume, and of the panel"),
        *placed("rotDetector", "turns of the panel", "rad"),
        *placed("nDetector", "rows and columns", ""),
        *placed("dDetector", "pixel of rows and columns"),
        *placed("sDetector", "size of the panel, compared with nDetector x dDetector"),
        refused("COR", "shift of the axis [mm]", "offOrigin and offDetector state it"),
        refused("mode", "cone or parallel", "a cone beam", neutral=("cone", "")),
        *noted_all("nVoxel dVoxel sVoxel accuracy filter", "of TIGRE's volume"),
    ),
    "nDetector and dDetector before sDetector.",
    example='fx.ConeVec.load("scan.tigre")',
)
LEAP: Final = FormatTable(
    "LEAP",
    "LEAP's `set_modularbeam`",
    (
        *placed("numAngles numRows numCols", "views, rows and columns", ""),
        *placed("pixelHeight pixelWidth", "of rows and columns"),
        *placed("sourcePositions moduleCenters", "places of each view"),
        *placed("rowVectors colVectors", "directions of rows and columns", ""),
    ),
    ONE,
    example='fx.ConeVec.load("scan.leap")',
)
FLEXDATA: Final = FormatTable(
    "flexDATA",
    "flexDATA's geometry.toml of version 0.1.0",
    (
        *placed("src2obj det2obj src2det", "distances, of which two are needed"),
        *placed("det_pixel", "pixel of the panel"),
        *placed("det_rows det_cols", "rows and columns", ""),
        used("ang_range", "first and last angle", "the views", "deg", of=ANGLES),
        used("proj_count", "number of views", "the views"),
        *placed("det_sample", "pixels over rows and columns", ""),
        *placed("vol_tra", "shift of the volume"),
        *placed("src_tan src_ort det_tan det_ort axs_tan", "shifts"),
        *placed("det_roll det_yaw det_pitch", "turns of the panel", "deg"),
        *(
            refused(
                name,
                what,
                "flexDATA turns source and detector about different points then",
            )
            for name, what in (
                ("axs_roll", "lean of the axis [deg]"),
                ("axs_pitch", "lean of the axis along the beam [deg]"),
                ("vol_rot", "turn of the volume"),
            )
        ),
        refused("unit", "of lengths", "flexDATA writes mm", neutral=("mm", "")),
        noted("img_pixel", "pixel at the axis", "it follows from the others"),
        noted("vol_sample", "voxels over pixels", "of flexDATA's volume"),
        noted("flextoml_version", "0.1.0; another is told"),
    ),
    "src2obj and det2obj before src2det.",
    example='fx.ConeVec.load("geometry.toml", shape=(760, 956))',
)
CSV: Final = FormatTable(
    "csv",
    "flexdt's own table of vectors",
    (
        *placed("source_? detector_? u_? v_?", "vectors of each view"),
        used(
            "# detector rows, columns", "shape of the panel", "the geometry", of=GEOMETRY
        ),
        used("file", "name of each image", "the images"),
        noted("angle_deg", "angle of each view", "the vectors have it"),
        noted("frame", "number of each view"),
        dropped("comment", "a line behind #", "no unit is taken from it"),
    ),
    ONE,
    example='fx.ConeVec.load("scan.csv")',
)
OWN: Final = FormatTable(
    "flexdt geometry",
    "flexdt",
    tuple(
        used(name, "flexdt's own", "the geometry")
        for name in (
            "kind", "schema", "name", "detector/rows", "detector/columns", "cone_vec",
            "real_cone_vec", "files", "notes", "full_scale", "kV", "provenance",
        )
    ),
    ONE,
    example='fx.ConeVec.load("scan.json")',
)  # fmt: skip
_DEVIATION: Final = (
    "deviations/type deviations/axis deviations/axis/? deviations/pivot/? "
    "deviations/amount deviations/known_to_reconstruction"
)
_FILTER: Final = "material_id thickness"


def _under(place: str, names: str) -> tuple[str, ...]:
    """Return the paths of names below a place."""
    return tuple(f"{place}/{name}" for name in names.split())


def _scenario() -> tuple[Field, ...]:
    """Make the fields of a scenario. A number's value, unit and drifts count as the number,
    and members of a list as one.
    """
    where = "center/? vector_u/? vector_w/? " + _DEVIATION
    parts = [
        used(name, f"place of the {part}", "the geometry", of=GEOMETRY)
        for part in ("source", "detector", "stage")
        for name in _under(f"geometry/{part}", where)
    ]
    panel = [
        *placed("detector/columns detector/rows", "of the panel", ""),
        *placed("detector/pixel_pitch/?", "pitch of columns (u) and rows (v)"),
        *placed("acquisition/pixel_binning/?", "pixels that are joined", ""),
        *placed("geometry/source/type", "cone; a parallel beam is refused", ""),
    ]
    angles = [
        used(f"acquisition/{name}", meaning, "the views", unit, of=ANGLES)
        for name, meaning, unit in (
            ("start_angle", "angle of the first view", "deg"),
            ("stop_angle", "angle of the last view", "deg"),
            ("direction", "CCW or CW", ""),
            ("number_of_projections", "views", ""),
            ("include_final_angle", "whether a view is at stop_angle", ""),
        )
    ]
    simulated = {
        "the sample": (
            *_under("samples", "file unit material_id scaling_factor/? position/center/? "
                    "position/vector_r/? position/vector_t/?"),
            *_under("samples/position", _DEVIATION),
            *_under("materials", "id density composition/formula "
                    "composition/mass_fraction"),
            "environment/material_id",
        ),
        "the tube": (
            *_under("source", "voltage current target/material_id target/type "
                    "target/thickness target/angle/incidence target/angle/emission "
                    "spot/size/? spot/sigma/? spectrum/monochromatic spectrum/file"),
            *_under("source/spot/intensity_map", "file type dim_x dim_y dim_z"),
            *_under("source/window", _FILTER), *_under("source/filters", _FILTER),
        ),
        "the detector": (
            *_under("detector", "type bit_depth integration_time image_lag "
                    "gray_value/imax gray_value/imin gray_value/factor gray_value/offset "
                    "gray_value/intensity_characteristics_file "
                    "gray_value/efficiency_characteristics_file noise/snr_at_imax "
                    "noise/noise_characteristics_file unsharpness/mtf "
                    "unsharpness/basic_spatial_resolution bad_pixel_map/file "
                    "bad_pixel_map/type bad_pixel_map/dim_x bad_pixel_map/dim_y"),
            *_under("detector/scintillator", _FILTER),
            *_under("detector/window/front", _FILTER),
            *_under("detector/window/rear", _FILTER),
            *_under("detector/filters/front", _FILTER),
            *_under("detector/filters/rear", _FILTER),
        ),
        "the images": _under("acquisition", "frame_average scattering dark_field/number "
                             "dark_field/frame_average dark_field/ideal "
                             "dark_field/correction flat_field/number "
                             "flat_field/frame_average flat_field/ideal "
                             "flat_field/correction"),
    }  # fmt: skip
    images = [
        used(name, what, "`flexdt simulate`")
        for what, names in simulated.items()
        for name in names
    ]
    about = [
        *placed("file/file_format_version/m*", "1.0 to 1.2; others are refused", ""),
        *placed("file/file_type", "CTSimU Scenario; others are refused", ""),
        used("file/name", "of the scenario", "the data set's name"),
    ]
    words = noted_all(
        "*/comment file/contact file/date_changed file/date_created file/description "
        "file/version file/version/m* */manufacturer */model */name materials/name "
        "*/endian */headersize */uncertainty detector/dead_time detector/gain "
        "acquisition/scan_mode acquisition/scan_speed environment/temperature",
        "words, or a figure of the scanner",
    )
    beam = [
        dropped(
            f"geometry/source/beam_divergence{end}",
            "opening of the beam",
            "the whole panel is taken to be lit",
        )
        for end in ("", "/?")
    ]
    program = noted("simulation*", "settings of another program's simulation")
    return (*parts, *panel, *angles, *about, *images, *words, *beam, program)


CTSIMU: Final = FormatTable(
    "CTSimU",
    "CTSimU's scenario file format 1.2, and the package ctsimu",
    _scenario(),
    "What reconstruction knows is the geometry; what is so apart from it is kept beside.",
    example='fx.ConeVec.load("scenario.json")',
)
GEOMETRY_TABLES: Final[Mapping[str, FormatTable]] = {
    "ctsimu": CTSIMU,
    "rtk": RTK,
    "astra": ASTRA,
    "tomosipo": TOMOSIPO,
    "cil": CIL,
    "tigre": TIGRE,
    "leap": LEAP,
    "flexdata": FLEXDATA,
    "csv": CSV,
}
"""Name of a format of `FORMATS` that is read -> its table."""


def taken(table: FormatTable) -> tuple[str, ...]:
    """Names of the fields that a reader takes."""
    return tuple(one.name for one in table.fields if one.role is Role.USED)
