"""Priors on the object: known values, gradients and curvatures against automatic differentiation, for every prior."""

import math
from functools import partial

import pytest
import torch
from torch import nn

from torchmask.restoration.given_prior import FunctionPrior, as_prior, check_prior
from torchmask.restoration.priors import EdgePreserving, ObjectPrior
from torchmask.restoration.slopes import divergence, gradient
from torchmask.restoration.structure import Metric
from torchmask.restoration.variation import AdaptedVariation, SmoothVariation, TotalVariation


def squares(image):
    """As a stranger writes one."""
    return 0.5 * (gradient(image)[0] ** 2 + 3.0 * gradient(image)[1] ** 2).sum()


class Learned(nn.Module):
    """A filter whose weights are parameters."""

    def __init__(self):
        super().__init__()
        generator = torch.Generator().manual_seed(4)
        self.kernel = nn.Parameter(torch.randn(2, 1, 3, 3, dtype=torch.float64, generator=generator))

    def forward(self, image):
        return torch.log1p(nn.functional.conv2d(image[None, None], self.kernel.to(image), padding=1) ** 2).sum()


class Entropy:
    """With a gradient and a curvature of its own."""

    def __call__(self, image):
        return ((image + 1) * (image + 1).log()).sum()

    def gradient(self, image):
        return (image + 1).log() + 1

    def curvature(self, image):
        return 1 / (image + 1)


class Ridge(ObjectPrior):
    """A subclass that writes `forward` only."""

    def forward(self, image):
        return 0.7 * (image**2).sum()


class AdaptedToAnother(ObjectPrior):
    """An `AdaptedVariation`, made for images of any size, adapted to one that is steeper to the right and below."""

    def forward(self, image):
        return self.for_images_like(image)(image)

    def value_and_gradient(self, image):
        return self.for_images_like(image).value_and_gradient(image)

    def curvature(self, image):
        return self.for_images_like(image).curvature(image)

    @staticmethod
    def for_images_like(image):
        other = rough(*image.shape, seed=7).cumsum(0).cumsum(1).to(image.dtype)
        found = SmoothVariation(0.7, 0.4, 0.05).adapted_to(other, 1.0)
        assert isinstance(found, AdaptedVariation)
        return found


PRIORS = {
    "total variation": TotalVariation,
    "smoother total variation": lambda: TotalVariation(2.0, 0.3),
    "total variation with bends": SmoothVariation,
    "more bends": lambda: SmoothVariation(0.3, 2.0, 0.1),
    "adapted to another image": AdaptedToAnother,
    "edge preserving": EdgePreserving,
    "edge preserving, other threshold": lambda: EdgePreserving(0.7, 0.1),
    "function": lambda: squares,
    "module": Learned,
    "own gradient": Entropy,
    "subclass": Ridge,
}
each_prior = pytest.mark.parametrize("make", PRIORS.values(), ids=PRIORS.keys())


def rough(rows=6, columns=7, seed=0, dtype=torch.float64):
    return torch.rand(rows, columns, dtype=dtype, generator=torch.Generator().manual_seed(seed))


def exact_gradient(prior, image):
    leaf = image.detach().clone().requires_grad_()
    return torch.autograd.grad(prior(leaf), leaf)[0]


@each_prior
@pytest.mark.parametrize(("dtype", "rounding"), [(torch.float64, 1e-12), (torch.float32, 2e-5)])
def test_value_and_gradient_are_those_of_autograd(make, dtype, rounding):
    prior, image = as_prior(make()), 3 * rough(dtype=dtype)
    value, slope = prior.value_and_gradient(image)
    expected = exact_gradient(prior, image)
    assert value.ndim == 0
    assert not value.requires_grad
    assert not slope.requires_grad
    assert slope.dtype == dtype
    assert float(value) == pytest.approx(float(prior(image).detach()), rel=rounding)
    assert float((slope - expected).abs().max()) < rounding * float(expected.abs().max())


@each_prior
def test_gradcheck(make):
    prior = as_prior(make())
    assert torch.autograd.gradcheck(prior, rough(4, 5).requires_grad_())
    if make is not PRIORS["own gradient"]:
        assert torch.autograd.gradgradcheck(prior, rough(4, 5, seed=1).requires_grad_())


@each_prior
def test_curvature_majorises_or_is_the_diagonal_of_the_hessian(make):
    """Within the statistical error of eight probes: the off-diagonal part of a row, over the square root of eight."""
    prior, image = as_prior(make()), rough()
    hessian = torch.autograd.functional.hessian(prior, image).reshape(image.numel(), -1)
    exact = hessian.diagonal()
    off = (hessian.square().sum(1) - exact.square()).clamp(min=0).sqrt()
    found = prior.curvature(image)
    assert found.shape == image.shape
    assert bool((found >= 0).all())
    if type(prior).curvature is ObjectPrior.curvature or isinstance(prior, FunctionPrior):
        assert bool(((found.flatten() - exact.clamp(min=0)).abs() < 4.5 * off / math.sqrt(8) + 1e-12).all())
    else:
        assert bool((found.flatten() >= exact - 1e-12).all())


@pytest.mark.parametrize(
    "make", [TotalVariation, partial(TotalVariation, 2.0, 0.3), SmoothVariation, AdaptedToAnother, EdgePreserving]
)
def test_curvature_majorises(make):
    """A quadratic in one pixel with that curvature lies above the prior everywhere and touches it at the image."""
    prior = make()
    image = rough(seed=1)
    value, slope = prior.value_and_gradient(image)
    curvature = prior.curvature(image)
    for step in (-2.0, -0.1, -0.001, 0.001, 0.1, 2.0):
        moved = image.clone()
        moved[2, 3] += step
        bound = value + slope[2, 3] * step + 0.5 * curvature[2, 3] * step**2
        assert float(prior(moved)) <= float(bound) + 1e-12


def test_total_variation_of_known_images():
    sharp = TotalVariation(epsilon=1e-9)
    step = torch.zeros(8, 10, dtype=torch.float64)
    step[2:6, 3:7] = 5.0
    # A square of side 4 and height 5: 16 unit edges, but at one corner both differences fall on one pixel.
    assert float(sharp(step)) == pytest.approx(5 * (14 + 2**0.5), rel=1e-6)
    assert float(TotalVariation()(torch.full((4, 4), 3.0))) == 0
    diagonal = torch.zeros(8, 8, dtype=torch.float64)
    diagonal[3, 3] = 1
    assert float(sharp(diagonal)) == pytest.approx(2 + 2**0.5, rel=1e-6)  # isotropic, not 4
    assert float(TotalVariation(3.0, 1e-9)(step)) == pytest.approx(3 * float(sharp(step)), rel=1e-12)


def test_total_variation_gradient():
    for epsilon in (0.01, 0.3):
        prior, image = TotalVariation(epsilon=epsilon), rough(5, 6)
        assert (prior.value_and_gradient(image)[1] - exact_gradient(prior, image)).abs().max() < 1e-12
    assert TotalVariation().value_and_gradient(torch.ones(3, 3))[1].abs().max() == 0


def test_bends_of_known_images():
    prior = SmoothVariation(2.0, 0.25, 1e-9)
    point = torch.zeros(8, 8, dtype=torch.float64)
    point[3, 3] = 5.0
    # On the point two second differences of 2 and a mixed one of 1; beside it those of 1, two with a mixed one.
    bends = 10**0.5 + 2 * 3**0.5 + 2 + 2**0.5
    assert float(prior(point)) == pytest.approx(2 * 5 * (2 + 2**0.5 + 0.25 * bends), rel=1e-6)
    assert float(SmoothVariation()(torch.full((4, 4), 3.0))) == 0
    even = torch.arange(6, dtype=torch.float64) + 2 * torch.arange(5, dtype=torch.float64)[:, None]
    inside = SmoothVariation(1.0, 1e3).value_and_gradient(even)[1][2, 2:4]  # nothing pulls at an even slope
    assert float(inside.abs().max()) < 1e-12


def test_an_adapted_variation_takes_less_from_edges_and_more_from_noise():
    """An edge, seen through noise: its own slopes cost less than they did, those of the noise alone more."""
    edge = torch.zeros(32, 32, dtype=torch.float64)
    edge[8:24, 8:24] = 5.0
    noise = 0.1 * rough(32, 32)
    prior = SmoothVariation(2.0, 0.1)
    found = prior.adapted_to(edge + noise, 1.0)
    assert (found.weight, found.bending, found.epsilon) == (2.0, 0.1, 0.01)
    assert float(found(edge)) < 0.9 * float(prior(edge))
    assert float(found(noise)) > 2 * float(prior(noise))
    assert repr(found) == "AdaptedVariation(weight=2, bending=0.1, epsilon=0.01)"


def test_an_adapted_variation_costs_what_it_did_for_its_own_object():
    """Without bends, and up to the smoothing of slopes by epsilon."""
    image = rough(12, 13)
    prior = SmoothVariation(2.0, 1e-9, 1e-9)
    assert float(prior.adapted_to(image, 1.0)(image)) == pytest.approx(float(prior(image)), rel=1e-6)


@pytest.mark.parametrize("times", [0.3, 1.0, 4.0])
def test_an_even_metric_multiplies_the_whole_penalty(times):
    """Its rounded corners, gradient and curvature as well."""
    prior, image = SmoothVariation(0.7, 0.4, 0.05), 0.1 * rough()
    everywhere = torch.full_like(image, times)
    adapted = AdaptedVariation(prior, Metric(everywhere, torch.zeros_like(image), everywhere, everywhere))
    for found, expected in zip(adapted.value_and_gradient(image), prior.value_and_gradient(image), strict=True):
        torch.testing.assert_close(found, times * expected, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(adapted.curvature(image), times * prior.curvature(image), rtol=1e-12, atol=1e-12)


def test_curvature_of_an_adapted_variation_is_the_diagonal_of_a_quadratic():
    """Of the one that touches it at the image, without bends: its lengths stand in the denominators."""
    image = rough()
    prior = SmoothVariation(0.7, 1e-30, 0.05).adapted_to(rough(seed=7).cumsum(0).cumsum(1), 1.0)
    dy, dx = prior.metric.of(*gradient(image))
    inverse = 0.7 / torch.sqrt(dy**2 + dx**2 + (0.05 * prior.metric.size) ** 2)
    units = torch.eye(image.numel(), dtype=torch.float64).view(-1, *image.shape)
    by_dy, by_dx = prior.metric.of(*gradient(units))
    diagonal = (inverse * (by_dy**2 + by_dx**2)).sum(dim=(-2, -1)).view(image.shape)
    torch.testing.assert_close(prior.curvature(image), diagonal, rtol=1e-12, atol=1e-12)


def test_what_is_adapted_to_an_even_object_stays_as_it_is():
    even = torch.full((6, 7), 2.0, dtype=torch.float64)
    for prior in (SmoothVariation(), TotalVariation(), EdgePreserving(), as_prior(squares)):
        assert prior.adapted_to(even, 1.0) is prior
    for prior in (TotalVariation(), EdgePreserving(), as_prior(squares)):
        assert prior.adapted_to(rough(), 1.0) is prior


def test_a_variation_suited_to_an_object_has_the_scale_of_its_gradients():
    suited = TotalVariation(2.0, 0.3).suited_to(0.7)
    assert isinstance(suited, SmoothVariation)
    assert (suited.weight, suited.epsilon) == pytest.approx((1.4, 0.3), rel=1e-12)


@pytest.mark.parametrize("prior", [TotalVariation(2.0, 0.3), SmoothVariation(2.0, 0.2, 0.3)])
def test_a_search_in_faint_light_has_a_lighter_prior_for_an_object_of_steep_slopes(prior):
    """By up to a factor of four; the prior itself keeps its weight."""
    for rate, weight in ((0.01, 0.5), (0.25, 0.5), (0.4, 0.8)):
        found = prior.in_search(rate)
        assert type(found) is type(prior)
        assert found.weight == pytest.approx(weight, rel=1e-12)
        assert float(found(rough())) == pytest.approx(float(prior(rough())) * weight / 2, rel=1e-12)
    assert prior.weight == 2.0


def test_priors_without_a_scale_stay_as_they_are():
    for prior in (EdgePreserving(), as_prior(squares)):
        assert prior.suited_to(0.3) is prior.in_search(0.3) is prior


def test_edge_preserving_is_quadratic_in_slopes_and_linear_in_edges():
    weight, threshold = 3.0, 0.5
    prior = EdgePreserving(weight, threshold)
    ramp = torch.zeros(6, 8, dtype=torch.float64)
    ramp[2, 3] = 1.0
    lengths = torch.tensor([1.0, 1.0, 2**0.5], dtype=torch.float64)  # of its slopes: from above, the left, and its own

    def expected(height):
        ratio = height * lengths / threshold
        return float(weight * threshold**2 * (ratio - torch.log1p(ratio)).sum())

    for height in (1e-3, 0.5, 40.0):
        assert float(prior(height * ramp)) == pytest.approx(expected(height), rel=1e-9)
    # Its limits: half the weight times squares, weight times threshold times lengths.
    small, large = 1e-6, 1e6
    assert float(prior(small * ramp)) == pytest.approx(weight / 2 * small**2 * 4, rel=1e-5)
    assert float(prior(large * ramp)) == pytest.approx(weight * threshold * large * float(lengths.sum()), rel=1e-4)


def test_edge_preserving_differentiates_where_the_image_is_flat():
    flat = torch.full((4, 5), 2.0, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(EdgePreserving()(flat), flat)
    assert float(slope.abs().max()) == 0
    assert float(EdgePreserving(2.0).curvature(flat.detach()).min()) == pytest.approx(8.0)  # 4 squares, each weight / 2


def test_gradient_and_divergence_are_adjoint():
    generator = torch.Generator().manual_seed(0)
    image, dy, dx = (torch.randn(7, 9, dtype=torch.float64, generator=generator) for _ in range(3))
    left = sum(float((a * b).sum()) for a, b in zip(gradient(image), (dy, dx), strict=True))
    assert left == pytest.approx(float((image * divergence(dy, dx)).sum()), rel=1e-12)


def test_a_linear_prior_has_no_curvature():
    assert float(as_prior(lambda image: 0.3 * image.sum()).curvature(rough()).abs().max()) == 0


def test_a_concave_prior_has_no_negative_curvature():
    assert float(as_prior(lambda image: -(image**2).sum()).curvature(rough()).abs().max()) == 0


def convex(image):
    """Each pixel with its neighbours, so that the diagonal of the Hessian has to be told from the rest."""
    return torch.log1p(image**2).sum() + 0.1 * ((image - image.roll(1, 0)) ** 2).sum()


@pytest.mark.parametrize("compiled", [lambda: torch.compile(convex, backend="aot_eager"), lambda: compiled_module()])
def test_a_compiled_prior_has_a_curvature(compiled):
    """By differences of gradients, whose error grows with the square of their step: it is not differentiated twice.

    Dark pixels count as a little brighter than they are.
    """
    image = 0.1 + rough()
    found = as_prior(compiled()).curvature(image)
    torch.testing.assert_close(found, as_prior(convex).curvature(image), rtol=1e-3, atol=1e-3)
    image[:3] = 0
    check_prior(as_prior(compiled()), image)


def compiled_module():
    class Convex(nn.Module):
        def forward(self, image):
            return convex(image)

    return torch.compile(Convex(), backend="aot_eager")


def sharp(image):
    """Total variation with kinks, to which autograd gives a gradient where it is flat, but no second derivative."""
    return torch.linalg.vector_norm(torch.stack(gradient(image)), dim=0).sum()


def test_a_prior_with_kinks_has_a_curvature_where_it_is_flat():
    image = rough()
    image[:4] = 0.3
    check_prior(as_prior(sharp), image)
    found = as_prior(sharp).curvature(image)
    assert bool(torch.isfinite(found).all())
    # where it is flat by two neighbours at least, which probes of other signs move by 0.02 in all
    assert float(found[1:3].min()) > 10
    assert float(found[1:3].max()) < 1000


def test_differences_keep_to_images_that_are_not_negative():
    """Below zero this prior has no value; at zero it has a kink, which autograd differentiates once."""

    def roots(image):
        return torch.linalg.vector_norm(image[..., None], dim=-1).sum() + ((image + 1e-9) ** 1.5).sum()

    image = torch.zeros(6, 7, dtype=torch.float64)
    check_prior(as_prior(roots), image)
    assert bool(torch.isfinite(as_prior(roots).curvature(image)).all())


def test_own_gradient_and_curvature_are_used():
    """They are known to be used by being wrong."""

    class Wrong(Entropy):
        def gradient(self, image):
            return torch.full_like(image, 7.0)

        def curvature(self, image):
            return torch.full_like(image, 9.0)

    prior = as_prior(Wrong())
    assert prior.value_and_gradient(rough())[1].unique().tolist() == [7.0]
    assert prior.curvature(rough()).unique().tolist() == [9.0]


def test_what_a_prior_is_called_tells_it_from_others():
    """A checkpoint goes by it; the repr of a function would hold an address."""
    assert repr(TotalVariation(2.0)) == "TotalVariation(weight=2, epsilon=0.01)"
    assert repr(SmoothVariation()) == "SmoothVariation(weight=1, bending=0.25, epsilon=0.01)"
    assert repr(EdgePreserving()) == "EdgePreserving(weight=2, threshold=0.5)"
    assert repr(as_prior(squares)).endswith("squares")
    assert "0x" not in repr(as_prior(squares))
    assert repr(as_prior(Learned())) == repr(Learned())
    assert list(as_prior(Learned()).state_dict()) == ["function.kernel"]


def test_a_prior_stays_the_same_object():
    prior = EdgePreserving()
    assert as_prior(prior) is prior


@pytest.mark.parametrize("number", [0.0, -1.0, math.nan, math.inf])
def test_refuses_numbers(number):
    for make, name in ((TotalVariation, "epsilon"), (EdgePreserving, "threshold")):
        for which in ("weight", name):
            with pytest.raises(ValueError, match=f"{which} is {number}: it must be finite and positive"):
                make(**{which: number})


def test_refuses_what_cannot_be_called():
    with pytest.raises(TypeError, match=r"prior is 3\.0: it must be a function or module"):
        as_prior(3.0)
    with pytest.raises(TypeError, match=r"prior is the class TotalVariation: give an object of it, such as TotalV"):
        as_prior(TotalVariation)


def test_a_subclass_without_forward_says_so():
    with pytest.raises(TypeError, match=r"Empty has no method forward\(image\): define one that returns a scalar"):
        type("Empty", (ObjectPrior,), {})()(rough())


class OfWrongShape:
    def __call__(self, image):
        return (image**2).sum()

    def gradient(self, image):
        return 2 * image[:-1]


class OfGradient:
    def __init__(self, factor):
        self.factor = factor

    def __call__(self, image):
        return (image**2).sum()

    def gradient(self, image):
        return self.factor * image


class OfCurvature:
    def __init__(self, curvature):
        self.curvature = curvature

    def __call__(self, image):
        return (image**2).sum()


@pytest.mark.parametrize(
    ("prior", "words"),
    [
        (lambda image: image**2, r"returns a tensor of shape \(6, 7\) for an image: it must return a scalar"),
        (lambda image: 1.0, "returns a float for an image"),
        (lambda image: image.sum() * math.nan, "is nan at the mean frame: it must be finite there"),
        (lambda image: -image.sum() / 0.0, "is -inf at the mean frame"),
        (lambda image: image.detach().sum(), "is not differentiable in the image"),
        (lambda image: torch.tensor(3.0), "is not differentiable in the image"),
        (lambda image: (image - image).sqrt().sum(), "is not finite: it must be finite, of shape"),
        (lambda image: image[9, 9], r"fails on an image \(6, 7\): index 9 is out of bounds"),
        (lambda image: (image @ image).sum(), r"fails on an image \(6, 7\)"),
        (OfWrongShape(), r"has shape \(5, 7\) or is not finite"),
        (OfGradient(-2.0), "another than that of its value by autograd, by 2 of it"),
        (OfGradient(1.0), "by 0.5 of it: mend the method, or leave it out"),
        (OfCurvature(lambda image: image[:-1]), r"curvature of .* is a tensor of shape \(5, 7\), or holds"),
        (OfCurvature(lambda image: 2.0), r"curvature of .* is a float, or holds"),
        (OfCurvature(lambda image: -image.abs()), r"negative or not finite: a tensor of shape \(6, 7\) is needed"),
        (OfCurvature(lambda image: image / 0), "values that are negative or not finite"),
    ],
)
def test_refuses_what_is_no_prior(prior, words):
    with pytest.raises(ValueError, match=words):
        check_prior(as_prior(prior), rough())


def training(layer):
    """A network of float64 in training, where its layer is random or changes itself."""
    return nn.Sequential(nn.Unflatten(0, (1, 1, -1)), nn.Conv2d(1, 2, 3, padding=1), layer).double().train()


def mean_square(image, network):
    return network(image).square().mean()


class OfNetwork(nn.Module):
    def __init__(self, network):
        super().__init__()
        self.network = network

    def forward(self, image):
        return mean_square(image, self.network)


HOLDERS = {
    "function": lambda network: lambda image: mean_square(image, network),
    "partial": lambda network: partial(mean_square, network=network),
    "module": OfNetwork,
    "method": lambda network: OfNetwork(network).forward,
    "compiled": lambda network: torch.compile(OfNetwork(network), backend="aot_eager"),
}
each_holder = pytest.mark.parametrize("held_by", HOLDERS.values(), ids=HOLDERS)


@each_holder
def test_a_random_prior_is_refused(held_by):
    network = training(nn.Dropout(0.5))
    with pytest.raises(ValueError, match=r"is random: its gradient .* under dropout in training. Call eval\(\)"):
        check_prior(as_prior(held_by(network)), rough())
    network.eval()
    check_prior(as_prior(held_by(network)), rough())


@each_holder
def test_a_prior_that_changes_its_network_is_refused_and_the_network_is_as_it_was(held_by):
    network = training(nn.BatchNorm2d(2))
    before = {name: value.clone() for name, value in network.state_dict().items()}
    with pytest.raises(
        ValueError, match=r"changes \S*2.running_mean, one of 3 such buffers, whenever .* Call eval\(\)"
    ):
        check_prior(as_prior(held_by(network)), rough())
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())
    network.eval()
    check_prior(as_prior(held_by(network)), rough())


@each_prior
def test_accepts_every_prior_at_an_image_with_dark_parts(make):
    image = rough()
    image[:3] = 0
    check_prior(as_prior(make()), image)
