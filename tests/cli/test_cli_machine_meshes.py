"""A machine file whose parts have meshes: what the commands take, show and refuse."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from flexdt.clients.cli.command_tree import run
from flexdt.clients.viewer.scenes.meshes.part_looks import own_looks, pieces_of
from flexdt.library import machines
from flexdt.phantoms.files import mesh_files
from flexdt.twin.errors import MachineFileError

TEXT = """base = "xyzr_cabinet"
name = "lab"
[[components]]
name = "source"
mesh = "cad/tube.glb"
mesh_at_mm = [0.0, -150.0, 0.0]
[[components]]
name = "cabinet"
mesh = "cad/wall.STL"
mesh_at_mm = [400.0, 500.0, 0.0]
"""
SCRIPT = "Z\tmove absolute\t300.0\t\tACK\t\t\n"


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    (tmp_path / "cad").mkdir()
    tube = trimesh.creation.cylinder(0.09, 0.3, sections=64)  # m, as GLB files are
    tube.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    tube.export(tmp_path / "cad/tube.glb")
    trimesh.creation.box((20.0, 1400.0, 800.0)).export(tmp_path / "cad/wall.stl")
    (tmp_path / "cad/wall.stl").rename(tmp_path / "cad/wall.STL")
    (tmp_path / "lab.toml").write_text(TEXT)
    return tmp_path / "lab.toml"


def test_meshes_are_read_beside_the_file_and_checked(
    lab: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = {part.name: part for part in machines.machine(lab).components}
    np.testing.assert_allclose(made["source"].size_mm, (180.0, 300.0, 180.0), atol=1e-3)
    np.testing.assert_allclose(made["source"].center_mm, (0.0, -150.0, 0.0), atol=1e-3)
    assert made["cabinet"].size_mm == (20.0, 1400.0, 800.0)
    assert made["cabinet"].center_mm == (400.0, 500.0, 0.0)
    assert run(["machine", "check", str(lab)]) == 0
    assert run(["machine", "show", str(lab)]) == 0
    assert "mesh cad/tube.glb" in capsys.readouterr().out
    script = lab.parent / "go.txt"
    script.write_text(SCRIPT)
    assert run(["check", str(script), "--machine", str(lab)]) == 0
    # A block where the carriage goes.
    lab.write_text(TEXT.replace("[400.0, 500.0, 0.0]", "[400.0, 900.0, -450.0]").replace(
        "cad/wall.STL", "cad/block.stl"))  # fmt: skip
    trimesh.creation.box((780.0, 200.0, 40.0)).export(lab.parent / "cad/block.stl")
    script.write_text(SCRIPT.replace("300.0", "720.0"))
    assert run(["check", str(script), "--machine", str(lab)]) != 0
    assert "z_carriage and cabinet come within" in capsys.readouterr().err


def test_the_scenes_draw_them_as_they_are(lab: Path) -> None:
    made = machines.machine(lab)
    looks = own_looks(made, lab.parent)
    assert looks.keys() == {"source", "cabinet"}
    assert looks["source"] == (lab.parent / "cad/tube.glb").read_bytes()
    wall = trimesh.load(trimesh.util.wrap_as_stream(looks["cabinet"]), file_type="glb")
    np.testing.assert_allclose(wall.extents, (0.02, 1.4, 0.8), atol=1e-6)
    # Without the files, the body that stands for a part.
    part = next(p for p in made.components if p.name == "source")
    [piece] = pieces_of(part)
    np.testing.assert_allclose(piece.mesh.extents, part.size_mm, atol=1e-6)


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        ("cad/gone.glb", "there is no file .*gone.glb"),
        ("cad/tube.obj", "tube.obj: not the mesh of a part; allowed: glb, stl"),
        ("cad/empty.stl", "empty.stl has 0 bytes"),
        ("cad/words.glb", "not a readable GLB file"),
        ("cad/many.stl", "many.stl: 12 triangles; allowed: 11"),
        ("cad/bytes.stl", "bytes.stl has [0-9]+ bytes; allowed: 2000"),
        (
            "cad/inch.glb",
            "measures 50000 mm; .* STL file is taken to be in mm, a GLB file in m",
        ),
    ],
)
def test_a_mesh_that_does_not_hold_is_told_with_file_and_part(
    lab: Path, mesh: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = lab.parent / "cad"
    (folder / "empty.stl").write_bytes(b"")
    (folder / "words.glb").write_bytes(b"not a mesh")
    trimesh.creation.box((50.0, 1.0, 1.0)).export(folder / "inch.glb")
    trimesh.creation.box((50.0, 1.0, 1.0)).export(folder / "many.stl")
    trimesh.creation.icosphere(subdivisions=2).export(folder / "bytes.stl")
    if "many" in mesh:
        monkeypatch.setattr(mesh_files, "MAX_PART_FACES", 11)
    monkeypatch.setattr(mesh_files, "MAX_PART_BYTES", 2000)
    lab.write_text(
        TEXT.split('[[components]]\nname = "cabinet"')[0].replace("cad/tube.glb", mesh)
    )
    with pytest.raises(
        MachineFileError, match=f"lab.toml: components.source.mesh: .*{message}"
    ):
        machines.machine(lab)
