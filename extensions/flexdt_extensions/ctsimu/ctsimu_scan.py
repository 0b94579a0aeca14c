"""A CTSimU scenario to all data of a simulation: geometry, samples, tube, detector, scan.

A request of the scenario that cannot be simulated is an error that names its place;
values that are not used become notes. Nothing is ignored in silence.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, TypeVar

import numpy as np

from flexdt.twin.attenuation import Substance, mass_fractions, parse_formula, tables
from flexdt.twin.errors import TwinError
from flexdt.twin.exchange import ExchangeError, ScanGeometry, read_json
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.physics import (
    Filter,
    Spectrum,
    TubeModel,
    deposited,
    monochromatic,
    tube_spectrum,
)
from flexdt_extensions.ctsimu.ctsimu_read import (
    MM,
    MOST,
    NUMBER,
    STAGE,
    WORLD,
    Beside,
    Pose,
    ScenarioReader,
    Watched,
    drifts_of,
    place,
    seen_from,
)

_KV: Final = {"kV": 1.0, "V": 1e-3, "MV": 1e3}
_MA: Final = {"mA": 1.0, "uA": 1e-3, "A": 1e3}
_S: Final = {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
_G_CM3: Final = {"g/cm^3": 1.0, "kg/m^3": 1e-3}
_PER_J: Final = {"1/J": 1.0}
_MIN_CHANGE: Final = 1e-9
"""Changes of place [mm] and direction that count as zero."""
DUPLEX_WIRE: Final = 0.69
"""Standard deviation of a Gaussian over its basic spatial resolution: two bars at a
distance of their width show a dip of 20 % (ASTM E2597)."""
T = TypeVar("T")
D = TypeVar("D", float, None)


@dataclass(frozen=True, eq=False)
class MeshSample:
    """A sample: a closed surface filled with one substance.

    Attributes:
        where: its place in the scenario, for errors.
        file: name of the surface in the scenario; the middle of its box is the sample's
            origin.
        scale_mm: millimeters for each unit of the file, along r, s, t.
        substance: filling.
        views: (n, 12) cone_vec rows of the unbinned pixels in the sample's r, s, t [mm].
        on_stage: center (3,) and axes as columns (3, 3) in the stage's frame; None if it
            moves.
    """

    where: str
    file: str
    scale_mm: FloatArray
    substance: Substance
    views: FloatArray
    on_stage: tuple[FloatArray, FloatArray] | None


@dataclass(frozen=True)
class Reference:
    """Dark or flat images: how many, of how many frames each, whether without noise, and
    whether the projections are corrected with them."""

    number: int
    averages: int
    ideal: bool
    correction: bool


@dataclass(frozen=True, eq=False)
class GreyValues:
    """How the energy that a pixel collects becomes its gray value.

    Attributes:
        imin, imax: without X-rays and of the brightest open pixel of the first frame; `imax` is
            None where one of the next two is given.
        factor, offset: gray values for each joule, and without any.
        table: (k, 2) joules and gray value.
        snr: signal-to-noise ratio of the brightest open pixel; None: no noise.
        noise: (k, 2) gray value and its signal-to-noise ratio, instead of `snr`.
        blur_mm: standard deviation of the unsharpness.
        mtf: (k, 2) frequency [1/mm] and modulation, instead of it.
        lag: part of a frame's signal that the next one still shows.
        bits: depth of the converter.
    """

    imin: float
    imax: float | None
    factor: float | None
    offset: float
    table: FloatArray | None
    snr: float | None
    noise: FloatArray | None
    blur_mm: float
    mtf: FloatArray | None
    lag: float
    bits: int


@dataclass(frozen=True, eq=False)
class ScenarioScan:
    """Data of a scenario's images.

    Attributes:
        geometry: of the binned pixels, as reconstruction knows it and as it is.
        views: (n, 12) cone_vec rows of the unbinned pixels as they are, in the stage's
            frame [mm].
        shape, binning: unbinned pixels that are used, and how many are binned, (rows,
            cols) each.
        samples: the objects.
        environment: substance of the space between; None for vacuum.
        spectra: photons of each energy per cm2 and mAs at 1 m behind the tube's filters.
        spectrum_of: (n,) index into `spectra` of each projection.
        mAs: (n,) charge of one frame [mAs].
        spot_mm: standard deviations of the focal spot along the panel's u and v.
        response: (e,) energy that a photon leaves in the detector on average [keV].
        grey: the detector's conversion of energy to gray values.
        averages: frames in a projection.
        dark, flat: reference images.
        scattering: whether scatter is simulated.
        notes: doubts, and values that are not used.
    """

    geometry: ScanGeometry
    views: FloatArray
    shape: tuple[int, int]
    binning: tuple[int, int]
    samples: tuple[MeshSample, ...]
    environment: Substance | None
    spectra: tuple[FloatArray, ...]
    spectrum_of: tuple[int, ...]
    mAs: FloatArray
    spot_mm: tuple[float, float]
    response: FloatArray
    grey: GreyValues
    averages: int
    dark: Reference
    flat: Reference
    scattering: bool
    notes: tuple[str, ...]


def read_scenario(text: str, file: str, beside: Beside) -> ScenarioScan:
    """Read all data of a scenario's images.

    Args:
        text: the scenario, JSON.
        file: its name, for errors.
        beside: returns the text of a file by its name: drifts, spectrum, characteristics.

    Raises:
        ExchangeError: names file, key and the allowed values.
    """
    return _ScanReader(read_json(text, file, Watched), file, beside).scan()


class _ScanReader(ScenarioReader):
    def scan(self) -> ScenarioScan:
        """Read the complete scenario: geometry, samples, spectra, currents, detector and
        references.

        Samples of vacuum are left out.

        Returns:
            The scan; its notes list values that are not used.

        Raises:
            ExchangeError: names file, key and the allowed values.
        """
        self._notes: list[str] = []
        size = [self._size("detector", name) for name in ("rows", "columns")]
        bins = self._bins(*size)[::-1]
        geometry = self.geometry()
        self._substances = dict(
            self._material_of(one, f"materials[{i}]")
            for i, one in enumerate(self._list("materials"))
        )
        parts = {name: self._part(name) for name in ("source", "detector", "stage")}
        pitch = [
            self._constant(MM, "detector", "pixel_pitch", axis, default=0.0)
            for axis in "uv"
        ]
        poses = self._poses(parts, self._angles(), pitch, True)
        views = np.array([seen_from(pose, *pose[4:]) for pose in poses])
        samples = [
            self._sample(one, f"samples[{i}]", poses)
            for i, one in enumerate(self._list("samples"))
        ]
        spectra, which = self._spectra()
        mAs = self._series(_MA, "source", "current", default=1.0)
        mAs = mAs * self._series(_S, "detector", "integration_time", default=1.0)
        rows, cols = (n // b * b for n, b in zip(size, bins, strict=True))
        response = self._response()
        grey = self._grey()
        scan = ScenarioScan(
            geometry,
            views,
            (rows, cols),
            bins,
            tuple(s for s in samples if s is not None),
            self._material(
                self._given("environment", "material_id"), "environment.material_id"
            ),
            spectra,
            which,
            mAs,
            self._spot(),
            response,
            grey,
            self._natural("acquisition", "frame_average"),
            self._reference("dark_field"),
            self._reference("flat_field"),
            self._flag("acquisition", "scattering"),
            (),
        )
        self._check(scan)
        told = geometry.accounted(self.account(images=True)).notes
        return replace(scan, notes=(*told, *self._notes))

    def _check(self, scan: ScenarioScan) -> None:
        """Check that a scan with scattering has one spectrum, and samples that rest on
        the stage; others are not checked.

        Raises:
            ExchangeError: it has not.
        """
        varies = len(scan.spectra) > 1
        if scan.scattering and (varies or any(s.on_stage is None for s in scan.samples)):
            raise self._error(
                "acquisition.scattering",
                "false, where the spectrum or a sample's place on the stage changes in the scan",
            )

    # Geometry

    def _sample(self, given: object, where: str, poses: list[Pose]) -> MeshSample | None:
        """Read a sample: mesh, scale, substance and place in every frame.

        Its place on the stage is None if it moves against the stage by `_MIN_CHANGE` or
        more.

        Args:
            given: its object in the scenario.
            where: its place, for errors.
            poses: of source, panel and stage, one for each frame.

        Returns:
            The sample; None for vacuum, with a note.

        Raises:
            ExchangeError: names file, key and the allowed values.
        """
        if not isinstance(given, dict) or not isinstance(given.get("position"), dict):
            raise self._error(
                where, "an object with file, unit, material_id and position"
            )
        name = self._text(given.get("file"), f"{where}.file")
        if name is None:
            raise self._error(
                f"{where}.file", "the name of a surface mesh, such as part.stl"
            )
        unit = self._factor(given.get("unit"), MM, where)
        factors = given.get("scaling_factor") or {}
        if not isinstance(factors, dict):
            raise self._error(f"{where}.scaling_factor", "r, s and t")
        scale = [
            self._plain(factors.get(a), NUMBER, f"{where}.scaling_factor.{a}", 1.0)
            for a in "rst"
        ]
        if min(scale) <= 0.0:
            raise self._error(f"{where}.scaling_factor", "above 0")
        substance = self._material(given.get("material_id"), f"{where}.material_id")
        part = self._read_part(given["position"], f"{where}.position", (STAGE, WORLD))
        still = np.zeros(self._count)
        views = np.empty((self._count, 12))
        there: list[tuple[FloatArray, FloatArray]] = []
        for i, pose in enumerate(poses):
            stage, turn = pose[4:]
            center, axes = place(part, still, i, True, (stage, turn))
            if part.on_stage:
                there.append((center, axes))
                center = stage + turn @ center
                axes = turn @ axes
            else:
                there.append((turn.T @ (center - stage), turn.T @ axes))
            views[i] = seen_from(pose, center, axes)
        moves = max(
            float(np.abs(a - b).max())
            for one in there
            for a, b in zip(one, there[0], strict=True)
        )
        if substance is None:
            self._notes.append(f"{where} is of vacuum and left out")
            return None
        return MeshSample(
            where,
            name,
            unit * np.array(scale),
            substance,
            views,
            there[0] if moves < _MIN_CHANGE else None,
        )

    # Materials

    def _material_of(self, given: object, where: str) -> tuple[str, Substance | None]:
        """Read a material: density and mass fractions of its elements.

        Fractions are normalized to 1. A density of 0, or a composition without an amount,
        is vacuum.

        Args:
            given: its object in the scenario.
            where: its place, for errors.

        Returns:
            Its id, and the substance; None for vacuum.

        Raises:
            ExchangeError: names file, key and the allowed values.
        """
        if not isinstance(given, dict) or not isinstance(given.get("id"), str):
            raise self._error(where, "an object with id, density and composition")
        density = self._plain(given.get("density"), _G_CM3, f"{where}.density", 0.0)
        parts = given.get("composition")
        amounts: dict[str, float] = {}
        for i, part in enumerate(parts if isinstance(parts, list) else [parts]):
            at = f"{where}.composition[{i}]"
            if not isinstance(part, dict):
                raise self._error(at, "an object with formula and mass_fraction")
            formula = self._text(part.get("formula"), f"{at}.formula") or ""
            whole = self._plain(
                part.get("mass_fraction"), NUMBER, f"{at}.mass_fraction", 1.0
            )
            if formula.strip() and whole > 0.0:
                for symbol, x in self._make_value(
                    at, _fractions, "".join(formula.split())
                ).items():
                    amounts[symbol] = amounts.get(symbol, 0.0) + whole * x
        total = sum(amounts.values())
        if density <= 0.0 or not total > 0.0:
            return given["id"], None
        shares = tuple((symbol, x / total) for symbol, x in amounts.items())
        return given["id"], self._make_value(
            where, Substance, given["id"], shares, density
        )

    def _material(self, name: object, where: str) -> Substance | None:
        """Return the substance of a material's id; None for None (vacuum). Raises on an
        unknown id, listing those known.
        """
        if name is None:
            return None
        if not isinstance(name, str) or name not in self._substances:
            raise self._error(
                where, f"the id of a material: {', '.join(self._substances)}"
            )
        return self._substances[name]

    def _layers(self, *path: str) -> tuple[Filter, ...]:
        """Read the list of filter layers at a path; layers of vacuum or without thickness
        are left out, and a missing list is ().

        Raises:
            ExchangeError: as `_layer`.
        """
        where = ".".join(path)
        found = [
            self._layer(one, f"{where}[{i}]") for i, one in enumerate(self._list(*path))
        ]
        return tuple(layer for layer in found if layer is not None)

    def _layer(self, given: object, where: str) -> Filter | None:
        """Read a thickness of a material.

        Args:
            given: object with material_id and thickness.
            where: its path, for messages.

        Returns:
            The layer; None for vacuum or no thickness.

        Raises:
            ExchangeError: another form, or more than 1000 mm.
        """
        if not isinstance(given, dict):
            raise self._error(where, "an object with material_id and thickness")
        substance = self._material(given.get("material_id"), f"{where}.material_id")
        thick = self._plain(given.get("thickness"), MM, f"{where}.thickness", 0.0)
        if not 0.0 <= thick <= 1e3:
            raise self._error(f"{where}.thickness", "0 to 1000 mm")
        if substance is None or not thick:
            return None
        return Filter(substance, thick)

    # Tube

    def _spectra(self) -> tuple[tuple[FloatArray, ...], tuple[int, ...]]:
        """Compute the spectra of the tube behind its filters.

        They are read from files, or else those of a tungsten tube by voltage [kV] behind
        its window, or lines of one energy.

        Returns:
            Photons per cm2 and mAs at 1 m of each spectrum that occurs, and the index of
            each frame's.

        Raises:
            ExchangeError: names file, key and the allowed values, also if the filters let
                nothing through.
        """
        at = "source.spectrum"
        single = self._flag("source", "spectrum", "monochromatic")
        files = self._texts(self._given("source", "spectrum", "file"), f"{at}.file")
        behind = self._layers("source", "filters")
        if any(files):
            keys: list[Any] = [self._text(name, f"{at}.file") for name in files]
            made = {
                name: self._read_spectrum(name, f"{at}.file")
                for name in dict.fromkeys(keys)
            }
            for name in (
                "voltage",
                "target",
                "window",
            ):  # tube settings of the file's spectrum
                self._at("source").get(name)
        else:
            keys = self._series(_KV, "source", "voltage").tolist()
            behind = (*self._layers("source", "window"), *behind)
            if not single:
                self._check_target()
            make = _line if single else _unfiltered_spectrum
            made = {
                kV: self._make_value("source.voltage", make, kV)
                for kV in dict.fromkeys(keys)
            }
        fluence = tuple(one.behind(*behind).fluence for one in made.values())
        if not min(one.sum() for one in fluence) > 0.0:
            raise self._error("source.filters", "filters that let some radiation through")
        order = {key: i for i, key in enumerate(made)}
        return fluence, tuple(order[key] for key in keys)

    def _check_target(self) -> None:
        """Check that the target is of tungsten, and add a note that its angle is not
        used.

        No material is taken for tungsten.

        Raises:
            ExchangeError: another material.
        """
        made_of = self._material(
            self._given("source", "target", "material_id"), "source.target.material_id"
        )
        if made_of is not None and made_of.fractions != (("W", 1.0),):
            raise self._error(
                "source.target.material_id", "tungsten, or a spectrum from a file"
            )
        for name in ("angle", "thickness"):
            self._given("source", "target", name)
        self._notes.append(
            "source.target: the spectrum is that of tungsten reflecting at 12 degrees, "
            "whatever type and angles are; source.spectrum.file states another"
        )

    def _read_spectrum(self, name: object, where: str) -> Spectrum:
        """Read the spectrum of a file into the tables' bins.

        Photons beyond the tables' energies are left out: more than 0.1 % of all below
        them with a note, more than 0.1 % above them are an error.

        Args:
            name: of the file: energy [keV] and photons / (s sr mA) about it.
            where: its place in the scenario, for errors.

        Returns:
            Photons per cm2 and mAs at 1 m.

        Raises:
            ExchangeError: fewer than two energies, some that do not grow or are too high,
                or negative photons.
        """
        energy, photons = self._numbers(name, where, 2).T
        if len(energy) < 2 or np.diff(energy).min() <= 0.0 or photons.min() < 0.0:
            raise self._error(where, "two or more growing energies, photons of 0 or more")
        middle = (energy[1:] + energy[:-1]) / 2.0
        edges = np.concatenate(
            [[2 * energy[0] - middle[0]], middle, [2 * energy[-1] - middle[-1]]]
        )
        bins = tables().energy_keV
        step = float(bins[1] - bins[0])
        ours = np.append(bins - step / 2, bins[-1] + step / 2)
        below = np.concatenate([[0.0], np.cumsum(photons)])
        amount = np.diff(np.interp(ours, edges, below))
        if below[-1] - np.interp(ours[-1], edges, below) > 1e-3 * below[-1]:
            raise self._error(where, f"energies up to {ours[-1]:g} keV")
        if np.interp(ours[0], edges, below) > 1e-3 * below[-1]:
            self._notes.append(f"{where}: photons below {ours[0]:g} keV are left out")
        return Spectrum(amount * 1e-4)  # a cm2 at 1 m is 1e-4 sr

    def _spot(self) -> tuple[float, float]:
        """Compute the focal spot's standard deviations along u and v [mm].

        A spot of a size is replaced by a Gaussian of the same standard deviation, with a
        note; one of a size of 6 sigma or more counts as complete. Without both it is 0.

        Raises:
            ExchangeError: a size or sigma below 0, or an intensity map.
        """
        where = ("source", "spot")
        self._nothing(*where, "intensity_map", "file")
        found = []
        for axis in "uv":
            size, sigma = (
                self._constant(MM, *where, name, axis, default=0.0)
                for name in ("size", "sigma")
            )
            if min(size, sigma) < 0.0:
                raise self._error("source.spot", "0 or more")
            if size > 0.0 and (sigma == 0.0 or size < 6.0 * sigma):
                self._notes.append(
                    f"source.spot: a Gaussian of the same width along {axis}"
                )
                x = np.linspace(-size / 2.0, size / 2.0, 1001)
                if sigma > 0.0:
                    weights = np.exp(-0.5 * (x / sigma) ** 2)
                else:
                    weights = np.ones(1001)
                sigma = float(np.sqrt((weights * x**2).sum() / weights.sum()))
            found.append(sigma)
        return found[0], found[1]

    # Detector

    def _response(self) -> FloatArray:
        """Compute the energy that a photon leaves in the detector on average.

        By the efficiency file, the scintillator (of type "real"), or all of it, which is
        noted for a missing scintillator.

        Returns:
            (e,) [keV] at the tables' energies, behind the detector's filters and window.
        """
        energy = tables().energy_keV
        kind = self._text(self._given("detector", "type"), "detector.type")
        if kind not in (None, "ideal", "real"):
            raise self._error("detector.type", "ideal or real")
        layers = self._layers("detector", "filters", "front")
        where = ("detector", "gray_value", "efficiency_characteristics_file")
        curve = self._table(2, *where)
        part = np.ones_like(energy)
        if curve is not None:
            part = np.interp(energy, curve[:, 0], curve[:, 1])
        else:
            layers = (*self._layers("detector", "window", "front"), *layers)
        if kind == "real" and curve is None:
            at = ("detector", "scintillator")
            screen = self._layer(self._given(*at) or {}, ".".join(at))
            if screen is None:
                self._notes.append(
                    "detector.scintillator is not given: all energy is absorbed"
                )
            else:
                part = deposited(screen).mean
        return part * energy * Spectrum(np.ones_like(energy)).behind(*layers).fluence

    def _grey(self) -> GreyValues:
        """Read the detector's gray values, noise, blur, lag and bits.

        Gray values are by a file or factor and offset, else by range. Photons of one
        energy need a range, unless their spectrum is from a file. Missing values are no
        noise, no blur, no lag and 16 bits.

        Returns:
            The conversion from energy to gray values.

        Raises:
            ExchangeError: names file, key and the allowed values.
        """
        at = ("detector", "gray_value")
        single = self._flag("source", "spectrum", "monochromatic")
        table = self._table(2, *at, "intensity_characteristics_file")
        imin, imax = (
            self._constant(NUMBER, *at, name, default=None) for name in ("imin", "imax")
        )
        factor = self._constant(_PER_J, *at, "factor", default=None)
        offset = self._constant(NUMBER, *at, "offset", default=0.0)
        if table is not None or factor is not None:
            if single and not self._given("source", "spectrum", "file"):
                raise self._error(
                    "detector.gray_value",
                    "imin and imax, where photons of one energy have no number",
                )
            imax = None
        elif imax is None or imax <= (imin or 0.0):
            raise self._error(
                "detector.gray_value", "imax above imin, or factor, or a file"
            )
        snr = self._constant(NUMBER, "detector", "noise", "snr_at_imax", default=None)
        blur = self._constant(
            MM, "detector", self._sharp(), "basic_spatial_resolution", default=0.0
        )
        lag = self._constant(NUMBER, "detector", "image_lag", default=0.0)
        bits = self._constant(NUMBER, "detector", "bit_depth", default=16.0)
        self._nothing("detector", "bad_pixel_map", "file")
        if snr is not None and snr <= 0.0:
            raise self._error("detector.noise.snr_at_imax", "above 0")
        if not 0.0 <= blur <= 100.0:
            raise self._error(
                "detector.unsharpness.basic_spatial_resolution", "0 to 100 mm"
            )
        if not 0.0 <= lag < 1.0:
            raise self._error("detector.image_lag", "0 or more, below 1")
        if bits not in range(1, 17):
            raise self._error("detector.bit_depth", "1 to 16")
        return GreyValues(
            imin or 0.0,
            imax,
            factor,
            offset,
            table,
            snr,
            self._table(2, "detector", "noise", "noise_characteristics_file"),
            blur * DUPLEX_WIRE,
            self._table(2, "detector", self._sharp(), "mtf"),
            lag,
            int(bits),
        )

    def _sharp(self) -> str:
        if "sharpness" in self._at("detector"):
            return "sharpness"
        return "unsharpness"

    def _reference(self, name: str) -> Reference:
        """Read how dark or flat images are taken: number (at least 1 if they correct the
        projections), averages, and whether they are ideal and correct the projections.
        """
        at = ("acquisition", name)
        correction = self._flag(*at, "correction")
        number = self._natural(*at, "number", default=0, least=int(correction))
        return Reference(
            number,
            self._natural(*at, "frame_average"),
            self._flag(*at, "ideal"),
            correction,
        )

    # Values

    def _given(self, *path: str) -> Any:
        """Return the value at a place; None where it or its object is missing or null.
        Raises if something on the way is not an object.
        """
        found: Any = self._document
        for i, key in enumerate(path):
            if not isinstance(found, dict):
                raise self._error(".".join(path[:i]), "an object")
            found = found.get(key)
            if found is None:
                return None
        return found

    def _list(self, *path: str) -> list[Any]:
        """Read the list at a path; empty without one.

        Raises:
            ExchangeError: something else is there.
        """
        found = self._given(*path)
        if found is not None and not isinstance(found, list):
            raise self._error(".".join(path), "a list")
        return found or []

    def _flag(self, *path: str) -> bool:
        """Read true or false at a path; False without one.

        Raises:
            ExchangeError: something else is there.
        """
        found = self._given(*path)
        if found not in (None, True, False):
            raise self._error(".".join(path), "true or false")
        return bool(found)

    def _natural(self, *path: str, default: int = 1, least: int = 1) -> int:
        """Read a whole number from `least` to MOST at a path; `default` without one.

        Raises:
            ExchangeError: something else is there.
        """
        found = self._given(*path)
        value = default if found is None else found
        if type(value) is not int or not least <= value <= MOST:
            raise self._error(".".join(path), f"a whole number from {least} to {MOST}")
        return value

    def _nothing(self, *path: str) -> None:
        """Check that a file that cannot be simulated is not given."""
        if any(self._texts(self._given(*path), ".".join(path))):
            raise self._error(".".join(path), "null; such files are not read")

    def _text(self, given: object, where: str) -> str | None:
        """Read a text; None without one.

        Raises:
            ExchangeError: something else, or a text that drifts.
        """
        if isinstance(given, dict):
            value = given.get("value")
        else:
            value = given
        if drifts_of(given) or not isinstance(value, str | None):
            raise self._error(where, "a text without drifts")
        return value or None

    def _texts(self, given: object, where: str) -> list[str | None]:
        """Return a text for each frame (n); drifts are lists or files of texts, spread
        evenly over the frames.

        Only the last drift counts. Without drifts every frame has the same text (None
        without one).

        Raises:
            ExchangeError: no list of texts, or something else than a text.
        """
        drifts = drifts_of(given)
        if not drifts:
            return [self._text(given, where)] * self._count
        if isinstance(drifts[-1], dict):
            last = drifts[-1]
        else:
            last = {}
        names = last.get("value")
        if isinstance(last.get("file"), str):
            names = (self._beside or str)(last["file"]).split()
        if not isinstance(names, list) or not all(
            isinstance(one, str) for one in names[:1]
        ):
            raise self._error(
                f"{where}.drifts", "a list of texts, or a file with one in each line"
            )
        given.get("value")  # type: ignore[attr-defined]
        steps = max(1, self._count - 1)
        return [
            self._text(names[i * (len(names) - 1) // steps], where)
            for i in range(self._count)
        ]

    def _table(self, columns: int, *path: str) -> FloatArray | None:
        """Read the numbers (n, columns) of the file named at a place, whose first column
        grows; None without a name.

        Raises:
            ExchangeError: no such table.
        """
        where = ".".join(path)
        name = self._text(self._given(*path), where)
        if name is None:
            return None
        table = self._numbers(name, where, columns)
        if np.diff(table[:, 0]).min(initial=1.0) <= 0.0:
            raise self._error(f"{where} ({name})", "a growing first column")
        return table

    def _plain(
        self, given: object, units: Mapping[Any, float], where: str, default: D
    ) -> float | D:
        """Read a number that is the same in all frames.

        Args:
            given: value or object from the document.
            units: unit -> factor.
            where: its path, for messages.
            default: returned if there is neither value nor drift.

        Raises:
            ExchangeError: no number, drifts without a value, or a number that drifts.
        """
        if given is None or (isinstance(given, dict) and given.get("value") is None):
            if drifts_of(given):
                raise self._error(where, "a value where there are drifts")
            return default
        frames = self._frames(given, where, units)
        if np.ptp(frames.real) > 0.0:
            raise self._error(f"{where}.drifts", "none: this is taken as constant")
        return float(frames.real[0])

    def _constant(self, units: Mapping[Any, float], *path: str, default: D) -> float | D:
        return self._plain(self._given(*path), units, ".".join(path), default)

    def _series(
        self, units: Mapping[Any, float], *path: str, default: float | None = None
    ) -> FloatArray:
        """Read the true values of a number above 0, one for each frame, drifts that
        reconstruction does not know included.

        Only a missing value takes the default; without a default it is an error.

        Args:
            units: unit -> factor.
            path: keys of the value.
            default: for all frames if there is no value.

        Returns:
            (n,).

        Raises:
            ExchangeError: no number, or one that is not above 0 in a frame.
        """
        where = ".".join(path)
        given = self._given(*path)
        if isinstance(given, dict):
            value = given.get("value")
        else:
            value = given
        if value is None and default is not None:
            return np.full(self._count, default)
        found = self._frames(given, where, units).real
        if found.min() <= 0.0:
            raise self._error(where, "above 0 in all frames")
        return found

    def _make_value(self, where: str, make: Callable[..., T], *given: Any) -> T:
        """Make a value from what the scenario gives; its error names `where`.

        Raises:
            ExchangeError: `make` raises a TwinError.
        """
        try:
            return make(*given)
        except TwinError as error:
            text = f"{self._file}: {where}: {error.message}"
            raise ExchangeError(text, {"path": where}) from None


def _fractions(formula: str) -> Mapping[str, float]:
    return mass_fractions(parse_formula(formula))


def _line(energy_keV: float) -> Spectrum:
    """Make the spectrum of one energy [keV]: one photon, shared linearly by the two bins
    about it.
    """
    bins = tables().energy_keV
    low = monochromatic(energy_keV)
    at = int(low.fluence.argmax())
    other = min(max(at + (1 if energy_keV > bins[at] else -1), 0), len(bins) - 1)
    part = abs(energy_keV - bins[at]) / (bins[1] - bins[0])
    low.fluence[at] = 1.0 - part
    low.fluence[other] = part if other != at else 1.0
    return low


def _unfiltered_spectrum(kV: float) -> Spectrum:
    return tube_spectrum(kV, TubeModel(()))
