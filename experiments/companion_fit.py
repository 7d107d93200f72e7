"""A star and a faint companion fitted to masked exposures, together with all that could be mistaken for one.

Every exposure is a star and, beside it, a companion of the same colour, imaged through aberrations common to all
exposures plus small ones of its own, blurred by the pixel and the spread of its charge, on a flat background. All of it
is fitted at once by Gauss-Newton steps, so the error of the companion includes what the aberrations could take up.
A companion is (contrast, east, north): its flux over that of the star, and its offset on the sky [rad].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.func import jacfwd

from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture
from torchmask.optics.band import Band
from torchmask.record import Callback, Record
from torchmask.restoration.forward import ExposureModel

STATIC_RMS, OWN_RMS = 0.3, 0.02  # [rad] expected sizes of the common aberrations, and of those of one exposure
OWN_MODES = 3  # piston, tip and tilt of every hole
BLUR, BLUR_RMS = 0.1, 0.1  # [pixel^2] variance of the spread of charge along an axis, and how well it is known
STEPS = 40  # of Gauss-Newton, at most
TOLERANCE = 0.1  # the last one lowers the squared residuals by less, which no error bar sees
_MARGIN = 2.0  # of the field around the exposures, which sets how finely the holes are sampled: to half a percent
_HALVINGS = 6  # of a step that makes the fit worse


@dataclass(frozen=True, eq=False)
class Exposures:
    """Exposures of one star, which stands in the middle of each but for a fraction of a pixel.

    frames, errors : (T, H, W) electrons, and their rms
    valid : (T, H, W) bool
    to_pixels : (T, 2, 2) from (east, north) [rad] to (y, x) [pixel]
    """

    frames: Tensor
    errors: Tensor
    valid: Tensor
    to_pixels: Tensor

    def __getitem__(self, chosen: Sequence[int] | slice) -> Exposures:
        index = chosen if isinstance(chosen, slice) else list(chosen)
        return Exposures(self.frames[index], self.errors[index], self.valid[index], self.to_pixels[index])


@dataclass(frozen=True, eq=False)
class Fit:
    """Where a fit ended.

    companion, covariance : (3,), (3, 3); a contrast of zero if there is none. Residuals count with the size they have
    shared : coefficients (N J) of the common aberrations [rad rms], variances of the blur along y and x [pixel^2]
    own : (T, 4 + 3 N) flux, background, y, x, coefficients of the aberrations of each exposure
    images : (T, H, W) the model [electrons]
    chi_square : mean squared residual of the valid pixels within the radius, (T,)
    jackknife : (T, 3) companion without each of the exposures
    """

    companion: Tensor
    covariance: Tensor
    shared: Tensor
    own: Tensor
    images: Tensor
    chi_square: Tensor
    jackknife: Tensor


@dataclass(frozen=True, eq=False)
class _Normal:
    """Normal equations of Gauss-Newton: `terms` of each exposure, (P, P) and (P,), and those of the prior."""

    matrices: Tensor
    vectors: Tensor
    prior_matrix: Tensor
    prior_vector: Tensor

    def factor(self, leave_out: int | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Cholesky factor of the scaled matrix, its scales, and the right-hand side."""
        matrix = self.matrices.sum(0) + self.prior_matrix
        vector = self.vectors.sum(0) + self.prior_vector
        if leave_out is not None:
            matrix, vector = matrix - self.matrices[leave_out], vector - self.vectors[leave_out]
        scale = matrix.diagonal().clamp(min=1e-300).rsqrt()
        scaled = matrix * scale[:, None] * scale
        scaled.diagonal().add_(1e-12)  # what nothing holds, such as the background of an exposure left out, stays
        return torch.linalg.cholesky(scaled), scale, vector

    def solve(self, leave_out: int | None = None) -> Tensor:
        factor, scale, vector = self.factor(leave_out)
        return scale * torch.cholesky_solve((scale * vector)[:, None], factor)[:, 0]


class CompanionModel:
    """Star and companion seen through a mask, compared with exposures within `radius` pixels of their middle.

    The variance of a pixel is that of its noise plus (flux_error x its flux)^2, for what no model of optics and
    detector gets right.
    """

    def __init__(
        self,
        aperture: Aperture,
        grid: Grid,
        n_modes: int,
        wavelengths: Sequence[float],
        weights: Sequence[float],
        radius: float,
        flux_error: float = 0.01,
    ) -> None:
        self.grid, self.radius, self.flux_error = grid, radius, flux_error
        self.n_sub, self.n_modes = aperture.n_subapertures, n_modes
        self.optics = ExposureModel(aperture, grid, n_modes, Band.of(wavelengths, weights), _MARGIN)
        rows, columns = self.optics.window.field.shape
        self._nu_y = torch.fft.fftfreq(rows, dtype=torch.float64)[:, None]
        self._nu_x = torch.fft.rfftfreq(columns, dtype=torch.float64)
        self._pixel = torch.sinc(self._nu_y) * torch.sinc(self._nu_x)
        # The cells of the pupil samples dim the model's image towards the border of its field; this undoes it.
        across = torch.sinc(torch.fft.fftfreq(columns, dtype=torch.float64))
        self._cells = 1 / (torch.sinc(self._nu_y) * across) ** 2
        y, x = torch.meshgrid(*(torch.arange(n).double() - n // 2 for n in grid.shape), indexing="ij")
        self._near = torch.hypot(y, x) <= radius
        self._n_aberrations = self.n_sub * n_modes

    def image(self, aberrations: Tensor, blur: Tensor, place: Tensor, companion: Tensor, to_pixels: Tensor) -> Tensor:
        """One exposure (H, W): aberrations (N J), blur (2,), flux, background, y and x of the star (4,)."""
        flux, background, y, x = place
        contrast, offset = companion[0], to_pixels @ companion[1:]
        spread = torch.exp(-2 * math.pi**2 * (blur[0] * self._nu_y**2 + blur[1] * self._nu_x**2))
        transfer = torch.fft.rfft2(self.optics.psf(aberrations[None])[0] * self._cells) * (flux * spread * self._pixel)
        sky = self._shift(y, x) * (1 + contrast * self._shift(offset[0], offset[1]))
        image = torch.fft.irfft2(transfer * sky, s=self.optics.window.field.shape)
        return image[: self.grid.shape[0], : self.grid.shape[1]] + background

    def fit(
        self,
        exposures: Exposures,
        companion: Tensor | None = None,
        start: Fit | None = None,
        steps: int = STEPS,
        callback: Callback | None = None,
    ) -> Fit:
        """The best fit; with a companion if one is given to start from."""
        n, search = len(exposures.frames), companion is not None
        found = torch.zeros(3, dtype=torch.float64) if companion is None else companion.double()
        shared, own = self._begin(exposures) if start is None else (start.shared, start.own)
        cost = self._cost(exposures, shared, own, found)
        for step in range(steps):
            before = cost
            change = self._normal(exposures, shared, own, found, search).solve()
            for _ in range(_HALVINGS):
                new_shared = shared + change[: len(shared)]
                new_own = own + change[len(shared) : len(shared) + own.numel()].view_as(own)
                new_found = found + change[-3:] if search else found
                new_cost = self._cost(exposures, new_shared, new_own, new_found)
                if new_cost < cost:
                    shared, own, found, cost = new_shared, new_own, new_found, new_cost
                    break
                change = change / 2
            if callback is not None:
                callback(Record("fit", step + 1, steps, {"cost": cost}))
            if before - cost < TOLERANCE:
                break
        normal = self._normal(exposures, shared, own, found, search)
        images = self._images(exposures, shared, own, found)
        residual = (exposures.frames - images) * self._root_weight(exposures)
        chi_square = (residual**2).sum((1, 2)) / (exposures.valid & self._near).sum((1, 2))
        covariance, jackknife = torch.zeros(3, 3, dtype=torch.float64), found.expand(n, 3)
        if search:
            factor, scale, _ = normal.factor()
            corner = torch.eye(len(scale), dtype=torch.float64)[:, -3:]
            inverse = scale[:, None] * torch.cholesky_solve(scale[:, None] * corner, factor)
            covariance = inverse[-3:] * max(1.0, float(chi_square.mean()))
            if n > 1:
                jackknife = torch.stack([found + normal.solve(leave_out=t)[-3:] for t in range(n)])
        return Fit(found, covariance, shared, own, images, chi_square, jackknife)

    def search(self, exposures: Exposures, star: Fit, offsets: Tensor) -> tuple[Tensor, Tensor]:
        """Contrast of a companion at each of `offsets` (M, 2) [rad] and its standard error, everything else refitted.

        Linearised about `star`, a fit without companion, or with one, beside which a second is looked for.
        """
        normal = self._normal(exposures, star.shared, star.own, star.companion, False)
        factor, scale, vector = normal.factor()
        solution = normal.solve()
        weight = self._root_weight(exposures)
        aligned = torch.zeros(len(offsets), dtype=torch.float64)
        power = torch.zeros_like(aligned)
        crossed = torch.zeros(len(vector), len(offsets), dtype=torch.float64)
        for t in range(len(exposures.frames)):
            residual, jacobian = self._linear(exposures, t, star.shared, star.own[t], star.companion, False, weight[t])
            transfer = torch.fft.rfft2(star.images[t] - star.own[t, 1], s=self.optics.window.field.shape)
            moved = (offsets @ exposures.to_pixels[t].T)[:, :, None, None]
            shifted = torch.fft.irfft2(
                transfer * self._shift(moved[:, 0], moved[:, 1]), s=self.optics.window.field.shape
            )
            window = shifted[:, : self.grid.shape[0], : self.grid.shape[1]]
            template = (window * weight[t])[:, self._near]  # (M, pixels)
            aligned += template @ residual
            power += (template**2).sum(1)
            crossed[self._columns(t, len(star.shared), star.own.shape, False)] += jacobian.T @ template.T
        inverse = scale[:, None] * torch.cholesky_solve(scale[:, None] * crossed, factor)
        variance = 1 / (power - (crossed * inverse).sum(0))
        contrast = variance * (aligned - solution @ crossed)
        return contrast, (variance * max(1.0, float(star.chi_square.mean()))).sqrt()

    def flux_error_of(self, exposures: Exposures, fit: Fit) -> float:
        """The fraction of the flux that, added to the noise, explains the residuals of `fit`."""
        near = exposures.valid & self._near
        squares = ((exposures.frames - fit.images) ** 2)[near]
        noise, flux = (exposures.errors**2)[near], exposures.frames.clamp(min=0)[near]
        low, high = 0.0, 1.0
        for _ in range(40):
            middle = (low + high) / 2
            explained = float((squares / (noise + (middle * flux) ** 2)).mean())
            low, high = (middle, high) if explained > 1 else (low, middle)
        return high

    def _shift(self, y: Tensor, x: Tensor) -> Tensor:
        return torch.exp(-2j * math.pi * (self._nu_y * y + self._nu_x * x))

    def _root_weight(self, exposures: Exposures) -> Tensor:
        variance = exposures.errors**2 + (self.flux_error * exposures.frames.clamp(min=0)) ** 2
        return torch.where(exposures.valid & self._near, variance, torch.inf).rsqrt()

    def _begin(self, exposures: Exposures) -> tuple[Tensor, Tensor]:
        """No aberrations; flux and centroid from the pixels around the middle."""
        middle = [n // 2 for n in self.grid.shape]
        rows, columns = (slice(m - 3, m + 4) for m in middle)
        shared = torch.zeros(self._n_aberrations + 2, dtype=torch.float64)
        shared[-2:] = BLUR
        own = torch.zeros(len(exposures.frames), 4 + self.n_sub * OWN_MODES, dtype=torch.float64)
        light = torch.where(exposures.valid, exposures.frames, 0.0).clamp(min=0)
        core = light[:, rows, columns]
        ramp = torch.arange(-3.0, 4.0, dtype=torch.float64)
        own[:, 0] = light.sum((1, 2))
        own[:, 2] = middle[0] + (core.sum(2) * ramp).sum(1) / core.sum((1, 2))
        own[:, 3] = middle[1] + (core.sum(1) * ramp).sum(1) / core.sum((1, 2))
        return shared, own

    def _total(self, shared: Tensor, own: Tensor) -> Tensor:
        """Aberrations (N J) of one exposure."""
        extra = own[4:].view(self.n_sub, OWN_MODES)
        extra = torch.nn.functional.pad(extra, (0, self.n_modes - OWN_MODES))
        return shared[: self._n_aberrations] + extra.flatten()

    def _images(self, exposures: Exposures, shared: Tensor, own: Tensor, companion: Tensor) -> Tensor:
        parts = zip(own, exposures.to_pixels, strict=True)
        return torch.stack([self.image(self._total(shared, o), shared[-2:], o[:4], companion, m) for o, m in parts])

    def _cost(self, exposures: Exposures, shared: Tensor, own: Tensor, companion: Tensor) -> float:
        """Squared residuals and squared distances from what is expected, in units of their variances."""
        residual = (exposures.frames - self._images(exposures, shared, own, companion)) * self._root_weight(exposures)
        precision, distance = self._prior(shared, own)
        return float((residual**2).sum() + (precision * distance**2).sum())

    def _prior(self, shared: Tensor, own: Tensor) -> tuple[Tensor, Tensor]:
        """Inverse variances of what is expected of shared and own, and how far it is away."""
        held = torch.full_like(shared, STATIC_RMS**-2)
        held[-2:] = BLUR_RMS**-2
        own_held = torch.zeros_like(own)
        own_held[:, 4:] = OWN_RMS**-2
        expected = torch.zeros_like(shared)
        expected[-2:] = BLUR
        return torch.cat([held, own_held.flatten()]), torch.cat([expected - shared, -own.flatten()])

    def _linear(
        self, exposures: Exposures, t: int, shared: Tensor, own: Tensor, companion: Tensor, search: bool, weight: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Weighted residuals (pixels,) of one exposure, and derivatives of the model by shared, own and companion."""
        n = self._n_aberrations
        parameters = torch.cat([self._total(shared, own), shared[-2:], own[:4], companion])

        def near(p: Tensor) -> tuple[Tensor, Tensor]:
            image = self.image(p[:n], p[n : n + 2], p[n + 2 : n + 6], p[n + 6 :], exposures.to_pixels[t])
            values = (image * torch.where(weight > 0, weight, 0.0))[self._near]
            return values, values

        jacobian, values = jacfwd(near, has_aux=True)(parameters)
        residual = (exposures.frames[t] * weight)[self._near] - values
        modes = torch.arange(n).view(self.n_sub, self.n_modes)[:, :OWN_MODES].flatten()
        parts = [jacobian[:, : n + 2], jacobian[:, n + 2 : n + 6], jacobian[:, modes]]
        return residual, torch.cat(parts + [jacobian[:, n + 6 :]] * search, dim=1)

    @staticmethod
    def _columns(t: int, n_shared: int, own: tuple[int, ...] | torch.Size, search: bool) -> Tensor:
        """Places of the parameters of one exposure among all."""
        first = n_shared + t * own[1]
        last = n_shared + own[0] * own[1]
        parts = [torch.arange(n_shared), torch.arange(first, first + own[1])]
        return torch.cat(parts + [torch.arange(last, last + 3)] * search)

    def _normal(self, exposures: Exposures, shared: Tensor, own: Tensor, companion: Tensor, search: bool) -> _Normal:
        n, n_all = len(own), len(shared) + own.numel() + 3 * search
        matrices = torch.zeros(n, n_all, n_all, dtype=torch.float64)
        vectors = torch.zeros(n, n_all, dtype=torch.float64)
        weight = self._root_weight(exposures)
        for t in range(n):
            residual, jacobian = self._linear(exposures, t, shared, own[t], companion, search, weight[t])
            places = self._columns(t, len(shared), own.shape, search)
            matrices[t][places[:, None], places] = jacobian.T @ jacobian
            vectors[t][places] = jacobian.T @ residual
        precision, distance = self._prior(shared, own)
        precision = torch.nn.functional.pad(precision, (0, 3 * search))
        distance = torch.nn.functional.pad(distance, (0, 3 * search))
        return _Normal(matrices, vectors, torch.diag(precision), precision * distance)
