"""The AB Dor experiment on binaries made with the simulation's own optics, and on real exposures if they are there."""

import json
import math

import companion_errors
import companion_fit
import niriss_ab_dor
import numpy as np
import pytest
import torch
from companion_fit import CompanionModel, Exposures

from torchmask.grid import ARCSEC, Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import FILTERS
from torchmask.optics.psf import psf_from_samples
from torchmask.optics.zernike import ZernikePhase

# torch.func itself still scripts some derivatives.
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")

MIDDLE, WIDTH = FILTERS[("NIRISS", "F480M")]
SCALE = 0.0655 * ARCSEC


def sky_matrix(angle):
    """(2, 2) from pixels (x, y) to (east, north) [rad]: north `angle` [deg] from y, east to the left of it."""
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    return SCALE * np.array([[-c, s], [s, c]])


def expose(aperture, sky, companion, place, n_pixels, band, seed):
    """Electrons and their rms (n, n), from a pupil twice as fine and an image twice as wide as the experiment's model.

    Companion (contrast, east, north), star at `place` (y, x); aberrations from the seed 0 in every exposure, and small
    ones of its own; the pixel's square, Poisson and read-out noise.
    """
    own = torch.Generator().manual_seed(seed)
    static = 0.06 * torch.randn(7, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    change = 0.005 * torch.randn(7, 6, dtype=torch.float64, generator=own)
    total = 0
    for wavelength in band:
        grid = Grid(n_pixels, SCALE, wavelength)
        phase = ZernikePhase(aperture, grid, 6, oversampling=4)((static + change) * MIDDLE / wavelength)
        total = total + psf_from_samples(aperture.samples(grid, 4), phase) / len(band)
    nu_y, nu_x = (torch.fft.fftfreq(n, dtype=torch.float64) for n in total.shape)
    x, y = np.linalg.inv(sky) @ companion[1:]

    def at(row, column):
        return torch.exp(-2j * math.pi * (nu_y[:, None] * row + nu_x * column))

    square = torch.sinc(nu_y)[:, None] * torch.sinc(nu_x)
    seen = at(*place) + companion[0] * at(place[0] + y, place[1] + x)
    image = 1e8 * torch.fft.ifft2(torch.fft.fft2(total) * square * seen).real[:n_pixels, :n_pixels]
    noise = (image.clamp(min=0) + 100**2).sqrt()
    return image + noise * torch.randn(image.shape, dtype=torch.float64, generator=own), noise


def band(n):
    return [MIDDLE + WIDTH * ((i + 0.5) / n - 0.5) for i in range(n)]


def polar_offset(separation, angle):
    """(east, north) [rad] of a separation [arcsec] and position angle [deg]."""
    return separation * ARCSEC * np.array([math.sin(math.radians(angle)), math.cos(math.radians(angle))])


@pytest.fixture(scope="module")
def model():
    mask = SparseAperture.from_catalog(niriss_ab_dor.MASK)
    return CompanionModel(mask, Grid(40, SCALE, MIDDLE), 6, band(2), [1.0] * 2, radius=15.0, flux_error=0.006)


def stack(companion, n=2):
    """n exposures through the whole filter, the star not quite on one place, north not quite in one direction."""
    mask = SparseAperture.from_catalog(niriss_ab_dor.MASK)
    skies = [sky_matrix(172 + 0.4 * t) for t in range(n)]
    shots = [
        expose(mask, skies[t], companion, (20.1 - 0.07 * t, 19.9 + 0.1 * t), 40, band(5), seed=t + 1) for t in range(n)
    ]
    frames, errors = (torch.stack(values) for values in zip(*shots, strict=True))
    valid = torch.ones(n, 40, 40, dtype=torch.bool)
    valid[:, 21, 24] = valid[1, 12, 20] = False
    frames[~valid] = 1e9
    to_pixels = torch.from_numpy(np.stack([np.linalg.inv(sky)[::-1] for sky in skies]))
    return Exposures(frames, errors, valid, to_pixels)


@pytest.fixture(scope="module")
def single(model):
    exposures = stack(np.zeros(3))
    return exposures, model.fit(exposures)


def test_companion_is_found_within_its_errors(model, single):
    """Broad band, aberrations, dithers, bad pixels; 5 mag fainter; from search to fit, with the errors of `single`."""
    truth = np.array([0.01, *polar_offset(0.31, 250.0)])
    exposures = stack(truth)
    star = model.fit(exposures, steps=3)
    offsets = companion_errors.places(0.05)
    contrast, error = model.search(exposures, star, offsets)
    best = int((contrast / error).argmax())
    start = torch.cat([contrast[best, None], offsets[best]])
    errors, rows = companion_errors.injection_errors(model, *single, start, 4, 0.05, lambda record: None)
    floor = errors.square().mean(0).sqrt()
    assert len(rows) == 4
    found = model.fit(exposures, start, star)
    measured = companion_errors.measurement(found, floor)
    total = measured["total_error"]
    assert abs(measured["separation"] - 310) < 3.5 * total["separation"] < 25
    assert abs(measured["position_angle"] - 250) < 3.5 * total["position_angle"] < 5
    assert abs(measured["magnitude_difference"] - 5) < 3.5 * total["magnitude_difference"] < 0.35
    assert found.chi_square.max() < 1.5  # as without companion, see below
    assert star.chi_square.min() > 1.5 * found.chi_square.max()
    # It went on until going on changes nothing.
    further = model.fit(exposures, found.companion, found)
    assert ((further.companion - found.companion).abs() < 0.3 * found.covariance.diagonal().sqrt()).all()
    # With the companion taken out nothing as bright is left.
    rest, _ = model.search(exposures, found, offsets)
    assert rest.abs().max() < 0.25 * contrast.max()
    # Aberrations common to all exposures come out as well, but for piston, tip and tilt, which exposures share.
    static = 0.06 * torch.randn(7, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    wrong = (found.shared[:-2].view(7, 6) - static)[:, 3:]
    assert wrong.std() < 0.4 * static[:, 3:].std()


def test_single_star_has_no_companion_at_that_level(model, single):
    exposures, star = single
    offsets = companion_errors.places(0.1)
    contrast, _ = model.search(exposures, star, offsets)
    assert star.chi_square.max() < 1.5  # half a percent of the flux is left by the sampling of the holes
    assert contrast.abs().max() < 0.003
    limits = companion_errors.detection_limits(offsets, contrast)
    assert (contrast.abs() < limits(offsets)).all()
    assert limits(offsets).max() < 0.008


def test_search_is_the_first_step_of_a_fit(model, single):
    """Its contrast is that of a fit that may only change linearly, its error that with the position known."""
    exposures, star = single
    place = torch.from_numpy(polar_offset(0.4, 30.0))
    contrast, error = model.search(exposures, star, place[None])
    start = torch.cat([torch.tensor([1e-9], dtype=torch.float64), place])
    normal = model._normal(exposures, star.shared, star.own, start, True)
    keep = torch.arange(len(normal.vectors[0]) - 2)  # all but east and north
    matrix = (normal.matrices.sum(0) + normal.prior_matrix)[keep][:, keep]
    vector = (normal.vectors.sum(0) + normal.prior_vector)[keep]
    assert float(contrast[0]) == pytest.approx(float(torch.linalg.solve(matrix, vector)[-1]), rel=0.1, abs=1e-5)
    excess = max(1.0, float(star.chi_square.mean()))
    expected = (torch.linalg.inv(matrix)[-1, -1] * excess).sqrt()
    assert float(error[0]) == pytest.approx(float(expected), rel=0.1)  # the template has the background's small wings


def test_derivatives_of_the_model_are_those_of_differences(model, single):
    exposures, star = single
    weight = model._root_weight(exposures)[0]
    companion = torch.tensor([0.02, 1e-6, -5e-7], dtype=torch.float64)
    residual, jacobian = model._linear(exposures, 0, star.shared, star.own[0], companion, True, weight)
    n = len(star.shared)
    steps = {0: 1e-4, 10: 1e-4, n - 1: 1e-4, n: 1e3, n + 1: 1.0, n + 2: 1e-4, n + 5: 1e-4}
    steps |= {jacobian.shape[1] - 3: 1e-4, jacobian.shape[1] - 2: 1e-10, jacobian.shape[1] - 1: 1e-10}
    for column, step in steps.items():
        moved = []
        for sign in (1, -1):
            parts = [star.shared.clone(), star.own[0].clone(), companion.clone()]
            which, place = (0, column) if column < n else (1, column - n) if column < n + 25 else (2, column - n - 25)
            parts[which][place] += sign * step
            moved.append(model._linear(exposures, 0, *parts, True, weight)[0])
        difference = (moved[1] - moved[0]) / (2 * step)
        assert (difference - jacobian[:, column]).abs().max() < 1e-5 * jacobian[:, column].abs().max() + 1e-12
    assert torch.isfinite(residual).all()


def test_injected_companion_is_the_star_moved_and_dimmed(model, single):
    exposures, star = single
    moved = torch.tensor([2.0, -3.0], dtype=torch.float64)  # whole pixels
    offset = torch.linalg.inv(exposures.to_pixels[0]) @ moved
    one = exposures[:1]
    changed = companion_errors.inject(one, companion_fit_of(star), torch.cat([torch.tensor([0.1]), offset]))
    light = torch.where(one.valid, one.frames, star.images[:1]) - star.own[:1, 1, None, None]
    assert torch.allclose(changed.frames - one.frames, 0.1 * light.roll((2, -3), (1, 2)), atol=1e-3)


def companion_fit_of(star):
    """The part of a fit that belongs to the first exposure."""
    return companion_fit.Fit(
        star.companion, star.covariance, star.shared, star.own[:1], star.images[:1], star.chi_square[:1], star.jackknife
    )


def test_errors_are_along_and_across_the_separation():
    """A companion in the north-east whose jackknife scatters along the separation, and whose noise is across it."""
    radius, spread, across = 1.5e-6, 1e-8, 2e-8
    outwards = torch.tensor([0.6, 0.8], dtype=torch.float64)
    companion = torch.cat([torch.tensor([0.01], dtype=torch.float64), radius * outwards])
    jackknife = companion.repeat(4, 1)
    jackknife[:, 1:] += spread * torch.tensor([1.0, -1.0, 1.0, -1.0], dtype=torch.float64)[:, None] * outwards
    sideways = torch.tensor([0.8, -0.6], dtype=torch.float64)
    covariance = torch.zeros(3, 3, dtype=torch.float64)
    covariance[1:, 1:] = across**2 * torch.outer(sideways, sideways)
    covariance[0, 0] = 1e-8
    nothing = torch.zeros(4)
    fit = companion_fit.Fit(companion, covariance, nothing, nothing, nothing, nothing, jackknife)
    systematic = torch.tensor([0.0, 3 * spread, 0.0], dtype=torch.float64)
    found = companion_errors.measurement(fit, systematic)
    mas = ARCSEC / 1000
    assert found["separation"] == pytest.approx(radius / mas)
    assert found["position_angle"] == pytest.approx(math.degrees(math.atan2(0.6, 0.8)))
    errors = found["statistical_error"]
    assert errors["separation"] == pytest.approx(3**0.5 * spread / mas)  # (n - 1) / n times n squares
    assert errors["position_angle"] == pytest.approx(math.degrees(across / radius))
    assert errors["magnitude_difference"] == pytest.approx(2.5 / math.log(10) * 1e-4 / 0.01)
    assert found["total_error"]["separation"] == pytest.approx(12**0.5 * spread / mas)
    other = companion_errors.measurement(fit, systematic)
    other["position_angle"] -= 359.0
    assert companion_errors.agreement(found, other)["position_angle"] == pytest.approx(
        -1 / (2**0.5 * errors["position_angle"]), rel=1e-6
    )


def test_valley_of_a_parabola():
    points = [(x, 3 * (x - 0.37) ** 2 + 2) for x in (-1.0, -0.5, 0.0, 0.5, 1.0)]
    assert niriss_ab_dor.valley(points) == pytest.approx(0.37)
    assert niriss_ab_dor.valley([(0.0, 1.0), (1.0, 2.0), (2.0, 5.0)]) == 0.0  # never beyond what was tried


def write(folder, star, companion, mask, n, seed):
    """Files as the archive gives them, in DN/s, with two dithers."""
    from astropy.io import fits

    for t in range(n):
        sky = sky_matrix(188.0)
        place = ((31.9, 34.1), (36.05, 29.0))[t % 2]
        image, noise = expose(mask, sky, companion, place, 64, [MIDDLE], seed=seed + t)
        unit = niriss_ab_dor.GAIN * 26.0
        sci = fits.ImageHDU((image / unit).numpy().astype(np.float32), name="SCI")
        degrees = np.degrees(sky)
        cards = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CUNIT1": "deg", "CUNIT2": "deg", "CRPIX1": 1.0}
        cards |= {"CRPIX2": 1.0, "CRVAL1": 82.0, "CRVAL2": -65.0, "BUNIT": "DN/s", "XPOSURE": 26.0}
        cards |= {f"CD{i + 1}_{j + 1}": degrees[i, j] for i in range(2) for j in range(2)}
        sci.header.update(cards)
        dq = np.zeros(image.shape, np.uint32)
        dq[33, 36], dq[:4] = 1, 1
        primary = fits.PrimaryHDU()
        primary.header.update({"INSTRUME": "NIRISS", "FILTER": "F480M"})
        err = fits.ImageHDU((noise / unit).numpy().astype(np.float32), name="ERR")
        fits.HDUList([primary, sci, err, fits.ImageHDU(dq, name="DQ")]).writeto(folder / f"{star}_{t}.fits")


def test_directions_on_the_sky_are_those_of_the_world_coordinates(tmp_path):
    """Of the arrays against astropy's own: one arcsecond north, one east."""
    from astropy.io import fits
    from astropy.wcs import WCS

    write(tmp_path, "star", np.zeros(3), SparseAperture.from_catalog(niriss_ab_dor.MASK), 1, seed=1)
    exposures, grid = niriss_ab_dor.read(tmp_path, "star", 40)
    assert grid.wavelength == MIDDLE
    assert grid.pixel_scale == pytest.approx(SCALE, rel=1e-6)
    with fits.open(tmp_path / "star_0.fits") as file:
        wcs = WCS(file["SCI"].header)
    here = wcs.wcs_world2pix([[82.0, -65.0]], 0)[0]
    for east, north in ((0.0, 1.0), (1.0, 0.0)):
        world = [82.0 + east / 3600 / math.cos(math.radians(65.0)), -65.0 + north / 3600]
        x, y = wcs.wcs_world2pix([world], 0)[0] - here
        moved = exposures.to_pixels[0] @ torch.tensor([east, north], dtype=torch.float64) * ARCSEC
        assert moved.numpy() == pytest.approx([y, x], abs=1e-3)


@pytest.fixture(scope="module")
def observed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("niriss")
    mask = SparseAperture.from_catalog(niriss_ab_dor.MASK, mirrored=True)
    turn = math.radians(0.7)
    rotation = torch.tensor([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]], dtype=torch.float64)
    mask = SparseAperture(mask.centers @ rotation.T, 0.8, mask.mask_diameter, "hexagon", mask.orientation + turn)
    write(folder, "pair", np.array([0.03, *polar_offset(0.35, 100.0)]), mask, 2, seed=10)
    write(folder, "single", np.zeros(3), mask, 2, seed=20)
    write(folder, "lonely", np.zeros(3), mask, 2, seed=30)
    return folder


def run(folder, runs, target):
    config = niriss_ab_dor.Config(
        data=folder, target=target, calibrator="single", crop=40, smoke=True, name=target, runs=runs
    )
    assert niriss_ab_dor.main(config) == 0
    return json.loads((runs / target / "results.json").read_text())


def test_from_files_to_the_companion(observed, tmp_path, capsys):
    """A mask mirrored and turned on the detector, which the calibrator tells; then the binary, with its errors."""
    results = run(observed, tmp_path, "pair")
    assert results["pose"]["mirrored"]
    assert results["pose"]["rotation"] == pytest.approx(0.7, abs=0.05)
    assert results["pose"]["magnification"] == pytest.approx(1, abs=1e-3)
    assert results["found"]
    pair, total = results["companion"], results["companion"]["total_error"]
    assert abs(pair["separation"] - 350) < 4 * total["separation"] < 40
    assert abs(pair["position_angle"] - 100) < 4 * total["position_angle"] < 8
    assert abs(pair["magnitude_difference"] + 2.5 * math.log10(0.03)) < 4 * total["magnitude_difference"] < 0.6
    assert set(results["half_differences"]) == {"separation", "position_angle", "magnitude_difference"}
    said = capsys.readouterr().out
    assert "pair: a companion at" in said
    assert "mirrored in x" in said
    for name in ("search", "exposure", "restored"):
        assert (tmp_path / "pair" / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_no_companion_is_said_so(observed, tmp_path, capsys, monkeypatch):
    pose = niriss_ab_dor.Pose(mirrored=True, rotation=0.7)
    rows = [{"mirrored": mirrored, "chi_square": 1.0} for mirrored in (True, False)]
    monkeypatch.setattr(niriss_ab_dor, "find_pose", lambda *args: (pose, rows))
    results = run(observed, tmp_path, "lonely")
    assert not results["found"]
    assert results["companion"] is None
    assert "lonely: NO companion found" in capsys.readouterr().out


def test_missing_exposures_are_said_so(tmp_path, capsys):
    assert niriss_ab_dor.main(niriss_ab_dor.Config(data=tmp_path, runs=tmp_path / "runs")) == 2
    assert "has no ab-dor_*.fits: give the folder of the exposures with --data" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_real_exposures(niriss, tmp_path, capsys):
    """Small and rough; what counts is that it runs on files from the archive, and finds the mask's way round."""
    config = niriss_ab_dor.Config(data=niriss, smoke=True, name="real", runs=tmp_path)
    assert niriss_ab_dor.main(config) == 0
    results = json.loads((tmp_path / "real" / "results.json").read_text())
    assert not results["pose"]["mirrored"]
    assert results["pose"]["rotation"] == pytest.approx(-0.4, abs=0.15)
    assert min(results["calibrator"]["limits"]["magnitude_difference"]) > 4
