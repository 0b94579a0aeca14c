"""The fields of Data Exchange, APS's and ALS's HDF5."""

from __future__ import annotations

from typing import Final

from flexdt.twin.dataset.format_table import (
    ANGLES,
    BEAM,
    DARK,
    GEOMETRY,
    FormatTable,
    dropped,
    noted_all,
    used,
)

INSTRUMENT: Final = "measurement/instrument"


def _at(group: str, names: str) -> str:
    """Return the paths of names in a group, divided by blanks."""
    return " ".join(f"{group}/{name}" for name in names.split())


DATA_EXCHANGE: Final = FormatTable(
    "Data Exchange",
    "dxfile's definition, dxchange's readers and 2-BM's and 7-BM's lists of places",
    (
        used("exchange/data", "images (angle, row, column)", "the images"),
        used("exchange/data_white", "flat images", "the flat image", of=BEAM),
        used("exchange/data_dark", "dark images", "the dark image", of=DARK),
        used("exchange/theta", "angle of each image", "the views", "deg", of=ANGLES),
        used(
            "process/acquisition/rotation/rotation_start",
            "angle of the first image",
            "the views, without theta",
            "deg",
            of=ANGLES,
        ),
        used(
            "process/acquisition/rotation/rotation_step",
            "turn from image to image",
            "the views, without theta",
            "deg",
            of=ANGLES,
        ),
        used(
            f"{INSTRUMENT}/detector/pixel_size_x",
            "pitch of columns",
            "the geometry",
            "m",
            of=GEOMETRY,
        ),
        used(
            f"{INSTRUMENT}/detector/pixel_size_y",
            "pitch of rows",
            "the geometry",
            "m",
            of=GEOMETRY,
        ),
        used(
            f"{INSTRUMENT}/detector/x_pixel_size",
            "pitch of columns",
            "the same",
            "m",
            of=GEOMETRY,
        ),
        used(
            f"{INSTRUMENT}/detector/y_pixel_size",
            "pitch of rows",
            "the same",
            "m",
            of=GEOMETRY,
        ),
        used(
            f"{INSTRUMENT}/source/distance",
            "source to sample",
            "the geometry",
            "m",
            of=GEOMETRY,
        ),
        used(
            f"{INSTRUMENT}/detector/distance",
            "sample to panel",
            "the geometry",
            "m",
            of=GEOMETRY,
        ),
        used(
            f"{INSTRUMENT}/detector/exposure_time",
            "exposure of projections",
            "flat images are put on it",
            "s",
        ),
        used(
            "process/acquisition/flat_fields/flat_exposure_time",
            "exposure of flat images",
            "flat images are put on that of projections",
            "s",
            of=BEAM,
        ),
        used(
            "process/acquisition/flat_fields/different_flat_exposure",
            "whether it is another",
            "flat images",
            of=BEAM,
        ),
        used("exchange/theta_white", "angles of the flat images", "nothing"),
        used("exchange/theta_dark", "angles of the dark images", "nothing"),
        dropped(
            f"{INSTRUMENT}/detector/rotation_center",
            "column of the axis",
            "the axis is taken in the middle column; `align` finds it",
            of=GEOMETRY,
        ),
        dropped(
            "exchange/center",
            "column of the axis",
            "the axis is taken in the middle column; `align` finds it",
            of=GEOMETRY,
        ),
        *noted_all("implements exchange/title exchange/name", "how the file is built"),
        *noted_all(
            _at(
                "measurement/sample",
                "name description file_path file_name full_file_name experimenter "
                "experiment/proposal experiment/title",
            ),
            "words",
        ),
        *noted_all(
            _at(
                f"{INSTRUMENT}/detection_system/objective",
                "magnification resolution lens name tube_length",
            )
            + " "
            + _at(f"{INSTRUMENT}/detection_system/scintillator", "type name thickness"),
            "of the optics",
            "pixel_size_x is the panel's",
        ),
        *noted_all(
            _at(
                f"{INSTRUMENT}/detector",
                "manufacturer model serial_number bit_depth operating_temperature "
                "firmware_version binning_x binning_y frame_rate array_size_x array_size_y "
                "dimension_x dimension_y temperature roi/min_x roi/min_y roi/size_x "
                "roi/size_y",
            ),
            "of the detector",
        ),
        *noted_all(
            _at(f"{INSTRUMENT}/source", "name beamline current datetime mode energy")
            + " "
            + _at(f"{INSTRUMENT}/monochromator", "energy energy_error mode type")
            + f" {INSTRUMENT}/name {INSTRUMENT}/comment",
            "of the beam",
        ),
        *noted_all(
            _at(f"{INSTRUMENT}/sample_motor_stack/setup", "x y z"),
            "where the sample stood",
        ),
        *noted_all(
            _at(
                "process/acquisition",
                "start_date end_date magnification rotation/rotation_stop "
                "rotation/num_angles rotation/rotation_speed rotation/rotation_range "
                "flat_fields/num_flat_fields flat_fields/flat_field_mode "
                "dark_fields/num_dark_fields dark_fields/dark_field_mode",
            ),
            "how the scan was taken",
        ),
    ),
    "theta before rotation_start and rotation_step; pixel_size_x before x_pixel_size; "
    "data_white's own exposure before that of projections.",
    example='fx.open("scan.h5", distances=(120, 260))',
)
