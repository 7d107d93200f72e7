"""The image grid and its Fourier plane: the relation between pixels, angles, frequencies and lengths in the pupil.

An image has pixels of `pixel_scale` radians. Its DFT frequencies nu are in cycles/pixel, and a pupil-plane vector x
(metres) corresponds to the frequency nu = x * pixel_scale / wavelength. One cycle per pixel is therefore
`wavelength / pixel_scale` metres in the pupil, which is the period of the frequency torus.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Real

import torch
from torch import Tensor

from torchmask.numbers import require_wavelength
from torchmask.plain import require_plain

ARCSEC = math.pi / 180 / 3600  # rad
MAS = ARCSEC / 1000  # rad, a thousandth of an arcsecond
_ROUNDING = 1e-9  # relative tolerance, so that a grid made for exactly Nyquist is accepted


@dataclass(frozen=True)
class Grid:
    """An image grid and its Fourier plane.

    Parameters
    ----------
    n_pixels : int or (int, int)
        Rows and columns of the image; one number means a square.
    pixel_scale : float
        Angle on the sky of one pixel [rad].
    wavelength : float
        Wavelength of the light [m].

    Raises
    ------
    ValueError
        If a number is not finite and positive, or the grid has fewer than 2 pixels on a side.
    TypeError
        If a number has a unit of astropy.

    Notes
    -----
    Any positive wavelength is taken, as only `wavelength / pixel_scale` counts in a grid; `nyquist`, `read_observation`
    and the command line refuse what is not a wavelength of light in metres.

    Examples
    --------
    >>> grid = Grid.nyquist(diameter=1.0, wavelength=550e-9, n_pixels=128)
    >>> grid.shape, round(grid.period, 12)
    ((128, 128), 2.0)
    """

    n_pixels: int | tuple[int, int]
    pixel_scale: float
    wavelength: float

    def __post_init__(self) -> None:
        given = self.n_pixels
        sides = tuple(given) if isinstance(given, tuple | list) else (given, given)
        if len(sides) != 2 or not all(isinstance(side, Real) and side >= 2 and side % 1 == 0 for side in sides):
            raise ValueError(f"n_pixels is {given}: it must be one or two whole numbers of at least 2")
        # Python's own numbers: those of NumPy and torch may be of low precision, and a tensor's hash is its identity
        rows, columns = map(int, sides)
        object.__setattr__(self, "n_pixels", (rows, columns) if isinstance(given, tuple | list) else rows)
        for name in ("pixel_scale", "wavelength"):
            require_plain(name, getattr(self, name))
            value = float(getattr(self, name))
            object.__setattr__(self, name, value)
            if not (math.isfinite(value) and value > 0):
                unit = "rad per pixel" if name == "pixel_scale" else "m"
                raise ValueError(f"{name} is {value}: it must be finite and positive, in {unit}")

    @classmethod
    def nyquist(
        cls, diameter: float, wavelength: float, n_pixels: int | tuple[int, int], oversampling: float = 1.0
    ) -> Grid:
        """Return the grid that samples the image of an aperture of `diameter` [m] at `oversampling` times Nyquist.

        At `oversampling=1` a pixel is wavelength / (2 diameter), the largest without aliasing.

        Raises ValueError if `diameter` is not finite and positive, `oversampling` is below 1, or `wavelength` is not
        one of light in metres; TypeError if one of them has a unit of astropy.
        """
        require_plain("diameter", diameter)
        require_plain("wavelength", wavelength)
        require_wavelength("wavelength", wavelength)
        if not (math.isfinite(diameter) and diameter > 0):
            raise ValueError(f"diameter is {diameter}: it must be finite and positive, in m")
        if not (math.isfinite(oversampling) and oversampling >= 1):
            raise ValueError(f"oversampling is {oversampling}: it must be at least 1, or the image is aliased")
        return cls(n_pixels, wavelength / (2 * diameter * oversampling), wavelength)

    @property
    def shape(self) -> tuple[int, int]:
        """Size of the image, (rows, columns)."""
        rows, columns = (self.n_pixels, self.n_pixels) if isinstance(self.n_pixels, int) else self.n_pixels
        return rows, columns

    @property
    def period(self) -> float:
        """Length in the pupil that corresponds to one cycle per pixel [m]."""
        return self.wavelength / self.pixel_scale

    def cutoff(self, diameter: float) -> float:
        """Return the highest spatial frequency that an aperture of `diameter` [m] transmits [cycles/pixel]."""
        return diameter / self.period

    def frequencies(
        self, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return the frequencies nu_y (H, 1) and nu_x (1, W) in FFT order, in [-1/2, 1/2) cycles/pixel."""
        height, width = self.shape
        nu_y = torch.fft.fftfreq(height, dtype=dtype, device=device)
        nu_x = torch.fft.fftfreq(width, dtype=dtype, device=device)
        return nu_y[:, None], nu_x[None, :]

    def describe(self, diameter: float, subaperture_diameter: float | None = None) -> str:
        """Describe how this grid samples an aperture, as a Markdown table of angles, pupil samples and aliasing.

        Parameters
        ----------
        diameter : float
            Diameter of the aperture, outer edge to outer edge (`aperture.extent`) [m].
        subaperture_diameter : float, optional
            Diameter of one hole [m].

        Raises
        ------
        ValueError
            If a diameter is not finite and positive.

        Examples
        --------
        >>> grid = Grid(n_pixels=128, pixel_scale=2.75e-7, wavelength=550e-9)
        >>> print(grid.describe(diameter=1.0, subaperture_diameter=0.117))
        | quantity | value | how |
        | --- | --- | --- |
        | pixel | 2.75e-07 rad = 0.05672 arcsec | pixel_scale |
        | field | 128 x 128 pixels = 7.261 x 7.261 arcsec | n_pixels, rows x columns |
        | one cycle/pixel in the pupil | 2 m | wavelength / pixel_scale |
        | one pupil sample | 0.01562 x 0.01562 m | that / n_pixels |
        | largest aperture without aliasing | 1 m | half of it |
        | aperture | 1 m | diameter |
        | wavelength / diameter | 2 pixels | Nyquist: 2 or more |
        | cut-off frequency | 0.5 cycles/pixel | at most 1/2: nothing aliases |
        | hole | 0.117 m | subaperture_diameter |
        | samples across a hole | 7.488 | 2 or more: can be sampled |
        | pixels across the image of a hole | 41.71 | 2.44 wavelength / subaperture_diameter |
        """
        for name, value in (("diameter", diameter), ("subaperture_diameter", subaperture_diameter)):
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}: it must be finite and positive, in m")
        (height, width), arcsec = self.shape, self.pixel_scale / ARCSEC
        cutoff = self.cutoff(diameter)
        if self._aliases(diameter):
            clean = max(0.0, 1 - cutoff)
            verdict = f"above 1/2: frequencies beyond {clean:.4g} cycles/pixel hold aliased light"
        else:
            verdict = "at most 1/2: nothing aliases"
        rows = [
            ("quantity", "value", "how"),
            ("---", "---", "---"),
            ("pixel", f"{self.pixel_scale:.4g} rad = {arcsec:.4g} arcsec", "pixel_scale"),
            (
                "field",
                f"{height} x {width} pixels = {height * arcsec:.4g} x {width * arcsec:.4g} arcsec",
                "n_pixels, rows x columns",
            ),
            ("one cycle/pixel in the pupil", f"{self.period:.4g} m", "wavelength / pixel_scale"),
            ("one pupil sample", f"{self.period / height:.4g} x {self.period / width:.4g} m", "that / n_pixels"),
            ("largest aperture without aliasing", f"{self.period / 2:.4g} m", "half of it"),
            ("aperture", f"{diameter:.4g} m", "diameter"),
            ("wavelength / diameter", f"{1 / cutoff:.4g} pixels", "Nyquist: 2 or more"),
            ("cut-off frequency", f"{cutoff:.4g} cycles/pixel", verdict),
        ]
        if subaperture_diameter is not None:
            across = subaperture_diameter * min(height, width) / self.period
            verdict = "2 or more: can be sampled" if across >= 2 else f"below 2: oversample by {math.ceil(2 / across)}"
            image = 2.44 * self.period / subaperture_diameter  # first dark ring of the Airy pattern
            rows += [
                ("hole", f"{subaperture_diameter:.4g} m", "subaperture_diameter"),
                ("samples across a hole", f"{across:.4g}", verdict),
                ("pixels across the image of a hole", f"{image:.4g}", "2.44 wavelength / subaperture_diameter"),
            ]
        return "\n".join(f"| {' | '.join(row)} |" for row in rows)

    def _aliases(self, diameter: float) -> bool:
        return self.cutoff(diameter) > 0.5 * (1 + _ROUNDING)

    def require_sampling(self, diameter: float) -> None:
        """Raise ValueError unless the image of an aperture of `diameter` [m] is sampled without aliasing."""
        if self._aliases(diameter):
            # Rounded down, so that the printed value is accepted.
            needed = self.wavelength / (2 * diameter) * (1 - 5e-5)
            raise ValueError(
                f"pixel_scale {self.pixel_scale:.4g} rad ({self.pixel_scale / ARCSEC:.4g} arcsec) undersamples an "
                f"aperture of {diameter:.4g} m at "
                f"{self.wavelength:.4g} m (cut-off {self.cutoff(diameter):.3f} cycles/pixel, above 1/2): "
                f"pixel_scale must be at most {needed:.5g} rad ({needed / ARCSEC:.5g} arcsec)"
            )
