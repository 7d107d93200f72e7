"""Calibration of a mask: its geometry and the transmissions of its holes, measured on frames of a star or pinhole."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.functional import jacobian

from torchmask.grid import Grid
from torchmask.interferometry.orientation import first_look
from torchmask.interferometry.star_fit import (
    Information,
    StarFit,
    evaluate,
    even_weights,
    explained_variance,
    fit_frame,
    fit_together,
    require_all_holes,
    start_frame,
)
from torchmask.interferometry.star_frames import StarFrames
from torchmask.interferometry.star_model import MAP, PLACE, Shared, StarModel
from torchmask.interferometry.star_verdict import StarVerdict, judge_star, require_star
from torchmask.interferometry.which_mask import require_mask
from torchmask.observation import check_frames, warn_of_copies
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.geometry import MaskGeometry, turn_and_stretch
from torchmask.optics.pixel import PixelResponse, SquarePixel
from torchmask.optics.unmarked import leave_out_unmarked
from torchmask.record import Callback, Record

_REACH = 1.6  # radius of the pixels compared [wavelength / hole diameter]: beyond the first dark ring of a hole
_FIRST_FILL = 0.5  # of the pixels, where the fit of their fill factor starts
_FIRST_MODES = 3  # piston, tip and tilt are fitted first


@dataclass(frozen=True, eq=False)
class MaskCalibration:
    """Measured geometry of a mask with standard errors; `print` shows it.

    aperture : the mask with the measured geometry
    geometry : map to it from the given mask, without rotations by 180 degrees, which images do not show
    geometry_errors : (4,) errors of rotation [rad], magnification_x, magnification_y and shear
    mirror_seen : False if a mirrored mask would look the same, as for symmetric baselines; `geometry` is then not
        mirrored
    transmissions : (N,) light through each hole relative to their mean
    transmission_errors : (N,) errors of the transmissions
    offset : (2,) mean position (x, y) of the star, relative to pixel [H // 2, W // 2] [pixel]
    offset_errors : (2,) errors of the offset [pixel]
    explained : (T,) fraction of the variance of each frame's pixels around the star that the fit explains
    fill_factor, fill_factor_error : sensitive fraction of a pixel's area, which noise may take out of its range of 0
        to 1, and its error; None if it was not estimated
    frame_numbers : numbers of the frames in their files, as `Observation.frame_numbers`; empty if not known
    verdict : whether a star and the mask explain the frames; None if that was not judged

    Examples
    --------
    >>> mask, geometry = SparseAperture([[0.0, 0.4], [0.3, -0.2]], 0.1, 1.0), MaskGeometry(rotation=0.01)
    >>> two, frame = torch.ones(2), torch.ones(1)
    >>> found = MaskCalibration(
    ...     geometry.apply(mask), geometry, 1e-4 * torch.ones(4), False, two, 0.02 * two, 0 * two, 0.1 * two, frame)
    >>> print(found)
    rotation, from x to y    0.5730 +- 0.0057 deg
    magnification along x    1.000000 +- 0.000100
    magnification along y    1.000000 +- 0.000100
    shear                    0.000000 +- 0.000100
    mirrored                 cannot be seen with this mask
    star from the middle     x 0.0000 +- 0.1000, y 0.0000 +- 0.1000 pixels
    light through the holes  1.000 +- 0.020, 1.000 +- 0.020
    explained of the frames  100.0 % or more
    """

    aperture: SparseAperture
    geometry: MaskGeometry
    geometry_errors: Tensor
    mirror_seen: bool
    transmissions: Tensor
    transmission_errors: Tensor
    offset: Tensor
    offset_errors: Tensor
    explained: Tensor
    fill_factor: float | None = None
    fill_factor_error: float | None = None
    frame_numbers: tuple[int, ...] = ()
    verdict: StarVerdict | None = None

    @property
    def pixel(self) -> SquarePixel | None:
        """Estimated pixel response with its fill factor in range, None if it was not estimated or pixels are points."""
        return SquarePixel(min(fill, 1.0)) if (fill := self.fill_factor or 0.0) > 0 else None

    def __str__(self) -> str:
        g, e = self.geometry, self.geometry_errors.tolist()
        mirror = ("yes" if g.mirrored else "no") if self.mirror_seen else "cannot be seen with this mask"
        holes = zip(self.transmissions.tolist(), self.transmission_errors.tolist(), strict=True)
        (x, y), (dx, dy) = self.offset.tolist(), self.offset_errors.tolist()
        rows = [
            ("rotation, from x to y", f"{math.degrees(g.rotation):.4f} +- {math.degrees(e[0]):.4f} deg"),
            ("magnification along x", f"{g.magnification_x:.6f} +- {e[1]:.6f}"),
            ("magnification along y", f"{g.magnification_y:.6f} +- {e[2]:.6f}"),
            ("shear", f"{g.shear:.6f} +- {e[3]:.6f}"),
            ("mirrored", mirror),
            ("star from the middle", f"x {x:.4f} +- {dx:.4f}, y {y:.4f} +- {dy:.4f} pixels"),
            ("light through the holes", ", ".join(f"{value:.3f} +- {error:.3f}" for value, error in holes)),
            ("explained of the frames", f"{100 * float(self.explained.min()):.1f} % or more"),
        ]
        if self.fill_factor is not None:
            rows.append(("fill factor of the pixels", f"{self.fill_factor:.4f} +- {self.fill_factor_error:.4f}"))
        if self.verdict is not None:
            rows.append(("a star behind the mask", str(self.verdict)))
        width = max(len(name) for name, _ in rows)
        return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)


def calibrate_mask(
    frames: Tensor | np.ndarray,
    aperture: SparseAperture,
    grid: Grid,
    *,
    valid: Tensor | np.ndarray | None = None,
    readout_noise: float = 0.0,
    pixel: PixelResponse | None = None,
    estimate_pixel: bool = False,
    n_modes: int = 6,
    callback: Callback | None = None,
) -> MaskCalibration:
    """Measure the geometry of a mask on short exposures `frames` (T, H, W) [electrons] of a star or pinhole.

    First, mirror, rotation and magnification are estimated roughly from the power of the fringes, which does not depend
    on the pistons of turbulence. Then the aberrations of every frame are fitted jointly with what all frames share: the
    affine map of the pupil and the transmission of each hole.

    Parameters
    ----------
    frames : (T, H, W) tensor or array
        Exposures with any turbulence, or none; a few tens are enough. The star may move from frame to frame.
    aperture : SparseAperture
        Nominal mask. It may be wrong by any rotation, a mirror, and a few percent in size.
    grid : Grid
        Grid of the frames. An error of the pixel scale appears as magnification, and is harmless.
    valid : (H, W) or (T, H, W) boolean tensor or array, optional
        False where a pixel is dead or saturated. Those that stand out (`leave_out_unmarked`) are left out as well.
    readout_noise : float
        Read-out noise [electrons rms per pixel].
    pixel : PixelResponse, optional
        Known blur by the detector's pixels. None: they are points, or estimated.
    estimate_pixel : bool
        Whether to estimate the fill factor of square pixels too. Motion during a frame looks like larger pixels;
        turbulence beyond `n_modes` lowers the estimate by more than its error (0.02 for holes of r0/2 and 6 modes).
    n_modes : int
        Number of Zernike modes of every hole and frame, at least 3.
    callback : callable, optional
        Called with a `Record` of stage "calibration" after each frame of the first fit.

    Returns
    -------
    MaskCalibration
        Standard errors are the larger of those from the noise and, for two or more frames, those from the scatter
        between frames, in which the noise, scaled to it, has the weight of ten; the scatter includes modes beyond
        `n_modes` of turbulence. Errors from one frame are too small: by a factor of 1.5 for holes of 0.6 r0.
        A warning says if a star and the mask leave more than noise and such modes, as for a double star (`verdict`).

    Raises
    ------
    ValueError
        If the aperture is not a single mask of three holes or more, `n_modes` or `readout_noise` are out of range, the
        pixels are both known and to be estimated, `check_frames` rejects the frames, or they do not show a point source
        behind this mask.

    Notes
    -----
    A hole's field is integrated by a quadrature, with all derivatives in closed form. The model has elliptical holes if
    the map stretches the mask, while the holes of the returned `aperture` are magnified uniformly.

    Examples
    --------
    >>> from torchmask.optics.detector import Detector
    >>> from torchmask.simulation.exposures import simulate_observation
    >>> told = SparseAperture([[0.0, 0.35], [-0.35, -0.2], [0.3, -0.25]], 0.2, 1.0)
    >>> true = MaskGeometry(rotation=0.02, magnification_x=1.01, magnification_y=1.01)
    >>> star = torch.zeros(64, 64, dtype=torch.float64); star[32, 32] = 1e7  # electrons per frame
    >>> grid = Grid.nyquist(1.1, 550e-9, 64)
    >>> seen = simulate_observation(star, true.apply(told), grid, None, Detector(), n_frames=1)
    >>> found = calibrate_mask(seen.frames, told, grid)
    >>> round(found.geometry.rotation, 3), round(found.aperture.subaperture_diameter, 3)
    (0.02, 0.202)
    """
    if aperture.centers.ndim != 2 or aperture.n_subapertures < 3:
        raise ValueError(f"centers has shape {tuple(aperture.centers.shape)}: one mask of at least 3 holes is needed")
    if n_modes < _FIRST_MODES:
        raise ValueError(f"n_modes is {n_modes}: at least {_FIRST_MODES}, piston, tip and tilt, are needed")
    if not (math.isfinite(readout_noise) and readout_noise >= 0):
        raise ValueError(f"readout_noise is {readout_noise}: it must be finite and at least 0, in electrons rms")
    if estimate_pixel and pixel is not None:
        raise ValueError(f"pixel is {pixel}, which is known, and estimate_pixel is true: leave one of them out")
    frames, valid = (values.cpu() for values in check_frames(frames, valid, grid))
    frames, valid = leave_out_unmarked(frames, valid, grid, aperture, stacklevel=2)
    warn_of_copies(frames, stacklevel=2)
    reach = min(math.ceil(_REACH * grid.period / aperture.subaperture_diameter), (min(grid.shape) - 1) // 2)
    star = StarFrames.around(frames, valid, reach)
    centers = aperture.centers.detach().double().cpu()
    look = first_look(star.light, centers, grid)
    star.require_fringes(centers @ look.geometry.matrix.T, grid)
    square = replace(grid, n_pixels=2 * reach + 1)
    require_mask(star.light, star.counted, look.geometry.apply(aperture), square)
    coarse, model = (StarModel(aperture, grid, reach, number, pixel) for number in (_FIRST_MODES, n_modes))
    data, counted = star.pixels.flatten(1), star.counted.flatten(1).double()
    even = even_weights(data, counted)
    fill = centers.new_tensor(_FIRST_FILL) if estimate_pixel else None
    shared = Shared(look.geometry.matrix, centers.new_zeros(len(centers)), fill)
    fit = _first_fit(coarse, model, data, even, shared, callback)
    require_star(data, counted, fit, model, grid.cutoff(aperture.extent))
    fit, _ = fit_together(model, data, even, fit)
    fit, information = fit_together(model, data, counted / _variance(data, counted, fit, readout_noise), fit)
    require_all_holes(fit.shared.log_transmission.exp())
    verdict = judge_star(star, model, fit, information, aperture, grid, readout_noise, pixel)
    if not verdict.explained:
        warnings.warn(str(verdict), stacklevel=2)
    return MaskCalibration(
        geometry=(geometry := MaskGeometry.from_matrix(fit.shared.matrix)),
        aperture=geometry.apply(aperture),
        mirror_seen=look.mirror_seen,
        explained=explained_variance(data, counted, fit.images),
        verdict=verdict,
        **_estimates(model, fit, information, star.middles),
    )


def _first_fit(
    coarse: StarModel, model: StarModel, data: Tensor, weights: Tensor, shared: Shared, callback: Callback | None
) -> StarFit:
    """Fit every frame separately, first with pistons, tips and tilts only and then with all modes."""
    coarse_kernels, kernels = coarse.kernels(shared.matrix), model.kernels(shared.matrix)
    rows = []
    for frame, weight in zip(data, weights, strict=True):
        own = start_frame(coarse, frame, weight, shared, coarse_kernels)
        own = fit_frame(coarse, frame, weight, own, shared, coarse_kernels)
        modes = own[PLACE:].view(model.n_holes, coarse.n_modes)
        modes = torch.nn.functional.pad(modes, (0, model.n_modes - coarse.n_modes))
        own = torch.cat([own[:PLACE], modes.flatten()])
        rows.append(fit_frame(model, frame, weight, own, shared, kernels))
        if callback is not None:
            callback(Record("calibration", len(rows), len(data), {}, preparatory=True))
    return evaluate(model, torch.stack(rows), shared, kernels)


def _variance(data: Tensor, counted: Tensor, fit: StarFit, readout_noise: float) -> Tensor:
    """Return the variance (T, pixels): that of the noise plus the excess residual of the frame, equal in all pixels.

    Residuals of modes that the model lacks are larger in bright pixels, but weights that follow them would give most
    weight to pixels with hardly any light.
    """
    noise = fit.images.clamp(min=1e-6 * float(fit.images.max())) + readout_noise**2
    freedom = (counted.sum(1) - fit.own.shape[1]).clamp(min=1)
    left = (counted * (data - fit.images) ** 2).sum(1) / freedom - (counted * noise).sum(1) / counted.sum(1)
    return noise + left.clamp(min=0)[:, None]


def _estimates(model: StarModel, fit: StarFit, information: Information, middles: Tensor) -> dict[str, Any]:
    """Return the fields of a `MaskCalibration` that have errors, and these errors."""
    covariances = [information.noise_covariance, information.covariance]

    def errors(function: Callable[[Tensor], Tensor], at: Tensor, part: slice) -> Tensor:
        slope = jacobian(function, at)
        assert isinstance(slope, Tensor)
        return torch.stack([(slope @ c[part, part] @ slope.T).diagonal().sqrt() for c in covariances]).amax(0)

    def geometry(elements: Tensor) -> Tensor:
        matrix = elements.view(2, 2)
        mirror = matrix.new_tensor([-1.0 if float(torch.linalg.det(matrix.detach())) < 0 else 1.0, 1.0])
        angle, stretch = turn_and_stretch(matrix * mirror)
        return torch.cat([angle[None], stretch])

    def transmissions(logarithms: Tensor) -> Tensor:
        return logarithms.exp() / logarithms.exp().mean()

    elements, logarithms = fit.shared.matrix.flatten(), fit.shared.log_transmission
    tilts = model.offset_slopes(fit.shared)
    offsets = middles + fit.own @ tilts
    n, end, fill = len(offsets), MAP + model.n_holes, fit.shared.fill
    fill_error = None if fill is None else float(errors(lambda value: value, fill[None], slice(end, None)))
    noise = torch.einsum("kx,tkl,lx->tx", tilts, information.own_covariances, tilts).mean(0)
    scatter = offsets.var(0) if n > 1 else torch.zeros_like(noise)
    return {
        "geometry_errors": errors(geometry, elements, slice(0, MAP)),
        "transmissions": transmissions(logarithms),
        "transmission_errors": errors(transmissions, logarithms, slice(MAP, end)),
        "offset": offsets.mean(0),
        "offset_errors": (torch.maximum(noise, scatter) / n).sqrt(),
        "fill_factor": None if fill is None else float(fill),
        "fill_factor_error": fill_error,
    }
