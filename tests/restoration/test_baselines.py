"""Shift-and-add and its PSF, against frames whose shifts are known."""

import math

import pytest
import torch

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.psf import PSF
from torchmask.restoration.baselines import average_psf, shift_and_add

GRID = Grid.nyquist(1.0, 550e-9, 48)
NO_TURBULENCE = 1e6  # r0 [m]


def blob(row: float, column: float) -> torch.Tensor:
    y, x = torch.meshgrid(torch.arange(48.0), torch.arange(48.0), indexing="ij")
    return torch.exp(-((y - row) ** 2 + (x - column) ** 2) / 18).double()


def test_shift_and_add_undoes_shifts_to_a_tenth_of_a_pixel():
    frames = torch.stack([blob(24 + dy, 24 + dx) for dy, dx in ((0, 0), (3.3, -2.1), (-1.7, 4.4), (0.5, 0.9))])
    mean = shift_and_add(frames)
    reference = frames[frames.std((1, 2)).argmax()]
    # 0.05 pixel off in each direction changes a Gaussian of sigma 3 by at most 0.05 sqrt(2) exp(-1/2) / 3 = 0.0143.
    assert float((mean - reference).abs().max()) < 0.05 * math.sqrt(2 / math.e) / 3
    assert float((frames.mean(0) - reference).abs().max()) > 0.1


def test_average_psf_of_still_air_is_the_psf():
    mask = SparseAperture.from_catalog("golay6", 1.0, 0.15)
    psf = average_psf(mask, GRID, TurbulencePhase(NO_TURBULENCE, 20.0), torch.Generator().manual_seed(0), n_frames=3)
    still = torch.fft.fftshift(PSF(mask, GRID, 4)())[1:, 1:]
    assert psf.shape == (47, 47)
    torch.testing.assert_close(psf, still / still.sum(), rtol=0, atol=1e-6)  # 1e-6 rad rms of turbulence are left


def test_average_psf_lies_between_the_still_and_the_long_exposure():
    """Taking out the shifts sharpens, and turbulence blurs: the peak tells."""
    pupil = FullAperture(1.0)
    generator = torch.Generator().manual_seed(0)
    psf = average_psf(pupil, GRID, TurbulencePhase(1 / 4, 20.0), generator, n_frames=60)
    assert float(psf.sum()) == pytest.approx(1)
    phase = TurbulencePhase(1 / 4, 20.0)(pupil.samples(GRID, 4), 60, generator.manual_seed(0))
    long = PSF(pupil, GRID, 4)(phase).mean(0)
    assert 1.5 * float(long.max()) < float(psf.max()) < 0.7 * float(PSF(pupil, GRID, 4)().max())
    assert divmod(int(psf.argmax()), 47) == (23, 23)


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        (torch.ones(8, 8), "n_frames"),
        (torch.ones(0, 8, 8), "at least one frame"),
        (torch.full((2, 8, 8), math.nan), "not finite"),
        (torch.zeros(2, 8, 8), "no light"),
    ],
)
def test_bad_frames(frames, words):
    with pytest.raises(ValueError, match=words):
        shift_and_add(frames)
