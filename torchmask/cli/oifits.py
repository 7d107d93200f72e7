"""`--oifits`: write visibilities and closure phases of the restored frames to a file beside the image."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from torch import Tensor

from torchmask.interferometry.fringes import frame_observables
from torchmask.interferometry.observables import Observables
from torchmask.interferometry.oifits import save_oifits
from torchmask.observation import Observation
from torchmask.optics.band import filter_of_header
from torchmask.restoration.result import RestorationResult

FILE = "frames.oifits"


@dataclass(frozen=True, kw_only=True)
class OIFITSOptions:
    """Options of the OIFITS file."""

    oifits: tyro.conf.FlagCreatePairsOff[bool] = False
    """Write the frames' squared visibilities and closure phases, not calibrated by a star, to frames.oifits."""
    bandwidth: float | None = None
    """Width of the band for the OIFITS file [m]; None: that of --filter, --wavelengths or --instrument, or else that of
    the FILTER in the header."""


def measure_frames(observation: Observation, options: OIFITSOptions, sky: Tensor | float = 0.0) -> Observables | None:
    """Return the frames' observables; None if --oifits was not given.

    A sky [electrons per pixel] is subtracted, a number or one that broadcasts to the frames. Raises ValueError if the
    width of the band is unknown, invalid or given without --oifits, or the mask's fringes overlap too much.
    """
    width = options.bandwidth
    if not options.oifits and width is not None:
        raise ValueError(
            "--bandwidth is for the OIFITS file alone: give --oifits, or tell the restoration its band by --filter, "
            "--wavelengths or --instrument"
        )
    if not options.oifits:
        return None
    if width is None and filter_of_header(observation.header) is None:
        raise ValueError(
            "--oifits needs the width of the band, but the header has no known FILTER: give --bandwidth [m] or --filter"
        )
    if width is not None and not 0 < width < 2 * observation.grid.wavelength:
        raise ValueError(
            f"--bandwidth is {width:g}: it must be positive and less than twice the wavelength, "
            f"{observation.grid.wavelength:.4g}, in m"
        )
    readout = observation.readout_noise
    if readout is not None:
        readout = math.hypot(readout, math.sqrt(torch.as_tensor(sky).mean()))  # a subtracted sky leaves its noise
    dark = dataclasses.replace(observation, frames=observation.frames - sky, readout_noise=readout)
    return frame_observables(dark)


def write_frames(
    folder: Path,
    observables: Observables | None,
    observation: Observation,
    options: OIFITSOptions,
    result: RestorationResult,
    known_sky: float,
) -> list[str]:
    """Write the file if there are observables, and return the line for the summary.

    A sky would count as light without fringes. `known_sky` [electrons per pixel], if it is not 0, has been taken off;
    one that explains the frames is now.
    """
    if observables is None:
        return []
    told = ""
    if result.background is not None and result.sky > 0 and known_sky == 0:
        if result.verdict is not None and result.verdict.explained:
            observables = measure_frames(observation, options, result.background[:, None, None]) or observables
            told = f", without a sky of {result.sky:.3g} electrons"
        else:
            told = "; a sky in the frames lowers |V|^2: take it off by --sky"
    save_oifits(folder / FILE, observables, observation, options.bandwidth)
    n, triangles = len(observables.pairs), len(observables.triangles)
    return [f"|V|^2 of {n} baselines and closure phases of {triangles} triangles: {folder / FILE}{told}"]
