import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchmask.optics import catalog
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.shapes import Disc, Hexagon

GOLAY = {"golay3": 3, "golay6": 6, "golay9": 9, "golay12": 12, "golay12_alt": 12}


def differences(points):
    points = np.asarray(points)
    return (points[:, None] - points[None])[~np.eye(len(points), dtype=bool)]


def test_every_mask_of_the_shared_file_with_its_coordinates(mask_facts):
    assert set(catalog.names()) == set(mask_facts)
    for name, fact in mask_facts.items():
        mask = catalog.entry(name)
        # Facts are printed to six decimals; instruments' numbers carry over as they are.
        tolerance = 0.0 if mask.unit == "m" else 5.1e-7
        np.testing.assert_allclose(mask.centers, fact["xy"], rtol=0, atol=tolerance, err_msg=name)
        assert mask.n_subapertures == fact["n"]
        assert mask.pupil_diameter == fact["pupil_diameter"]
        assert mask.central_obstruction == fact["central_obstruction"]
        assert isinstance(mask.shape, Hexagon) == fact["hole_shape"].startswith("hexagon")
        assert (mask.unit == "m") == (fact["units"] == "m")
        if name != "vlt_visir_7":
            assert mask.hole_diameter == fact["hole_diameter"]


def test_visir_hexagons_are_stored_flat_to_flat(mask_facts):
    side = 0.61
    assert mask_facts["vlt_visir_7"]["hole_diameter"] == 2 * side
    assert catalog.entry("vlt_visir_7").hole_diameter == pytest.approx(math.sqrt(3) * side, rel=1e-15)


@pytest.mark.parametrize("name", catalog.names())
def test_every_entry_says_where_it_comes_from(name):
    mask = catalog.entry(name)
    assert len(mask.source) > 20
    assert bool(mask.hole_source) == (mask.hole_diameter is not None)
    assert isinstance(mask.shape, Disc | Hexagon)
    assert mask.unit in ("m", "lattice", "outer radius")


@pytest.mark.parametrize(("name", "count"), GOLAY.items())
def test_golay_arrays_are_exact_non_redundant_lattice_arrays_with_threefold_symmetry(name, count):
    centers = np.array(catalog.entry(name).centers)
    assert len(centers) == count
    vectors = differences(centers)
    distance = np.linalg.norm(vectors[:, None] - vectors[None], axis=-1) + 9 * np.eye(len(vectors))
    assert distance.min() == pytest.approx(1, abs=1e-14)  # the pitch: distinct vectors of one lattice
    turn = np.array([[-0.5, -math.sqrt(3) / 2], [math.sqrt(3) / 2, -0.5]])
    turned = centers @ turn.T
    assert np.linalg.norm(turned[:, None] - centers[None], axis=-1).min(axis=1).max() < 1e-14


def test_golay6_differences_fill_the_first_four_shells():
    squared = (differences(catalog.entry("golay6").centers) ** 2).sum(-1)
    shells, counts = np.unique(squared.round(9), return_counts=True)
    assert shells.tolist() == [1, 3, 4, 7]
    assert counts.tolist() == [6, 6, 6, 12]


@pytest.mark.parametrize(
    ("name", "pitch"),
    [("jwst_niriss_ami_7", 1.32), ("jwst_niriss_ami_7_bis", 1.309)]
    + [(f"keck_lws_pattern{k}", 0.9 * math.sqrt(3)) for k in ("5a_6", "2a_9", "6a_6", "6b_6", "6c_6")],
)
def test_hexagons_stand_like_the_segments(name, pitch):
    """Segments that tile the plane meet along sides square to the steps of their lattice."""
    mask = catalog.entry(name)
    vectors = differences(mask.centers)

    def misfit(orientation):
        normals = orientation + np.array([0, 1]) * math.pi / 3
        steps = pitch * np.stack([np.cos(normals), np.sin(normals)])  # across two neighbouring sides, as columns
        counts = vectors @ np.linalg.inv(steps).T
        return np.abs(counts - np.round(counts)).max()

    assert misfit(mask.shape.orientation) < 1e-5  # the sources print five or six decimals
    assert misfit(mask.shape.orientation + math.pi / 6) > 0.1  # the other way to stand does not carry the holes


def test_instruments_as_built():
    mask = SparseAperture.from_catalog("jwst_niriss_ami_7")
    assert (mask.shape, mask.subaperture_diameter, mask.mask_diameter) == (Hexagon(math.radians(30)), 0.8, 6.559)
    assert mask.centers.dtype == torch.float64
    assert mask.centers[0].tolist() == [0.0, -2.64]


@pytest.mark.parametrize("name", [n for n in catalog.names() if catalog.entry(n).n_subapertures < 15])
def test_laid_afresh_the_outer_edges_touch_the_mask(name):
    mask = SparseAperture.from_catalog(name, mask_diameter=2.5, fill_factor=0.12)
    outer = mask.subaperture_diameter * (1 if mask.shape == Disc() else 2 / math.sqrt(3))
    assert mask.mask_diameter == 2.5
    assert mask.fill_factor == pytest.approx(0.12, rel=1e-14)
    middle, radius = catalog.smallest_enclosing_circle(mask.centers.numpy())
    assert np.linalg.norm(middle) < 1e-12
    assert radius + outer / 2 == pytest.approx(1.25, rel=1e-12)


def test_one_size_alone_scales_or_replaces():
    built = SparseAperture.from_catalog("gpi")
    scaled = SparseAperture.from_catalog("gpi", mask_diameter=1.0)
    assert scaled.mask_diameter == pytest.approx(1.0, rel=1e-15)
    assert scaled.fill_factor == pytest.approx(built.fill_factor, rel=1e-14)
    torch.testing.assert_close(scaled.centers * built.mask_diameter, built.centers, rtol=1e-14, atol=0)
    wider = SparseAperture.from_catalog("gpi", fill_factor=0.1)
    assert torch.equal(wider.centers, built.centers)
    assert wider.fill_factor == pytest.approx(0.1, rel=1e-14)
    assert SparseAperture.from_catalog("vlt_sphere_irdis_7", fill_factor=0.1).mask_diameter == 8.0


@pytest.mark.parametrize("name", ["keck_nirc2_9", "jwst_niriss_ami_7"])
def test_mirrored_reverses_x_and_turns_the_hexagons(name):
    mask, mirror = SparseAperture.from_catalog(name), SparseAperture.from_catalog(name, mirrored=True)
    assert torch.equal(mirror.centers, mask.centers * torch.tensor([-1.0, 1.0], dtype=torch.float64))
    shift = torch.tensor([[0.3, 0.1], [-0.2, 0.4]], dtype=torch.float64)
    reversed_shift = shift * torch.tensor([-1.0, 1.0])
    torch.testing.assert_close(mirror.shape.otf(reversed_shift, 0.8), mask.shape.otf(shift, 0.8), rtol=0, atol=1e-15)


@pytest.mark.parametrize("spelling", ["Golay-6", "GOLAY 6", "golay_6"])
def test_spelling_does_not_matter(spelling):
    assert catalog.entry(spelling).name == "golay6"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("golay7",), "did you mean 'golay.*known masks are golay3"),
        (("Hubble",), "known masks are golay3, .*keck_nirc2_9"),
        (("golay6",), r"both mask_diameter \[m\] and fill_factor"),
        (("golay6", 1.0), r"both mask_diameter \[m\] and fill_factor"),
        (("golay6", None, 0.15), r"both mask_diameter \[m\] and fill_factor"),
        (("golay6", 1.0, 7.0), "lower fill_factor"),
        (("vlt_eris_7",), "no source gives the hole diameter of vlt_eris_7: give fill_factor"),
        (("golay6", -1.0, 0.15), r"mask_diameter is -1\.0: it must be finite and positive, in m"),
        (("golay6", 1.0, float("nan")), r"fill_factor is nan: it must be finite and positive, N d\^2 / D\^2"),
    ],
)
def test_bad_requests_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        SparseAperture.from_catalog(*arguments)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype(dtype):
    assert SparseAperture.from_catalog("golay9", 1.0, 0.15, dtype=dtype).centers.dtype == dtype


def brute_force_radius(points):
    """Smallest radius among all circles through two or three points that hold every point."""
    candidates = [(p + q) / 2 for p, q in itertools.combinations(points, 2)]
    for p, q, r in itertools.combinations(points, 3):
        matrix = 2 * np.stack([q - p, r - p])
        if abs(np.linalg.det(matrix)) > 1e-9:
            candidates.append(p + np.linalg.solve(matrix, [(q - p) @ (q - p), (r - p) @ (r - p)]))
    return min(np.linalg.norm(points - c, axis=1).max() for c in candidates)


# A coarse lattice brings ties, points in line and points twice.
LATTICE = st.lists(st.tuples(st.integers(-4, 4), st.integers(-4, 4)), min_size=2, max_size=9)


@given(LATTICE)
@settings(max_examples=150, derandomize=True, deadline=None)
def test_smallest_enclosing_circle_against_all_circles(points):
    points = np.array(points, dtype=float)
    center, radius = catalog.smallest_enclosing_circle(points)
    assert np.linalg.norm(points - center, axis=1).max() == pytest.approx(radius, rel=1e-12, abs=1e-12)
    assert radius == pytest.approx(brute_force_radius(points), rel=1e-9, abs=1e-12)
