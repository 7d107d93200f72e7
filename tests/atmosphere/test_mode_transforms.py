import math
import time

import pytest
import torch

from torchmask.atmosphere.mode_transforms import directions, mode_transforms
from torchmask.atmosphere.von_karman import modal_covariance
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.zernike import aperture_modes

CROSS = [0.0, math.pi / 2, math.pi, 3 * math.pi / 2]
PUPILS = {
    "a cross": FullAperture(1.0, 0.3, 0.03, CROSS),
    "uneven vanes": FullAperture(8.0, 0.3, 0.3, [0.1, 0.4, 2.0, 5.0]),
    "one vane": FullAperture(1.0, 0.2, 0.05, [0.3]),
    "three vanes that meet": FullAperture(1.0, 0.0, 0.1, [0.0, 1.2, 3.2]),
    "vanes that meet at other places": FullAperture(1.0, 0.1, 0.08, [0.0, 0.6, 2.0, 4.0]),
    "two halves": FullAperture(1.0, 0.0, 0.3, [0.2, 0.2 + math.pi]),
    "hexagon": SparseAperture([[0.0, 0.0]], 1.0, 1.2, "hexagon", orientation=0.1),
}


@pytest.mark.parametrize("n_modes", [1, 2, 21])
@pytest.mark.parametrize("name", PUPILS)
def test_transforms_are_sums_over_the_open_area(name, n_modes):
    """By a quadrature of the whole area, of a degree that suits the highest frequency, at each of the angles."""
    aperture, highest, n_angles = PUPILS[name], 30.0, 80
    points, weights = aperture.shape.quadrature(120, aperture.subaperture_diameter)
    modes = weights[:, None] * aperture_modes(aperture, points, n_modes)
    frequency = torch.tensor([1e-3, 0.3, 0.8, 1.0], dtype=torch.float64) * highest / math.pi / aperture.outer_diameter
    phase = 2 * math.pi * frequency[:, None, None] * (directions(n_angles) @ points.T)
    expected = torch.complex(phase.cos() @ modes, phase.sin() @ modes)
    found = mode_transforms(aperture, n_modes, highest)(frequency, n_angles)
    assert found.shape == (4, n_angles, n_modes)
    assert float((found - expected).abs().max()) < 1e-10  # of modes whose rms is 1; what series leave out is 1e-11


def test_the_modes_of_a_pupil_with_vanes_are_quick():
    """All modes of a restoration's search; a sum over the pupil's points took a minute."""
    start = time.process_time()
    covariance = modal_covariance(FullAperture(1.0, 0.3, 0.03, CROSS), 231, 1 / 7, 20.0)
    assert time.process_time() - start < 10  # 0.8 s alone on one core
    assert float(torch.linalg.eigvalsh(covariance)[0]) > 0
