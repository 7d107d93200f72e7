"""A mask that is magnified is magnified as a whole: holes, their places and the disc that contains them."""

import pytest

from torchmask.optics.aperture import SparseAperture
from torchmask.optics.geometry import MaskGeometry


@pytest.mark.parametrize(("along_x", "along_y", "shear"), [(1.02, 1.02, 0.0), (1.03, 0.99, 0.02)])
def test_holes_and_the_disc_grow_by_the_root_of_the_area(along_x, along_y, shear):
    mask = SparseAperture([[0.0, 0.4], [0.3, -0.2], [-0.3, -0.2]], 0.1, 1.2, "hexagon")
    seen = MaskGeometry(0.1, along_x, along_y, shear).apply(mask)
    grown = (along_x * along_y - shear**2) ** 0.5
    assert seen.subaperture_diameter == pytest.approx(0.1 * grown, rel=1e-12)
    assert seen.mask_diameter == pytest.approx(1.2 * grown, rel=1e-12)

    def area(corners):  # of the triangle of the centres
        (ax, ay), (bx, by) = (corners[1:] - corners[0]).tolist()
        return abs(ax * by - ay * bx) / 2

    assert area(seen.centers) == pytest.approx(area(mask.centers) * grown**2, rel=1e-12)
