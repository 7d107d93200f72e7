"""Images of a star through a mask that lies otherwise: against FFTs, and all their derivatives."""

import math

import pytest
import torch

from torchmask.grid import Grid
from torchmask.interferometry.star_fit import Information
from torchmask.interferometry.star_frames import StarFrames
from torchmask.interferometry.star_model import PLACE, Shared, StarModel
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.geometry import MaskGeometry
from torchmask.optics.pixel import SquarePixel
from torchmask.optics.psf import focal_intensity
from torchmask.optics.zernike import ZernikePhase

GRID = Grid.nyquist(1.1, 550e-9, 48)
MASKS = {
    shape: SparseAperture([[0.02, 0.38], [-0.35, -0.2], [0.3, -0.28], [0.31, 0.2]], 0.2, 1.0, shape)
    for shape in ("disc", "hexagon")
}


def shared(geometry: MaskGeometry, logarithms: list[float]) -> Shared:
    return Shared(geometry.matrix, torch.tensor(logarithms, dtype=torch.float64))


def own(seed: int, n_modes: int, rms: float = 0.5) -> torch.Tensor:
    values = rms * torch.randn(4 * n_modes, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.cat([values.new_tensor([3.0, 0.7]), values])


@pytest.mark.parametrize("shape", MASKS)
def test_images_are_those_of_the_moved_mask_by_fft(shape):
    geometry, mask, values = MaskGeometry(0.05, 1.02, 1.02), MASKS[shape], own(0, 3)
    model, lies = StarModel(mask, GRID, 23, 3), shared(geometry, [0.0] * 4)
    image = model.image(values, lies, model.kernels(lies.matrix)) - values[1]
    moved, errors = geometry.apply(mask), []
    coefficients = values[PLACE:].view(4, 3)
    tilts = coefficients[:, 1:] @ (geometry.matrix / 1.02).T  # the model's turn with the mask
    coefficients = torch.cat([coefficients[:, :1], tilts], 1)
    for oversampling in (4, 8):
        phase = ZernikePhase(moved, GRID, 3, oversampling)
        by_fft = focal_intensity(moved.samples(GRID, oversampling), phase(coefficients))
        square = by_fft.roll((23, 23), (0, 1))[:47, :47].flatten()
        errors.append(float((square * (image.sum() / square.sum()) - image).norm() / image.norm()))
    # The samples of the pupil err by the square of their step.
    assert errors[1] < 2e-3
    assert 2.5 < errors[0] / errors[1] < 6


@pytest.mark.parametrize("pixel", [None, SquarePixel()], ids=["points", "squares"])
@pytest.mark.parametrize("shape", MASKS)
def test_derivatives_are_those_of_autograd(shape, pixel):
    model = StarModel(MASKS[shape], GRID, 4, 6, pixel)
    lies = shared(MaskGeometry(0.05, 1.02, 0.99, 0.01, mirrored=True), [0.1, -0.1, 0.2, 0.0])

    def image(own, matrix, logarithms):
        here = Shared(matrix.view(2, 2), logarithms)
        return model.image(own, here, model.kernels(here.matrix))

    arguments = (own(1, 6), lies.matrix.flatten(), lies.log_transmission)
    values, by_own, by_shared = model.linearise(arguments[0], lies, model.kernels(lies.matrix))
    expected = torch.func.jacrev(image, argnums=(0, 1, 2))(*arguments)
    torch.testing.assert_close(values, image(*arguments))
    torch.testing.assert_close(by_own, expected[0], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(by_shared, torch.cat(expected[1:], 1), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("fill", [-0.1, 0.0, 0.7, 1.0])
def test_derivative_by_the_pixels_is_that_of_autograd(fill):
    """Also below 0, where the series goes on; within range the blur is that of SquarePixel."""
    model, values = StarModel(MASKS["disc"], GRID, 4, 3), own(1, 3)
    matrix, even = MaskGeometry(0.05).matrix, torch.zeros(4, dtype=torch.float64)

    def image(fill):
        return model.image(values, Shared(matrix, even, fill), model.kernels(matrix))

    at = torch.tensor(fill, dtype=torch.float64)
    _, _, by_shared = model.linearise(values, Shared(matrix, even, at), model.kernels(matrix))
    torch.testing.assert_close(by_shared[:, -1], torch.func.jacrev(image)(at), rtol=1e-9, atol=1e-9)
    if fill > 0:
        known = StarModel(MASKS["disc"], GRID, 4, 3, SquarePixel(fill))
        torch.testing.assert_close(image(at), known.image(values, Shared(matrix, even), known.kernels(matrix)))


def test_pixels_blur_by_their_transfer_function():
    sharp, blurred = (StarModel(MASKS["disc"], GRID, 12, 3, pixel) for pixel in (None, SquarePixel(0.7)))
    lies, values = shared(MaskGeometry(), [0.0] * 4), own(2, 3)
    images = [model.image(values, lies, model.kernels(lies.matrix)).view(25, 25) for model in (sharp, blurred)]
    nu = torch.fft.fftfreq(25, dtype=torch.float64)
    ratio = torch.fft.fft2(images[1] - values[1]) / torch.fft.fft2(images[0] - values[1])
    torch.testing.assert_close(ratio.real, SquarePixel(0.7).transfer(nu[:, None], nu))


@pytest.mark.parametrize("shape", MASKS)
def test_offsets_tell_by_how_much_a_common_tilt_moves_the_image(shape):
    model, lies = StarModel(MASKS[shape], GRID, 12, 6), shared(MaskGeometry(0.3, 1.05, 0.97, 0.02), [0.0] * 4)
    move = torch.tensor([1.0, -2.0], dtype=torch.float64)
    # phase k s . A r at the centres is their piston; over a hole, by Noll 2 and 3 along x and y: 2 r / R has unit rms
    slope = 2 * math.pi / GRID.period * (move @ lies.matrix)
    points, weights = model._points, model._weights
    tilts = torch.linalg.lstsq(model._modes * weights.sqrt()[:, None], (points @ slope) * weights.sqrt()).solution
    coefficients = tilts.repeat(4, 1)
    coefficients[:, 0] += model.centers @ slope
    values = torch.cat([move.new_zeros(PLACE), coefficients.flatten()])
    torch.testing.assert_close(values @ model.offset_slopes(lies), move)
    kernels = model.kernels(lies.matrix)
    still = model.image(torch.zeros_like(values), lies, kernels).view(25, 25)
    moved = model.image(values, lies, kernels).view(25, 25)
    torch.testing.assert_close(moved[:-2, 1:], still[2:, :-1])


@pytest.mark.parametrize("shape", [(32, 36), (33, 35)])
def test_places_of_stars_count_from_the_middle_pixel_of_odd_sides_too(shape):
    frames = torch.zeros(2, *shape, dtype=torch.float64)
    frames[0, shape[0] // 2 + 3, shape[1] // 2 - 2] = frames[1, shape[0] // 2 - 1, shape[1] // 2 + 4] = 1.0
    star = StarFrames.around(frames, torch.ones_like(frames, dtype=torch.bool), 3)
    assert star.middles.tolist() == [[-2.0, 3.0], [4.0, -1.0]]  # (x, y)
    assert star.pixels[:, 3, 3].tolist() == [1.0, 1.0]


def test_the_light_of_a_star_is_that_inside_the_frame_filled_in_or_not():
    frames = torch.full((1, 9, 9), 2.0, dtype=torch.float64)
    frames[0, 1, 1], frames[0, 1, 2] = 50.0, 30.0
    valid = torch.ones_like(frames, dtype=torch.bool)
    valid[0, 1, 2] = False
    star = StarFrames.around(frames, valid, 3)
    assert star.middles.tolist() == [[-3.0, -3.0]]
    expected = torch.zeros(7, 7, dtype=torch.float64)
    expected[3, 3], expected[3, 4] = 48.0, 28.0
    torch.testing.assert_close(star.light[0], expected, rtol=0, atol=0)
    assert star.inside[0, :, 1].tolist() == [False] * 7
    assert star.inside[0, 2:, 2:].all()
    assert int((star.inside & ~star.counted).sum()) == 1


def test_the_scatter_of_frames_is_that_of_their_mean():
    """Each tells one number with a variance of 1 / 2: the mean of them all has their sample variance over n."""
    numbers = torch.tensor([1.0, -2.0, 0.5, 3.0, -2.5], dtype=torch.float64)
    ones, nothing = torch.ones(5, 1, 1, dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64)
    information = Information(2 * ones, 2 * (numbers - numbers.mean())[:, None], ones, nothing)
    assert float(information.noise_covariance) == pytest.approx(1 / 10, rel=1e-12)
    assert float(information.covariance) == pytest.approx(float(numbers.var()) / 5, rel=1e-12)


@pytest.mark.parametrize(("n", "size"), [(2, 8), (3, 8), (10, 4)])
def test_errors_of_few_frames_are_those_of_all_their_parameters(n, size):
    """Frames that differ by twice their noise: the mean square of pulls is that of F for all parameters and frames.

    It is m / (m - 2) with m = size (n - 1); for each parameter by itself it is infinite for two or three frames.
    """
    generator, squares = torch.Generator().manual_seed(0), []
    nothing = torch.zeros(size, size, dtype=torch.float64)
    for _ in range(400):
        numbers = 2 * torch.randn(n, size, generator=generator, dtype=torch.float64)
        ones = torch.eye(size, dtype=torch.float64).expand(n, -1, -1)
        covariance = Information(ones, numbers - numbers.mean(0), ones, nothing).covariance
        squares.append(numbers.mean(0) ** 2 / covariance.diagonal())
    m = size * (n - 1)
    assert float(torch.stack(squares).mean()) == pytest.approx(m / (m - 2), rel=0.15)


def test_scatter_below_the_noise_counts_by_the_number_of_frames():
    """The noise has the weight of ten: four frames that agree have 10 / 14 of its variance."""
    ones, nothing = torch.ones(4, 1, 1, dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64)
    information = Information(ones, torch.zeros(4, 1, dtype=torch.float64), ones, nothing)
    assert float(information.covariance) == pytest.approx(10 / 14 / 4, rel=1e-12)
    single = Information(ones[:1], torch.zeros(1, 1, dtype=torch.float64), ones[:1], nothing)
    assert float(single.covariance) == 1.0
