"""A CTSimU scenario to its images: `flexdt simulate`, and `flexdt.simulate(SCENARIO)` in
Python.

`ctsimu_scan` reads the scenario; exact paths through the samples' meshes, the spectrum,
scatter and blur are those of `flexdt.simulate`. Only the detector's conversion of
collected energy differs: a scenario gives gray values and a signal-to-noise ratio.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np

from flexdt import DataSet
from flexdt.extending import tiff_bytes
from flexdt.library.datasets.exchange import text_of
from flexdt.phantoms import Material
from flexdt.phantoms.channels import Channel, scatter_object
from flexdt.phantoms.files.mesh_files import read_mesh
from flexdt.twin.attenuation import Substance
from flexdt.twin.errors import LimitError
from flexdt.twin.exchange import ExchangeError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.physics import (
    FWHM,
    Beam,
    Counts,
    EffectiveBeam,
    PixelPaths,
    Rays,
    ScanScatter,
    ScatterSettings,
    blurred,
    check_rays,
    edges_needed,
    effective_beam,
    flux_of,
    frame_rng,
    scan_scatter,
    spot_blur_px,
    transmitted,
)
from flexdt.twin.projection import (
    TriangleMesh,
    Within,
    paths_within,
    project_mesh,
    rays_needed,
)
from flexdt_extensions.ctsimu.ctsimu_scan import MeshSample, Reference, read_scenario

KEV_J: Final = 1.602176634e-16
FORMAT: Final = {"major": 1, "minor": 2}


class ScenarioImages:
    """The images of a scenario, each computed on access.

    Args:
        path: the scenario; the files that it names are in its folder.
        seed: of the noise, >= 0; None for images without noise.
        rays: along each side of a pixel that an edge of a sample reaches, whose signals
            are averaged; "auto" keeps the error on an edge below the scenario's noise, or
            the rounding to gray values, as `flexdt.simulate` does.

    Raises:
        ExchangeError, TwinError: a request of the scenario that is not possible, and its
            place.
        OSError: a file cannot be read.
    """

    def __init__(
        self, path: str | os.PathLike[str], seed: int | None = None, rays: Rays = "auto"
    ) -> None:
        """Read a scenario and the meshes of its samples.

        Args:
            path: file.
            seed: of the noise; None: without noise.
            rays: along each side of a pixel that an edge reaches, or "auto".

        Raises:
            LimitError: seed or rays out of their range.
            ExchangeError: no scenario that can be simulated.
        """
        if not 0 <= (seed or 0) <= 2**63:
            raise LimitError(f"seed is {seed}; allowed: 0 to 2^63", {"asked": seed})
        self._rays = check_rays(rays)
        self.path = Path(path)
        self._seed = seed
        self.scan = read_scenario(
            text_of(self.path), str(self.path), self._read_named_file
        )
        self._meshes = [self._mesh(sample) for sample in self.scan.samples]
        found: dict[Substance, float] = {}
        for sample, mesh in zip(self.scan.samples, self._meshes, strict=True):
            reach = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
            found[sample.substance] = found.get(sample.substance, 0.0) + reach
        self._thickest = found

    def _read_named_file(self, name: str) -> str:
        """Read the text of a file that the scenario names, relative to the scenario's
        folder.

        Raises:
            ExchangeError: it cannot be read.
        """
        try:
            return text_of(self.path.parent / name)
        except (OSError, ValueError) as error:
            raise ExchangeError(
                f"{self.path} names {name!r}: {error}", {"path": name}
            ) from None

    def _mesh(self, sample: MeshSample) -> TriangleMesh:
        """Read a sample's mesh, from the scenario's folder, centered on its bounding box
        and scaled to mm.

        Raises:
            OSError, TwinError: it cannot be read.
        """
        found = read_mesh(self.path.parent / sample.file)
        corners = np.asarray(found.vertices, dtype=np.float64)
        middle = (corners.min(axis=0) + corners.max(axis=0)) / 2.0
        return TriangleMesh((corners - middle) * sample.scale_mm, np.asarray(found.faces))

    # The X-rays

    @cached_property
    def _beams(self) -> list[EffectiveBeam]:
        """Effective beam of each spectrum, with the detector's response, through all
        substances, the surroundings included, up to the thickest path.
        """
        substances = list(self._thickest)
        thick = list(self._thickest.values())
        if self.scan.environment is not None:
            substances.append(self.scan.environment)
            thick.append(max(float(self._distance(i).max()) for i in range(len(self))))
        signals = [spectrum * self.scan.response for spectrum in self.scan.spectra]
        return [
            effective_beam(s, s * self.scan.response, substances, thick) for s in signals
        ]

    def _distance(self, frame: int) -> Float32Array:
        """Compute the distance from the source to each pixel's center in a frame, (rows,
        cols) [mm].
        """
        row = self.scan.views[frame]
        (rows, cols) = self.scan.shape
        v = np.arange(rows)[:, None, None] - (rows - 1) / 2
        u = np.arange(cols)[None, :, None] - (cols - 1) / 2
        pixels = row[3:6] - row[0:3] + u * row[6:9] + v * row[9:12]
        return np.asarray(np.linalg.norm(pixels, axis=2), dtype=np.float32)

    def _with_air(self, paths: Float32Array, distance: Float32Array) -> Float32Array:
        """Add the environment, if there is one, as the last layer: what the samples leave
        of the distance to the pixel's center, at least 0 [mm]."""
        if self.scan.environment is None:
            return paths
        rest = np.maximum(distance - paths.sum(axis=0), np.float32(0.0))
        return np.concatenate([paths, rest[None]])

    def _through(
        self, frame: int, project: Callable[[TriangleMesh, ConeVec], Float32Array]
    ) -> Float32Array:
        """Sum what `project` finds of the meshes of each substance in a frame, one layer a
        substance, in the order of `_thickest` [mm]."""
        layers = {one: np.zeros((), np.float32) for one in self._thickest}
        for sample, mesh in zip(self.scan.samples, self._meshes, strict=True):
            found = project(mesh, ConeVec(sample.views[frame][None]))
            layers[sample.substance] = layers[sample.substance] + found
        return np.stack(list(layers.values()))

    def _areas(self, frame: int) -> PixelPaths | None:
        """Compute paths along the rays of the pixels of a frame that need several; None for
        one ray a pixel."""
        shape = self.scan.shape
        view = self.scan.views[frame]
        blur = min(spot_blur_px(view, one * FWHM) for one in self.scan.spot_mm)
        need = edges_needed(self._rays, self._open_noise, blur)
        if need is None:
            return None
        beam = self._beams[self.scan.spectrum_of[frame]]
        mu = beam.mean_mu()
        if self.scan.environment is not None:
            mu = mu[:-1] - mu[-1]  # samples are in place of the environment
        weights = dict(zip(self._thickest, mu.tolist(), strict=True))
        marks = [
            rays_needed(
                mesh, ConeVec(one.views[frame][None]), shape, need, weights[one.substance]
            )
            for one, mesh in zip(self.scan.samples, self._meshes, strict=True)
        ]
        within = Within.joined([Within.of(some) for some in marks])
        paths = self._through(frame, lambda m, cone: paths_within(m, cone, shape, within))
        distance = self._distance(frame).reshape(-1)[within.pixels]
        return PixelPaths(within, self._with_air(paths, within.repeated(distance)))

    def _collected_energy(
        self, frame: int, samples: bool = True
    ) -> tuple[Float32Array, Float32Array]:
        """Compute the energy in each pixel of one frame, and its variance, before the
        detector blurs.

        The signals of a pixel's rays are averaged and blurred by the focal spot; with
        samples scatter is added. Both are scaled by distance and mAs.

        Args:
            frame: number of the frame.
            samples: with the samples; False is the open beam.

        Returns:
            Mean [keV] and variance [keV^2], (rows, cols) each.
        """
        scan = self.scan
        beam = self._beams[scan.spectrum_of[frame]]
        areas = None
        paths = np.zeros((len(self._thickest), *scan.shape), np.float32)
        if samples and scan.samples:
            paths = self._through(
                frame, lambda mesh, cone: project_mesh(mesh, cone, scan.shape)[0]
            )
            areas = self._areas(frame)
        mean, spread = transmitted(
            beam, self._with_air(paths, self._distance(frame)), areas
        )
        view = scan.views[frame]
        u, v = (float(np.linalg.norm(view[i : i + 3])) for i in (6, 9))
        spot = [spot_blur_px(view, one * FWHM) for one in scan.spot_mm]
        mean, spread = (blurred(one, spot[0], spot[1] * u / v) for one in (mean, spread))
        if samples and self._scatter is not None:
            mean = mean + self._scatter[frame].signal * np.float32(beam.signal.sum())
            spread = spread + self._scatter[frame].variance * np.float32(beam.noise.sum())
        flux = flux_of(view, scan.shape) * np.float32(scan.mAs[frame])
        return mean * flux, spread * flux

    @cached_property
    def _scatter(self) -> ScanScatter | None:
        """Scatter of all frames by the samples on the stage, with the first spectrum;
        None where the scenario has none or no sample.
        """
        scan = self.scan
        if not scan.scattering or not scan.samples:
            return None
        parts = []
        reach = np.zeros(3)
        for sample, mesh in zip(scan.samples, self._meshes, strict=True):
            assert sample.on_stage is not None
            center, axes = sample.on_stage
            there = TriangleMesh(center + mesh.vertices @ axes.T, mesh.faces)
            reach = np.maximum(reach, np.abs(there.vertices).max(axis=0))
            parts.append(Channel(_made_of(sample.substance), there, 0.0))
        x, y, z = (2.0 * reach).tolist()
        settings = ScatterSettings(collimated=True, seed=self._seed or 0)
        grid = scatter_object(parts, (x, y, z), settings.voxels)
        response = scan.response
        beam = Beam(scan.spectra[0] * response, response, response**2)
        return scan_scatter(grid, scan.views, scan.shape, beam, settings)

    # The detector

    @cached_property
    def _open(self) -> tuple[Float32Array, Float32Array]:
        """Energy and variance of the open beam, (rows, cols) each.

        Raises:
            ExchangeError: nothing reaches the detector.
        """
        nothing = ExchangeError(
            f"{self.path}: nothing of the open beam reaches and stays in the detector; "
            "allowed: thinner windows, filters and environment, a thicker scintillator"
        )
        try:
            energy, variance = self._collected_energy(0, samples=False)
        except LimitError:  # too little for an effective energy
            raise nothing from None
        if not min(energy.max(), variance.max()) > 0.0:
            raise nothing
        return energy, variance

    @cached_property
    def _open_noise(self) -> float:
        """Noise of the brightest open pixel in a projection relative to its gray value, that
        of rounding included (standard deviation)."""
        grey = self.scan.grey
        ratio = grey.snr
        if grey.noise is not None:
            ratio = float(np.interp(self.brightest, grey.noise[:, 0], grey.noise[:, 1]))
        counted = 0.0 if ratio is None else 1.0 / max(ratio, 1e-9)
        rounded = 1.0 / (np.sqrt(12.0) * max(self.brightest, 1.0))
        return float(np.hypot(counted / np.sqrt(self.scan.averages), rounded))

    @property
    def brightest(self) -> float:
        """Grey value of the brightest open pixel in the first frame."""
        return float(self._grey(self._open[0].max(keepdims=True)).max())

    def _grey(self, energy: Float32Array) -> Float32Array:
        """Convert collected energy [keV] to gray values: linearly to the range if it has
        a maximum (that of the brightest open beam), else by the table over energy [J],
        else by offset and factor.
        """
        grey = self.scan.grey
        if grey.imax is not None:
            values = (
                grey.imin + (grey.imax - grey.imin) / float(self._open[0].max()) * energy
            )
        elif grey.table is not None:
            values = np.interp(energy * KEV_J, grey.table[:, 0], grey.table[:, 1])
        else:
            values = grey.offset + (grey.factor or 0.0) * KEV_J * energy
        return np.asarray(values, dtype=np.float32)

    def _blur(self, image: Float32Array) -> Float32Array:
        """Apply the detector's blur, a Gaussian or the file's MTF.

        Edges are continued outwards; frequencies beyond the file's are removed.

        Args:
            image: (rows, cols), unbinned.

        Returns:
            The blurred image. A Gaussian has the detector's resolution less the pixel's
            own width.
        """
        grey = self.scan.grey
        view = self.scan.views[0]
        u, v = (float(np.linalg.norm(view[i : i + 3])) for i in (6, 9))
        if grey.mtf is None:
            # The resolution of a detector is that with its pixels.
            rest = (
                np.sqrt(max((grey.blur_mm / one) ** 2 - 1 / 12, 0.0)) for one in (u, v)
            )
            return blurred(image, *map(float, rest))
        wide = max(image.shape) // 2
        padded = np.pad(image, wide, mode="edge")
        frequency = np.hypot(
            np.fft.fftfreq(padded.shape[0], v)[:, None],
            np.fft.rfftfreq(padded.shape[1], u),
        )
        curve = (
            np.interp(frequency, grey.mtf[:, 0], grey.mtf[:, 1], right=0.0)
            / grey.mtf[0, 1]
        )
        back = np.fft.irfft2(np.fft.rfft2(padded) * curve, padded.shape)
        return np.asarray(back[wide:-wide, wide:-wide], dtype=np.float32)

    def _read_out(
        self,
        energy: Float32Array,
        variance: Float32Array,
        averages: int,
        noise: int | None,
    ) -> FloatArray:
        """Compute the gray values of the binned pixels.

        In this order: blur, conversion, noise, clipping to 0 and the detector's largest
        value, mean over each binned pixel. There is no noise without a seed.

        Args:
            energy, variance: (rows, cols), unbinned.
            averages: frames in the image.
            noise: the image's number, for its random numbers; None for no noise.
        """
        grey = self.scan.grey
        values = self._grey(self._blur(energy))
        if noise is not None and self._seed is not None:
            if grey.noise is not None:
                ratio = np.interp(values, grey.noise[:, 0], grey.noise[:, 1])
                sigma = values / np.maximum(ratio, 1e-9)
            elif grey.snr is not None:
                brightest = float(self._open[1].max())
                sigma = np.sqrt(variance / brightest) * (self.brightest / grey.snr)
            else:
                sigma = np.zeros_like(values)
            draw = frame_rng(self._seed, noise).standard_normal(
                values.shape, dtype=np.float32
            )
            values = values + draw * (sigma / np.sqrt(averages)).astype(np.float32)
        top = 2.0**grey.bits - 1.0
        (b, c) = self.scan.binning
        rows, cols = (n // k for n, k in zip(self.scan.shape, (b, c), strict=True))
        blocks = np.clip(values, 0.0, top).reshape(rows, b, cols, c)
        return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float64))

    def _references(
        self, asked: Reference, lit: bool, first: int
    ) -> Iterator[FloatArray]:
        """Yield dark (or `lit` flat) images, (rows, cols), binned.

        Args:
            asked: their number, averages, and whether they are ideal, without noise.
            lit: flat images instead of dark ones.
            first: number of the first one's noise.
        """
        energy, variance = (
            self._open if lit else (np.zeros(self.scan.shape, np.float32),) * 2
        )
        for k in range(asked.number):
            number = None if asked.ideal else first + k
            yield self._read_out(energy, variance, asked.averages, number)

    # The images

    def __len__(self) -> int:
        return len(self.scan.views)

    def darks(self) -> list[Counts]:
        """Compute the dark images, uint16 (rows, cols)."""
        return [self._counts(one) for one in self._references(self.scan.dark, False, 0)]

    def flats(self) -> list[Counts]:
        """Compute the flat images, uint16 (rows, cols); their noise is numbered after the
        dark images'.
        """
        first = self.scan.dark.number
        return [
            self._counts(one) for one in self._references(self.scan.flat, True, first)
        ]

    def projections(self) -> Iterator[Counts]:
        """Yield the projections in order.

        With lag each frame keeps a part of the frame before; the first has none. They are
        corrected by the mean dark and flat images where the scenario says so.

        Yields:
            uint16 (rows, cols).
        """
        scan = self.scan
        lag = self.scan.grey.lag
        if scan.dark.correction:
            dark = np.mean(self.darks(), axis=0)
        else:
            dark = 0.0
        gain = None
        if scan.flat.correction:
            gain = self.brightest / np.maximum(np.mean(self.flats(), axis=0) - dark, 1e-9)
        before: Float32Array | None = None
        first = scan.dark.number + scan.flat.number
        for i in range(len(self)):
            energy, variance = self._collected_energy(i)
            if lag > 0.0:
                # Each frame keeps the part `lag` of the previous one.
                if before is None:
                    left = np.zeros_like(energy)
                else:
                    left = before - energy
                n = scan.averages
                before = energy + left * np.float32(lag**n)
                energy = energy + left * np.float32(lag * (1 - lag**n) / (1 - lag) / n)
            values = self._read_out(energy, variance, scan.averages, first + i) - dark
            yield self._counts(values if gain is None else values * gain)

    def _counts(self, values: FloatArray) -> Counts:
        return np.clip(np.rint(values), 0.0, 2.0**self.scan.grey.bits - 1.0).astype(
            np.uint16
        )

    def dataset(self) -> DataSet:
        """Collect all images in a data set in memory, with the geometry that
        reconstruction knows.

        Where the scenario corrects projections, dark images are zero and flat ones
        uniform.

        Without dark or flat images in the scenario the data set has none either.
        """
        scan = self.scan
        darks = self.darks()
        flats = self.flats()
        dark: Any = np.stack(darks) if darks else None
        flat: Any = np.stack(flats) if flats else None
        counts = np.stack(list(self.projections()))
        if scan.dark.correction and dark is not None:
            dark = np.zeros_like(dark)
            if flat is not None:
                flat = flat - np.mean(darks, axis=0)
        if scan.flat.correction:
            flat = np.full(counts.shape[1:], round(self.brightest), np.uint16)
        if flat is not None:
            flat = np.rint(np.maximum(flat, 0.0))
        made = DataSet.from_arrays(
            counts,
            scan.geometry.cone_vec,
            dark=dark,
            flat=flat,
            name=self.path.stem,
            warnings=scan.notes,
            truth=self,
        )
        return replace(made, full_scale=2**scan.grey.bits - 1)

    def write(self, folder: str | os.PathLike[str]) -> Path:
        """Write all images as TIFF, and CTSimU's metadata, into a new folder.

        The folder appears only when everything is in it; after an error nothing is left.
        An empty folder is replaced.

        Returns:
            Path of the metadata file.

        Raises:
            ExchangeError: the folder exists and is not empty, or a file has its name.
            OSError: it cannot be written.
        """
        folder = Path(folder).absolute()
        stem = self.path.stem
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise ExchangeError(
                f"{folder} exists; allowed: a new folder, or an empty one",
                {"path": str(folder)},
            )
        folder.parent.mkdir(parents=True, exist_ok=True)
        part = folder.with_name(f".{folder.name}.{os.getpid()}.part")
        part.mkdir()
        try:
            names = {}
            for kind, images in (("dark", self.darks()), ("flat", self.flats())):
                if len(images) == 1:
                    pattern = f"{stem}_{kind}.tif"
                else:
                    pattern = f"{stem}_{kind}_%04d.tif"
                names[kind] = pattern if images else None
                for k, image in enumerate(images):
                    if "%" in pattern[len(stem) :]:
                        name = pattern % k
                    else:
                        name = pattern
                    (part / name).write_bytes(tiff_bytes(image))
            for i, image in enumerate(self.projections()):
                (part / f"{stem}_{i:04d}.tif").write_bytes(tiff_bytes(image))
            about = json.dumps(
                self._metadata(folder, names), indent=1, ensure_ascii=False
            )
            (part / f"{stem}_metadata.json").write_text(about + "\n", encoding="utf-8")
            if folder.exists():
                folder.rmdir()
            part.replace(folder)
        finally:
            shutil.rmtree(part, ignore_errors=True)
        return folder / f"{stem}_metadata.json"

    def _metadata(self, folder: Path, names: dict[str, str | None]) -> dict[str, Any]:
        """Make the JSON object of CTSimU's metadata of the written images, with today's
        date.

        Args:
            folder: of the images.
            names: file pattern of dark and flat images; None for none.
        """
        own = Path(os.path.relpath(self.path.absolute(), folder)).as_posix()
        scan = self.scan
        today = datetime.now(UTC).date().isoformat()
        rows, cols = scan.geometry.shape or (0, 0)
        pitch = scan.geometry.pitch_mm

        def size(values: tuple[float, float], unit: str) -> dict[str, Any]:
            return {
                a: {"value": x, "unit": unit} for a, x in zip("xy", values, strict=True)
            }

        def images(kind: str, asked: Reference) -> dict[str, Any]:
            """Describe dark or flat images (`kind`) for the metadata file: number,
            averages, file name, and whether projections are corrected.
            """
            return {
                "number": asked.number,
                "frame_average": asked.averages,
                "filename": names[kind],
                "projections_corrected": asked.correction,
            }

        return {
            "file": {
                "name": self.path.stem,
                "description": scan.geometry.name,
                "contact": "",
                "date_created": today,
                "date_changed": today,
                "file_type": "CTSimU Metadata",
                "file_format_version": FORMAT,
            },
            "output": {
                "system": f"flexdt {version('flexdt')}",
                "date_measured": today,
                "projections": {
                    "filename": f"{self.path.stem}_%04d.tif",
                    "number": len(self),
                    "frame_average": scan.averages,
                    "max_intensity": self.brightest,
                    "datatype": "uint16",
                    "byteorder": "little",
                    "headersize": {"file": 0, "image": 0},
                    "dimensions": size((cols, rows), "px"),
                    "pixelsize": size(pitch, "mm"),
                    "dark_field": images("dark", scan.dark),
                    "flat_field": images("flat", scan.flat),
                    "bad_pixel_map": {"filename": None, "projections_corrected": False},
                },
                "tomogram": None,
            },
            "acquisition_geometry": {"path_to_CTSimU_JSON": own},
            "reconstruction": {"software": None, "settings": {}},
            "simulation": {
                "flexdt": {
                    "seed": self._seed,
                    "rays": self._rays,
                    "notes": list(scan.notes),
                },
                "ctsimu_scenario": {},
            },
        }


def _made_of(substance: Substance) -> Material:
    """Wrap a substance for the scatter's grid, which needs nothing else."""
    return Material(substance.name, "", substance, 0.0, "")


def dataset(path: str | os.PathLike[str], seed: int | None, rays: Rays) -> DataSet:
    """Simulate a scenario for `flexdt.simulate`; see `ScenarioImages`."""
    return ScenarioImages(path, seed, rays).dataset()
