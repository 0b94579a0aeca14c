"""`tests/studies/further_bench.py` on small problems: the references, and who takes
part."""

from __future__ import annotations

import sys

import further_bench
import numba
import numpy as np
import pytest

from flexdt.twin.projection import project_mesh, project_scene
from flexdt.twin.projection.analytic_solids import Scene, Solid, Sphere
from flexdt_extensions.bench.benchmark import Case, circle, errors, interleaved, noise

SHAPE = (30, 40)


def test_growth_with_threads_takes_turns(monkeypatch) -> None:
    monkeypatch.setattr(further_bench, "C1_SHAPE", (8, 8, 8))
    before = numba.get_num_threads()
    rounds = []

    def fewer(calls, budget_s):
        rounds.append(list(calls))
        return interleaved(calls, budget_s=0.0)

    monkeypatch.setattr(further_bench, "interleaved", fewer)
    points = further_bench.growth_with_threads()
    assert len(rounds) == 1
    assert numba.get_num_threads() == before
    assert {p["x"] for p in points if p["series"] == "tilted, 36 views"} == {
        2**k for k in range(before.bit_length())
    }
    assert all(p["ms"] > 0 for p in points)


def test_the_adjoint_is_measured_beside_the_forward(monkeypatch) -> None:
    view = circle(2, SHAPE, pitch=0.5)
    case = Case("C1", lambda: noise((16, 12, 10)), view, SHAPE, True, "small")
    monkeypatch.setattr(further_bench, "peer_cases", lambda: [case])
    monkeypatch.setattr(further_bench, "untuned_cases", list)
    chosen = ("adjoint-C1", "adjoint-C1-new")
    assert set(chosen) < set(further_bench.adjoint_names())
    entries = further_bench.adjoint(lambda name: name in chosen)
    assert [entry["name"] for entry in entries] == list(chosen)
    for entry in entries:
        assert entry["dot_product_error"] < 1e-6
        assert entry["times_forward"] > 0
        assert not entry["peers"]


def test_bead_scene_and_mesh_are_what_they_say() -> None:
    assert len(further_bench.bead_scene().solids) == 6
    mesh = further_bench.ball_mesh(2)
    assert len(mesh.faces) == 320
    assert mesh.volume_mm3 == pytest.approx(4 / 3 * np.pi * 1000, rel=0.04)


def test_scenes_and_meshes_are_compared_with_a_second_way() -> None:
    view = circle(1, SHAPE, pitch=3.0, tilt_deg=(3.0, 2.0, 1.0))
    scene = further_bench.bead_scene()
    exact = further_bench.scene_chords(scene, view, SHAPE)
    assert exact.max() > 0.3
    assert errors(project_scene(scene, view, SHAPE), exact)[1] < 1e-6
    # A bead left out is found.
    assert errors(project_scene(Scene(scene.solids[:-1]), view, SHAPE), exact)[1] > 0.1
    mesh = further_bench.ball_mesh(1)
    paths = project_mesh(mesh, view, SHAPE)
    pixels = np.argwhere(paths[0])
    again = further_bench.mesh_paths(mesh, view, SHAPE, pixels)
    assert len(pixels) > 20
    assert errors(paths[0][tuple(pixels.T)], again)[1] < 1e-6
    ball = Scene((Solid(Sphere((0, 0, 0), 10.0), "abs", 1.0),))
    assert errors(project_scene(ball, view, SHAPE)[0][tuple(pixels.T)], again)[1] > 0.01


def test_what_memory_allows_is_counted_from_the_geometry(monkeypatch) -> None:
    view = circle(2, SHAPE, pitch=0.5)
    case = Case("C1x36", lambda: noise((16, 12, 10)), view, SHAPE, True, "small")
    monkeypatch.setattr(further_bench, "peer_cases", lambda: [case])
    monkeypatch.setattr(further_bench, "bandwidth", lambda: {"all_threads_GB_s": 1e-3})
    (entry,) = further_bench.bounds(lambda name: name == "bound-C1x36")
    assert entry["least_MB"] == pytest.approx(16 * 12 * 10 * 4e-6)
    assert entry["bound_ms"] == pytest.approx(1e3 * entry["least_MB"] / 1e-3 / 1e3)
    assert entry["share"] == pytest.approx(entry["bound_ms"] / entry["ms_per_view"])
    assert all(
        entry[key] > 0 for key in ("cpu_ms", "cached_ms", "cached_cpu_ms", "serial_ms")
    )
    # Points close together on the lines from the source to a detector column's place.
    counted = 0
    for one in view.rows:
        for c in range(SHAPE[1]):
            end = one[3:5] + (c - (SHAPE[1] - 1) / 2) * one[6:8]
            points = one[:2] + np.linspace(0.4, 0.8, 200_000)[:, None] * (end - one[:2])
            x, y = np.floor((points + (0.5, 0.6)) / 0.1).T.astype(int)
            inside = (x >= 0) & (x < 10) & (y >= 0) & (y < 12)
            counted += len(np.unique(100 * x[inside] + y[inside]))
    assert entry["asked_MB"] == pytest.approx(counted / 2 * 16 * 4e-6)


def test_no_peers_means_none(monkeypatch) -> None:
    def refuse(*arguments):
        raise AssertionError("a peer was prepared")

    parts = []
    monkeypatch.setattr(
        further_bench,
        "GROUPS",
        {("mesh",): lambda wanted, part: parts.append(part) or []},
    )
    monkeypatch.setattr(further_bench, "absent", lambda name: None)
    assert further_bench.run(["mesh"], with_peers=False)["machine"]["peers"] == {}
    further_bench.run(["mesh"], with_peers=True)
    assert parts == [frozenset(), {"itk-rtk", "embreex"}]
    monkeypatch.setattr(further_bench, "Embree", refuse)
    monkeypatch.setattr(further_bench, "BINNED", SHAPE)
    monkeypatch.setattr(
        further_bench, "circle", lambda n, shape: circle(n, shape, pitch=1.5)
    )
    monkeypatch.setattr(further_bench, "CHECKED", 20)
    for made in further_bench.meshes(frozenset()):
        assert made["worst_error"] < 1e-6
    with pytest.raises(AssertionError, match="prepared"):
        further_bench.meshes(frozenset({"embreex"}))


def test_the_list_names_every_case(monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["further_bench.py", "--list"])
    further_bench.main()
    assert capsys.readouterr().out.splitlines() == further_bench.names()
