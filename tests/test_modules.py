"""Laws that every nn.Module of the library obeys, whatever it computes."""

import copy
import importlib
import inspect
import io
import pickle
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch._inductor import config as inductor

import torchmask
from torchmask.atmosphere.phase import LayeredPhase, TurbulencePhase
from torchmask.atmosphere.profiles import named_layers
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture, FullAperture, SparseAperture
from torchmask.optics.band import Band
from torchmask.optics.detector import Detector
from torchmask.optics.otf import OTF
from torchmask.optics.psf import PSF
from torchmask.optics.zernike import ZernikePhase
from torchmask.restoration.aberrations import AberrationBasis, plain_basis
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.given_prior import FunctionPrior
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.priors import EdgePreserving, ObjectPrior
from torchmask.restoration.pupil import SampledPupil
from torchmask.restoration.variation import SmoothVariation, TotalVariation
from torchmask.spectra import NoisePSD, PowerLawPSD

GRID = Grid.nyquist(1.0, 550e-9, 32)
CENTERS = torch.tensor([[0.02, 0.31], [0.3, -0.21], [-0.29, -0.18]], dtype=torch.float64)
DTYPES = (torch.float32, torch.float64)
Kind = dict[str, Any]  # dtype and, if not the CPU, device
FLOAT64: Kind = {"dtype": torch.float64}


def mask(shape="disc", centers=CENTERS):
    return SparseAperture(centers, 0.2, 1.0, shape)


def moved(shape="disc"):
    """The mirror image: it has other values and as many open pupil samples."""
    return mask(shape, CENTERS * torch.tensor([-1.0, 1.0]))


def criterion(n_photons=1e7):
    return AsymptoticMSE(GRID, PowerLawPSD(1.5, n_photons), NoisePSD(n_photons), n_frames=20)


def turbulent_criterion(n_photons=1e7, **light):
    return TurbulentMSE(GRID, PowerLawPSD(1.5, n_photons), NoisePSD(n_photons), n_frames=20, r0=0.2, **light)


def wide_criterion(n_photons=1e7):
    return turbulent_criterion(n_photons, wavelengths=(550e-9, 600e-9))


def scored(module: AsymptoticMSE, kind: Kind) -> Tensor:
    return module(mask().to(**kind))


def seeded():
    return torch.Generator("cpu").manual_seed(0)


def random(*shape, dtype, device="cpu"):
    return torch.rand(*shape, generator=seeded(), dtype=torch.float64, device="cpu").to(dtype=dtype, device=device)


def sampled(aperture: SparseAperture) -> SampledPupil:
    return SampledPupil(aperture, GRID, Band.of([GRID.wavelength]), plain_basis(aperture, 4))


def objective(aperture: SparseAperture) -> MyopicObjective:
    frames = random(2, 32, 32, dtype=torch.float64)
    precision = torch.ones(1, 1, 1, dtype=torch.float64, device="cpu")
    return MyopicObjective(ExposureModel(aperture, GRID, 4), frames, precision, TotalVariation())


def costly(module: MyopicObjective, kind: Kind) -> Tensor:
    return module(random(*module.model.window.field.shape, **kind), random(2, 12, **kind))


def adapted(values: Tensor) -> ObjectPrior:
    return SmoothVariation().adapted_to(values.double().view(8, 8), 1.0)


def penalised(module: ObjectPrior, kind: Kind) -> Tensor:
    return module(random(8, 8, **kind))


@dataclass(frozen=True)
class Entry:
    """How to make a module, the same with another state (or None: it has none), and how to call it."""

    make: Callable[[], nn.Module]
    call: Callable[[nn.Module, Kind], Tensor]
    other: Callable[[], nn.Module] | None = None
    result: torch.dtype | None = None  # where it is not the dtype of the input


def samples(module: nn.Module, kind: Kind) -> Tensor:
    return module.samples(GRID, 2).weights


def blurred(module: PSF, kind: Kind) -> Tensor:
    return module(random(2, *module.samples().weights.shape, **kind)).abs()


def turbulent(module: TurbulencePhase | LayeredPhase, kind: Kind) -> Tensor:
    pupil = mask().to(**kind).samples(GRID)
    return module(pupil, 2, generator=seeded())


def exposed(module: ExposureModel, kind: Kind) -> Tensor:
    return module(random(*module.window.field.shape, **kind), random(2, module.aberrations.n_parameters, **kind))


MODULES: dict[str, Entry] = {
    "mask of discs": Entry(mask, samples, moved),
    "mask of hexagons": Entry(lambda: mask("hexagon"), samples, lambda: moved("hexagon")),
    "full pupil": Entry(lambda: FullAperture(0.9, 0.2), samples),
    "Zernike phase": Entry(
        lambda: ZernikePhase(mask(), GRID, 4),
        lambda module, kind: module(random(2, 3, 4, **kind)),
        lambda: ZernikePhase(moved(), GRID, 4),
    ),
    "turbulence": Entry(lambda: TurbulencePhase(0.15, 20.0), turbulent),
    "frozen flow": Entry(lambda: TurbulencePhase(0.15, 20.0, wind=(3.0, 1.0), frame_interval=0.01), turbulent),
    "turbulence in layers": Entry(lambda: LayeredPhase(named_layers("hv57", 2), 550e-9, 20.0), turbulent),
    "PSF": Entry(lambda: PSF(mask(), GRID), blurred, lambda: PSF(moved(), GRID)),
    "OTF": Entry(lambda: OTF(mask(), GRID), blurred, lambda: OTF(moved(), GRID)),
    "criterion": Entry(criterion, scored, lambda: criterion(1e6)),
    "criterion under turbulence": Entry(turbulent_criterion, scored, lambda: turbulent_criterion(1e6)),
    "criterion of a wide band": Entry(wide_criterion, scored, lambda: wide_criterion(1e6)),
    "detector": Entry(
        lambda: Detector(1.5),
        lambda module, kind: module(1e3 * random(8, 8, **kind), seeded()),
    ),
    "detector that differentiates": Entry(
        lambda: Detector(1.5, noise="gaussian"),
        lambda module, kind: module(1e3 * random(8, 8, **kind), seeded()),
    ),
    "exposure model": Entry(lambda: ExposureModel(mask(), GRID, 4), exposed, lambda: ExposureModel(moved(), GRID, 4)),
    "sampled pupil": Entry(
        lambda: sampled(mask()),
        lambda module, kind: module.samples().field(module.samples().phase(random(2, 12, **kind))).abs(),
        lambda: sampled(moved()),
    ),
    "aberration basis": Entry(
        lambda: AberrationBasis(random(6, 5, dtype=torch.float64), 3),
        lambda module, kind: module.coefficients(random(2, 5, **kind)),
        lambda: AberrationBasis(1 + random(6, 5, dtype=torch.float64), 3),
    ),
    "objective": Entry(lambda: objective(mask()), costly, lambda: objective(moved())),
    "total variation": Entry(TotalVariation, penalised),
    "total variation with bends": Entry(SmoothVariation, penalised),
    "adapted total variation": Entry(
        lambda: adapted(torch.arange(64.0).square()), penalised, lambda: adapted(torch.arange(64.0).sin())
    ),
    "edge-preserving prior": Entry(EdgePreserving, penalised),
    "prior that is a module": Entry(
        lambda: FunctionPrior(nn.Sequential(nn.Flatten(0), nn.Softplus(), nn.LayerNorm(64, elementwise_affine=False))),
        penalised,
    ),
}
each_module = pytest.mark.parametrize("entry", MODULES.values(), ids=MODULES)


def test_the_registry_is_complete():
    classes = set()
    for found in pkgutil.walk_packages(torchmask.__path__, "torchmask."):
        if not found.name.startswith("torchmask.interop."):
            for _, value in inspect.getmembers(importlib.import_module(found.name), inspect.isclass):
                if issubclass(value, nn.Module) and value.__module__.startswith("torchmask."):
                    classes.add(value)
    assert classes - {Aperture, ObjectPrior} == {type(entry.make()) for entry in MODULES.values()}


@each_module
def test_state_dict_round_trip(entry):
    source = entry.make()
    if entry.other is None:
        target = entry.make()
    else:
        target = entry.other()
        assert not torch.equal(entry.call(target, FLOAT64), entry.call(source, FLOAT64))
    file = io.BytesIO()
    torch.save(source.state_dict(), file)
    file.seek(0)
    target.load_state_dict(torch.load(file, weights_only=True))
    assert torch.equal(entry.call(target, FLOAT64), entry.call(source, FLOAT64))


@each_module
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m))], ids=["deepcopy", "pickle"])
def test_copies_do_the_same_and_share_nothing(entry, copied):
    source = entry.make()
    expected = entry.call(source, FLOAT64)
    twin = copied(source)
    assert torch.equal(entry.call(twin, FLOAT64), expected)
    with torch.no_grad():
        for tensor in [*twin.parameters(), *twin.buffers()]:
            tensor.zero_()
    assert torch.equal(entry.call(source, FLOAT64), expected)


@each_module
@pytest.mark.parametrize("dtype", DTYPES)
def test_the_dtype_follows_the_inputs(entry, dtype):
    """Whatever torch's default is: the numbers are those of float64 up to float32's rounding."""
    module = entry.make().to(dtype)
    default = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64 if dtype == torch.float32 else torch.float32)
    try:
        result = entry.call(module, {"dtype": dtype})
    finally:
        torch.set_default_dtype(default)
    assert result.dtype == (entry.result or dtype)
    assert bool(torch.isfinite(result).all())


@each_module
def test_the_device_follows_the_inputs(entry):
    """Every array made inside is made where the inputs are: on another default device nothing goes there."""
    module, untouched = entry.make(), entry.make()  # which has made nothing at a first call yet
    expected = entry.call(module, FLOAT64)
    with torch.device("meta"):
        result = entry.call(untouched, FLOAT64)
    assert torch.equal(result, expected)


@each_module
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("dtype", DTYPES)
def test_a_gpu_does_what_the_processor_does(entry, dtype):
    """From the same seed: results differ by rounding alone, and lie where the module and its inputs are."""
    expected = entry.call(entry.make().to(dtype), {"dtype": dtype})
    module = entry.make().to(dtype).cuda()
    assert all(tensor.is_cuda for tensor in [*module.parameters(), *module.buffers()])
    result = entry.call(module, {"dtype": dtype, "device": "cuda"})
    assert result.is_cuda
    # a hundred roundings of the largest value: sums of up to some 4000 terms, those of FFTs in a tree
    allowed = 100 * torch.finfo(dtype).eps * float(expected.abs().max())
    torch.testing.assert_close(result.cpu(), expected, rtol=0, atol=allowed)


@pytest.mark.parametrize(
    "make",
    [
        lambda aperture: aperture,
        lambda aperture: ZernikePhase(aperture, GRID, 3),
        lambda aperture: PSF(aperture, GRID),
        lambda aperture: OTF(aperture, GRID),
        lambda aperture: ExposureModel(aperture, GRID, 3),
    ],
    ids=["mask", "Zernike phase", "PSF", "OTF", "exposure model"],
)
def test_a_parameter_stays_that_very_object(make):
    centers = nn.Parameter(CENTERS.clone())
    module = make(SparseAperture(centers, 0.2, 1.0))
    assert [parameter is centers for parameter in module.parameters()] == [True]
    plain = make(SparseAperture(CENTERS, 0.2, 1.0))
    assert list(plain.parameters()) == []


def value_and_gradient(function, aperture, phase):
    aperture.centers.grad = None
    value = function(aperture) if phase is None else (function(phase) * random(32, 32, dtype=torch.float64)).sum()
    value.backward()
    return value.detach(), aperture.centers.grad.clone()


@inductor.patch(compile_threads=1)  # every process that compiles beside this one would import torch
@pytest.mark.filterwarnings("ignore")  # the compiler warns of its own doings
@pytest.mark.parametrize(
    ("name", "backend"),
    [
        ("PSF", "aot_eager"),
        ("criterion", "aot_eager"),
        pytest.param("PSF", "inductor", marks=pytest.mark.slow),
        pytest.param("criterion", "inductor", marks=pytest.mark.slow),
        pytest.param("criterion under turbulence", "aot_eager", marks=pytest.mark.slow),
    ],
)
def test_compiled_modules_do_what_eager_ones_do(name, backend):
    """Also after an optimiser has moved the holes: nothing of the first call is frozen into the graph."""
    aperture = SparseAperture(nn.Parameter(CENTERS.clone()), 0.2, 1.0)
    module = PSF(aperture, GRID) if name == "PSF" else MODULES[name].make()
    phase = random(2, *aperture.samples(GRID).weights.shape, dtype=torch.float64) if name == "PSF" else None
    torch.compiler.reset()
    compiled = torch.compile(module, backend=backend)
    for step in (0.0, 0.013):
        with torch.no_grad():
            aperture.centers += step * CENTERS
        expected, gradient = value_and_gradient(module, aperture, phase)
        value, compiled_gradient = value_and_gradient(compiled, aperture, phase)
        # reordered sums of at most 32 x 32 x 2 terms
        torch.testing.assert_close(value, expected, rtol=1e-12, atol=0)
        torch.testing.assert_close(compiled_gradient, gradient, rtol=1e-10, atol=1e-12 * float(gradient.abs().max()))
