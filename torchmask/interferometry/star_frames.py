"""Cut-outs around a star from its frames, and a test that it is a point source."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.interferometry.orientation import mean_power

_LEAST_CONTRAST = 0.05  # squared visibility of a star through turbulence with r0 of half a hole's diameter


@dataclass(frozen=True, eq=False)
class StarFrames:
    """Square cut-outs around a star.

    pixels : (T, S, S) electrons, with invalid pixels filled in, and 0 outside the frame
    inside : (T, S, S) bool, whether a pixel is inside the frame
    counted : (T, S, S) bool, whether it is valid besides
    middles : (T, 2) position (x, y) of the middle of each square relative to pixel [H // 2, W // 2] [pixel]
    """

    pixels: Tensor
    inside: Tensor
    counted: Tensor
    middles: Tensor

    @classmethod
    def around(cls, frames: Tensor, valid: Tensor, reach: int) -> StarFrames:
        """Cut out squares of 2 reach + 1 pixels around the brightest position of frames (T, H, W).

        Pixels that are not `valid` (T, H, W) must be filled in.
        """
        blur = 2 * (reach // 4) + 1
        smooth = torch.nn.functional.avg_pool2d(frames[:, None], blur, 1, blur // 2, count_include_pad=False)
        height, width = frames.shape[-2:]
        brightest = smooth.flatten(1).argmax(1)
        rows, columns = brightest // width, brightest % width
        inside = torch.ones_like(valid)
        frames, valid, inside = (torch.nn.functional.pad(values, 4 * [reach]) for values in (frames, valid, inside))
        side = 2 * reach + 1
        parts = [
            (t, slice(row, row + side), slice(column, column + side))
            for t, (row, column) in enumerate(zip(rows.tolist(), columns.tolist(), strict=True))
        ]
        middles = torch.stack([columns - width // 2, rows - height // 2], 1).double()
        pixels, counted, inside = (torch.stack([values[part] for part in parts]) for values in (frames, valid, inside))
        return cls(pixels, inside, counted, middles)

    @property
    def light(self) -> Tensor:
        """Electrons above the median of each square (T, S, S), 0 outside the frame."""
        level = torch.stack([square[good].median() for square, good in zip(self.pixels, self.counted, strict=True)])
        return torch.where(self.inside, self.pixels - level[:, None, None], 0.0)

    def require_fringes(self, centers: Tensor, grid: Grid) -> None:
        """Raise ValueError unless fringes at the baselines of `centers` (N, 2) [m] have the contrast of a star.

        The contrast is the median over baselines, corrected for photon noise.
        """
        light = self.light
        total = light.sum((1, 2))
        power = mean_power(light, centers, grid).median() - self.pixels.clamp(min=0).sum((1, 2)).mean()
        contrast = float(len(centers) ** 2 * power / (total**2).mean().clamp(min=torch.finfo(total.dtype).tiny))
        if contrast < _LEAST_CONTRAST:
            raise ValueError(
                f"the squared visibility of the fringes is {contrast:.2g}, where a star has {_LEAST_CONTRAST} or more: "
                "give frames of a point source through this mask, bright enough for its fringes to be seen"
            )
