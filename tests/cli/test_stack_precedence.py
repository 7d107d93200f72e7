"""What a stack says itself counts before a plan, and jitter is added to the pixels that it has."""

import dataclasses

import numpy as np
import pytest
import torch

from torchmask.cli.stacks import StackOptions, read_stack
from torchmask.grid import ARCSEC, Grid
from torchmask.observation import Observation
from torchmask.optics.pixel import JitteredPixel, SquarePixel


def test_a_pixel_scale_in_the_stack_is_not_replaced_by_the_planned_one_without_a_word(folder, recorded):
    camera = dataclasses.replace(recorded.camera, pixel_scale=0.03)
    dataclasses.replace(recorded, camera=camera).save(folder / "scaled.json")
    numbers = {"frames": np.full((2, 8, 8), 7.0), "wavelength": recorded.mean_wavelength, "readout_noise": 2.5}
    told = {"mask": folder / "mask.json", "instrument": folder / "scaled.json"}
    np.savez(folder / "other.npz", **numbers, pixel_scale=0.02 * ARCSEC)
    with pytest.raises(ValueError, match=r"--pixel-scale-arcsec \(0\.02 against 0\.03 arcsec\)"):
        read_stack([folder / "other.npz"], StackOptions(**told))
    with pytest.warns(
        UserWarning, match=r"given, 0\.025 arcsec, is taken, .* the file says 0\.02 arcsec, 20\.0 % less"
    ):
        given = read_stack([folder / "other.npz"], StackOptions(**told, pixel_scale_arcsec=0.025))
    assert given.grid.pixel_scale == pytest.approx(0.025 * ARCSEC, rel=1e-12)
    np.savez(folder / "none.npz", **numbers)
    planned = read_stack([folder / "none.npz"], StackOptions(**told))
    assert planned.grid.pixel_scale == pytest.approx(0.03 * ARCSEC, rel=1e-12)


def test_the_sky_coordinates_of_a_stack_get_the_pixel_scale_that_is_given(tmp_path, golay, sky_cards, sky_matrix):
    pytest.importorskip("astropy")
    grid = Grid.nyquist(golay.extent, 550e-9, 16)
    header = sky_cards(0.3, grid.pixel_scale)
    Observation(torch.ones(2, 16, 16), golay, grid, 1.0, header=header).save(tmp_path / "stack.npz")
    twice = StackOptions(pixel_scale_arcsec=2 * grid.pixel_scale / ARCSEC)
    with pytest.warns(
        UserWarning, match=r"the file says .* 50\.0 % less and the CD matrix or CDELT says .* 50\.0 % less"
    ):
        seen = read_stack([tmp_path / "stack.npz"], twice)
    np.testing.assert_allclose(seen.sky_matrix, sky_matrix(0.3, 2 * grid.pixel_scale), rtol=1e-9)
    for name in ("CD1_1", "CD1_2", "CD2_1", "CD2_2"):
        assert seen.header[name] == pytest.approx(2 * header[name], rel=1e-9)
    near = StackOptions(pixel_scale_arcsec=1.009 * grid.pixel_scale / ARCSEC)  # within what statements may differ
    assert read_stack([tmp_path / "stack.npz"], near).grid.pixel_scale == pytest.approx(1.009 * grid.pixel_scale)


def test_jitter_is_that_of_the_pixels_of_the_stack(tmp_path, golay):
    grid = Grid.nyquist(golay.extent, 550e-9, 16)
    Observation(torch.ones(2, 16, 16), golay, grid, 1.0, pixel=SquarePixel(0.8)).save(tmp_path / "stack.npz")
    for options, pixel in (
        ({"jitter": 0.3}, JitteredPixel(0.3, SquarePixel(0.8))),
        ({"jitter": 0.3, "pixel_fill": 0.5}, JitteredPixel(0.3, SquarePixel(0.5))),
        ({"jitter": 0.3, "pixel_fill": 0.0}, JitteredPixel(0.3, None)),
        ({}, SquarePixel(0.8)),
    ):
        assert read_stack([tmp_path / "stack.npz"], StackOptions(**options)).pixel == pixel
