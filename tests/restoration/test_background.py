"""The background: closed forms of the constant that fits, and what a restoration makes of a sky."""

import math

import pytest
import torch

from torchmask.grid import Grid
from torchmask.restoration.adjoint import data_fidelity
from torchmask.restoration.background import Background, check_known_level, darkest_level, fills_field
from torchmask.restoration.calibration import fit_of_frames
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.frames import FrameStack
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.state import Calibration, State
from torchmask.restoration.variation import TotalVariation
from torchmask.restoration.verdict import Finding

GRID = Grid((12, 15), 2.3e-7, 550e-9)
FREE, COMMON = Background.PER_FRAME, Background.COMMON


def test_no_other_constant_fits_better(random_exposures, three_holes):
    exposures = random_exposures(ExposureModel(three_holes, GRID, 4))
    difference, precision = exposures.frames, exposures.precision
    level = FREE.level(difference, precision)
    least = (precision * (difference - level) ** 2).sum((1, 2), keepdim=True)
    total = precision.sum((1, 2), keepdim=True)
    for step in (0.01, -0.01):  # a parabola: precision * step^2 above the least
        moved = (precision * (difference - level - step) ** 2).sum((1, 2), keepdim=True)
        torch.testing.assert_close(moved - least, total * step**2)
    assert float(level.min()) > 0
    assert torch.equal(FREE.residual(-difference, precision), -difference)  # light is not negative
    assert torch.equal(Background.NONE.residual(difference, precision), difference)


def test_no_other_common_constant_fits_better_in_frames_divided_by_their_transmission(random_exposures, three_holes):
    exposures = random_exposures(ExposureModel(three_holes, GRID, 4))
    difference, precision = exposures.frames, exposures.precision
    unit = torch.tensor([0.5, 1.0, 3.0], dtype=torch.float64)[:, None, None]
    level = COMMON.level(difference, precision, unit)
    torch.testing.assert_close(level, unit * (level / unit).mean())  # one constant
    least = (precision * (difference - level) ** 2).sum()
    for step in (0.01, -0.01):
        moved = (precision * (difference - level - step * unit) ** 2).sum()
        torch.testing.assert_close(moved - least, (precision * unit**2).sum() * step**2)
    assert float(level.min()) > 0
    assert torch.equal(COMMON.residual(-difference, precision, unit), -difference)


def test_a_common_sky_is_as_much_more_certain_as_there_are_frames(explained):
    """Least squares: the variance is 1 / sum of w (1 - s m)^2, over one frame or over all.

    s m is the image of the object that is nearest to a constant, since the transmission s is fitted too. The variance
    of 300 draws scatters by sqrt(2 / 300) = 8 %: 4 deviations.
    """
    objective, state = explained
    model, draws, noise = objective.model, 300, 0.5
    transmission = torch.tensor([0.6, 0.9, 1.1, 1.4], dtype=torch.float64)[:, None, None]
    sharp = model(state.image, state.z)
    sky, generator = 3.0, torch.Generator().manual_seed(2)
    nearest = sharp.sum((1, 2), keepdim=True) / (sharp**2).sum((1, 2), keepdim=True) * sharp
    told = ((1 - nearest) ** 2).sum((1, 2)) / noise**2  # of the constant, by each frame
    found: dict[Background, list] = {COMMON: [], FREE: []}
    for _ in range(draws):
        white = torch.randn(sharp.shape, dtype=torch.float64, generator=generator)
        frames = transmission * sharp + sky + noise * white
        for background, levels in found.items():
            seen = MyopicObjective(model.beside(background), frames, torch.ones(1, 1, 1).double(), TotalVariation())
            left = frames - fit_of_frames(seen, state)[0][:, None, None] * sharp
            levels.append(background.level(left, seen.precision).flatten())
    common, each = (torch.stack(found[background]) for background in (COMMON, FREE))
    assert float(common.std(1).max()) == 0
    for levels, expected in ((common[:, 0], 1 / told.sum()), (each, 1 / told)):
        torch.testing.assert_close(levels.var(0), expected, rtol=4 * math.sqrt(2 / draws), atol=0)
        assert float(((levels.mean(0) - sky) / (expected / draws).sqrt()).abs().max()) < 4


@pytest.mark.parametrize(("dtype", "rounding"), [(torch.float64, 1e-12), (torch.float32, 1e-4)])
@pytest.mark.parametrize("one_precision", [True, False])
@pytest.mark.parametrize("background", [FREE, COMMON])
def test_gradients_beside_a_free_background_are_those_of_autograd(
    dtype, rounding, one_precision, background, random_exposures, three_holes
):
    model = ExposureModel(three_holes, GRID, 4, background=background, dtype=dtype)
    model, image, z, frames, precision = random_exposures(model)
    precision = precision[:, :1, :1] if one_precision else precision
    objective = MyopicObjective(
        model, frames + torch.tensor([9.0, -9.0, 9.0])[:, None, None], precision, TotalVariation()
    )
    image.requires_grad_()
    z.requires_grad_()
    value = objective(image, z)
    by_image, by_z = torch.autograd.grad(value, (image, z))
    found = objective.value_and_gradients(image.detach(), z.detach())
    assert float(found.value) == pytest.approx(value.item(), rel=rounding)
    assert (found.object_gradient - by_image).abs().max() < rounding * by_image.abs().max()
    assert (found.aberration_gradient - by_z).abs().max() < rounding * by_z.abs().max()


def test_the_misfit_does_not_know_a_sky_and_the_object_pays_for_its_light(random_exposures, three_holes):
    model, image, z, frames, precision = random_exposures(ExposureModel(three_holes, GRID, 4, background=FREE))
    frames = frames + 10.0 * image.mean()
    sky = torch.tensor([0.3, 2.0, 50.0], dtype=torch.float64)[:, None, None]
    below, above = (data_fidelity(model, image, z, f, precision) for f in (frames, frames + sky))
    torch.testing.assert_close(below.value, above.value)
    torch.testing.assert_close(below.object_gradient, above.object_gradient, rtol=1e-9, atol=1e-12)
    # A level of the object is a sky too: only its price tells them apart.
    objective = MyopicObjective(model, frames, precision, TotalVariation())
    evaluate = objective.evaluator(objective.neutral_calibration())
    rise = evaluate(image + 2.0, z).value - evaluate(image, z).value
    assert float(rise) == pytest.approx(2.0 * FREE.price * image.numel(), rel=1e-6)


def test_transmissions_are_those_of_what_rises_above_the_background(random_exposures, three_holes):
    model, image, z, _, precision = random_exposures(ExposureModel(three_holes, GRID, 4, background=FREE))
    transmission = torch.tensor([0.7, 1.4, 0.9], dtype=torch.float64)
    frames = transmission[:, None, None] * model(image, z) + torch.tensor([3.0, 0.0, 0.5]).double()[:, None, None]
    objective = MyopicObjective(model, frames, precision, TotalVariation())
    state = State(image, z, Calibration(torch.ones(3).double(), torch.ones(3).double(), 1.0))
    found, chi_square = fit_of_frames(objective, state)
    torch.testing.assert_close(found, transmission)
    assert float(chi_square.max()) < 1e-20


def test_a_common_sky_is_never_less_than_none(random_exposures, three_holes):
    """Frames from which too much was subtracted are fitted as if no sky were free."""
    model, image, z, _, precision = random_exposures(ExposureModel(three_holes, GRID, 4))
    frames = model(image, z) - 3.0
    ones = torch.ones(3, dtype=torch.float64)
    state = State(image, z, Calibration(ones, ones, 1.0))
    told, free = (
        fit_of_frames(MyopicObjective(model.beside(background), frames, precision, TotalVariation()), state)
        for background in (Background.NONE, COMMON)
    )
    for one, other in zip(free, told, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=0)


def test_the_darkest_part_is_that_of_the_mean_frame():
    frames = torch.full((3, 40, 32), 9.0, dtype=torch.float64)
    frames[:, :5, 4:8] = torch.tensor([2.0, 6.0, 4.0]).double()[:, None, None]
    frames[0, 20:25, 8:12] = 0.0  # darker, in one frame only
    assert darkest_level(frames).flatten().tolist() == [2.0, 6.0, 4.0]


def test_a_background_that_is_known_is_taken_off_and_its_noise_is_left(five_holes, observation):
    frames, sky = observation.frames, 40.0
    options = (observation.grid, five_holes, 1.5)
    plain = FrameStack.of(frames, None, *options)
    for given in (sky, torch.full(frames.shape[1:], sky), torch.full((len(frames), 1, 1), sky)):
        stack = FrameStack.of(frames + sky, None, *options, given)
        torch.testing.assert_close(stack.frames, plain.frames)
        assert stack.unit == pytest.approx(plain.unit)
        assert stack.variance == pytest.approx(plain.variance + sky)


@pytest.mark.parametrize(
    ("background", "message"),
    [
        ("common", "such as Background.COMMON"),
        (math.nan, "not finite"),
        (-3.0, "negative .-3 electrons"),
        (torch.zeros(5), "broadcasts"),
        (torch.zeros(2, 1, 1), "one number"),
    ],
)
def test_a_background_that_cannot_be_one_is_refused(background, message):
    with pytest.raises(ValueError, match=message):
        check_known_level(background, torch.ones(3, 8, 8))


def test_frames_that_are_darker_than_their_background_are_refused(observation, five_holes):
    with pytest.raises(ValueError, match="hold only background"):
        FrameStack.of(
            observation.frames, None, observation.grid, five_holes, 1.5, 2.0 * float(observation.frames.mean())
        )


def test_a_sky_is_free_where_the_darkest_part_of_the_field_shows_it(three_holes):
    """Holes scatter light too: a level below a tenth of the mean may be theirs."""
    shining = torch.full((4, 40, 40), 1.0, dtype=torch.float64)
    shining[:, 10:30, 10:30] = 9.0  # 3 on average, 1 where it is darkest
    for level, seen in ((0.0, True), (-0.8, False), (-1.1, False)):
        frames = shining + level
        is_seen = 1 + level > 0.1 * (3 + level)
        assert is_seen is seen
        assert Background.IF_SEEN.of(frames, fills=False) is (FREE if seen else Background.NONE)
        assert Background.IF_SEEN.of(frames, fills=True) is Background.NONE
    noisy = shining + 2 * torch.randn(shining.shape, generator=torch.Generator().manual_seed(0)).double()
    stack = FrameStack.of(noisy, None, Grid(40, 2.3e-7, 550e-9), three_holes, 1.0, Background.IF_SEEN)
    assert stack.free is FREE
    for told in (Background.NONE, FREE):
        assert told.of(shining, fills=told is FREE) is told


@pytest.mark.parametrize(("dark", "filled"), [(4, True), (18, True), (22, False), (36, False)])
def test_an_object_that_most_of_the_border_shows_fills_the_field(dark, filled):
    """It is in the light to the right of column `dark`, and seen wherever the border is dark."""
    frames = torch.full((2, 40, 40), 3.0, dtype=torch.float64)
    frames[:, 5:35, 5:35] = 8.0
    frames[:, :, dark:] = 8.0  # on a level of 3, which may be a sky or its own
    valid = torch.ones_like(frames, dtype=torch.bool)
    assert (38 + 2 * (40 - dark) > 156 / 2) is filled  # pixels of the border in the light, of all
    assert fills_field(frames, valid, 1e-6) is filled
    framed = valid.clone()
    framed[:, 0] = framed[:, -1] = framed[:, :, 0] = framed[:, :, -1] = False
    assert not fills_field(frames, framed, 1e-6)  # pixels without weight tell nothing


@pytest.mark.parametrize(("share", "filled"), [(0.42, False), (0.44, True)])
def test_a_halo_at_the_border_is_no_object_that_fills_the_field(share, filled):
    """All of the border has this share of the mean light above the darkest part."""
    frames = torch.zeros(2, 40, 40, dtype=torch.float64)
    frames[:, 10:30, 10:30] = 1.0  # 400 of 1600 pixels
    frames[:, [0, -1]] = frames[:, :, [0, -1]] = border = share * 400 / (1600 - share * 156)
    frames += 1.0 + torch.tensor([-0.5, 0.5])[:, None, None]  # the sky changes from frame to frame
    assert border == pytest.approx(share * float(frames.mean() - 1), rel=1e-12)
    valid = torch.ones_like(frames, dtype=torch.bool)
    assert fills_field(frames, valid, 1e-6) is filled


def test_a_border_as_bright_as_its_noise_shows_no_object():
    """Of noise alone the border is as bright as the rest, above its darkest part, of 5 x 5 pixels in two frames."""
    frames = torch.full((2, 40, 40), 8.0, dtype=torch.float64)
    frames[:, 5:10, 5:10] = 3.0
    above = 5 * (1 - 1 / 64)  # of the mean light over the darkest of 64 parts
    surely = 50 * (above / 5) ** 2  # the noise of a pixel, at which that is five standard deviations
    valid = torch.ones_like(frames, dtype=torch.bool)
    assert fills_field(frames, valid, 0.99 * surely)
    assert not fills_field(frames, valid, 1.01 * surely)


def test_a_model_does_not_decide_what_frames_show(three_holes):
    model = ExposureModel(three_holes, GRID, 4)
    for make in (lambda sky: ExposureModel(three_holes, GRID, 4, background=sky), model.beside):
        with pytest.raises(ValueError, match=r"IF_SEEN, which frames decide and no model"):
            make(Background.IF_SEEN)


def test_a_model_beside_a_background_shares_all_else(random_exposures, three_holes):
    model = ExposureModel(three_holes, GRID, 4)
    beside = model.beside(FREE)
    assert (model.background, beside.background) == (Background.NONE, FREE)
    assert beside.pupil is model.pupil


def test_a_restoration_finds_one_sky_for_all_frames_through_clouds(observe, restoring):
    """As bright as a mean pixel of the object; less than a tenth of that would not count as seen."""
    observation = observe()
    sky, gains = float(observation.frames.mean()), torch.linspace(0.5, 1.5, 8, dtype=torch.float64)[:, None, None]
    noise = torch.poisson(torch.full_like(observation.frames, sky), generator=torch.Generator().manual_seed(5))
    method = restoring(background=COMMON, max_iterations=30)
    result = method.restore(gains * observation.frames + noise, known_object=observation.object)
    assert result.background is not None
    assert float(result.background.std()) < 1e-6 * sky
    assert result.sky == pytest.approx(sky, rel=0.1)


@pytest.mark.filterwarnings("ignore:the frames are bright at the border")  # where no sky is looked for
def test_a_restoration_finds_the_sky_and_loses_nothing_else(observation, restoring):
    """A sky as bright as the mean pixel: its noise is more, the object is the same."""
    restored = restoring(max_iterations=400).restore(observation.frames)
    sky = float(observation.frames.mean())
    noise = torch.poisson(torch.full_like(observation.frames, sky), generator=torch.Generator().manual_seed(5))
    result = restoring(max_iterations=400).restore(observation.frames + noise)
    assert result.background is not None
    assert float((result.background - sky).abs().max()) < 0.05 * sky  # of which the halo of the object is a part
    torch.testing.assert_close(result.transmission, restored.transmission, atol=0.02, rtol=0)
    change = (result.object - restored.object).norm() / restored.object.norm()
    ignored = restoring(background=Background.NONE, max_iterations=400).restore(observation.frames + noise)
    assert float(change) < 0.5 * float((ignored.object - restored.object).norm() / restored.object.norm())


@pytest.mark.slow
def test_the_sky_of_bright_frames_does_not_stay_in_the_object(observe, restoring):
    """The dark ring that modes left out draw around a bright object would hold a seventh of the sky up, and later more.

    A tenth is the light of the object that the optics scatter into the field's dark parts, at most 0.06 of its mean,
    over a sky of 0.5.
    """
    seen = observe(n_frames=4, n_photons=2e7, r0=0.2)
    sky = 0.5 * float(seen.frames.mean())
    noise = torch.poisson(torch.full_like(seen.frames, sky), generator=torch.Generator().manual_seed(5))
    result = restoring(6, r0=0.2, max_iterations=500, refine_geometry=False).restore(seen.frames + noise)
    assert result.sky == pytest.approx(sky, rel=0.06 / 0.5)


@pytest.mark.filterwarnings("ignore:much of the light is even")
def test_noise_is_all_sky_and_no_object(five_holes):
    grid = Grid.nyquist(1.0, 550e-9, 32)
    frames = torch.poisson(torch.full((4, *grid.shape), 200.0), generator=torch.Generator().manual_seed(0)).double()
    result = MyopicDeconvolution(five_holes, grid, 3, r0=0.25).restore(frames)
    assert result.verdict.finding is Finding.ONLY_NOISE
    assert result.sky == pytest.approx(200.0, rel=0.05)
    assert bool(torch.isfinite(result.object).all())
