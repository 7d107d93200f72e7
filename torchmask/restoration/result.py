"""The result of a restoration: object, aberrations, quality of the fit, and why it ended."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmask.io import load_npz, save_npz
from torchmask.observation import number_frames
from torchmask.optics.geometry import MaskGeometry
from torchmask.record import Brief
from torchmask.restoration.verdict import Verdict

_OFF = (0.1, 0.003)  # rms rotation [deg] and magnification less one found of masks that lay as told: docs/tried.md


@dataclass(frozen=True, eq=False, repr=False)
class RestorationResult(Brief):
    """A restored object, with its aberrations and the quality of the fit.

    object : (H, W) on the pixels of the frames [electrons per pixel and frame], of all its light, see `light_beyond`
    extended_object : (H', W') object with a margin beyond the field, in rows and columns after H and W
    coefficients : (T, N, J) Zernike coefficients [rad rms]
    transmission : (T,) transmission of each frame, 1 on average
    model : (T, H, W) frames computed from object and coefficients [electrons]
    residuals : (T, H, W) (frames - model) / noise, 0 where a pixel is not valid
    chi_square : (T,) mean square of the residuals
    prior : description of the prior on the object; weights are for frames of mean 1
    r0 : Fried parameter of the prior on the aberrations [m]; NaN without such a prior or for known aberrations
    noise : rms noise of a pixel, averaged over the stack [electrons]
    cost : (iterations,) cost after each iteration, of all starts in succession
    converged : whether the restoration converged
    message : why it stopped
    n_evaluations : number of evaluations of cost and gradient
    seconds : wall time [s]
    object_std : (H, W) standard deviation of the object below the diffraction limit [electrons], for fixed position and
        brightness, which frames do not determine; None unless samples were requested
    coefficients_std : (N, J) standard deviation of the coefficients of a frame [rad rms], or None
    background : (T,) mean background of a pixel in each frame [electrons]; None in files of version 0.1
    rotation : fitted rotation of the mask from x to y [rad]; 0 if it was not fitted
    magnification : fitted magnification of the mask; 1 if it was not fitted
    geometry_std : (2,) standard deviations of rotation and magnification due to noise, or None
    verdict : whether all this explains the frames; None in files of 0.1
    motion : (T, N, J) change of the coefficients while a frame lasts [rad rms]; None where frames are snapshots
    light_beyond : share of the object's light that the optics spread beyond the field of the model, from which `model`
        is computed; 0 in files of before
    frame_numbers : number of each frame, by which summary and verdict name it; 0 to T - 1 by default

    Model, residuals and chi_square have the data type of the method's model, all else is float64.

    Examples
    --------
    >>> import tempfile
    >>> from torchmask.grid import Grid
    >>> from torchmask.optics.aperture import SparseAperture
    >>> from torchmask.restoration.myopic import MyopicDeconvolution
    >>> mask = SparseAperture([[0.0, 0.3], [-0.3, -0.2], [0.3, -0.2]], 0.2, 1.0)
    >>> method = MyopicDeconvolution(mask, Grid.nyquist(1.0, 550e-9, 32), n_modes=3, max_iterations=3)
    >>> x = torch.arange(32.0) - 16; frames = (20 + 1000 * torch.exp(-(x[:, None] ** 2 + x**2) / 20)).expand(4, 32, 32)
    >>> result = method.restore(torch.poisson(frames, generator=torch.Generator().manual_seed(0)))
    >>> result.chi_square.shape, result.converged
    (torch.Size([4]), False)
    >>> result.save(f"{tempfile.mkdtemp()}/result.npz")  # and RestorationResult.load reads it
    """

    object: Tensor
    extended_object: Tensor
    coefficients: Tensor
    transmission: Tensor
    model: Tensor
    residuals: Tensor
    chi_square: Tensor
    prior: str
    r0: float
    noise: float
    cost: Tensor
    converged: bool
    message: str
    n_evaluations: int
    seconds: float
    object_std: Tensor | None = None
    coefficients_std: Tensor | None = None
    background: Tensor | None = None
    rotation: float = 0.0
    magnification: float = 1.0
    geometry_std: Tensor | None = None
    verdict: Verdict | None = None
    motion: Tensor | None = None
    light_beyond: float = 0.0
    frame_numbers: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "frame_numbers", number_frames(self.frame_numbers, len(self.chi_square)))

    def with_frame_numbers(self, numbers: Sequence[int]) -> RestorationResult:
        """Return the result with other numbers of its frames, such as `Observation.frame_numbers`.

        Raises ValueError unless there are as many numbers as frames.
        """
        renamed = replace(self, frame_numbers=tuple(numbers))
        if self.verdict is None:
            return renamed
        name = dict(zip(self.frame_numbers, renamed.frame_numbers, strict=True))
        return replace(renamed, verdict=replace(self.verdict, frames=tuple(name[n] for n in self.verdict.frames)))

    @property
    def geometry(self) -> MaskGeometry:
        """Fitted geometry of the mask relative to the nominal one."""
        return MaskGeometry(self.rotation, self.magnification, self.magnification)

    @property
    def sky(self) -> float:
        """Mean background of a pixel [electrons]; NaN in files of version 0.1."""
        return math.nan if self.background is None else float(self.background.mean())

    def save(self, path: str | Path) -> None:
        """Write everything to a new .npz file, without pickle. Raises the errors of `torchmask.io.save_npz`."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        values["frame_numbers"] = np.array(self.frame_numbers)
        if self.verdict is not None:
            values["verdict"] = json.dumps(self.verdict.to_json())
        save_npz(path, {name: value for name, value in values.items() if value is not None})

    @classmethod
    def load(cls, path: str | Path) -> RestorationResult:
        """Read a file written by `save`, also by version 0.1, with tensors on the CPU.

        Raises ValueError if the file is missing, damaged or of another kind.
        """
        stored = _as_of_now(load_npz(path, required=("object", "coefficients", "chi_square")))
        needed = [item.name for item in fields(cls) if item.default is MISSING]
        missing = [name for name in needed if name not in stored]
        if missing:
            raise ValueError(f"{path} has no {', '.join(missing)}: it is not a saved restoration, or is damaged")
        names = [item.name for item in fields(cls) if item.name in stored]
        values: dict[str, Any] = {name: torch.from_numpy(stored[name]) for name in names if stored[name].ndim}
        values.update({name: stored[name].item() for name in names if not stored[name].ndim})
        if "frame_numbers" in values:
            values["frame_numbers"] = tuple(values["frame_numbers"].tolist())
        if "verdict" in values:
            values["verdict"] = Verdict.from_json(values["verdict"])
        return cls(**values)

    def summary(self) -> str:
        """Return a summary of a few lines, the last of which is the verdict."""
        n_frames, n_sub, n_modes = self.coefficients.shape
        chi, worst = self.chi_square, self.frame_numbers[int(self.chi_square.argmax())]
        lines = [
            f"restored {self.object.shape[0]} x {self.object.shape[1]} pixels from {n_frames} frames, "
            f"{n_sub} x {n_modes} aberrations each",
            f"{self.message} after {len(self.cost)} iterations, {self.n_evaluations} evaluations, {self.seconds:.1f} s",
            f"chi-square per pixel {float(chi.mean()):.3f} (worst frame {worst}: {float(chi.max()):.3f})",
            f"noise {self.noise:.3g} electrons rms, prior {self.prior}"
            + ("" if math.isnan(self.r0) else f", r0 {self.r0:.3g} m")
            + (f", sky {self.sky:.3g} electrons" if self.sky > 0 else ""),
        ]
        if self.geometry_std is not None:
            turn, scale = self.geometry_std.tolist()
            lines.append(
                f"mask turned by {math.degrees(self.rotation):.3f} +- {math.degrees(turn):.3f} deg from x to y and "
                f"magnified by {self.magnification:.5f} +- {scale:.5f} against what was told; the errors are those of "
                f"noise, besides which frames of an object are off by some {_OFF[0]:g} deg and {_OFF[1]:.1%}"
            )
        if self.motion is not None:
            piston = self.motion[..., 0] - self.motion[..., 0].mean(1, keepdim=True)
            lines.append(f"pistons change by {float(piston.square().mean().sqrt()):.2f} rad rms while a frame lasts")
        if self.verdict is not None and self.verdict.unseen:
            lines.append(f"the mask {self.verdict.unseen} makes the same fringes, so that frames cannot show that")
        return "\n".join([*lines, *([] if self.verdict is None else [str(self.verdict)])])


def _as_of_now(stored: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the arrays of a file under their present names; version 0.1 had one prior, and gains as transmission."""
    if "gains" not in stored or "tv_weight" not in stored:
        return stored
    described = f"TotalVariation(weight={stored['tv_weight'].item():g}, epsilon=0.01)"
    return stored | {"transmission": stored["gains"], "prior": np.asarray(described)}
