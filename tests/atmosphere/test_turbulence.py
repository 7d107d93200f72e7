import math

import numpy as np
import pytest
import torch

from torchmask.atmosphere.endless import Screen, ScreenWindow
from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.atmosphere.screens import draw_seed, frozen_flow, phase_screens
from torchmask.atmosphere.von_karman import modal_covariance, von_karman_structure_function
from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.zernike import zernike_basis

WAVELENGTH = 550e-9


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def exact_structure(distance, r0, outer_scale):
    return float(von_karman_structure_function(torch.tensor(distance, dtype=torch.float64), r0, outer_scale))


def fitted_modes(samples, aperture, phase, n_modes):
    """Weighted least-squares Zernike coefficients (T, N, J) of a phase (T, N, P): no leak of piston into the rest."""
    basis = zernike_basis(samples, aperture, n_modes)
    weighted = basis * samples.weights[..., None]
    gram = torch.einsum("npi,npj->nij", weighted, basis)
    return torch.linalg.solve(gram, torch.einsum("npi,tnp->nit", weighted, phase)).permute(2, 0, 1)


def covariance_scores(coefficients, expected):
    """Deviation of the sample covariance (of columns, zero mean) from `expected`, in standard errors."""
    measured = coefficients.T @ coefficients / len(coefficients)
    variance = expected.diagonal()
    error = ((variance[:, None] * variance + expected**2) / len(coefficients)).sqrt()
    return (measured - expected) / error


# ---- statistics of screens


@pytest.mark.parametrize(("size", "outer_scale"), [(256, 20.0), (256, 2.0), (256, 100.0)])
def test_structure_function_of_screens(size, outer_scale):
    """400 screens over 2 D at D/r0 = 7: von Karman from 2 samples to D, within 4 standard errors and 0.3 %.

    The expected deviation is below 0.3 %; the standard error itself is below 1 % for small separations, 5 % at D.
    """
    step, r0 = 2 / size, 1 / 7
    lags = [2, 5, size // 32, size // 8, size // 4, size // 2]
    values = torch.zeros(400, len(lags), dtype=torch.float64)
    generator = seeded(int(outer_scale))
    for first in range(0, 400, 20):
        screens = phase_screens((size, size), step, r0, outer_scale, 20, generator, dtype=torch.float32)
        for k, lag in enumerate(lags):
            along = [screens[:, lag:] - screens[:, :-lag], screens[..., lag:] - screens[..., :-lag]]
            values[first : first + 20, k] = sum((d**2).mean((1, 2)) for d in along).double() / 2
    for k, lag in enumerate(lags):
        exact = exact_structure(lag * step, r0, outer_scale)
        error = float(values[:, k].std()) / math.sqrt(400) / exact
        assert error < (0.01 if lag < 8 else 0.05), lag
        assert float(values[:, k].mean()) == pytest.approx(exact, rel=0.003 + 4 * error), lag


def test_zernike_covariance_over_the_pupil():
    """Sample covariance of 15 modes in 3000 frames against theory, every entry, piston included."""
    pupil, r0, outer_scale = FullAperture(1.0), 1 / 7, 20.0
    samples = pupil.samples(Grid.nyquist(1.0, WAVELENGTH, 64))
    phase = TurbulencePhase(r0, outer_scale)(samples, 3000, seeded(1))
    modes = fitted_modes(samples, pupil, phase, 15)[:, 0]
    scores = covariance_scores(modes, modal_covariance(pupil, 15, r0, outer_scale))
    assert float(scores.abs().max()) < 4.5
    # Frames are independent of each other.
    following = (modes[1:] * modes[:-1]).mean(0) / modes.var(0)
    assert float(following.abs().max()) < 4.5 / math.sqrt(3000)


def test_modes_and_piston_differences_of_small_sub_apertures():
    """Sub-apertures of 0.117 D, two in contact, across the whole pupil: the joint covariance, and what fringes feel."""
    d, r0, outer_scale = 0.117, 1 / 7, 20.0
    centers = torch.tensor([[-0.44, 0.0], [-0.44 + d, 0.0], [0.1, -0.2], [0.44, 0.05]], dtype=torch.float64)
    mask = SparseAperture(centers, d, 1.0)
    samples = mask.samples(Grid.nyquist(1.0, WAVELENGTH, 192))
    phase = TurbulencePhase(r0, outer_scale)(samples, 2000, seeded(2))
    modes = fitted_modes(samples, mask, phase, 6)
    expected = modal_covariance(mask, 6, r0, outer_scale)
    assert float(covariance_scores(modes.flatten(1), expected).abs().max()) < 4.5
    for p in range(4):
        for q in range(p):
            difference = modes[:, p, 0] - modes[:, q, 0]
            exact = float(expected[6 * p, 6 * p] + expected[6 * q, 6 * q] - 2 * expected[6 * p, 6 * q])
            assert float((difference**2).mean()) == pytest.approx(exact, rel=4 * math.sqrt(2 / 2000))


def test_pupil_sees_one_continuous_screen():
    """The raster is in FFT order: the pupil lies across its border, where neighbours are as close as elsewhere."""
    r0, outer_scale = 1 / 7, 20.0
    grid = Grid.nyquist(1.2, WAVELENGTH, 64)
    for aperture in (FullAperture(1.2), SparseAperture([[1.0, 0.9], [1.2, 1.3], [0.6, 1.2]], 0.4, 1.2)):
        samples = aperture.samples(grid)
        phase = TurbulencePhase(r0, outer_scale)(samples, 200, seeded(3))
        n = samples.raster[0]
        open_cell = (samples.weights > 0).flatten()
        plane = torch.full((200, n * n), math.nan, dtype=torch.float64)
        plane[:, samples.index.flatten()[open_cell]] = phase.flatten(1)[:, open_cell]
        plane = plane.reshape(200, n, n)
        for axis in (1, 2):
            step = (plane - plane.roll(1, axis)).square().mean(0)  # NaN where one of the two is closed
            seam = step[0] if axis == 1 else step[:, 0]
            middle = step[n // 2] if axis == 1 else step[:, n // 2]
            crossing = torch.cat([seam, middle])
            crossing = crossing[~crossing.isnan()]
            assert len(crossing) > 10
            exact = exact_structure(samples.step[0], r0, outer_scale)
            # Each is a chi-square of 200 degrees of freedom.
            assert float((crossing / exact - 1).abs().max()) < 0.01 + 5 * math.sqrt(2 / 200)


# ---- frozen flow


def test_a_moved_screen_is_the_same_screen():
    """Whole samples: to rounding, what overlaps. Half a sample twice is a whole one. x to the right, y down."""
    step = 0.02
    moves = torch.tensor([[0.0, 0.0], [5.0, 0.0], [0.0, -3.0], [2.5, 1.5], [5.0, 3.0]], dtype=torch.float64) * step
    screens = frozen_flow((40, 50), step, 0.15, 20.0, moves, seeded(4), torch.float64)
    assert screens.shape == (5, 40, 50)
    close = {"rtol": 0, "atol": 1e-9}
    torch.testing.assert_close(screens[1][:, 5:], screens[0][:, :-5], **close)
    torch.testing.assert_close(screens[2][:-3], screens[0][3:], **close)
    torch.testing.assert_close(screens[4][3:, 5:], screens[0][:-3, :-5], **close)
    half = frozen_flow((40, 50), step, 0.15, 20.0, moves[3:4] / 2.5, seeded(4), torch.float64)
    assert not torch.allclose(half[0], screens[0])
    # One draw of a field of the same size: half way is half way of the whole way.
    twice = frozen_flow(
        (40, 50), step, 0.15, 20.0, torch.tensor([[0, 0], [0.5, 0], [1.0, 0], [1.5, 0]]) * step, seeded(5)
    )
    torch.testing.assert_close(twice[3][:, 1:], twice[1][:, :-1], rtol=0, atol=1e-3)


def test_flow_has_the_statistics_of_still_screens_in_space_and_time():
    """Time is distance over speed, beyond the width of the pupil too: the path does not come round again."""
    r0, outer_scale, step = 0.2, 5.0, 1 / 16
    moves = torch.tensor([[0.0, 0.0], [0.7, 0.35], [2.0, 1.75], [6.0, 5.25]], dtype=torch.float64)
    window = ScreenWindow((12, 16), (step, step), outer_scale, torch.float64, torch.device("cpu"))
    screens = [Screen(window, r0, seed) for seed in range(600)]
    samples = torch.stack([torch.stack([s.at((-x, -y)) for x, y in moves.tolist()]) for s in screens])
    flow = frozen_flow((12, 16), step, r0, outer_scale, moves, seeded(1), torch.float64)
    assert torch.equal(
        flow, torch.stack([Screen(window, r0, draw_seed(seeded(1))).at((-x, -y)) for x, y in moves.tolist()])
    )
    for t in range(4):
        for u in range(t):
            # The same point at two times, and opposite corners, the wind helping or opposing.
            for (y1, x1), (y2, x2) in (((0, 0), (0, 0)), ((11, 15), (0, 0)), ((0, 0), (11, 15)), ((0, 15), (11, 0))):
                difference = samples[:, t, y1, x1] - samples[:, u, y2, x2]
                lag = torch.tensor([x1 - x2, y1 - y2], dtype=torch.float64) * step - (moves[t] - moves[u])
                exact = exact_structure(float(lag.norm()), r0, outer_scale)
                assert float(difference.square().mean()) == pytest.approx(exact, rel=4.5 * math.sqrt(2 / 600))
            # Fine detail does not return: slopes are as uncorrelated as their distance makes them, 2 % at most here.
            slopes = samples[:, (t, u), 5, 8] - samples[:, (t, u), 5, 7]
            assert abs(float(torch.corrcoef(slopes.T)[0, 1])) < 0.021 + 4.5 / math.sqrt(600)


def test_wind_carries_the_phase_across_the_pupil():
    """Two equal holes in a line with the wind see the same phase, one after the other."""
    grid = Grid.nyquist(1.0, WAVELENGTH, 64)
    step = grid.period / 64
    mask = SparseAperture([[-8 * step, 0.0], [4 * step, 6 * step]], 0.2, 1.0)
    samples = mask.samples(grid)
    turbulence = TurbulencePhase(0.15, 20.0, wind=(12 * step / 0.003, 6 * step / 0.003), frame_interval=0.001)
    phase = turbulence(samples, 4, seeded(6))
    torch.testing.assert_close(phase[3, 1], phase[0, 0], rtol=0, atol=1e-9)
    assert float((phase[1, 1] - phase[0, 0]).abs().max()) > 0.1
    still = TurbulencePhase(0.15, 20.0, wind=(0.0, 0.0), frame_interval=1.0)(samples, 3, seeded(6))
    torch.testing.assert_close(still[0], still[2])


def test_a_flow_may_last():
    """Hundred kilometres of path in a square field: the frames at its end are like those at its beginning."""
    samples = FullAperture(1.0).samples(Grid.nyquist(1.0, WAVELENGTH, 32))
    turbulence = TurbulencePhase(0.15, 2.0, wind=(1e4, 1e4), frame_interval=1.0)
    phase = turbulence(samples, 100, seeded(8))[:, 0]
    still = TurbulencePhase(0.15, 2.0)(samples, 100, seeded(9))[:, 0]
    first, last = ((p[:, 1:] - p[:, :-1]).square().mean() for p in (phase[:50], phase[50:]))
    expected = float((still[:, 1:] - still[:, :-1]).square().mean())
    # mean squares of a pupil's worth of differences in 50 and 100 frames scatter by 2 % at most
    assert float(first) == pytest.approx(expected, rel=0.08)
    assert float(last) == pytest.approx(expected, rel=0.08)
    assert turbulence.extra_repr().endswith("wind=(10000.0, 10000.0), frame_interval=1.0")


# ---- generators, types, populations


def test_same_seed_same_numbers():
    for draw in (
        lambda seed, n=4: phase_screens((16, 20), 0.05, 0.2, 20.0, n, seeded(seed), torch.float64),
        lambda seed, n=4: frozen_flow((16, 20), 0.05, 0.2, 20.0, torch.zeros(n, 2), seeded(seed), torch.float64),
    ):
        assert torch.equal(draw(7), draw(7))
        assert not torch.allclose(draw(7), draw(8))
        assert torch.equal(draw(7, 3), draw(7)[:3])
    screens = phase_screens((16, 20), 0.05, 0.2, 20.0, 3, seeded(7))
    assert float((screens[0] - screens[1]).abs().min()) > 0
    torch.manual_seed(11)
    first = phase_screens((8, 8), 0.1, 0.2, 20.0, 1)
    torch.manual_seed(11)
    assert torch.equal(first, phase_screens((8, 8), 0.1, 0.2, 20.0, 1))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_follows_the_samples(dtype):
    samples = SparseAperture(torch.tensor([[0.0, 0.2], [0.2, -0.2]], dtype=dtype), 0.2, 1.0).samples(
        Grid.nyquist(1.0, WAVELENGTH, 32)
    )
    for turbulence in (TurbulencePhase(0.2, 20.0), TurbulencePhase(0.2, 20.0, (3.0, 1.0), 0.01)):
        phase = turbulence(samples, 3, seeded())
        assert phase.dtype == dtype
        assert phase.shape == (3, *samples.weights.shape)
    assert phase_screens((4, 5), (0.1, 0.2), 0.2, 20.0, 2, dtype=dtype).dtype == dtype


def test_a_population_sees_the_same_screens():
    grid = Grid.nyquist(1.2, WAVELENGTH, 32)
    centers = torch.tensor([[[0.0, 0.3], [0.2, -0.2]], [[0.2, -0.2], [-0.3, 0.1]]], dtype=torch.float64)
    phase = TurbulencePhase(0.2, 20.0)(SparseAperture(centers, 0.3, 1.2).samples(grid), 5, seeded())
    assert phase.shape[:3] == (2, 5, 2)
    torch.testing.assert_close(phase[0, :, 1], phase[1, :, 0])


def test_holes_that_train_see_the_phase_of_holes_that_rest():
    """Without a gradient of its own, and without a warning (warnings are errors here)."""
    grid = Grid.nyquist(1.2, WAVELENGTH, 32)
    centers = torch.tensor([[0.0, 0.3], [0.2, -0.2]], dtype=torch.float64)
    resting, training = (SparseAperture(c, 0.3, 1.2).samples(grid) for c in (centers, torch.nn.Parameter(centers)))
    phase = TurbulencePhase(0.2, 20.0)(training, 2, seeded())
    assert training.weights.requires_grad
    assert not phase.requires_grad
    assert torch.equal(phase, TurbulencePhase(0.2, 20.0)(resting, 2, seeded()))


# ---- bad input


@pytest.mark.parametrize("value", [0.0, -0.1, math.nan, math.inf])
def test_scales_must_be_positive(value):
    with pytest.raises(ValueError, match=r"r0 is .* finite and positive"):
        TurbulencePhase(value, 20.0)
    with pytest.raises(ValueError, match=r"outer_scale is .* finite and positive"):
        TurbulencePhase(0.1, value)
    with pytest.raises(ValueError, match=r"r0 is .* finite and positive"):
        phase_screens((8, 8), 0.1, value, 20.0, 1)
    with pytest.raises(ValueError, match=r"step is .* finite and positive"):
        phase_screens((8, 8), value, 0.1, 20.0, 1)


def test_flow_and_counts_are_checked():
    with pytest.raises(ValueError, match="only one of wind and frame_interval"):
        TurbulencePhase(0.1, 20.0, wind=(1.0, 0.0))
    with pytest.raises(ValueError, match="only one of wind and frame_interval"):
        TurbulencePhase(0.1, 20.0, frame_interval=0.01)
    with pytest.raises(ValueError, match=r"wind is \(1.0, nan\)"):
        TurbulencePhase(0.1, 20.0, (1.0, math.nan), 0.01)
    with pytest.raises(ValueError, match="frame_interval is 0"):
        TurbulencePhase(0.1, 20.0, (1.0, 0.0), 0.0)
    samples = FullAperture(1.0).samples(Grid.nyquist(1.0, WAVELENGTH, 32))
    with pytest.raises(ValueError, match="n_frames is 0"):
        TurbulencePhase(0.1, 20.0)(samples, 0)
    with pytest.raises(TypeError, match=r"samples are of type FullAperture: give those of a pupil, aperture\.samples"):
        TurbulencePhase(0.1, 20.0)(FullAperture(1.0), 1)
    with pytest.raises(ValueError, match=r"n_screens is 2\.5"):
        phase_screens((8, 8), 0.1, 0.1, 20.0, 2.5)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="side of shape is 0"):
        phase_screens((8, 0), 0.1, 0.1, 20.0, 2)
    with pytest.raises(TypeError, match="float16"):
        phase_screens((8, 8), 0.1, 0.1, 20.0, 2, dtype=torch.float16)


def test_a_step_may_be_a_number_of_numpy_or_a_tensor():
    expected = phase_screens((8, 9), (0.25, 0.25), 0.15, 20.0, 1, seeded())
    for step in (0.25, np.float32(0.25), torch.tensor(0.25), [0.25, 0.25]):  # which float32 holds exactly
        assert torch.equal(phase_screens((8, 9), step, 0.15, 20.0, 1, seeded()), expected)
    assert torch.equal(phase_screens((8.0, 9.0), 0.25, 0.15, 20.0, 1.0, seeded()), expected)
    with pytest.raises(ValueError, match=r"step is \(0\.1, 0\.1, 0\.1\): .* in m, one number or two \(dy, dx\)"):
        phase_screens((8, 9), (0.1, 0.1, 0.1), 0.15, 20.0, 1)


@pytest.mark.parametrize("shape", [(3,), (0, 2), (2, 3), (1, 2, 2)])
def test_a_flow_has_one_displacement_for_each_frame(shape):
    told = str(shape).replace("(", r"\(").replace(")", r"\)")
    with pytest.raises(ValueError, match=rf"displacements has shape {told}: it must be \(n_frames, 2\), .* in m"):
        frozen_flow((8, 9), 0.1, 0.15, 20.0, torch.zeros(shape))
