"""Numbers with a unit and hidden values are refused where they would silently become plain ones."""

import numpy as np
import pytest
import torch

from torchmask.grid import Grid
from torchmask.io import as_tensor
from torchmask.optics.aperture import SparseAperture
from torchmask.restoration.myopic import MyopicDeconvolution

units = pytest.importorskip("astropy.units")


def test_values_with_a_unit_are_no_tensor():
    for unit, wanted in ((units.electron, "electron"), (units.mm, "m"), (units.arcsec, "rad"), (units.ms, "s")):
        with pytest.raises(TypeError, match=rf"values has the unit {unit}: .* values\.to_value\('{wanted}'\)"):
            as_tensor(np.ones(3) * unit)
    with pytest.raises(TypeError, match=r"values has the unit adu: .* give values\.value"):
        as_tensor(np.ones(3) * units.adu)


def test_masked_arrays_are_taken_only_if_they_hide_nothing():
    frames = np.ma.masked_greater(np.arange(6.0), 4.5)
    with pytest.raises(ValueError, match=r"hides 1 of 6 values .*values\.filled\(0\), with valid=~values\.mask"):
        as_tensor(frames)
    assert torch.equal(as_tensor(np.ma.masked_greater(np.arange(6.0), 9.0)), torch.arange(6.0).double())


def test_frames_and_centres_with_a_unit_are_refused():
    mask, grid = SparseAperture([[0.0, 0.3], [0.3, -0.2]], 0.2, 1.0), Grid.nyquist(1.0, 550e-9, 16)
    with pytest.raises(TypeError, match=r"give values\.to_value\('electron'\)"):
        MyopicDeconvolution(mask, grid).restore(np.ones((2, 16, 16)) * units.electron)
    with pytest.raises(TypeError, match=r"give values\.to_value\('m'\)"):
        SparseAperture(mask.centers.numpy() * 1000 * units.mm, 0.2, 1.0)


def test_numbers_of_a_grid_with_a_unit_are_refused():
    with pytest.raises(TypeError, match=r"pixel_scale has the unit arcsec: .*pixel_scale\.to_value\('rad'\)"):
        Grid(16, 0.02 * units.arcsec, 550e-9)
    with pytest.raises(TypeError, match=r"wavelength\.to_value\('m'\)"):
        Grid(16, 1e-7, 550 * units.nm)
    for arguments, name in (((1.0, 550 * units.nm), "wavelength"), ((100 * units.cm, 550e-9), "diameter")):
        with pytest.raises(TypeError, match=rf"{name} has the unit .*{name}\.to_value\('m'\)"):
            Grid.nyquist(*arguments, 16)
