"""Two twins on one projector: samples of one name and different contents are kept apart."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexdt.phantoms import load_phantom
from flexdt.runtime.files.directory import open_data
from flexdt.server.imaging.projections import Imaging, TrueGeometry, digest_of
from flexdt.server.imaging.projector_client import ProjectorClient
from flexdt.server.imaging.projector_pool import ProjectorPool
from flexdt.server.projector.service import ProjectorServer, serve_projector
from flexdt.server.storage.stored_samples import SampleStore
from flexdt.twin.projection import Volume
from flexdt.twin.projection.analytic import TriangleMesh
from flexdt.twin.scanner.state import Sample
from tests.support.projector_user import ProjectorUser
from tests.support.shelf import CAMERA, POSES, M, Shelf, block, brightest, imaging_of

LIMIT = 256 * 2**20


def run(work: Any, limit: int = LIMIT) -> None:
    async def main() -> None:
        server = await serve_projector(memory_limit=limit)
        one, other = (ProjectorUser(port=server.port) for _ in range(2))
        pool = ProjectorPool(
            [ProjectorClient(port=server.port), ProjectorClient(port=server.port)]
        )
        try:
            await asyncio.wait_for(work(server, one, other, pool), 300)
        finally:
            for client in (one, other, pool):
                await client.close()
            await server.close()

    asyncio.run(main())


def test_equal_names_with_different_contents_are_two_things() -> None:
    """By turns, each twin gets its own: a cube of 24 mm is 24 mm and a little thick."""

    async def work(
        server: ProjectorServer, one: Any, other: Any, pool: ProjectorPool
    ) -> None:
        twins = [(imaging_of(c, Shelf(thing=block(mu))), mu)
                 for c, mu in ((one, 0.01), (other, 0.03), (pool, 0.05))]  # fmt: skip
        for _ in range(3):
            for imaging, mu in twins:
                assert 24.0 * mu <= await brightest(imaging) < 24.0 * 1.5 * mu
        names = [v.name for v in (await one.volumes()).volumes]
        assert len(names) == 3
        assert all(name.startswith("thing #") for name in names)

    run(work)


def test_equal_contents_are_one_thing() -> None:
    async def work(
        server: ProjectorServer, one: Any, other: Any, pool: ProjectorPool
    ) -> None:
        found = [
            await brightest(imaging_of(c, Shelf(thing=block(0.02)))) for c in (one, other)
        ]
        assert found[0] == found[1] > 0.4
        assert len((await one.volumes()).volumes) == 1

    run(work)


@pytest.mark.parametrize("through_pool", [False, True])
def test_two_versions_of_a_sample_stay_and_older_ones_go(through_pool: bool) -> None:
    async def work(
        server: ProjectorServer, one: Any, other: Any, pool: ProjectorPool
    ) -> None:
        shelf = Shelf(thing=block(0.01), still=block(0.09))
        imaging = imaging_of(pool if through_pool else other, shelf)
        await brightest(imaging, "still")
        seen: list[set[str]] = []
        for mu in (0.01, 0.02, 0.03, 0.02, 0.04):
            shelf.contents["thing"] = block(mu)
            assert 24.0 * mu <= await brightest(imaging) < 24.0 * 1.5 * mu
            seen.append({v.name for v in (await one.volumes()).volumes})
        assert [len(names) for names in seen] == [2, 3, 3, 3, 3]
        # What was returned to is not the oldest: 0.03 went for 0.04, not 0.02.
        assert len(seen[1] & seen[4]) == 2
        assert await brightest(imaging, "still") > 24.0 * 0.09

    run(work)


def test_another_twin_gets_what_was_removed_once_more() -> None:
    async def work(
        server: ProjectorServer, one: Any, other: Any, pool: ProjectorPool
    ) -> None:
        mine, shelf = imaging_of(one, Shelf(thing=block(0.01))), Shelf(thing=block(0.01))
        first = await brightest(mine)
        theirs = imaging_of(other, shelf)
        for mu in (0.01, 0.02, 0.03):  # the third has the first removed
            shelf.contents["thing"] = block(mu)
            await brightest(theirs)
        assert len((await one.volumes()).volumes) == 2
        assert await brightest(mine) == first

    run(work)


def test_a_projector_that_is_full_forgets_versions_before_it_refuses() -> None:
    """Room for two and a half volumes of 64^3, of which each takes 2 MiB."""

    async def work(
        server: ProjectorServer, one: Any, other: Any, pool: ProjectorPool
    ) -> None:
        shelf = Shelf(thing=block(0.01, 64), next=block(0.05, 64))
        imaging = imaging_of(one, shelf)
        for mu in (0.01, 0.02):
            shelf.contents["thing"] = block(mu, 64)
            await brightest(imaging)
        assert await brightest(imaging, "next") >= 24.0 * 0.05
        assert len((await one.volumes()).volumes) == 2
        assert 24.0 * 0.02 <= await brightest(imaging) < 24.0 * 1.5 * 0.02

    run(work, limit=5 * 2**20)


def test_materials_of_a_sample_are_named_by_content_too(tmp_path: Path) -> None:
    async def work(
        server: ProjectorServer, one: Any, other: Any, pool: ProjectorPool
    ) -> None:
        imaging = Imaging(
            one, TrueGeometry(), SampleStore(open_data(tmp_path)), M.detector.pixels
        )
        channels, paths, *_ = await imaging.path_lengths(Sample("lego"), POSES, CAMERA)
        assert len(channels) == len(paths) > 1
        names = [v.name for v in (await one.volumes()).volumes]
        assert len(names) == len(channels)
        assert all(", material " in name and " #" in name for name in names)
        assert float(paths.max()) > 1.0

    run(work)


def test_digests_are_of_contents() -> None:
    data = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    one = Volume(data, 0.5)
    same = Volume(np.asfortranarray(data), (0.5, 0.5, 0.5))
    assert digest_of(one) == digest_of(same)
    others = [Volume(data + 1e-6, 0.5), Volume(data, 0.25), Volume(data, 0.5, (0.0, 0.0, 1.0)),
              Volume(data.reshape(3, 2, 4), 0.5)]  # fmt: skip
    scenes = [load_phantom(name).scene for name in ("lego", "normal-3", "normal-5")]
    digests = {digest_of(body) for body in [one, *others, *scenes]}
    assert len(digests) == 8
    assert digest_of(load_phantom("lego").scene) in digests
    corners = np.eye(4, 3)  # a tetrahedron
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    mesh = [
        TriangleMesh(corners, order(faces)) for order in (np.array, np.asfortranarray)
    ]
    assert digest_of(mesh[0]) == digest_of(mesh[1])
