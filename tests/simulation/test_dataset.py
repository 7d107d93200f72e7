"""Stacks drawn by index: reproducible in any worker, within their ranges, and true to the simulation behind them."""

import math

import numpy as np
import pytest
import torch
from torch import nn
from torch.utils.data import DataLoader, Subset

from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.simulation.dataset import StackDataset, StackRanges

GRID = Grid.nyquist(1.0, 550e-9, 32)
CENTERS = torch.tensor([[0.02, 0.31], [0.3, -0.21], [-0.29, -0.18]], dtype=torch.float64)
MASK = SparseAperture(CENTERS, 0.2, 1.0)


def stacks(length=4, mask=MASK, **options):
    return StackDataset(mask, GRID, length, n_frames=3, **options)


def equal(first, second):
    assert first.keys() == second.keys()
    return all(torch.equal(first[name], second[name]) for name in first)


def test_an_item_is_a_stack_with_its_truth():
    item = stacks()[1]
    shapes = {name: tuple(tensor.shape) for name, tensor in item.items()}
    assert shapes == {
        "frames": (3, 32, 32),
        "object": (32, 32),
        "psfs": (3, 32, 32),
        "n_photons": (),
        "r0": (),
        "attitude": (3,),
        "sun": (3,),
    }
    assert {tensor.dtype for tensor in item.values()} == {torch.float32}
    assert float(item["object"].sum()) == pytest.approx(float(item["n_photons"]), rel=1e-5)
    assert float(item["sun"].norm()) == pytest.approx(1, rel=1e-6)


@pytest.mark.parametrize("index", range(3))
def test_frames_are_the_truth_blurred_by_the_psfs(index):
    """A full pupil in weak turbulence, whose PSFs lose little to the border of the field."""
    ranges = StackRanges(n_photons=(1e8, 1e8), r0=(1.0, 1.0))
    item = stacks(mask=FullAperture(1.0), ranges=ranges, dtype=torch.float64, readout_noise=0.0)[index]
    lost = float(1 - item["psfs"].sum((1, 2)).min())
    assert 0 < lost < 0.03
    spectrum = torch.fft.rfft2(item["object"], s=(64, 64)) * torch.fft.rfft2(item["psfs"], s=(64, 64))
    expected = torch.fft.irfft2(spectrum, s=(64, 64))[:, 16:48, 16:48]
    error, light = (image.flatten(1).norm(dim=1) for image in (item["frames"] - expected, expected))
    # Poisson: the squared norm of the noise is the number of electrons. What is lost is spread over more than the
    # field, and adds a tenth of its share at most.
    assert bool((error < 1.2 * 1e4 + 0.1 * lost * light).all())
    assert bool((error > 0.8 * 1e4).all())
    assert float((item["frames"] - expected.roll(1, -1)).norm() / expected.norm()) > 0.1


def test_stacks_depend_on_seed_and_index_alone():
    first = stacks(seed=5)
    backwards = [first[i] for i in (3, 1, 0)]
    again = stacks(length=100, seed=5)
    assert all(equal(item, again[i]) for item, i in zip(backwards, (3, 1, 0), strict=True))
    assert not torch.equal(first[0]["object"], first[1]["object"])
    assert not torch.equal(first[0]["object"], stacks(seed=6)[0]["object"])
    torch.manual_seed(0)
    state = torch.get_rng_state()
    first[2]
    assert torch.equal(torch.get_rng_state(), state)  # nobody else's random numbers are used up


@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")  # from Python 3.12 on
@pytest.mark.parametrize("start", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_workers_draw_the_same_stacks(start):
    dataset = stacks(mask=SparseAperture(nn.Parameter(CENTERS.clone()), 0.2, 1.0))
    loader = DataLoader(dataset, batch_size=2, num_workers=1 if start == "spawn" else 2, multiprocessing_context=start)
    batches = list(loader)
    assert [tuple(batch["frames"].shape) for batch in batches] == [(2, 3, 32, 32)] * 2
    for k, batch in enumerate(batches):
        for i in range(2):
            assert equal({name: values[i] for name, values in batch.items()}, dataset[2 * k + i])


def stars(index, generator):
    """As many stars as the index says, anywhere in the middle of the field."""
    image = torch.zeros(32, 32)
    for row, column in torch.randint(8, 24, (index + 1, 2), generator=generator).tolist():
        image[row, column] += 1.0
    return image


def test_scenes_of_ones_own_are_what_the_stacks_show():
    dataset = stacks(scene=stars, seed=3)
    assert set(dataset[0]) == {"frames", "object", "psfs", "n_photons", "r0"}
    for index in range(4):
        item = dataset[index]
        assert item["object"].dtype == torch.float32
        count = item["object"] / item["object"].sum() * (index + 1)
        torch.testing.assert_close(count, count.round(), rtol=0, atol=1e-5)
        assert float(item["object"].sum()) == pytest.approx(float(item["n_photons"]), rel=1e-5)
    given = torch.arange(32.0 * 32).reshape(32, 32)  # of any brightness, from an archive
    shown = stacks(scene=lambda index, generator: given)[2]["object"]
    torch.testing.assert_close(shown, given * (shown.sum() / given.sum()), rtol=1e-6, atol=0)


def test_own_scenes_depend_on_seed_and_index_alone():
    first, other = stacks(scene=stars, seed=5), stacks(length=100, scene=stars, seed=5)
    assert all(equal(first[i], other[i]) for i in (3, 1, 0))
    assert not torch.equal(first[2]["object"] > 0, stacks(scene=stars, seed=6)[2]["object"] > 0)
    # what the scene draws leaves the turbulence and the noise as they were
    flat = stacks(scene=lambda index, generator: torch.ones(32, 32), seed=5)
    assert torch.equal(flat[2]["psfs"], first[2]["psfs"])


@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")  # from Python 3.12 on
def test_workers_draw_the_same_own_scenes():
    dataset = stacks(scene=stars)
    loader = DataLoader(dataset, batch_size=2, num_workers=2, multiprocessing_context="fork")
    for k, batch in enumerate(loader):
        for i in range(2):
            assert equal({name: values[i] for name, values in batch.items()}, dataset[2 * k + i])


@pytest.mark.parametrize(
    ("scene", "error", "message"),
    [
        ("satellite", TypeError, "scene is a str: it must be a function of an index and a generator"),
        (lambda index, generator: [[1.0]], TypeError, r"scene\(0, generator\) gave a list"),
        (lambda index, generator: torch.zeros(32, 32), ValueError, r"scene\(0, generator\) gave an image"),
        (lambda index, generator: torch.full((32, 32), math.nan), ValueError, "with a sum of nan"),
        (lambda index, generator: torch.ones(16, 32), ValueError, r"scene has shape \(16, 32\)"),
        (lambda index, generator: torch.ones(32, 32) - 2 * torch.eye(32), ValueError, "negative light"),
    ],
)
def test_bad_scenes_are_refused_when_it_is_made(scene, error, message):
    with pytest.raises(error, match=message):
        stacks(scene=scene)
    with pytest.raises(ValueError, match="scene and path"):
        stacks(scene=stars, path="satellite.obj")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_batches_go_to_a_gpu():
    batch = next(iter(DataLoader(stacks(), batch_size=2, pin_memory=True)))
    moved = {name: values.to("cuda", non_blocking=True) for name, values in batch.items()}
    assert all(torch.equal(moved[name].cpu(), values) for name, values in batch.items())


def test_conditions_lie_within_their_ranges_and_fill_them():
    ranges = StackRanges(((-10, 10), (20, 30), (0, 0)), sun_angle=(15, 50), n_photons=(1e5, 1e7), r0=(0.1, 0.4))
    items = list(stacks(24, ranges=ranges))
    drawn = {name: torch.stack([item[name] for item in items]).double() for name in ("attitude", "n_photons", "r0")}
    drawn["angle"] = torch.stack([torch.rad2deg(torch.acos(item["sun"][2].double())) for item in items])
    bounds = {"angle": (15, 50), "n_photons": (1e5, 1e7), "r0": (0.1, 0.4)}
    cases = [(drawn[name], *bounds[name], name != "angle") for name in bounds]
    cases += [(drawn["attitude"][:, 0], -10, 10, False), (drawn["attitude"][:, 1], 20, 30, False)]
    for values, low, high, logarithmic in cases:
        share = (values - low) / (high - low)
        if logarithmic:
            share = torch.log(values / low) / math.log(high / low)
        assert share.min() > -1e-5
        assert share.max() < 1 + 1e-5
        # the mean of 24 uniform numbers: 4.5 standard errors; both ends are reached (1 - 0.75^24 = 0.999)
        assert abs(float(share.mean()) - 0.5) < 4.5 / math.sqrt(12 * 24)
        assert share.min() < 0.25
        assert share.max() > 0.75
    assert not drawn["attitude"][:, 2].any()
    assert float(torch.stack([item["sun"][:2] for item in items]).mean(0).norm()) < 0.4  # from all sides


def test_a_mask_that_trains_on_does_not_change_the_stacks():
    centers = nn.Parameter(CENTERS.clone())
    dataset = stacks(mask=SparseAperture(centers, 0.2, 1.0))
    before = dataset[0]
    with torch.no_grad():
        centers.mul_(0.8)
    assert equal(dataset[0], before)
    assert centers.requires_grad


def test_a_double_precision_dataset_shows_the_same_targets():
    item, fine = stacks()[2], stacks(dtype=torch.float64)[2]
    assert fine["frames"].dtype == torch.float64
    torch.testing.assert_close(
        item["object"].double(), fine["object"], rtol=1e-6, atol=1e-6 * float(fine["object"].max())
    )


def test_the_sequence_ends():
    dataset = stacks()
    assert len(dataset) == len(list(iter(dataset))) == 4
    with pytest.raises(IndexError, match="there are 4"):
        dataset[4]


def test_an_index_may_be_a_whole_number_of_torch_or_numpy():
    dataset = stacks()
    for index in (torch.tensor(3), torch.tensor([3]), np.int64(3)):
        assert equal(dataset[index], dataset[3])
    drawn = Subset(dataset, torch.tensor([2, 0]))
    assert equal(drawn[0], dataset[2])
    for index in (-1, torch.tensor(-1), torch.tensor(4)):
        with pytest.raises(IndexError, match="there are 4, from 0"):
            dataset[index]


@pytest.mark.parametrize("index", [1.5, slice(0, 2), "1", True, None, torch.tensor([0, 1]), torch.tensor(1.0)])
def test_what_is_no_index_is_refused(index):
    with pytest.raises(TypeError, match=r"the index of a stack is .*: it must be one whole number"):
        stacks()[index]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"length": 0}, "length is 0"),
        ({"length": 2.5}, "length is 2.5"),
        ({"seed": -1}, "seed is -1"),
        ({"size": 1.2}, "size is 1.2"),
        ({"path": "none.obj"}, "none.obj"),
        ({"readout_noise": -1.0}, "readout_noise"),
        ({"outer_scale": 0.0}, "outer_scale"),
        ({"mask": SparseAperture(torch.stack([CENTERS, CENTERS]), 0.2, 1.0)}, "population"),
    ],
)
def test_bad_input_is_refused_when_it_is_made(options, message):
    with pytest.raises(ValueError, match=message):
        stacks(**options)


@pytest.mark.parametrize(
    "bad",
    [
        {"n_photons": (0.0, 1e6)},
        {"r0": (0.2, 0.1)},
        {"r0": (0.1, math.inf)},
        {"sun_angle": (-5.0, 40.0)},
        {"attitude": ((0, 1), (0, math.nan), (0, 1))},
    ],
)
def test_bad_ranges_are_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        StackRanges(**bad)


def test_ranges_of_another_type_are_refused():
    with pytest.raises(TypeError, match="ranges is a dict: it must be StackRanges"):
        stacks(ranges={"r0": (0.1, 0.2)})


def test_whole_numbers_may_be_floats():
    """As arithmetic makes them."""
    mask = SparseAperture.from_catalog("golay6", 1.0, 0.15)
    floats, ints = (StackDataset(mask, GRID, *given)[0] for given in ((2.0, 3.0), (2, 3)))
    assert floats["frames"].shape == (3, *GRID.shape)
    assert torch.equal(floats["frames"], ints["frames"])
    with pytest.raises(ValueError, match=r"n_frames is 2\.5: it must be a whole number of at least 1"):
        StackDataset(mask, GRID, 2, 2.5)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"aperture": CENTERS}, "aperture is of type Tensor: it must be of type Aperture, such as SparseAperture"),
        ({"grid": 32}, r"grid is of type int: it must be of type Grid, such as Grid\.nyquist"),
        ({"dtype": torch.float16}, r"dtype is torch\.float16: torch\.float32 or torch\.float64 is needed"),
    ],
)
def test_arguments_of_another_type_are_refused(given, message):
    with pytest.raises(TypeError, match=message):
        StackDataset(**({"aperture": MASK, "grid": GRID, "length": 2} | given))


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"r0": 0.2}, r"r0 is 0\.2: it must be a range \(lowest, highest\), the same number twice for a constant"),
        ({"r0": (0.1, 0.2, 0.3)}, r"r0 is \(0\.1, 0\.2, 0\.3\): it must be a range"),
        ({"r0": ("low", "high")}, r"r0 is \('low', 'high'\): it must be a range"),
        ({"attitude": (0.0, 0.0, 0.0)}, r"attitude is \(0\.0, 0\.0, 0\.0\): it must be three ranges"),
        ({"attitude": ((0, 1), (0, 1))}, "it must be three ranges"),
        ({"attitude": ((0, 1), (0, 1), 2)}, "it must be three ranges"),
    ],
)
def test_what_is_no_pair_is_no_range(bad, message):
    with pytest.raises(ValueError, match=message):
        StackRanges(**bad)
