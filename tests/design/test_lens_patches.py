"""The lenses of masks on patches of pixels."""

import torch

from torchmask.atmosphere.colour_coherence import ColourCoherence
from torchmask.atmosphere.seeing import Seeing
from torchmask.design.lens_patches import LensPatches
from torchmask.design.overlap import Geometry
from torchmask.optics.band import Band
from torchmask.optics.shapes import Disc

DIAMETER, REFERENCE = 0.1, 550e-9
GEOMETRY = Geometry((64, 64), 2.0, Disc(), DIAMETER, DIAMETER)
CENTERS = torch.tensor([[[0.0, 0.3], [0.25, -0.1], [-0.3, -0.12]]], dtype=torch.float64)


def patches_of(wavelengths, coherence, amplitude):
    band = Band.of([length * REFERENCE for length in wavelengths])
    return LensPatches(GEOMETRY, band, REFERENCE, coherence, amplitude, torch.float64, torch.device("cpu"))


def by_baseline(scale):
    """A table whose amplitude is 1 - |b| / 4 times the scale, whatever the lens."""

    def factors(baselines):
        return torch.cat([scale * (1 - baselines.norm(dim=-1) / 4)[None], torch.zeros(4, len(baselines)).double()])

    return factors


def test_the_amplitude_belongs_to_the_baseline_and_the_phases_of_the_wavelength():
    patches = patches_of([0.8], None, by_baseline)
    lenses = patches(CENTERS)
    length = patches.plane.baselines[lenses.index].norm(dim=-1) * 0.8
    torch.testing.assert_close(lenses.kept[0], lenses.values[0] * (1 - length / 4) / 0.8)
    assert float((lenses.kept - lenses.values).abs().max()) > 0.1


def test_every_wavelength_of_a_band_keeps_its_own_amplitude():
    """The sum of squares over modes is that of amplitudes, coherent as far as the frequency says."""
    wavelengths = (0.9, 1.1)
    band = Band.of([length * REFERENCE for length in wavelengths])
    coherence = ColourCoherence(Disc(), DIAMETER, Seeing(0.15), band, REFERENCE, 1.5)
    both = patches_of(wavelengths, coherence, by_baseline)(CENTERS)
    plane = patches_of(wavelengths, coherence, by_baseline).plane
    found = plane.summed(both.index[:, 1:], (both.kept**2).sum(0)[:, 1:])[0]
    alone = []
    for length in wavelengths:
        patches = patches_of([length], None, by_baseline)
        lenses = patches(CENTERS)
        each = torch.zeros(3, plane.n_pixels, dtype=torch.float64)
        # the planes of a band and of one wavelength have other margins
        rows, columns = (lenses.index // patches.plane.size[1], lenses.index % patches.plane.size[1])
        rows, columns = (
            rows - patches.plane.origin[0] + plane.origin[0],
            columns - patches.plane.origin[1] + plane.origin[1],
        )
        for lens in range(3):
            each[lens].index_add_(
                0, (rows * plane.size[1] + columns)[0, lens + 1].flatten(), lenses.kept[0, 0, lens + 1].flatten() / 2
            )
        alone.append(each)
    kept = coherence.between(plane.baselines)
    expected = sum(alone[i] * alone[j] * kept[:, i, j] for i in (0, 1) for j in (0, 1)).sum(0)
    bright = expected > 1e-3
    assert int(bright.sum()) > 50
    # modes that hold a hundredth of the light are left out
    torch.testing.assert_close(found[bright], expected[bright], rtol=0.02, atol=0.002)
    squares = sum(one**2 for one in alone).sum(0)
    assert float((expected - squares)[bright].max()) > 0.02


def test_patches_beyond_the_plane_are_known_from_the_nearest_pixels_or_the_opposite_ones():
    """On it they are themselves; a function of the baseline must be even for the opposite to stand for it."""
    plane = patches_of([1.0], None, None).plane
    unit = GEOMETRY.period / 64
    corners = torch.tensor([[3.0, 2.0], [-20.0, -29.0], [90.0, 4.0], [-90.0, -70.0]], dtype=torch.float64)
    found = plane.baselines[plane.nearest(corners, 4, 5)] / unit
    x, y = torch.meshgrid(torch.arange(5).double(), torch.arange(4).double(), indexing="xy")
    pixels = corners[:, None, None] + torch.stack([x, y], -1)
    torch.testing.assert_close(found[0], pixels[0])
    torch.testing.assert_close(found[1], -pixels[1])
    (_, bottom), (right, top) = ((edge / unit).tolist() for edge in (plane.baselines.amin(0), plane.baselines.amax(0)))
    assert 32 < right < 90
    assert -29 < bottom < 0
    expected = torch.stack([torch.full((4, 5), right).double(), pixels[2, ..., 1]], -1)
    torch.testing.assert_close(found[2], expected)
    assert (found[3] == torch.tensor([right, top])).all()
