import math

import pytest
import torch

from torchmask.atmosphere.random_field import RandomField, split_spectrum
from torchmask.atmosphere.von_karman import von_karman_covariance, von_karman_structure_function


def structure_function(bands, dy, dx):
    """Expected over all fields: every wave's power times 2 (1 - cos)."""
    return sum(
        float(
            (
                2 * b.amplitude**2 * (1 - torch.cos(2 * math.pi * (b.frequency_y[:, None] * dy + b.frequency_x * dx)))
            ).sum()
        )
        for b in bands
    )


CASES = {
    "pupil": ((1.0, 1.0), 0.25, (1 / 128, 1 / 128)),
    "oblong": ((1.0, 0.3), 0.25, (1 / 128, 1 / 128)),
    "oblong samples": ((1.0, 1.0), 0.25, (1 / 64, 1 / 96)),
    "long path": ((0.5, 6.0), 0.125, (1 / 64, 1 / 64)),
    "few samples": ((1.0, 1.0), 2.0, (1 / 8, 1 / 8)),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("outer_scale", [0.5, 2.0, 20.0, 100.0, 1e6])
def test_expected_structure_function(case, outer_scale):
    """von Karman at every separation that fits into the field, in all directions, one sample and corner to corner."""
    extent, margin, step = CASES[case]
    bands = split_spectrum(extent, margin, step, 0.2, outer_scale)
    rows, columns = (round(e / s) - 1 for e, s in zip(extent, step, strict=True))
    near = [(0, 1), (1, 0), (1, 1), (0, 2), (2, 0), (2, -3), (4, 4)]
    far = [(rows // 4, 0), (0, columns // 4), (rows // 2, columns // 2), (rows // 2, -columns)]
    ends = [(rows, 0), (0, columns), (rows, columns), (-rows, columns)]
    for y, x in near + far + ends:
        dy, dx = y * step[0], x * step[1]
        distance = torch.tensor(math.hypot(dy, dx), dtype=torch.float64)
        ratio = structure_function(bands, dy, dx) / float(von_karman_structure_function(distance, 0.2, outer_scale))
        assert ratio == pytest.approx(1, abs=0.002 if outer_scale <= 20 else 0.0035), (y, x)
    variance = sum(float((b.amplitude**2).sum()) for b in bands)
    expected = float(von_karman_covariance(torch.zeros(1, dtype=torch.float64), 0.2, outer_scale))
    assert variance == pytest.approx(expected, rel=0.005)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_field_is_the_sum_of_its_waves(dtype):
    """FFT and matrix products against the plain sum over all waves, at some samples."""
    shape, step = (9, 12), (0.1, 0.05)
    bands = split_spectrum((2.0, 1.5), 0.8, step, 1.0, 5.0)
    field = RandomField(bands, shape, step, dtype, torch.device("cpu"))
    coefficients = field.draw(torch.Generator().manual_seed(0))
    values = field.sum(coefficients)
    assert values.shape == shape
    assert values.dtype == (torch.complex64 if dtype == torch.float32 else torch.complex128)
    size = sum(float((b.amplitude**2).sum()) for b in bands) ** 0.5
    for row, column in [(0, 0), (8, 11), (3, 7)]:
        y, x = row * step[0], column * step[1]
        expected = sum(
            complex((c * torch.exp(2j * math.pi * (b.frequency_y[:, None] * y + b.frequency_x * x))).sum())
            for c, b in zip(coefficients, bands, strict=True)
        )
        assert abs(complex(values[row, column]) - expected) < 30 * torch.finfo(dtype).eps * size


def test_real_and_imaginary_parts_are_independent():
    """Circular coefficients: no correlation between the two screens, equal variances; 2000 draws of four samples."""
    step = (0.5, 0.5)
    bands = split_spectrum((1.0, 1.0), 8.0, step, 1.0, 2.0)
    field = RandomField(bands, (2, 2), step, torch.float64, torch.device("cpu"))
    generator = torch.Generator().manual_seed(3)
    values = torch.stack([field.sum(field.draw(generator)).flatten() for _ in range(2000)])
    variance = sum(float((b.amplitude**2).sum()) for b in bands)
    cross = values.real.T @ values.imag / 2000 / variance
    assert float(cross.abs().max()) < 4.5 / math.sqrt(2000)
    for part in (values.real, values.imag):
        assert float(((part**2).mean(0) / variance - 1).abs().max()) < 4.5 * math.sqrt(2 / 2000)
