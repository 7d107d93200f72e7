"""Joint fit of the fringes of all baselines to each frame, with the covariance of their noise."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.interferometry.visibilities import fringe_waves, pairs_and_triangles, triangle_sides
from torchmask.optics.aperture import Aperture
from torchmask.optics.phasor import phasor
from torchmask.optics.pixel import PixelResponse

_FIELD = 4  # width of the field for the fringes' envelope, relative to the frames, to avoid wrap-around
_WORST_CONDITION = 1e6  # maximum condition number of the normal equations of the fringes
_DARKEST = 1e-3  # minimum noise variance of a pixel, relative to the largest
_LEAST_SEEN = 1e-6  # minimum power of an envelope in valid pixels, relative to the largest, above rounding
_PLACES, _SETTLED = 50, 1e-3  # maximum number of steps to the centre, and length of the last [pixel]


@dataclass(frozen=True, eq=False)
class FringeFit:
    """Fitted fringes of T frames, with K = 1 + 2 B parameters: total light, and real and imaginary parts of B fringes.

    values : (T, K) parameters [electrons]
    covariance : (T, K, K) covariance from the noise of the pixels
    cubes : (T, 1 + C) complex, mean bias by that noise of the cube of the light and of the product of the fringes of
        each triangle
    """

    values: Tensor
    covariance: Tensor
    cubes: Tensor

    @property
    def light(self) -> Tensor:
        """Total light of each frame (T,) [electrons]."""
        return self.values[:, 0]

    @property
    def fringes(self) -> Tensor:
        """Complex fringes (T, B) [electrons]."""
        return as_complex(self.values[:, 1:])

    @property
    def fringe_noise(self) -> Tensor:
        """Noise variance of each complex fringe (T, B)."""
        return torch.stack(self.covariance.diagonal(dim1=1, dim2=2)[:, 1:].chunk(2, 1)).sum(0)


@dataclass(frozen=True, eq=False)
class PixelNoise:
    """Noise of each pixel of the frames (T, H, W).

    variance : variance [electrons^2], which may be negative if it is an unbiased estimate
    is_own : whether the variance is estimated from the pixel's own light, and thus correlated with its noise
    light : light [electrons], which equals the third central moment of the noise, as for a Poisson variable
    """

    variance: Tensor
    is_own: bool
    light: Tensor

    @property
    def third(self) -> Tensor:
        """Correction of triple products that remains after subtracting the products of values and covariances.

        E(xyz) - XYZ = X cov(y, z) + Y cov(x, z) + Z cov(x, y) + third moment. With measured values for X, Y and Z and
        a measured covariance that is correlated with their noise, three covariances (v, x) are subtracted too much.
        """
        return 3 * self.variance - self.light if self.is_own else -self.light


class FringeModel:
    """Linear model of a mask's fringes, with the diffraction pattern of one hole as envelope and the pixels' blur."""

    aperture: Aperture
    grid: Grid
    pairs: Tensor
    triangles: Tensor

    def __init__(self, aperture: Aperture, grid: Grid, pixel: PixelResponse | None = None) -> None:
        self.aperture, self.grid = aperture, grid
        self.pairs, self.triangles = pairs_and_triangles(aperture)
        height, width = grid.shape
        self._wide = Grid((height * _FIELD, width * _FIELD), grid.pixel_scale, grid.wavelength)
        self._nu_y, self._nu_x = self._wide.frequencies(torch.float64)
        shift = torch.stack(torch.broadcast_tensors(self._nu_x, self._nu_y), -1) * grid.period
        self._transfer = aperture.shape.otf(shift, aperture.subaperture_diameter)
        self._seen = None if pixel is None else pixel.transfer(self._nu_y, self._nu_x)

    @cached_property
    def points(self) -> FringeModel:
        """The model of light that pixels do not blur, which does not move it."""
        return self if self._seen is None else FringeModel(self.aperture, self.grid)

    def blur(self, image: Tensor) -> Tensor:
        """Blur an image (H, W), dark outside, by the diffraction pattern of one hole."""
        return self._around(image, self._halves[0])[: self.grid.shape[0], : self.grid.shape[1]]

    def centre(self, frames: Tensor, valid: Tensor) -> tuple[float, float]:
        """Return the place (x, y) of the light in frames (T, H, W), relative to [H // 2, W // 2] [pixel].

        It is where the diffraction pattern of one hole, of any brightness, explains most of the `valid` pixels
        (T, H, W). There may be none on one side, so the fringes, which average out over whole frames, are fitted around
        each place and taken off before the next.
        """
        light, counted = torch.where(valid, frames, 0.0).sum(0), valid.double().sum(0)
        points, norm = self.points, self.norm(counted)
        place = self._likeliest(light, norm)
        for _ in range(_PLACES):
            before, place = place, points.place_beside_fringes(light, counted, norm, points.columns(*place))
            if math.dist(before, place) < _SETTLED:
                break
        return place

    def place_beside_fringes(
        self, light: Tensor, counted: Tensor, norm: Tensor, columns: Tensor
    ) -> tuple[float, float]:
        """Return the place (x, y) of `light` (H, W), a sum over `counted` frames, without the fringes in `columns`."""
        normal, seen = (columns * counted.flatten()) @ columns.T, columns @ light.flatten()
        values = torch.linalg.lstsq(normal, seen[:, None], driver="gelsd").solution[1:, 0]
        return self._likeliest(light - counted * (values @ columns[1:]).view_as(counted), norm)

    @cached_property
    def _halves(self) -> tuple[Tensor, Tensor]:
        """Transforms of the envelope and of its square for the frequencies of `rfft2`; the envelope is real."""
        squared = torch.fft.rfft2(torch.fft.ifft2(self._transfer).real ** 2)
        return self._transfer[:, : squared.shape[1]], squared

    def norm(self, counted: Tensor) -> Tensor:
        """Return the square of the envelope around each place, summed over `counted` frames (H, W)."""
        return self._around(counted, self._halves[1])

    def _around(self, image: Tensor, transfer: Tensor) -> Tensor:
        return torch.fft.irfft2(torch.fft.rfft2(image, s=self._wide.shape) * transfer, s=self._wide.shape)

    def _likeliest(self, light: Tensor, norm: Tensor) -> tuple[float, float]:
        """Return the place (x, y) where the envelope explains most of `light` (H, W), a sum over `counted` frames.

        Envelope e of the best brightness explains (e . light)^2 / (e^2 . counted), whose lower part is `norm`. A
        parabola through the root of that gives its peak to a fraction of a pixel; it may lie up to one pixel outside.
        """
        share = self._around(light, self._halves[0]) / norm.clamp(min=_LEAST_SEEN * float(norm.max())).sqrt()
        height, width = self.grid.shape
        row, column = divmod(int(share[:height, :width].argmax()), width)
        offsets = []
        for at, line, n in ((column, share[row], width), (row, share[:, column], height)):
            before, here, after = (float(line[at + step]) for step in (-1, 0, 1))
            offset = (before - after) / (2 * (before - 2 * here + after)) if before + after < 2 * here else 0.0
            offsets.append(at + min(max(offset, -1.0), 1.0) - n // 2)
        return offsets[0], offsets[1]

    def columns(self, x: float, y: float) -> Tensor:
        """Return the matrix (K, P) of frame = columns^T (light, real and imaginary parts), around (x, y) [pixel].

        The pixels' response is applied to the fringe of frequency nu including its envelope,
        envelope(x) 2 Re(fringe exp(2 pi i nu . x)), and so to its whole patch of frequencies.
        """
        height, width = self.grid.shape
        ramp = -2 * math.pi * (self._nu_x * (x + width // 2) + self._nu_y * (y + height // 2))
        envelope = torch.fft.ifft2(self._transfer * phasor(ramp)).real
        if self._seen is None:
            light = envelope[:height, :width].flatten()
            fringes = self._waves * light
        else:
            light = self._through_pixels(envelope).real
            wide = self._wide_waves()
            fringes = torch.stack([self._through_pixels(envelope * row[:, None] * column) for row, column in wide])
        return torch.cat([light[None], 2 * fringes.real, -2 * fringes.imag])

    @cached_property
    def _waves(self) -> Tensor:
        return fringe_waves(self.aperture, self.grid, self.pairs)

    def _wide_waves(self) -> list[tuple[Tensor, Tensor]]:
        """Return exp(2 pi i nu . x) of every baseline on the wide field, factored into rows and columns."""
        centers = self.aperture.centers.detach().double().cpu()
        nu = (centers[self.pairs[:, 1]] - centers[self.pairs[:, 0]]) / self.grid.period
        places = [
            torch.arange(wide, dtype=torch.float64) - n // 2
            for wide, n in zip(self._wide.shape, self.grid.shape, strict=True)
        ]

        def wave(turns: Tensor) -> Tensor:
            return phasor(2 * math.pi * turns)

        return [(wave(float(v) * places[0]), wave(float(u) * places[1])) for u, v in nu]

    def _through_pixels(self, wide: Tensor) -> Tensor:
        """Return the pixel values (P,) of an image on the wide field."""
        height, width = self.grid.shape
        assert self._seen is not None
        return torch.fft.ifft2(torch.fft.fft2(wide) * self._seen)[:height, :width].flatten()


def fit_fringes(frames: Tensor, valid: Tensor, noise: PixelNoise, model: FringeModel, places: Tensor) -> FringeFit:
    """Fit fringes by weighted least squares to the valid pixels of each of `frames` (T, H, W), around `places` (T, 2).

    Weights are one over the variance of the mean frame, blurred by one hole: weights correlated with the noise of a
    pixel would favour low values and bias the fit.

    Raises ValueError if two baselines are too similar to be separated, or a valid pixel has no error that can be.
    """
    noise = replace(noise, variance=_variance_of_valid(noise, valid))
    weights, size = _weights(noise.variance, valid, model), 1 + 2 * len(model.pairs)
    values, covariance = frames.new_empty(len(frames), size), frames.new_empty(len(frames), size, size)
    cubes = torch.empty(len(frames), 1 + len(model.triangles), dtype=torch.complex128)
    for place, around in _alike(places):
        columns = model.columns(*place.tolist())
        for good, among in _alike(valid[around].flatten(1)):
            chosen = around[among]
            estimator = _estimator(columns, weights * good, model)
            values[chosen] = frames[chosen].flatten(1) @ estimator.T
            for frame in chosen.tolist():
                covariance[frame] = (estimator * noise.variance[frame].flatten()) @ estimator.T
            cubes[chosen] = _cubes(estimator, noise.third[chosen].flatten(1), model)
    return FringeFit(values, covariance, cubes)


def _alike(rows: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Return each distinct one of `rows` (T, ...) and the numbers of those that equal it."""
    same, group = torch.unique(rows, dim=0, return_inverse=True)
    return [(row, (group == number).nonzero().flatten()) for number, row in enumerate(same)]


def as_complex(parts: Tensor) -> Tensor:
    """Return complex numbers (..., B) from real and imaginary parts (..., 2 B)."""
    real, imaginary = parts.chunk(2, -1)
    return torch.complex(real, imaginary)


def _variance_of_valid(noise: PixelNoise, valid: Tensor) -> Tensor:
    """Return the variance (T, H, W) with 0 where pixels are not valid, whose errors may be anything.

    Raises ValueError unless told errors of valid pixels are finite and positive.
    """
    variance = noise.variance
    wrong = (valid & ~(torch.isfinite(variance) & (variance > 0))).nonzero()
    if len(wrong) and not noise.is_own:
        place = tuple(wrong[0].tolist())
        raise ValueError(
            f"errors are not finite and positive at {len(wrong)} valid pixels, the first is at (frame, row, column) "
            f"{place}, with the square {float(variance[place]):.3g}: standard deviations in electrons are needed, or "
            "False in `valid`"
        )
    return torch.where(valid, variance, 0.0)


def _weights(variance: Tensor, valid: Tensor, model: FringeModel) -> Tensor:
    """Return weights (P,), one over the variance of a pixel of the mean frame."""
    counted = valid.double().mean(0)
    mean = torch.where(valid, variance, 0.0).mean(0)
    smooth = model.blur(mean) / model.blur(counted).clamp(min=torch.finfo(torch.float64).tiny)
    smooth = smooth.clamp(min=_DARKEST * float(smooth.max()))
    return 1 / smooth.flatten()


def _estimator(columns: Tensor, weights: Tensor, model: FringeModel) -> Tensor:
    """Return the matrix (K, P) for which parameters = estimator @ frame."""
    weighted = columns * weights
    normal = weighted @ columns.T
    values = torch.linalg.eigvalsh(normal)
    if not values[0] * _WORST_CONDITION > values[-1]:
        raise ValueError(
            f"the fringes of some of the {len(model.pairs)} baselines cannot be separated: {_closest(model.aperture)};"
            " use restored_observables, a mask without redundant baselines or a wider field"
        )
    return torch.linalg.solve(normal, weighted)


def _cubes(estimator: Tensor, third: Tensor, model: FringeModel) -> Tensor:
    """Return the sums (T, 1 + C) over the pixels of the product of three estimators and `third` (T, P)."""
    light, fringes = estimator[0], as_complex(estimator[1:].T).T
    one, two, three = triangle_sides(model.pairs, model.triangles)
    of_light = third @ light**3
    found = [of_light.to(fringes)[:, None]]
    for index in zip(one, two, three, strict=True):
        a, b, c = (fringes[side] for side in index)
        found.append((third.to(fringes) @ (a * b * c.conj()))[:, None])
    return torch.cat(found, 1)


def _closest(aperture: Aperture) -> str:
    """Describe the two baselines, of either direction, that are closest to each other."""
    centers = aperture.centers.detach().double()
    pairs, _ = pairs_and_triangles(aperture)
    baselines = centers[pairs[:, 1]] - centers[pairs[:, 0]]
    both = torch.cat([baselines, -baselines])
    distance = torch.linalg.vector_norm(both[:, None] - both, dim=-1).fill_diagonal_(math.inf)
    first, second = divmod(int(distance.argmin()), len(both))
    names = ["-".join(map(str, pairs[index % len(pairs)].tolist())) for index in (first, second)]
    return (
        f"those of holes {names[0]} and {names[1]} lie {float(distance.min()):.3g} m apart, with holes of "
        f"{aperture.subaperture_diameter:.3g} m"
    )
