"""CTSimU scenarios to simulate, written from the format's description."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from flexdt.twin.geometry.conventions import FloatArray


def mm(value: float) -> dict[str, Any]:
    return {"value": value, "unit": "mm"}


def deg(value: float) -> dict[str, Any]:
    return {"value": value, "unit": "deg"}


def vector(values: FloatArray, names: str) -> dict[str, Any]:
    return {a: {"value": float(x)} for a, x in zip(names, values, strict=True)}


def point(values: FloatArray, names: str) -> dict[str, Any]:
    return {a: mm(float(x)) for a, x in zip(names, values, strict=True)}


def material(name: str, formula: str, density: float) -> dict[str, Any]:
    return {
        "id": name, "name": name, "density": {"value": density, "unit": "g/cm^3"},
        "composition": [{"formula": {"value": formula}, "mass_fraction": {"value": 1}}],
    }  # fmt: skip


def scenario(rows: int = 20, cols: int = 24, frames: int = 3) -> dict[str, Any]:
    """Nothing in a beam of 60 keV, source in the origin, stage at 250, panel at 400 mm."""
    across, along = np.array([0.0, -1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    facing = {"vector_u": vector(across, "xyz"), "vector_w": vector(along, "xyz")}
    return {
        "file": {
            "name": "test", "file_type": "CTSimU Scenario",
            "file_format_version": {"major": 1, "minor": 2},
        },
        "environment": {"material_id": None, "temperature": None},
        "geometry": {
            "detector": {"center": point(400.0 * along, "xyz"), **facing},
            "source": {"type": "cone", "center": point(0.0 * along, "xyz"), **facing},
            "stage": {
                "center": point(250.0 * along, "xyz"),
                "vector_u": vector(along, "xyz"),
                "vector_w": vector(np.array([0.0, 0.0, 1.0]), "xyz"),
            },
        },
        "detector": {
            "type": "ideal",
            "columns": {"value": cols, "unit": "px"}, "rows": {"value": rows, "unit": "px"},
            "pixel_pitch": {"u": mm(4.0), "v": mm(4.0)},
            "bit_depth": {"value": 16}, "integration_time": {"value": 0.5, "unit": "s"},
            "gray_value": {"imax": {"value": 50000}, "imin": {"value": 200}},
            "noise": {"snr_at_imax": {"value": None}},
        },
        "source": {
            "voltage": {"value": 60, "unit": "kV"}, "current": {"value": 120, "unit": "uA"},
            "spectrum": {"monochromatic": True, "file": None}, "window": [], "filters": [],
        },
        "samples": [],
        "acquisition": {
            "start_angle": deg(0.0), "stop_angle": deg(360.0), "direction": "CCW",
            "number_of_projections": frames, "include_final_angle": False, "frame_average": 1,
            "dark_field": {"number": 0}, "flat_field": {"number": 0},
            "pixel_binning": {"u": 1, "v": 1}, "scattering": False,
        },
        "materials": [material("Al", "Al", 2.7), material("PMMA", "C5 H8 O2", 1.18)],
        "simulation": None,
    }  # fmt: skip


def box(folder: Path, name: str, size: FloatArray) -> None:
    """A box as STL, not in the middle of its file: a scenario places its middle."""
    mesh = trimesh.creation.box(size)
    mesh.apply_translation([3.0, -7.0, 11.0])
    mesh.export(folder / name)


def sample(
    file: str, made_of: str, center: FloatArray, turn: FloatArray, names: str
) -> Any:
    """A sample whose r and t are the first and last column of `turn`."""
    return {
        "name": file, "file": {"value": file}, "unit": "mm", "material_id": made_of,
        "scaling_factor": {a: {"value": 1.0} for a in "rst"},
        "position": {
            "center": point(center, names), "vector_r": vector(turn[:, 0], names),
            "vector_t": vector(turn[:, 2], names), "deviations": [],
        },
    }  # fmt: skip


def write(folder: Path, document: dict[str, Any]) -> Path:
    path = folder / "case.json"
    path.write_text(json.dumps(document))
    return path
