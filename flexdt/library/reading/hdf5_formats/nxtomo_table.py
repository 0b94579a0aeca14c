"""The fields of NeXus's NXtomo, by their place in the entry."""

from __future__ import annotations

from typing import Final

from flexdt.twin.dataset.format_table import (
    ANGLES,
    GEOMETRY,
    FormatTable,
    dropped,
    noted,
    noted_all,
    used,
)

DETECTOR: Final = "instrument/detector"
"""Canonical place of the group with the images, whatever its name in a file."""
BEAM: Final = "incident_energy incident_wavelength flux extent distance"
"""What files say of the beam."""


def _at(group: str, names: str) -> str:
    """Return the paths of names in a group, divided by blanks."""
    return " ".join(f"{group}/{name}" for name in names.split())


NXTOMO: Final = FormatTable(
    "NXtomo",
    "the application definition NXtomo 2.0, ESRF's nxtomo, and Diamond's files",
    (
        used(f"{DETECTOR}/data", "images", "the images"),
        used(f"{DETECTOR}/image_key", "kind of each image", "the images"),
        used(
            f"{DETECTOR}/x_pixel_size",
            "pitch of columns",
            "the geometry",
            "m",
            of=GEOMETRY,
        ),
        used(
            f"{DETECTOR}/y_pixel_size", "pitch of rows", "the geometry", "m", of=GEOMETRY
        ),
        used(f"{DETECTOR}/distance", "sample to panel", "the geometry", "m", of=GEOMETRY),
        used(
            "instrument/source/distance",
            "source to sample",
            "the geometry",
            "m",
            of=GEOMETRY,
        ),
        used("*rotation_angle", "angle of each image", "the views", "deg", of=ANGLES),
        used(
            f"{DETECTOR}/x_rotation_axis_pixel_position",
            "column of the axis; 0 and below count from the middle, as ESRF's files do",
            "the axis",
            "pixels",
            of=GEOMETRY,
        ),
        used(
            f"{DETECTOR}/y_rotation_axis_pixel_position",
            "row of the source's plane, likewise",
            "the panel's height",
            "pixels",
            of=GEOMETRY,
        ),
        used(
            f"{DETECTOR}/estimated_cor_from_motor",
            "column of the axis, from the middle",
            "the axis",
            "pixels",
            of=GEOMETRY,
        ),
        used(
            f"{DETECTOR}/x_flipped", "columns are mirrored", "the geometry", of=GEOMETRY
        ),
        used(f"{DETECTOR}/y_flipped", "rows are mirrored", "the geometry", of=GEOMETRY),
        used(
            f"{DETECTOR}/transformations/rz",
            "a rotation by 180 deg mirrors the columns",
            "the geometry",
            of=GEOMETRY,
        ),
        used(
            f"{DETECTOR}/transformations/ry",
            "a rotation by 180 deg mirrors the rows",
            "the geometry",
            of=GEOMETRY,
        ),
        used(
            f"{DETECTOR}/field_of_view",
            "Half: the axis is near one side of the panel",
            "it is compared with the axis",
            of=GEOMETRY,
        ),
        used(
            f"{DETECTOR}/count_time",
            "exposure of each image",
            "counts are put on one exposure",
            "s",
        ),
        used(
            "control/data",
            "current or monitor of each image",
            "counts are put on one current",
        ),
        used("sample/z_translation", "height of the sample", "a helix", "m", of=GEOMETRY),
        used(
            "cone_vec", "flexdt's geometry, which wins", "the geometry", "mm", of=GEOMETRY
        ),
        used(
            "flexdt/cone_vec", "the same in the entry", "the geometry", "mm", of=GEOMETRY
        ),
        *(
            dropped(
                f"sample/{axis}_translation",
                f"movement of the sample {way}, where it differs between views [m]",
                "the file does not say whether this stage sits on or under the rotation stage; "
                "pass geometry=",
                of=GEOMETRY,
            )
            for axis, way in (("x", "along the beam"), ("y", "across the beam"))
        ),
        noted(f"{DETECTOR}/transformations/gravity", "direction of gravity"),
        noted(
            f"{DETECTOR}/transformations/gravity@*", "direction of gravity", "a constant"
        ),
        *(
            noted(
                f"{DETECTOR}/transformations/{name}@*",
                "kind and axis of a transformation",
                "its name says both",
            )
            for name in ("rz", "ry")
        ),
        dropped(
            f"{DETECTOR}/transformations/*",
            "a turn or shift of the panel",
            "the panel is taken to stand upright at the central ray",
            of=GEOMETRY,
        ),
        dropped(
            "sample/transformations/*",
            "a turn or shift of the sample",
            "the sample is taken to stand on the axis",
        ),
        dropped(
            "sample/depends_on",
            "chain of the sample's transformations",
            "it is not followed",
            neutral=("", ".", "0"),
        ),
        noted(f"{DETECTOR}/depends_on", "chain of transformations", "they are listed"),
        noted(
            f"{DETECTOR}/image_key_control",
            "kind of each image, with alignment images as -1",
            "image_key has it",
        ),
        noted(f"{DETECTOR}/roi", "region of the panel", "pixels are the images' own"),
        *noted_all(
            _at(
                DETECTOR,
                "sequence_number tomo_n group_size local_name type exposure_time "
                "frame_time bit_depth_readout serial_number magnification layout "
                "gain_setting name",
            ),
            "of the detector",
        ),
        *noted_all(
            "sample/x_pixel_size sample/y_pixel_size sample/propagation_distance "
            "sample/effective_propagation_distance",
            "a figure at the sample",
            "it follows from the geometry",
        ),
        *noted_all(
            "title start_time end_time duration definition program_name run_cycle "
            "experiment_identifier entry_identifier scan_command group_size "
            "sample/name sample/description sample/chemical_formula sample/type "
            "instrument/name bliss_original_files",
            "descriptive text, dates and counts",
        ),
        *noted_all(
            _at(
                "instrument/source",
                "name type probe mode energy current power voltage "
                "target_material target flux frequency last_fill top_up",
            ),
            "of the source",
        ),
        *noted_all(_at("instrument/beam", BEAM) + " " + _at("beam", BEAM), "of the beam"),
        *noted_all(_at("user", "name affiliation role email address"), "a person"),
        *noted_all(_at("control", "mode preset type range"), "of the monitor"),
        noted("data/data", "the images once more"),
        noted("data/image_key", "the keys once more"),
        noted("other entry/*", "of another scan in the file", "one scan is read"),
    ),
    "the first of these wins: flexdt's cone_vec over everything else; x_flipped and y_flipped "
    "over transformations; x_rotation_axis_pixel_position over estimated_cor_from_motor; "
    "figures beside the images over those of the entry.",
    example='fx.open("scan.nxs")',
)
