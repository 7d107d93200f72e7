"""Joint fit of the aberrations of every frame of a star and of shared parameters, by Gauss-Newton steps."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchmask.interferometry.star_model import MAP, PLACE, Shared, StarModel

_STEPS = 30  # maximum number of steps of each fit
_ENOUGH = 0.01  # predicted decrease of the squared residuals at which a fit ends: far below the error bars
_HALVINGS = 8  # maximum number of halvings of a step that makes the fit worse
_DAMPING = (1e-3, 1e8)  # Levenberg-Marquardt damping: initial value, and value at which a frame's fit ends
_LOOSE = (10.0, 3.0)  # [rad] prior rms of pistons and tilts, and of higher modes: loose, for what data do not constrain
_EVEN = 1e-3  # prior rms of the mean log transmission, which is degenerate with the light of the frames
_PRIOR = 10  # frames whose weight the noise has in covariances
_LEAST_MEDIAN = 0.5  # of the mean light through a hole: a wide object is fitted best by the blob of one hole


@dataclass(frozen=True, eq=False)
class StarFit:
    """Present state of a fit.

    own : (T, 2 + N J) parameters of each frame
    shared : parameters shared by all frames
    images : (T, pixels) model of the frames
    """

    own: Tensor
    shared: Shared
    images: Tensor


@dataclass(frozen=True, eq=False)
class Information:
    """Fisher information of the frames on the shared parameters, marginal over each frame's own parameters.

    matrices : (T, S, S) information of each frame
    scores : (T, S) minus half the gradient of its squared residuals
    own_covariances : (T, K, K) covariance of the own parameters for known shared ones
    prior : (S, S) information of the prior
    """

    matrices: Tensor
    scores: Tensor
    own_covariances: Tensor
    prior: Tensor

    @property
    def noise_covariance(self) -> Tensor:
        """Covariance (S, S) from the noise of the pixels."""
        return torch.linalg.inv(self.matrices.sum(0) + self.prior)

    @property
    def covariance(self) -> Tensor:
        """Covariance (S, S) from the scatter between frames (sandwich estimate), or from noise for a single frame.

        The scatter of few frames is itself uncertain. So the noise enters as a prior with the weight of ten frames,
        scaled by how much more than noise the scores of the frames differ from 0.
        """
        bread, n = self.noise_covariance, len(self.scores)
        if n == 1:
            return bread
        scatter, noise = self.scores.T @ self.scores * (n / (n - 1)), self.matrices.sum(0)
        inverses = torch.linalg.pinv(self.matrices, hermitian=True)
        misfit = torch.einsum("ts,tsr,tr->", self.scores, inverses, self.scores) / (n - 1) / self.scores.shape[1]
        return bread @ (_PRIOR * misfit.clamp(min=1) * noise + n * scatter) @ bread / (_PRIOR + n)


def start_frame(
    model: StarModel, frame: Tensor, weight: Tensor, shared: Shared, kernels: tuple[Tensor, Tensor]
) -> Tensor:
    """Return initial parameters (2 + N J,) of a frame (pixels,), with pistons from its fringes as only aberrations.

    At the baseline of holes m and n a frame has the phasor exp(i (phase_n - phase_m)); the phases of the leading
    eigenvector of the matrix of all pairs agree best with all of them (angular synchronisation; Singer, Appl. Comput.
    Harmon. Anal. 30, 20, 2011).
    """
    carrier = kernels[1]
    counts = weight > 0
    pairs = (carrier.T * torch.where(counts, frame - frame[counts].median(), 0.0)) @ carrier.conj()  # (N, N)
    pairs.fill_diagonal_(0)
    own = frame.new_zeros(PLACE + model.n_holes * model.n_modes)
    own[PLACE :: model.n_modes] = -torch.linalg.eigh(pairs).eigenvectors[:, -1].angle()
    shape = model.image(own, shared, kernels)
    design = torch.stack([shape, torch.ones_like(shape)], 1)
    root = weight.sqrt()
    light, background = torch.linalg.lstsq(root[:, None] * design, (root * frame)[:, None]).solution[:, 0]
    own[0], own[1] = light.clamp(min=1e-6 * float(frame.abs().max())).log(), background
    return own


def fit_frame(
    model: StarModel, frame: Tensor, weight: Tensor, own: Tensor, shared: Shared, kernels: tuple[Tensor, Tensor]
) -> Tensor:
    """Fit the own parameters (2 + N J,) of a frame (pixels,) by the Levenberg-Marquardt method."""
    hold, damping = prior_weights(model), _DAMPING[0]

    def cost(own: Tensor) -> float:
        return float((weight * (frame - model.image(own, shared, kernels)) ** 2).sum() + (hold * own**2).sum())

    now = cost(own)
    for _ in range(_STEPS):
        image, by_own, _ = model.linearise(own, shared, kernels)
        matrix = (by_own.T * weight) @ by_own + hold.diag()
        slope = by_own.T @ (weight * (frame - image)) - hold * own
        while True:
            step = torch.linalg.solve(matrix + damping * matrix.diagonal().diag(), slope)
            new = cost(own + step)
            if new < now or damping > _DAMPING[1]:
                break
            damping *= 10
        if not new < now:
            break
        own, now, damping = own + step, new, damping / 10
        if float(slope @ step) < _ENOUGH:
            break
    return own


def fit_together(model: StarModel, frames: Tensor, weights: Tensor, fit: StarFit) -> tuple[StarFit, Information]:
    """Fit all parameters jointly to `frames` (T, pixels) with `weights` (T, pixels)."""
    cost, kernels = _cost(model, frames, weights, fit), model.kernels(fit.shared.matrix)
    for _ in range(_STEPS):
        step, steps, promised, information = _step(model, frames, weights, fit, kernels)
        for halving in range(_HALVINGS):
            scale = 0.5**halving
            shared = fit.shared.moved(scale * step)
            there = model.kernels(shared.matrix)
            moved = evaluate(model, fit.own + scale * steps, shared, there)
            new = _cost(model, frames, weights, moved)
            if new < cost:
                fit, cost, kernels = moved, new, there
                break
        else:
            break
        if promised < _ENOUGH:
            break
    return fit, information


def evaluate(model: StarModel, own: Tensor, shared: Shared, kernels: tuple[Tensor, Tensor]) -> StarFit:
    """Return the fit with these parameters and their images; the kernels are those of the shared matrix."""
    return StarFit(own, shared, torch.stack([model.image(row, shared, kernels) for row in own]))


def _cost(model: StarModel, frames: Tensor, weights: Tensor, fit: StarFit) -> float:
    held = (prior_weights(model) * fit.own**2).sum() + fit.shared.log_transmission.mean() ** 2 / _EVEN**2
    return float((weights * (frames - fit.images) ** 2).sum() + held)


def _step(
    model: StarModel, frames: Tensor, weights: Tensor, fit: StarFit, kernels: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor, float, Information]:
    """Return steps of shared (S,) and own (T, K) parameters, the predicted decrease of the cost, and the information.

    The own parameters of a frame are eliminated from its normal equations (Schur complement).
    """
    hold = prior_weights(model)
    matrices, scores, back, ahead, known, promised = [], [], [], [], [], 0.0
    for frame, weight, own in zip(frames, weights, fit.own, strict=True):
        image, by_own, by_shared = model.linearise(own, fit.shared, kernels)
        difference = weight * (frame - image)
        own_slope = by_own.T @ difference - hold * own
        factor = torch.linalg.cholesky((by_own.T * weight) @ by_own + hold.diag())
        mixed = (by_own.T * weight) @ by_shared
        back.append(torch.cholesky_solve(mixed, factor))
        ahead.append(torch.cholesky_solve(own_slope[:, None], factor)[:, 0])
        matrices.append((by_shared.T * weight) @ by_shared - mixed.T @ back[-1])
        scores.append(by_shared.T @ difference - mixed.T @ ahead[-1])
        known.append(torch.cholesky_inverse(factor))
        promised += float(own_slope @ ahead[-1])
    n = model.n_holes
    prior, holes = torch.zeros_like(matrices[0]), slice(MAP, MAP + n)
    prior[holes, holes] = (_EVEN * n) ** -2
    information = Information(torch.stack(matrices), torch.stack(scores), torch.stack(known), prior)
    slope = information.scores.sum(0)
    slope[holes] -= fit.shared.log_transmission.mean() / (_EVEN**2 * n)
    step = information.noise_covariance @ slope
    promised += float(slope @ step)
    return step, torch.stack(ahead) - torch.stack(back) @ step, promised, information


def prior_weights(model: StarModel) -> Tensor:
    """Return the prior's inverse variances (2 + N J,) of a frame's own parameters."""
    low, high = _LOOSE
    modes = torch.full((model.n_modes,), high**-2, dtype=torch.float64)
    modes[:3] = low**-2
    return torch.cat([modes.new_zeros(PLACE), modes.repeat(model.n_holes)])


def explained_variance(data: Tensor, counted: Tensor, images: Tensor) -> Tensor:
    """Return the fraction (T,) of the variance of each frame's counted pixels that the fit explains."""
    mean = (data * counted).sum(1, keepdim=True) / counted.sum(1, keepdim=True)
    left, all_of_it = ((counted * (data - level) ** 2).sum(1) for level in (images, mean))
    return 1 - left / all_of_it


def require_all_holes(light: Tensor) -> None:
    """Raise ValueError if a fit has most of the light through few holes, where `light` is that through each (N,)."""
    if float((light / light.mean()).median()) < _LEAST_MEDIAN:
        raise ValueError(
            f"the best fit has {100 * float(light.max() / light.sum()):.0f} % of the light through one of "
            f"{len(light)} holes: the object is no point, or another mask was in the beam; give frames of a star"
        )


def even_weights(data: Tensor, counted: Tensor) -> Tensor:
    """Return equal weights (T, pixels) for all valid pixels of a frame: one over their mean light, which is clamped."""
    level = (data * counted).sum(1, keepdim=True) / counted.sum(1, keepdim=True).clamp(min=1)
    return counted / level.clamp(min=1e-6 * float(data.abs().max()))
