"""The parameters of a design table and its rows, before anything is computed."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any

from torchmask.design.rules import MaskRules
from torchmask.design.search import METHODS
from torchmask.grid import Grid
from torchmask.numbers import THROUGH_AIR, require_diameter, require_wavelength
from torchmask.optics.packing import hole_diameter

AXES = ("n_subapertures", "fill_factor", "n_photons", "n_frames", "diameter_over_r0", "seed")
ANY_WAVELENGTH = 550e-9  # [m] for pixels of wavelength / (2 D), whose frequencies are the same at every wavelength
_WHOLE = ("n_subapertures", "n_frames", "seed", "n_pixels", "n_frequencies", "n_draws")
_SAMPLES = 512  # minimum across the pupil raster for turbulence, where the sampled OTF biases the error by 0.1 %
_MAY_BE_ZERO = ("seed", "exponent", "readout_noise")
_NOT_NUMBERS = ("method", "budget", "pixel_scale", *(field.name for field in fields(MaskRules)))


@dataclass(frozen=True)
class DesignSpace(MaskRules):
    """Parameters of a design table, which has a row for every combination of the first six.

    The rules of the telescope and the workshop (`MaskRules`) hold for every mask.

    Raises ValueError if an axis is empty or repeats a value, or a value is out of range.
    """

    n_subapertures: tuple[int, ...] = (6, 9, 11, 13, 16)
    """Numbers of holes, N."""
    fill_factor: tuple[float, ...] = (0.15,)
    """Fill factors N d^2 / D^2, the collecting area of holes of diameter d in a mask of diameter D."""
    n_photons: tuple[float, ...] = (1e7,)
    """Electrons per frame at the reference fill factor; at others they are in proportion to N d^2."""
    n_frames: tuple[int, ...] = (20,)
    """Numbers of exposures, K."""
    diameter_over_r0: tuple[float, ...] = (7.0,)
    """Strengths of turbulence, D / r0. If empty, only MSE_a is computed, without a limit on d / r0."""
    seed: tuple[int, ...] = (0,)
    """Random seeds of the search."""
    reference_fill_factor: float = 0.15
    """Fill factor to which the numbers of photons refer."""
    max_hole_over_r0: float = 1.5
    """Largest hole diameter, in units of r0."""
    mask_diameter: float = 1.0
    """Diameter of the mask, D [m]."""
    wavelength: float | None = None
    """Wavelength of the observation [m], needed with a pixel scale; None: errors with pixels of wavelength / (2 D)
    depend on no wavelength."""
    n_pixels: int = 128
    """Pixels per side of the detector's field, which sets the total read-out noise; the criterion has its own grid."""
    n_frequencies: int = 256
    """Frequencies per side of the criterion's grid."""
    pixel_scale: float | None = None
    """Angle on the sky of one pixel [rad]; None: the largest without aliasing for D, at the wavelength."""
    exponent: float = 1.5
    """Exponent of the object's power-law power spectrum."""
    knee: float = 1 / 64
    """Frequency below which that spectrum is flat [cycles/pixel]."""
    readout_noise: float = 0.0
    """Read-out noise [electrons rms per pixel]."""
    outer_scale: float = 20.0
    """Outer scale of the turbulence [m]."""
    n_draws: int = 16
    """Number of random stacks of K exposures for the mean Wiener MSE and its standard error."""
    method: str = "hybrid"
    """Search method, hybrid or cma, as of `torchmask design`."""
    budget: int | None = None
    """Evaluations of the criterion in a search; None: as many as `torchmask design` takes."""

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ValueError(f"method is {self.method!r}: known methods are {', '.join(METHODS)}")
        if self.budget is not None:
            _number("budget", self.budget, whole=True)
        for name in (field.name for field in fields(DesignSpace) if field.name not in _NOT_NUMBERS):
            given = getattr(self, name)
            if name == "wavelength" and given is None:
                continue
            values = tuple(_number(name, v, name in _WHOLE) for v in (given if name in AXES else (given,)))
            if len(set(values)) < len(values) or not (values or name == "diameter_over_r0"):
                raise ValueError(f"{name} is {given}: it must hold at least one value, and none twice")
            object.__setattr__(self, name, values if name in AXES else values[0])
        if self.n_draws < 2:
            raise ValueError(f"n_draws is {self.n_draws}: a standard error needs at least 2")
        if self.pixel_scale is not None and self.wavelength is None:
            raise ValueError(f"pixel_scale is {self.pixel_scale} rad: the wavelength is missing, give it in m")
        require_diameter("mask_diameter", self.mask_diameter)
        require_wavelength("wavelength", self.wavelength, *THROUGH_AIR)
        self.constraints()
        self.require_on_pupil(self.mask_diameter)
        self.grid.require_sampling(self.mask_diameter)

    @property
    def grid(self) -> Grid:
        """Grid of the criterion's frequencies."""
        wavelength = ANY_WAVELENGTH if self.wavelength is None else self.wavelength
        if self.pixel_scale is None:
            return Grid.nyquist(self.mask_diameter, wavelength, self.n_frequencies)
        return Grid(self.n_frequencies, self.pixel_scale, wavelength)

    @property
    def oversampling(self) -> int:
        """Oversampling of the pupil under turbulence, which limits errors of the sampled OTF."""
        return math.ceil(_SAMPLES / self.n_frequencies)

    def designs(self) -> Iterator[Design]:
        """Yield the rows of the table before anything is computed; those that cannot be built say why."""
        axes = [getattr(self, name) for name in AXES if name != "diameter_over_r0"]
        for (n, fill, photons, frames, seed), strength in itertools.product(
            itertools.product(*axes), self.diameter_over_r0 or (None,)
        ):
            yield Design(
                n,
                fill,
                photons,
                frames,
                strength,
                seed,
                subaperture_diameter=self.mask_diameter * math.sqrt(fill / n),
                photons_per_frame=photons * fill / self.reference_fill_factor,
                infeasible=self._obstacle(n, fill, strength),
            )

    def _obstacle(self, n: int, fill_factor: float, strength: float | None) -> str | None:
        try:
            hole_diameter(n, self.mask_diameter, fill_factor)
        except ValueError as error:
            return str(error)
        if strength is None:
            return None
        largest = n * (self.max_hole_over_r0 / strength) ** 2
        if fill_factor > largest * (1 + 1e-9):
            over = strength * math.sqrt(fill_factor / n)
            return f"d/r0 is {over:.3g}, above {self.max_hole_over_r0:g}: fill_factor must be at most {largest:.4g}"
        relative = self.mask_diameter * math.sqrt(fill_factor / n) / self.grid.period  # of the width of the raster
        if relative * self.n_frequencies * self.oversampling < 2:
            need = math.ceil(2 / relative)
            return f"a hole spans less than 2 samples of the pupil: n_frequencies must be at least {need}"
        return None


@dataclass(frozen=True)
class Design:
    """One row of a design table: a combination of parameters, the mask found for it, and its errors.

    Diameters are in metres. Errors are relative to the mean of the object's PSD.

    relative_mse : MSE_a
    above_floor : MSE_a without the part that no mask of this diameter can change
    wiener_mse : mean of `wiener_mse` under von Karman screens
    wiener_error : standard error of that mean
    centers : (N, 2) centres of the holes [m]
    infeasible : why there is no mask, or None
    """

    n_subapertures: int
    fill_factor: float
    n_photons: float
    n_frames: int
    diameter_over_r0: float | None
    seed: int
    subaperture_diameter: float
    photons_per_frame: float
    relative_mse: float | None = None
    above_floor: float | None = None
    wiener_mse: float | None = None
    wiener_error: float | None = None
    centers: tuple[tuple[float, float], ...] = ()
    infeasible: str | None = None


def _number(name: str, value: Any, whole: bool) -> int | float:
    """Return `value` as int or float, so that equal tasks have equal files."""
    unit = {"mask_diameter": ", in m", "wavelength": ", in m, such as 550e-9", "outer_scale": ", in m"}.get(name, "")
    least = "not negative" if name in _MAY_BE_ZERO else "positive"
    fits = math.isfinite(value) and (value > 0 or (value == 0 and name in _MAY_BE_ZERO))
    if not fits or (whole and not float(value).is_integer()):
        raise ValueError(f"{name} is {value}: it must be {'whole' if whole else 'finite'} and {least}{unit}")
    return int(value) if whole else float(value)
