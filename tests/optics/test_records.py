"""Apertures as files hold them, from version 0.1 on."""

import pytest
import torch

from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.records import aperture_record, read_aperture, read_mask
from torchmask.optics.shapes import Annulus, Disc, Hexagon

CENTERS = torch.tensor([[0.0, 0.3], [0.2, -0.2]], dtype=torch.float64)
APERTURES = (
    SparseAperture(CENTERS, 0.2, 1.0),
    SparseAperture(CENTERS.float(), 0.2, 1.0, Hexagon(0.3)),
    SparseAperture([[0.1, 0.0]], 0.2, 1.0),  # one hole, but not in the middle
    SparseAperture([[0.0, 0.0]], 0.2, 1.0, "hexagon"),  # in the middle, but not round
    FullAperture(0.9),
    FullAperture(0.9, 0.2, dtype=torch.float32),
)


@pytest.mark.parametrize("aperture", APERTURES, ids=repr)
def test_a_record_gives_the_aperture_back(aperture):
    back = read_aperture(aperture_record(aperture))
    assert type(back) is type(aperture)
    assert torch.equal(back.centers, aperture.centers)
    assert back.centers.dtype == aperture.centers.dtype
    for name in ("shape", "subaperture_diameter", "mask_diameter"):
        assert getattr(back, name) == getattr(aperture, name), name


def old_record(centers, **changes):
    """The keys of version 0.1, which gave every shape an orientation and an obstruction."""
    record = {"subaperture_diameter": 0.2, "mask_diameter": 1.0, "shape": "disc", "orientation": 0.0}
    return record | {"central_obstruction": 0.0, "centers": centers} | changes


def test_records_of_version_0_1():
    assert read_aperture(old_record(CENTERS)).shape == Disc()
    assert read_aperture(old_record(CENTERS, shape="hexagon", orientation=0.1)).shape == Hexagon(0.1)
    pupil = read_aperture(old_record(torch.zeros(1, 2), central_obstruction=0.25))
    assert isinstance(pupil, FullAperture)
    assert (pupil.shape, pupil.mask_diameter) == (Annulus(0.25), 0.2)  # its own diameter
    assert isinstance(read_mask(old_record(torch.zeros(1, 2))), SparseAperture)


def test_a_shape_that_is_not_told_is_a_disc():
    record = old_record(CENTERS)
    del record["shape"], record["orientation"]
    assert read_mask(record).shape == Disc()


@pytest.mark.parametrize("change", [{"shape": "star"}, {"mask_diameter": -1.0}, {"subaperture_diameter": "wide"}])
def test_what_describes_no_aperture_is_refused(change):
    with pytest.raises(ValueError, match=r"star|-1\.0|wide"):
        read_aperture(old_record(CENTERS, **change))
