"""What a restoration found, how well it fits, and how it came to an end."""

from __future__ import annotations

import json
import math
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmask.io import load_npz, save_npz
from torchmask.optics.geometry import MaskGeometry
from torchmask.record import Brief
from torchmask.restoration.verdict import Verdict


@dataclass(frozen=True, eq=False, repr=False)
class RestorationResult(Brief):
    """A restored object and everything that was found with it.

    object : (H, W) electrons per frame and pixel, on the pixels of the frames
    extended_object : (H', W') the same with the margin around the field, rows and columns beyond H and W
    coefficients : (T, N, J) Zernike coefficients [rad rms]
    transmission : (T,) of each frame, 1 on average
    model : (T, H, W) the frames that object and coefficients make [electrons]
    residuals : (T, H, W) (frames - model) / noise, 0 where a pixel is not valid
    chi_square : (T,) mean square of the residuals
    prior : the prior on the object, as it describes itself; weights are in units of frames of mean 1
    r0 : Fried parameter of the prior on the aberrations [m], NaN without prior or where they are known
    noise : electrons rms per pixel, averaged over the stack
    cost : (iterations,) what was minimised, one start after the other
    converged, message : whether and why it stopped
    n_evaluations : of cost and gradient
    seconds : wall time
    object_std : (H, W) standard deviation of the object below the diffraction limit [electrons], its position and
        brightness, which frames cannot tell, taken as found; None unless samples were asked for
    coefficients_std : (N, J) that of the coefficients of a frame [rad rms], or None
    background : (T,) mean light of a pixel of each frame that is not the object's [electrons]; None in files of 0.1
    rotation, magnification : of the mask against what was told, [rad] from x to y; 0 and 1 where it was taken as told
    geometry_std : (2,) standard deviations of both, as the noise leaves them, or None
    verdict : whether all this explains the frames; None in files of 0.1

    Examples
    --------
    >>> import tempfile
    >>> from torchmask.grid import Grid
    >>> from torchmask.optics.aperture import SparseAperture
    >>> from torchmask.restoration.myopic import MyopicDeconvolution
    >>> mask = SparseAperture([[0.0, 0.3], [-0.3, -0.2], [0.3, -0.2]], 0.2, 1.0)
    >>> method = MyopicDeconvolution(mask, Grid.nyquist(1.0, 550e-9, 32), n_modes=3, max_iterations=3)
    >>> frames = torch.full((4, 32, 32), 20.0); frames[:, 12:20, 12:20] = 1000.0
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

    @property
    def geometry(self) -> MaskGeometry:
        """How the mask lies against what was told, as far as the restoration has looked for it."""
        return MaskGeometry(self.rotation, self.magnification, self.magnification)

    @property
    def sky(self) -> float:
        """Mean light of a pixel that is not the object's [electrons]; NaN in files of 0.1."""
        return math.nan if self.background is None else float(self.background.mean())

    def save(self, path: str | Path) -> None:
        """Write everything to a new .npz file, without pickle. Errors as in `torchmask.io.save_npz`."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        if self.verdict is not None:
            values["verdict"] = json.dumps(self.verdict.to_json())
        save_npz(path, {name: value for name, value in values.items() if value is not None})

    @classmethod
    def load(cls, path: str | Path) -> RestorationResult:
        """Read what `save` wrote, version 0.1 included; tensors on the CPU.

        Raises ValueError for a missing, damaged or foreign file.
        """
        stored = _as_of_now(load_npz(path, required=("object", "coefficients", "chi_square")))
        needed = [item.name for item in fields(cls) if item.default is MISSING]
        missing = [name for name in needed if name not in stored]
        if missing:
            raise ValueError(f"{path} has no {', '.join(missing)}: it is no saved restoration, or a damaged one")
        names = [item.name for item in fields(cls) if item.name in stored]
        values: dict[str, Any] = {name: torch.from_numpy(stored[name]) for name in names if stored[name].ndim}
        values.update({name: stored[name].item() for name in names if not stored[name].ndim})
        if "verdict" in values:
            values["verdict"] = Verdict.from_json(values["verdict"])
        return cls(**values)

    def summary(self) -> str:
        """A few lines for people, the last one the verdict."""
        n_frames, n_sub, n_modes = self.coefficients.shape
        chi = self.chi_square
        lines = [
            f"restored {self.object.shape[0]} x {self.object.shape[1]} pixels from {n_frames} frames, "
            f"{n_sub} x {n_modes} aberrations each",
            f"{self.message} after {len(self.cost)} iterations, {self.n_evaluations} evaluations, {self.seconds:.1f} s",
            f"chi-square per pixel {float(chi.mean()):.3f} (worst frame {int(chi.argmax())}: {float(chi.max()):.3f})",
            f"noise {self.noise:.3g} electrons rms, prior {self.prior}"
            + ("" if math.isnan(self.r0) else f", r0 {self.r0:.3g} m")
            + (f", sky {self.sky:.3g} electrons" if self.sky > 0 else ""),
        ]
        if self.geometry_std is not None:
            turn, scale = self.geometry_std.tolist()
            lines.append(
                f"mask turned by {math.degrees(self.rotation):.3f} +- {math.degrees(turn):.3f} deg from x to y and "
                f"magnified by {self.magnification:.5f} +- {scale:.5f} against what was told"
            )
        return "\n".join([*lines, *([] if self.verdict is None else [str(self.verdict)])])


def _as_of_now(stored: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of a file under today's names: version 0.1 knew one prior and called transmissions gains."""
    if "gains" not in stored or "tv_weight" not in stored:
        return stored
    described = f"TotalVariation(weight={stored['tv_weight'].item():g}, epsilon=0.01)"
    return stored | {"transmission": stored["gains"], "prior": np.asarray(described)}
