"""The least-squares problem of a fit to exposures of a star and its companion, and its normal equations."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.func import jacfwd

from torchmask.interferometry.companion import OWN_MODES, CompanionModel, Exposures, Parameters

STATIC_RMS, OWN_RMS = 0.3, 0.02  # [rad] prior rms of the common aberrations, and of those of one exposure
BLUR, BLUR_RMS = 0.1, 0.1  # [pixel^2] prior mean and rms of the variance of the charge diffusion along an axis
_RIDGE = 1e-12  # of the scaled normal matrix, for parameters without data, such as those of an exposure left out


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Gauss-Newton normal equations: terms of each exposure, (T, P, P) and (T, P), and terms of the prior."""

    matrices: Tensor
    vectors: Tensor
    prior_matrix: Tensor
    prior_vector: Tensor

    def solve(self, leave_out: int | None = None) -> Tensor:
        """Return the step (P,) from all exposures, or from all but one."""
        vector = self.vectors.sum(0) + self.prior_vector
        if leave_out is not None:
            vector = vector - self.vectors[leave_out]
        return self.solve_for(vector[:, None], leave_out)[:, 0]

    def solve_for(self, columns: Tensor, leave_out: int | None = None) -> Tensor:
        """Return the inverse of the matrix times `columns` (P, M)."""
        matrix = self.matrices.sum(0) + self.prior_matrix
        if leave_out is not None:
            matrix = matrix - self.matrices[leave_out]
        scale = matrix.diagonal().clamp(min=1e-300).rsqrt()
        scaled = matrix * scale[:, None] * scale
        scaled.diagonal().add_(_RIDGE)
        return scale[:, None] * torch.cholesky_solve(scale[:, None] * columns, torch.linalg.cholesky(scaled))


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Sum of squared residuals and squared deviations from the prior mean, in units of their variances.

    The parameters are concatenated: static, blur, those of each exposure, and the companion if it is `free`.
    """

    model: CompanionModel
    exposures: Exposures
    free: bool

    def cost(self, at: Parameters) -> float:
        """Return the sum of both at these parameters."""
        images = self.model.images(at, self.exposures.to_pixels)
        residual = (self.exposures.frames - images) * self.model.root_weights(self.exposures)
        precision, distance = self._expected(at)
        return float((residual**2).sum() + (precision * distance**2).sum())

    def move(self, at: Parameters, change: Tensor) -> Parameters:
        """Return the parameters after a step (P,)."""
        sizes = [len(at.static), 2, at.own.numel(), 3 * self.free]
        static, blur, own, companion = change.split(sizes)
        found = at.companion + companion if self.free else at.companion
        return Parameters(at.static + static, at.blur + blur, at.own + own.view_as(at.own), found)

    def linearise(self, at: Parameters, t: int) -> tuple[Tensor, Tensor]:
        """Return weighted residuals (pixels,) of exposure t, and the derivatives in the parameters at `places`."""
        model, n = self.model, len(at.static)
        weight = model.root_weights(self.exposures[t : t + 1])[0]
        row = torch.cat([model.total(at.static, at.own[t]), at.blur, at.own[t, :4], at.companion])

        def near(p: Tensor) -> tuple[Tensor, Tensor]:
            image = model.image(p[:n], p[n : n + 2], p[n + 2 : n + 6], p[n + 6 :], self.exposures.to_pixels[t])
            values = (image * weight)[model.near]
            return values, values

        jacobian, values = jacfwd(near, has_aux=True)(row)
        residual = (self.exposures.frames[t] * weight)[model.near] - values
        own_modes = torch.arange(n).view(model.n_subapertures, model.n_modes)[:, :OWN_MODES].flatten()
        parts = [jacobian[:, : n + 2], jacobian[:, n + 2 : n + 6], jacobian[:, own_modes]]
        return residual, torch.cat(parts + [jacobian[:, n + 6 :]] * self.free, dim=1)

    def places(self, at: Parameters, t: int) -> Tensor:
        """Return the indices of the parameters that exposure t depends on."""
        shared, (n_exposures, n_own) = len(at.static) + 2, at.own.shape
        first, last = shared + t * n_own, shared + n_exposures * n_own
        parts = [torch.arange(shared), torch.arange(first, first + n_own)]
        return torch.cat(parts + [torch.arange(last, last + 3)] * self.free)

    def normal_equations(self, at: Parameters) -> NormalEquations:
        """Return the normal equations of the next step."""
        precision, distance = self._expected(at)
        n, n_all = len(at.own), len(precision)
        matrices = torch.zeros(n, n_all, n_all, dtype=torch.float64)
        vectors = torch.zeros(n, n_all, dtype=torch.float64)
        for t in range(n):
            residual, jacobian = self.linearise(at, t)
            places = self.places(at, t)
            matrices[t][places[:, None], places] = jacobian.T @ jacobian
            vectors[t][places] = jacobian.T @ residual
        return NormalEquations(matrices, vectors, torch.diag(precision), precision * distance)

    def _expected(self, at: Parameters) -> tuple[Tensor, Tensor]:
        """Return the prior's inverse variances (P,), and the deviations (P,) of the parameters from its mean."""
        static, blur, own = torch.full_like(at.static, STATIC_RMS**-2), torch.full_like(at.blur, BLUR_RMS**-2), at.own
        own_precision = torch.zeros_like(own)
        own_precision[:, 4:] = OWN_RMS**-2
        companion = own.new_zeros(3 * self.free)
        precision = torch.cat([static, blur, own_precision.flatten(), companion])
        return precision, torch.cat([-at.static, BLUR - at.blur, -own.flatten(), companion])
