"""What begins on a GPU stays there, and agrees with the processor: criteria, searches, exposures, restorations, bounds.

The laws of every module by itself are in tests/test_modules.py.
"""

import math

import pytest
import torch
from torch import nn

from torchmask.atmosphere.phase import LayeredPhase, TurbulencePhase
from torchmask.atmosphere.profiles import named_layers
from torchmask.design.constraints import KeepOutDisc, MinimumGap, NFoldSymmetry
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.refine import refine_mask
from torchmask.design.search import search_mask
from torchmask.design.tolerance import machining_errors
from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import Grid
from torchmask.metrics import relative_error
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.band import Band
from torchmask.optics.detector import Detector
from torchmask.planning.bounds import myopic_bound
from torchmask.restoration.baselines import average_psf
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.schedule import Schedule
from torchmask.simulation.conditions import Conditions
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import SceneOptions, make_scene
from torchmask.spectra import NoisePSD, PowerLawPSD

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")

GRID = Grid.nyquist(1.0, 550e-9, 64)
PSDS = (PowerLawPSD(1.5, 1e7), NoisePSD(1e7))
BAND = Band.top_hat(550e-9, 110e-9, 3)


def masks(shape="disc", dtype=torch.float64, device="cpu"):
    """Three masks of seven holes, two of which touch in the first."""
    centers = 0.7 * (torch.rand(3, 7, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5)
    centers[0, 1] = centers[0, 0] + torch.tensor([0.12, 0.0])
    return SparseAperture(nn.Parameter(centers.to(device, dtype)), 0.12, 1.0, shape)


def exposures(aperture, n_frames=4, *, device="cuda", **given):
    """Frames of the packaged satellite in 48 x 48 pixels, of which one draw is the same on every device."""
    grid = Grid.nyquist(1.0, 550e-9, 48)
    given = {"turbulence": TurbulencePhase(0.3, 20.0), "conditions": None, "flux": 1e6} | given
    scene = make_scene(grid.shape, given.pop("flux"), SceneOptions(size=0.5)).to(device)
    source = torch.Generator().manual_seed(1)
    return simulate_observation(
        scene,
        aperture.to(device),
        grid,
        given["turbulence"],
        Detector(1.5),
        n_frames,
        source,
        conditions=given["conditions"],
    )


CRITERIA = {
    "frozen": lambda: AsymptoticMSE(GRID, *PSDS, 20),
    "turbulent": lambda: TurbulentMSE(GRID, *PSDS, 20, r0=0.1),
    "in a band": lambda: TurbulentMSE(GRID, *PSDS, 20, 0.1, 20.0, 2e-3, 10.0, BAND.wavelengths, BAND.shares, sky=3.0),
}


@pytest.mark.parametrize(
    ("name", "shape"),
    [("frozen", "disc"), ("frozen", "hexagon"), ("turbulent", "disc"), ("turbulent", "hexagon"), ("in a band", "disc")],
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_criterion_and_its_gradient(name, shape, dtype):
    """Against the same precision on the processor: sums in another order, of up to some 1e4 terms."""

    def value_and_gradient(device):
        mask = masks(shape, dtype, device)
        value = CRITERIA[name]().to(device)(mask)
        (gradient,) = torch.autograd.grad(value.sum(), mask.centers)
        assert value.device.type == gradient.device.type == device
        return value.detach().cpu(), gradient.cpu()

    (value, gradient), (expected, slope) = value_and_gradient("cuda"), value_and_gradient("cpu")
    eps = torch.finfo(dtype).eps
    torch.testing.assert_close(value, expected, rtol=100 * eps, atol=0)
    # a slope is a difference of terms as large as the value over the width of a hole
    torch.testing.assert_close(gradient, slope, rtol=0, atol=1000 * eps * float(expected.max()) / 0.12)


@pytest.mark.parametrize("aperture", [FullAperture(1.0, 0.3), FullAperture(1.0, 0.2, 0.02, (0.0, 1.57, 3.14))])
def test_a_criterion_of_a_full_pupil(aperture):
    criterion = TurbulentMSE(GRID, *PSDS, 20, r0=0.1)
    expected = criterion(aperture)
    torch.testing.assert_close(criterion.cuda()(aperture.cuda()).cpu(), expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize("constraints", [(), (MinimumGap(0.02), KeepOutDisc(0.1)), (NFoldSymmetry(3),)])
@pytest.mark.parametrize("method", ["cma", "hybrid"])
def test_a_search_and_a_refinement(method, constraints):
    criterion = AsymptoticMSE(GRID, *PSDS, 20)

    def search(criterion):
        return search_mask(criterion, 6, 1.0, 0.1, method=method, budget=96, constraints=constraints)

    expected, found = search(criterion), search(criterion.cuda())
    assert found.aperture.centers.is_cuda
    assert found.mse == pytest.approx(float(criterion(found.aperture)), rel=1e-9)
    # the paths part by rounding, yet 96 evaluations and a descent lead to masks alike
    assert found.mse == pytest.approx(expected.mse, rel=0.2)
    refined = refine_mask(criterion, found.aperture, budget=40, constraints=constraints)
    assert refined.aperture.centers.is_cuda
    assert refined.mse <= found.mse
    assert found.aperture.centers.is_cuda  # as before: the refinement has a copy of its own


def test_errors_of_machining():
    criterion, mask = AsymptoticMSE(GRID, *PSDS, 20), SparseAperture.from_catalog("golay6", 1.0, 0.15)

    def growth(device):
        source = torch.Generator().manual_seed(0)
        return machining_errors(criterion.to(device), mask.to(device), 2e-3, 2e-3, n_draws=16, generator=source).mse

    assert growth("cuda").is_cuda
    torch.testing.assert_close(growth("cuda").cpu(), growth("cpu"), rtol=1e-9, atol=0)


SIMULATED = {
    "screens": {},
    "wind": {
        "turbulence": TurbulencePhase(0.3, 20.0, wind=(5.0, 2.0), frame_interval=0.02),
        "conditions": Conditions(sky=2.0, transparency_scatter=0.1, exposure_time=5e-3, band=BAND),
    },
    "layers": {"turbulence": LayeredPhase(named_layers("hv57", 2), 550e-9, 20.0)},
}


@pytest.mark.parametrize("given", SIMULATED.values(), ids=SIMULATED)
def test_simulated_frames(given, golay6):
    """Photons are counted on the processor, from expectations that rounding alone tells apart."""
    frames, expected = (exposures(golay6, device=device, **given).frames for device in ("cuda", "cpu"))
    assert frames.is_cuda
    different = (frames.cpu() - expected).abs() > 1e-6 * expected.max()
    assert float(different.double().mean()) < 1e-3


RESTORED = {
    "mask": ({}, {}),
    "mask in float32": ({}, {"dtype": torch.float32}),
    "faint": ({"flux": 2e4}, {}),
    "sky in a band": (
        {"conditions": Conditions(sky=20.0, band=BAND)},
        {"wavelengths": BAND.wavelengths, "weights": BAND.shares, "refine_geometry": True},
    ),
}


@pytest.mark.parametrize(("seen", "given"), RESTORED.values(), ids=RESTORED)
def test_a_restoration(seen, given, golay6, tmp_path):
    """Its cost is that of the processor until rounding leads elsewhere; it ends as well, resumes and has deviations."""
    observation = exposures(golay6, device="cpu", **seen)

    def restore(device, most, **options):
        method = MyopicDeconvolution(
            golay6, observation.grid, n_modes=6, r0=0.3, max_iterations=most, device=device, **given
        )
        return method.restore(observation.frames.to(device), **options)

    file = tmp_path / "progress.npz"
    few, expected = restore("cuda", 10, checkpoint=file), restore("cpu", 10)
    rounding = torch.finfo(given.get("dtype", torch.float64)).eps
    torch.testing.assert_close(few.cost.cpu()[:3], expected.cost[:3], rtol=1e4 * rounding, atol=0)
    result, known = restore("cuda", 300, checkpoint=file, n_samples=2), restore("cpu", 300)
    assert result.object.is_cuda
    assert result.object_std.is_cuda
    # paths part by rounding, and end in fits that explain the same noise: apart by less than its own scatter
    scatter = math.sqrt(2 / observation.frames.numel())
    assert float(result.chi_square.mean()) == pytest.approx(float(known.chi_square.mean()), abs=3 * scatter)


def test_a_restoration_through_a_full_pupil():
    """With phase retrieval, which has code of its own."""
    pupil = FullAperture(1.0, 0.2)
    observation = exposures(pupil, 6, flux=1e7)
    method = MyopicDeconvolution(pupil.cuda(), observation.grid, n_modes=28, r0=0.3, max_iterations=400, device="cuda")
    result = method.restore(observation.frames)
    assert result.object.is_cuda
    assert relative_error(result.object, observation.object, 0.5) < 0.3


def test_known_aberrations_or_a_known_object(golay6):
    observation = exposures(golay6)
    method = MyopicDeconvolution(golay6.cuda(), observation.grid, n_modes=6, r0=0.3, max_iterations=100, device="cuda")
    blind = method.restore(observation.frames)
    assert method.restore(observation.frames, coefficients=blind.coefficients).object.is_cuda
    assert method.restore(observation.frames, known_object=observation.object).coefficients.is_cuda
    assert method.restore(observation.frames, start=blind).object.is_cuda
    errors = torch.full_like(observation.frames, 20.0)
    valid = torch.ones_like(errors, dtype=torch.bool)
    valid[:, 3, 4] = False
    assert method.restore(observation.frames, valid=valid, errors=errors).object.is_cuda


def test_a_plain_schedule(golay6):
    observation = exposures(golay6)
    method = MyopicDeconvolution(golay6, observation.grid, n_modes=3, schedule=Schedule.plain(), device="cuda")
    assert method.restore(observation.frames).object.is_cuda


def test_a_bound(golay6):
    grid = Grid.nyquist(1.0, 550e-9, 24)
    scene = make_scene(grid.shape, 1e6, SceneOptions(size=0.5))
    psds = (PowerLawPSD(1.5, 1e6), NoisePSD(1e6))

    def bound(device):
        source = torch.Generator().manual_seed(0)
        return myopic_bound(scene.to(device), golay6.to(device), grid, *psds, 2, r0=0.2, generator=source)

    assert bound("cuda").unknown == pytest.approx(bound("cpu").unknown, rel=1e-8)


def test_the_average_psf(golay6):
    source = torch.Generator().manual_seed(0)
    psf = average_psf(golay6.cuda(), GRID, TurbulencePhase(0.3, 20.0), source, n_frames=3)
    assert psf.device.type == "cpu"
