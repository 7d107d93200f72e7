"""What several files of tests stand on: reference data beside a checkout, seeds, a mask, a satellite, a binary."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.special import j0
from torch import Tensor

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.observation import Observation
from torchmask.optics.aperture import Aperture, SparseAperture
from torchmask.optics.detector import Detector
from torchmask.optics.psf import psf_from_samples
from torchmask.optics.round import disc_otf
from torchmask.optics.zernike import ZernikePhase
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import SceneOptions, make_scene


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of the reference data; a test that asks for it is skipped where there is none."""
    folder = Path(__file__).parents[2] / "shared"
    if not folder.is_dir():
        pytest.skip("the reference data lie beside a checkout only")
    return folder


@pytest.fixture(scope="session")
def shared_stack(shared: Path) -> Callable[[str], Observation]:
    """Reads exposures that another program has simulated, by name: skylab_1e7_mask, mgs_1e6_full and others."""
    return lambda name: Observation.load(shared / "stacks" / f"{name}.npz")


@pytest.fixture(scope="session")
def mask_facts(shared: Path) -> dict[str, Any]:
    """What the catalogue was made from, by mask."""
    return json.loads((shared / "masks.json").read_text())["masks"]


@pytest.fixture(scope="session")
def niriss(shared: Path) -> Path:
    """Folder of real exposures, ab-dor_*.fits and hd-37093_*.fits."""
    return shared / "real" / "niriss"


@pytest.fixture(scope="session")
def seeded() -> Callable[[int], torch.Generator]:
    """A fresh generator from a seed."""
    return lambda seed: torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def coarse_figures() -> Iterator[None]:
    """Figures are saved at a quarter of their size and without layout, for files that do not ask how they look.

    Everything is drawn all the same; tests/viz looks at figures as they are.
    """
    from matplotlib.figure import Figure

    save = Figure.savefig

    def savefig(figure: Figure, file: Any, **options: Any) -> None:
        figure.set_layout_engine("none")
        save(figure, file, **options | {"dpi": 40})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", savefig)
        yield


@pytest.fixture(scope="session")
def lens_points() -> Callable[..., Tensor]:
    """Points (P, 2) [m] of the overlap of two discs `place` (2,) apart, about its middle, `side` to a diameter."""

    def points_of(place: Tensor, diameter: float, side: int) -> Tensor:
        axis = ((torch.arange(side, dtype=torch.float64) + 0.5) / side - 0.5) * diameter
        points = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), -1).flatten(0, 1)
        inside = [(points + half).norm(dim=-1) < diameter / 2 for half in (place / 2, -place / 2)]
        return points[inside[0] & inside[1]]

    return points_of


@pytest.fixture
def golay6() -> SparseAperture:
    """Six discs in 1 m, of the reference case's collecting area, one per test."""
    return SparseAperture.from_catalog("golay6", 1.0, 0.15)


@pytest.fixture(scope="session")
def observe_satellite() -> Callable[..., Observation]:
    """Draws exposures of the packaged satellite, half the field wide, with read-out noise of 1.5 electrons."""

    def observe(
        aperture: Aperture,
        grid: Grid,
        *,
        n_photons: float = 1e7,
        d_over_r0: float = 7.0,
        n_frames: int = 10,
        seed: int = 0,
    ) -> Observation:
        scene = make_scene(grid.shape, n_photons, SceneOptions(size=0.5))
        turbulence = TurbulencePhase(1 / d_over_r0, 20.0)
        generator = torch.Generator().manual_seed(seed)
        return simulate_observation(scene, aperture, grid, turbulence, Detector(1.5), n_frames, generator)

    return observe


@pytest.fixture
def fits_cube() -> np.ndarray:
    """(3, 16, 20): no two pixels alike, a star on row 9, column 12."""
    frames = np.arange(3 * 16 * 20, dtype=np.float32).reshape(3, 16, 20) + 100
    frames[:, 9, 12] += 1e5
    return frames


@pytest.fixture
def write_fits(tmp_path: Path) -> Callable[..., Path]:
    """Writes a FITS file and returns its path: pixels of 0.02 arcsec, 550 nm, electrons, but for other `cards`.

    A card that is None is left out. With `sci`, the data are an extension SCI behind an empty primary one.
    """

    def write(
        name: str,
        data: np.ndarray | None,
        *,
        extensions: Sequence[tuple[str, np.ndarray]] = (),
        sci: bool = False,
        **cards: Any,
    ) -> Path:
        from astropy.io import fits

        header = fits.Header()
        for key, value in ({"PIXELSCL": 0.02, "WAVELEN": 550e-9, "BUNIT": "electron", "RDNOISE": 3.0} | cards).items():
            if value is not None:
                header[key] = value
        primary = fits.PrimaryHDU(None if sci else data, header=header)
        images = [("SCI", data)] * sci + list(extensions)
        hdus = [primary, *(fits.ImageHDU(values, name=extension) for extension, values in images)]
        fits.HDUList(hdus).writeto(tmp_path / name)
        return tmp_path / name

    return write


@pytest.fixture(scope="session")
def sky_matrix() -> Callable[..., np.ndarray]:
    """(2, 2) from pixels (x, y) to (east, north), in units of `pixel_scale`: y is `angle` [rad] away from north, east
    to the left, or to the right if mirrored."""

    def matrix(angle: float, pixel_scale: float, mirrored: bool = False) -> np.ndarray:
        c, s, parity = math.cos(angle), math.sin(angle), 1 if mirrored else -1
        return pixel_scale * np.array([[parity * c, -parity * s], [s, c]])

    return matrix


@pytest.fixture(scope="session")
def sky_cards(sky_matrix: Callable[..., np.ndarray]) -> Callable[..., dict[str, Any]]:
    """The FITS cards that say the same."""

    def cards(angle: float, pixel_scale: float, mirrored: bool = False) -> dict[str, Any]:
        matrix = sky_matrix(angle, math.degrees(pixel_scale), mirrored)
        found = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CUNIT1": "deg", "CUNIT2": "deg"}
        found |= {"CRVAL1": 82.0, "CRVAL2": -65.0, "CRPIX1": 5.0, "CRPIX2": 9.0}
        return found | {f"CD{i + 1}_{j + 1}": float(matrix[i, j]) for i in range(2) for j in range(2)}

    return cards


@pytest.fixture(scope="session")
def static_aberrations() -> Tensor:
    """Those that `expose_binary` puts into every exposure (7, 6) [rad rms]."""
    return 0.06 * torch.randn(7, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


@pytest.fixture(scope="session")
def expose_binary(static_aberrations: Tensor) -> Callable[..., tuple[Tensor, Tensor]]:
    """Electrons and their rms of one exposure of a binary through seven holes.

    From a pupil twice as fine and an image twice as wide as those of `CompanionModel`: companion (contrast, east,
    north), star at `place` (y, x); static aberrations, and small ones of its own; the pixel's square, Poisson and
    read-out noise.
    """

    def expose(
        aperture: Aperture,
        grid: Grid,
        sky: np.ndarray,
        companion: np.ndarray,
        place: tuple[float, float],
        wavelengths: Sequence[float],
        seed: int,
    ) -> tuple[Tensor, Tensor]:
        n_pixels, own = grid.shape[0], torch.Generator().manual_seed(seed)
        change = 0.005 * torch.randn(7, 6, dtype=torch.float64, generator=own)
        total = torch.zeros(())
        for wavelength in wavelengths:
            coloured = Grid(n_pixels, grid.pixel_scale, wavelength)
            coefficients = (static_aberrations + change) * grid.wavelength / wavelength
            phase = ZernikePhase(aperture, coloured, 6, oversampling=4)(coefficients)
            total = total + psf_from_samples(aperture.samples(coloured, 4), phase) / len(wavelengths)
        nu_y, nu_x = (torch.fft.fftfreq(n, dtype=torch.float64) for n in total.shape)
        x, y = np.linalg.inv(sky) @ companion[1:]

        def at(row: float, column: float) -> Tensor:
            return torch.exp(-2j * math.pi * (nu_y[:, None] * row + nu_x * column))

        square = torch.sinc(nu_y)[:, None] * torch.sinc(nu_x)
        seen = at(*place) + companion[0] * at(place[0] + y, place[1] + x)
        image = 1e8 * torch.fft.ifft2(torch.fft.fft2(total) * square * seen).real[:n_pixels, :n_pixels]
        noise = (image.clamp(min=0) + 100**2).sqrt()
        return image + noise * torch.randn(image.shape, dtype=torch.float64, generator=own), noise

    return expose


@pytest.fixture(scope="session")
def expose_points() -> Callable[..., Tensor]:
    """Frames (T, H, W) of point sources (x, y, flux), pixels from [H // 2, W // 2], a random piston on every hole and
    frame."""

    def expose(
        mask: Aperture,
        grid: Grid,
        stars: Sequence[tuple[float, float, float]] = ((0.0, 0.0, 1.0),),
        *,
        electrons: float = 1e6,
        n_frames: int = 1,
        oversampling: int = 8,
        pistons: bool = True,
    ) -> Tensor:
        samples = mask.samples(grid, oversampling)
        position = samples.offsets + mask.centers[:, None, :]
        shape, generator = (n_frames, mask.n_subapertures, 1), torch.Generator().manual_seed(0)
        phase = pistons * 2 * math.pi * torch.rand(shape, generator=generator, dtype=torch.float64)
        frames = torch.zeros(n_frames, *grid.shape, dtype=torch.float64)
        height, width = grid.shape
        for x, y, flux in stars:
            tilt = 2 * math.pi * grid.pixel_scale / grid.wavelength * position @ position.new_tensor([x, y])
            psf = psf_from_samples(samples, tilt + phase)
            frames += flux * psf.roll((height // 2, width // 2), (-2, -1))[:, :height, :width]
        return frames * electrons / sum(flux for *_, flux in stars)

    return expose


@dataclass(frozen=True)
class Binary:
    """A star and a companion `contrast` as bright, (east, north) [rad] away; the star is the phase centre."""

    east: float
    north: float
    contrast: float

    def visibilities(self, baselines: Any, wavelength: float) -> np.ndarray:
        """On baselines (B, 2) [m]."""
        u, v = np.asarray(baselines).T / wavelength
        return (1 + self.contrast * np.exp(-2j * math.pi * (u * self.east + v * self.north))) / (1 + self.contrast)

    def closure_phases(self, baselines: Any, wavelength: float) -> np.ndarray:
        """Of the triangles of all holes, in order."""
        values, n = self.visibilities(baselines, wavelength), round((1 + math.sqrt(1 + 8 * len(baselines))) / 2)
        number = {pair: index for index, pair in enumerate(itertools.combinations(range(n), 2))}
        triangles = itertools.combinations(range(n), 3)
        triple = [(values[number[i, j]], values[number[j, k]], values[number[i, k]]) for i, j, k in triangles]
        return np.array([np.angle(one * two * np.conj(three)) for one, two, three in triple])

    def dimming(self, grid: Grid, diameter: float) -> float:
        """The share of the light by which holes of `diameter` dim a companion: the overlap of a disc's diffraction
        pattern with itself, shifted."""
        away = math.hypot(self.east, self.north) / grid.pixel_scale

        def power(x: float) -> float:
            return float(disc_otf(torch.tensor(x))) ** 2 * x

        kept = quad(lambda x: power(x) * j0(2 * math.pi * x * grid.cutoff(diameter) * away), 0, 1)[0]
        return self.contrast * (1 - kept / quad(power, 0, 1)[0])


@pytest.fixture(scope="session")
def binary() -> type[Binary]:
    """The closed forms of a star and its companion."""
    return Binary
