"""The pupil samples of a mask that has been rotated and shrunk, and gradients with respect to that step."""

from __future__ import annotations

import torch
from torch import Tensor

from torchmask.restoration.pupil import OpenSamples, SampledPupil


def moved_centers(centers: Tensor, step: Tensor) -> Tensor:
    """Rotate centres (N, 2) from x to y by step[0] [rad] and divide them by exp(step[1]); differentiable in both."""
    turn, scale = step[0], (-step[1]).exp()
    cosine, sine = scale * turn.cos(), scale * turn.sin()
    x, y = centers.to(step).unbind(-1)
    return torch.stack([cosine * x - sine * y, sine * x + cosine * y], -1)


def centers_of(pupil: SampledPupil) -> Tensor:
    """Return the centres (N, 2) [m] of a pupil's sub-apertures, where its samples lie."""
    return pupil.aperture.centers.detach().to(pupil.weights.device)


class PlacedSamples:
    """The open samples of a pupil whose sub-aperture centres are rotated and shrunk about the origin by `step` (2,).

    `centers` (N, 2) [m] are `centers_of` the pupil, taken once for all steps, and the step lies where they do.

    samples : the samples, detached from the graph
    """

    def __init__(self, pupil: SampledPupil, centers: Tensor, step: Tensor) -> None:
        self._step: Tensor = step.detach().clone().requires_grad_()
        with torch.enable_grad():
            # As many for every step on a GPU: a CUDA graph cannot hold a number that depends on values.
            with_closed = step.device.type == "cuda"
            self._moved = pupil.samples_at(moved_centers(centers, self._step), with_closed=with_closed)
        self.samples: OpenSamples = OpenSamples(*(values.detach() for values in self._moved))

    def pull_back(self, weights: Tensor, basis: Tensor) -> Tensor:
        """Return the gradient (2,) in the step from those in the samples' weights (P,) and basis (P, K)."""
        pairs = ((self._moved.weights, weights), (self._moved.basis, basis))
        moved, by_moved = zip(*(pair for pair in pairs if pair[0].requires_grad), strict=True)  # pistons do not move
        (slope,) = torch.autograd.grad(moved, self._step, by_moved)
        return slope
