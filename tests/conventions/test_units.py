"""Metres, radians, electrons. docs/conventions.md, "Units"."""

import math

import pytest
import torch

import torchmask as tm
from torchmask.atmosphere.von_karman import von_karman_structure_function

GRID = tm.Grid.nyquist(diameter=2.0, wavelength=1e-6, n_pixels=64)


def test_a_length_in_the_pupil_is_a_frequency_in_the_image():
    grid = tm.Grid(64, pixel_scale=2e-7, wavelength=1e-6)
    assert grid.cutoff(1.25) == pytest.approx(1.25 * 2e-7 / 1e-6)  # x pixel_scale / wavelength [cycles/pixel]
    assert grid.period == pytest.approx(5.0)  # [m]


def test_the_first_dark_ring_is_at_1_22_wavelengths_over_the_diameter():
    grid = tm.Grid.nyquist(1.0, 550e-9, 128, oversampling=6)  # 14.6 pixels to the ring
    profile = tm.PSF(tm.FullAperture(1.0), grid)()[0, :64]
    ring = int((profile[1:] > profile[:-1]).nonzero()[0])
    expected = 1.22 * 550e-9 / 1.0 / grid.pixel_scale
    assert ring == pytest.approx(expected, abs=0.5)


def test_hexagons_are_measured_flat_to_flat_and_turned_to_the_normal_of_a_side():
    mask = tm.SparseAperture([[0.0, 0.0]], 1.0, 2.0, shape="hexagon", orientation=0.0)
    assert mask.area == pytest.approx(math.sqrt(3) / 2)
    samples = mask.samples(tm.Grid.nyquist(2.0, 1e-6, 256))
    inside = samples.offsets[0][samples.weights[0] > 0.5]
    step = samples.step[0]
    assert float(inside[:, 0].abs().max()) == pytest.approx(0.5, abs=step)  # a flat side faces +x
    assert float(inside[:, 1].abs().max()) == pytest.approx(1 / math.sqrt(3), abs=step)  # a corner points to +y


def test_fill_factor_is_the_collecting_area_in_mask_areas():
    mask = tm.SparseAperture.random(5, mask_diameter=2.0, fill_factor=0.2, generator=torch.Generator().manual_seed(0))
    assert mask.fill_factor == pytest.approx(0.2)
    assert mask.area == pytest.approx(0.2 * math.pi * 2.0**2 / 4)


def test_r0_is_where_the_structure_function_is_6_88():
    distance = torch.tensor([0.2], dtype=torch.float64)
    value = von_karman_structure_function(distance, r0=0.2, outer_scale=2e9)
    assert float(value) == pytest.approx(6.8839, rel=1e-3)


def test_a_scene_is_in_electrons_per_frame_and_a_frame_is_in_electrons():
    scene = tm.make_scene(GRID.shape, n_photons=1e7, dtype=torch.float64)
    assert float(scene.sum()) == pytest.approx(1e7)
    generator = torch.Generator().manual_seed(0)
    observation = tm.simulate_observation(scene, tm.FullAperture(2.0), GRID, None, tm.Detector(2.0), 4, generator)
    assert observation.n_photons == pytest.approx(1e7)
    kept = float(observation.psfs[0].sum())
    assert 0.9 < kept < 1  # the halo of the PSF leaves the field, and nothing comes back
    for frame in observation.frames:
        assert kept * 1e7 * 0.98 < float(frame.sum()) < 1e7


def test_noise_is_in_electrons_rms():
    dark = torch.zeros(200, 200, dtype=torch.float64)
    frame = tm.Detector(readout_noise=2.5)(dark, torch.Generator().manual_seed(0))
    assert float(frame.std()) == pytest.approx(2.5, rel=5 / math.sqrt(2 * 200**2))
