"""The end-to-end simulation against closed forms, against independently simulated stacks, and its bookkeeping."""

import itertools
import math

import numpy as np
import pytest
import torch
from scipy.special import j0, j1
from torch import nn

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.atmosphere.von_karman import von_karman_structure_function
from torchmask.grid import Grid
from torchmask.observation import PHASE_OVERSAMPLING
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.detector import Detector
from torchmask.optics.otf import analytic_otf
from torchmask.optics.psf import PSF, psf_from_samples
from torchmask.optics.zernike import ZernikePhase
from torchmask.simulation import exposures as module
from torchmask.simulation.exposures import simulate_observation

WAVELENGTH = 550e-9


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


class Tilt(nn.Module):
    """A wavefront that is tilted the same way in every frame: it moves the image by `shift` (x, y) pixels."""

    r0, outer_scale = 1.0, 1.0

    def __init__(self, grid, aperture, shift):
        super().__init__()
        self.scale = 2 * math.pi * grid.pixel_scale / grid.wavelength * torch.tensor(shift, dtype=torch.float64)
        self.centers = aperture.centers

    def forward(self, samples, n_frames, generator=None):
        position = samples.offsets + self.centers[:, None, :]
        return (position @ self.scale).expand(n_frames, -1, -1)


@pytest.fixture
def grid():
    return Grid.nyquist(1.0, WAVELENGTH, 32)


@pytest.fixture
def mask():
    return SparseAperture([[0.0, 0.38], [0.33, -0.2], [-0.35, -0.15], [0.05, -0.05]], 0.2, 1.0)


@pytest.fixture
def scene():
    image = torch.zeros(32, 32, dtype=torch.float64)
    image[10:22, 12:18] = 500.0
    image[14, 14:24] = 2000.0
    return image


def simulate(scene, aperture, grid, *, r0=0.2, readout_noise=0.0, n_frames=3, seed=0, **options):
    turbulence = None if r0 is None else TurbulencePhase(r0, 20.0)
    return simulate_observation(
        scene, aperture, grid, turbulence, Detector(readout_noise), n_frames, generator(seed), **options
    )


@pytest.mark.parametrize("diameter", [0.2, 1.0])
def test_without_turbulence_the_psf_is_the_airy_pattern(diameter):
    # Light beyond the PSFs' field (4 x 64 pixels) is folded into it or left out: at most what the closed form
    # J0^2 + J1^2 puts outside the circle inscribed in that field.
    grid = Grid.nyquist(1.0, WAVELENGTH, 64)
    scene = torch.zeros(64, 64, dtype=torch.float64)
    scene[32, 32] = 1e9
    stack = simulate(scene, FullAperture(diameter), grid, r0=None, n_frames=1)
    assert stack.psfs is not None
    c = grid.cutoff(diameter)
    pixel = np.arange(64) - 32
    r = np.hypot(pixel[:, None], pixel)
    v = np.pi * c * np.where(r == 0, 1e-9, r)
    airy = (2 * j1(v) / v) ** 2 * np.pi / 4 * c**2
    beyond = j0(np.pi * c * 128) ** 2 + j1(np.pi * c * 128) ** 2
    psf = stack.psfs[0].numpy()
    assert np.unravel_index(psf.argmax(), psf.shape) == (32, 32)
    assert np.abs(psf - airy).sum() < 2 * beyond
    assert abs(psf.sum() - airy.sum()) < beyond
    # the image of a point is its PSF, within photon noise
    frame = stack.frames[0].numpy() / 1e9
    assert np.abs(frame - psf).max() < 6 * math.sqrt(psf.max() / 1e9)


def test_without_turbulence_the_psf_is_that_of_the_psf_layer(scene, mask, grid):
    stack = simulate(scene, mask, grid, r0=None, n_frames=2)
    layer = PSF(mask, Grid(128, grid.pixel_scale, WAVELENGTH))()
    expected = torch.roll(layer, (16, 16), (0, 1))[:32, :32]
    for psf in stack.psfs:
        torch.testing.assert_close(psf, expected, rtol=0, atol=1e-14)
    assert stack.r0 is None
    assert stack.outer_scale is None


def test_frames_are_the_scene_blurred_by_the_stored_psfs(scene, mask, grid):
    # Direct sum over the lit pixels. Stored PSFs reach 16 pixels: only what lies within that of all light is complete.
    stack = simulate(scene * 1e6, mask, grid, n_frames=2)
    for frame, psf in zip(stack.frames, stack.psfs, strict=True):
        expected = torch.zeros_like(frame)
        for row, column in torch.nonzero(scene).tolist():
            for y in range(14, 20):
                for x in range(12, 20):
                    expected[y, x] += scene[row, column] * 1e6 * psf[16 + y - row, 16 + x - column]
        window = (slice(14, 20), slice(12, 20))
        difference = (frame - expected)[window]
        assert float((difference / expected[window].sqrt()).abs().max()) < 5  # photon noise, 48 pixels


@pytest.mark.parametrize("shift", [(3.0, 0.0), (0.0, -5.0), (1.5, 2.25)])
def test_a_tilted_wavefront_moves_the_image(scene, grid, shift):
    aperture = FullAperture(0.9)
    flat = simulate(scene * 1e8, aperture, grid, r0=None, n_frames=1)
    tilt = Tilt(grid, aperture, shift)
    moved = simulate_observation(scene * 1e8, aperture, grid, tilt, Detector(), 1, generator())

    def centroid(image):
        bright = image.clamp(min=0.05 * image.max()) - 0.05 * image.max()
        rows, columns = torch.meshgrid(torch.arange(32.0), torch.arange(32.0), indexing="ij")
        return float((bright * columns).sum() / bright.sum()), float((bright * rows).sum() / bright.sum())

    before, after = centroid(flat.frames[0]), centroid(moved.frames[0])
    # the faint ends that are clipped differ with the position within a pixel
    assert after[0] - before[0] == pytest.approx(shift[0], abs=0.05)
    assert after[1] - before[1] == pytest.approx(shift[1], abs=0.05)
    assert int(moved.psfs[0].argmax()) % 32 in (16 + math.floor(shift[0]), 16 + math.ceil(shift[0]))


def test_the_mean_psf_is_the_long_exposure():
    # Mean OTF = telescope OTF x exp(-D / 2) with von Karman's D (Fried 1966). The PSFs are cropped to a field that
    # holds nearly all light of a full pupil; the rest changes the OTF by at most the light lost.
    grid = Grid.nyquist(1.0, WAVELENGTH, 64)
    scene = torch.ones(64, 64, dtype=torch.float64)
    aperture, n_frames = FullAperture(1.0), 300
    stack = simulate(scene, aperture, grid, r0=0.25, n_frames=n_frames)
    assert stack.psfs is not None
    otfs = torch.fft.fft2(torch.fft.ifftshift(stack.psfs, dim=(-2, -1)))
    nu_y, nu_x = grid.frequencies(torch.float64)
    distance = torch.hypot(nu_y, nu_x)
    theory = analytic_otf(aperture, grid).real * torch.exp(
        -von_karman_structure_function(distance * grid.period, 0.25, 20.0) / 2
    )
    lost = 1 - float(stack.psfs.sum(dim=(-2, -1)).mean())
    assert 0 < lost < 0.05
    for low, high in ((0.02, 0.05), (0.05, 0.08), (0.08, 0.12)):
        ring = (distance >= low) & (distance < high)
        values = otfs.real[:, ring].mean(-1)
        error = float(values.std()) / math.sqrt(n_frames)
        assert abs(float(values.mean()) - float(theory[ring].mean())) < 4 * error + lost


@pytest.mark.parametrize("name", ["skylab_1e7_mask", "skylab_1e7_full", "mgs_1e6_mask", "mgs_1e6_full"])
def test_agrees_with_stacks_of_another_program(shared_stack, name):
    other = shared_stack(name)
    assert other.object is not None
    assert other.psfs is not None
    assert other.n_photons is not None
    assert other.r0 is not None
    scene = other.object.double() * (other.n_photons / float(other.object.double().sum()))
    own = simulate(scene, other.aperture, other.grid, r0=other.r0, readout_noise=other.readout_noise, n_frames=20)
    assert own.psfs is not None

    nu_y, nu_x = other.grid.frequencies(torch.float64)
    distance = torch.hypot(nu_y, nu_x)

    def power(psfs):
        transfer = torch.fft.fft2(psfs.double()).abs() ** 2
        edges = (0.05, 0.1, 0.2, 0.3, 0.4, 0.48)
        rings = [(distance >= low) & (distance < high) for low, high in itertools.pairwise(edges)]
        return torch.stack([transfer[:, ring].mean(-1) for ring in rings])

    # What reaches high frequencies frame by frame, within the scatter of 20 frames each
    ours, theirs = power(own.psfs), power(other.psfs)
    error = ((ours.var(-1) + theirs.var(-1)) / 20).sqrt()
    assert bool(((ours.mean(-1) - theirs.mean(-1)).abs() < 4 * error).all())
    assert bool((error < 0.35 * theirs.mean(-1)).all())  # the comparison can fail

    # Light kept in the field. That program leaves the sinc^2 of its pupil samples in its PSFs, which darkens the outer
    # field; with it put back here, what is lost agrees within a tenth.
    def lost(stack):
        return 1 - float(stack.psfs.sum(dim=(-2, -1)).double().mean())

    attenuation = torch.sinc(torch.fft.fftfreq(512, dtype=torch.float64)) ** 2
    attenuation = attenuation[:, None] * attenuation
    inner = torch.fft.fftshift(attenuation)[192:320, 192:320]
    kept, samples = 1 - lost(own), other.aperture.samples(other.grid, 4)
    phase = TurbulencePhase(other.r0, 20.0)(samples, 4, generator(1))
    whole = psf_from_samples(samples, phase)
    total = float((whole * attenuation).sum(dim=(-2, -1)).mean())
    darkened = float((own.psfs * inner).sum(dim=(-2, -1)).mean()) / total
    assert kept < 1 - lost(other) < 1
    assert (1 - darkened) == pytest.approx(lost(other), rel=0.1)
    # and so do the frames keep what the PSFs keep, less what blur carries across the border from off-centre
    assert 0 < kept - float((own.frames.sum(dim=(-2, -1)) / own.n_photons).mean()) < 0.012


def test_light_lost_in_the_frames(scene, mask, grid):
    stack = simulate(scene * 1e4, mask, grid, n_frames=4)
    assert stack.n_photons == pytest.approx(float(scene.sum()) * 1e4)
    kept = stack.frames.sum(dim=(-2, -1)) / stack.n_photons
    assert bool((kept < 1).all())
    assert bool((kept > 0.7).all())
    # centred light keeps what the PSF keeps
    point = torch.zeros_like(scene)
    point[16, 16] = 1e12
    stack = simulate(point, mask, grid, n_frames=4)
    torch.testing.assert_close(stack.frames.sum((-2, -1)) / 1e12, stack.psfs.sum((-2, -1)), rtol=0, atol=6e-6)


def test_one_seed_gives_one_observation_and_two_differ(scene, mask, grid):
    first, again, other = (simulate(scene, mask, grid, readout_noise=1.0, seed=s) for s in (7, 7, 8))
    assert torch.equal(first.frames, again.frames)
    assert torch.equal(first.psfs, again.psfs)
    assert not torch.equal(first.frames, other.frames)
    assert (first.psfs - other.psfs).abs().max() > 1e-3
    assert (first.psfs[0] - first.psfs[1]).abs().max() > 1e-3


def test_noise_and_flux_leave_the_screens_as_they_were(scene, mask, grid):
    quiet = simulate(scene, mask, grid, readout_noise=0.0, seed=3)
    for changed in (simulate(scene, mask, grid, readout_noise=2.0, seed=3), simulate(5 * scene, mask, grid, seed=3)):
        assert torch.equal(changed.psfs, quiet.psfs)
        assert not torch.equal(changed.frames, quiet.frames)


def test_screens_leave_the_noise_as_it_was(mask, grid):
    dark = torch.zeros(32, 32, dtype=torch.float64)
    dark[16, 16] = 1e-9
    still, blurred = (simulate(dark, mask, grid, r0=r0, readout_noise=2.0, seed=3) for r0 in (None, 0.2))
    assert not torch.equal(still.psfs, blurred.psfs)
    assert torch.equal(still.frames, blurred.frames)


def test_frames_do_not_depend_on_the_chunks(scene, mask, grid, monkeypatch):
    whole = simulate(scene, mask, grid, n_frames=5)
    monkeypatch.setattr(module, "_CHUNK", 2 * 128 * 128)
    records = []
    chunked = simulate(scene, mask, grid, n_frames=5, callback=records.append)
    torch.testing.assert_close(chunked.psfs, whole.psfs, rtol=0, atol=1e-15)
    assert [(r.stage, r.step, r.n_steps) for r in records] == [("simulation", k, 5) for k in (1, 2, 3, 4, 5)]
    assert [len(r.arrays["frames"]) for r in records if r.arrays] == [2, 4, 5]
    assert all(0.7 < r.scalars["kept_light"] < 1.05 for r in records)


def test_the_light_that_is_told_to_be_kept_is_without_noise(scene, mask, grid):
    """A tenth of a photon in each frame, beneath the noise of 1024 pixels, is kept as much of as of a bright scene."""
    told = []
    for light in (0.1, 1e9):
        records = []
        simulate(
            scene * (light / float(scene.sum())), mask, grid, n_frames=2, readout_noise=10.0, callback=records.append
        )
        told.append([record.scalars["kept_light"] for record in records])
    assert told[0] == pytest.approx(told[1], rel=1e-6)
    assert 0.7 < told[1][-1] < 1


def test_read_noise_and_photon_noise_add(mask, grid):
    # A black corner far from a faint source shows read noise alone; a bright uniform field, photons too.
    scene = torch.zeros(32, 32, dtype=torch.float64)
    scene[16, 16] = 1e-6
    stack = simulate(scene, mask, grid, readout_noise=3.0, n_frames=200)
    n = stack.frames.numel()
    assert abs(float(stack.frames.mean())) < 4 * 3 / math.sqrt(n)
    assert abs(float(stack.frames.var()) / 9 - 1) < 4 * math.sqrt(2 / n)
    assert stack.readout_noise == 3.0


@pytest.mark.parametrize("shape", [(32, 24), (25, 31)])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_fields_of_any_shape_and_dtype(shape, dtype):
    grid = Grid(shape, WAVELENGTH / 2, WAVELENGTH)
    scene = torch.rand(shape, generator=generator(), dtype=dtype) * 1e6
    stack = simulate(scene, FullAperture(1.0), grid, n_frames=2)
    assert stack.frames.shape == stack.psfs.shape == (2, *shape)
    assert stack.frames.dtype == stack.psfs.dtype == stack.object.dtype == dtype
    still = simulate(scene, FullAperture(1.0), grid, r0=None, n_frames=1)
    peak = int(still.psfs[0].argmax())
    assert divmod(peak, shape[1]) == (shape[0] // 2, shape[1] // 2)


def test_float32_agrees_with_float64(scene, mask, grid):
    double, single = simulate(scene, mask, grid, seed=2), simulate(scene.float(), mask, grid, seed=2)
    torch.testing.assert_close(single.psfs.double(), double.psfs, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_phases_that_are_kept_make_the_psfs(scene, mask, grid, dtype):
    """On the pupil samples of the observation: through the same optics they give what was stored."""
    seen = simulate(scene.to(dtype), mask, grid, keep_phases=True)
    samples = seen.aperture.samples(seen.grid, PHASE_OVERSAMPLING)
    assert seen.phases.shape == (3, *samples.weights.shape)
    psfs = psf_from_samples(samples, seen.phases).to(dtype).roll((16, 16), (-2, -1))[:, :32, :32]
    assert torch.equal(psfs, seen.psfs)
    # PSF folds the light from beyond the field into it, where the observation has lost it
    folded = PSF(seen.aperture, seen.grid, PHASE_OVERSAMPLING)(seen.phases).roll((16, 16), (-2, -1))
    lost = 1 - seen.psfs.sum((1, 2))
    assert ((folded - seen.psfs).sum((1, 2)) - lost).abs().max() < 100 * torch.finfo(dtype).eps
    assert (folded - seen.psfs).min() > -torch.finfo(dtype).eps


def test_phases_are_kept_on_request_only_and_change_nothing(scene, mask, grid):
    without, kept = simulate(scene, mask, grid), simulate(scene, mask, grid, keep_phases=True)
    assert without.phases is None
    assert torch.equal(without.frames, kept.frames)
    assert not torch.equal(kept.phases[0], kept.phases[1])
    still = simulate(scene, mask, grid, r0=None, keep_phases=True)
    assert torch.equal(still.phases, torch.zeros_like(kept.phases))


def test_phases_that_are_kept_are_those_of_a_tilted_wavefront(scene, grid):
    """A restored wavefront in Zernike modes, on the same samples, is the truth: a tilt is the second and third mode."""
    mask = SparseAperture([[0.0, 0.0]], 0.9, 0.9)
    shift = (1.5, -0.5)
    seen = simulate_observation(scene, mask, grid, Tilt(grid, mask, shift), Detector(), 2, keep_phases=True)
    phase = ZernikePhase(mask, grid, 3, PHASE_OVERSAMPLING)
    # 2 pi s x pixel_scale / wavelength over a disc of diameter d, in modes 2 x and 2 y of unit rms on the unit disc
    per_pixel = 2 * math.pi * grid.pixel_scale / grid.wavelength * 0.45 / 2
    coefficients = per_pixel * torch.tensor([[[0.0, shift[0], shift[1]]]], dtype=torch.float64)
    torch.testing.assert_close(phase(coefficients).expand(2, -1, -1), seen.phases, rtol=0, atol=1e-12)


def test_training_the_mask_does_not_change_the_observation(scene, mask, grid):
    moving = SparseAperture(nn.Parameter(mask.centers.clone()), 0.2, 1.0)
    stack = simulate(scene.requires_grad_(), moving, grid, n_frames=1)
    assert not stack.frames.requires_grad
    assert not stack.object.requires_grad
    assert not stack.aperture.centers.requires_grad
    with torch.no_grad():
        moving.centers += 1.0
    torch.testing.assert_close(stack.aperture.centers, mask.centers)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (-1.0, "negative"),
        (math.nan, "not finite"),
        (math.inf, "not finite"),
    ],
)
def test_bad_scenes_are_refused(mask, grid, values, message):
    scene = torch.ones(32, 32)
    scene[3, 4] = values
    with pytest.raises(ValueError, match=message):
        simulate(scene, mask, grid)


def test_bad_requests_are_refused(scene, mask, grid):
    with pytest.raises(ValueError, match="black"):
        simulate(torch.zeros(32, 32), mask, grid)
    with pytest.raises(ValueError, match=r"\(32, 32\)"):
        simulate(torch.ones(16, 16), mask, grid)
    with pytest.raises(ValueError, match="dtype"):
        simulate(torch.ones(32, 32, dtype=torch.int64), mask, grid)
    with pytest.raises(ValueError, match="population"):
        simulate(scene, SparseAperture(mask.centers.expand(2, 4, 2), 0.2, 1.0), grid)
    with pytest.raises(ValueError, match="undersamples"):
        simulate(scene, FullAperture(2.0), grid)
    for n_frames in (0, -1, 1.5):
        with pytest.raises(ValueError, match="n_frames"):
            simulate(scene, mask, grid, n_frames=n_frames)
    with pytest.raises(TypeError, match=r"scene is a ndarray: it must be a tensor \(H, W\)"):
        simulate(scene.numpy(), mask, grid)
    with pytest.raises(ValueError, match=r"scene has dtype torch\.float16: it must be float32 or float64"):
        simulate(torch.ones(32, 32, dtype=torch.float16), mask, grid)
    with pytest.raises(
        TypeError, match=r"detector is of type NoneType: it must be of type Detector, such as Detector\("
    ):
        simulate_observation(scene, mask, grid, None, None, 1)
    with pytest.raises(TypeError, match="aperture is of type Tensor: it must be of type Aperture"):
        simulate(scene, mask.centers, grid)
    with pytest.raises(TypeError, match=r"generator is 0: it must be a torch\.Generator"):
        simulate_observation(scene, mask, grid, None, Detector(), 1, 0)
    with pytest.raises(ValueError, match="n_frames is 1000000000000: that takes at least"):
        simulate(scene, mask, grid, n_frames=10**12)
