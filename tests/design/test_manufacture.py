import contextlib
import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchmask.design.drawing import save_dxf, save_svg
from torchmask.design.manufacture import amplitude_map, load_mask, mask_wavelength, save_fits, save_json
from torchmask.optics.aperture import FullAperture, SparseAperture

SAVE = {
    ".json": save_json,
    ".dxf": partial(save_dxf, allow_overlap=True),
    ".svg": partial(save_svg, allow_overlap=True),
    ".fits": save_fits,
}
READABLE = [".json", ".dxf", ".fits"]
SVG = "{http://www.w3.org/2000/svg}"


def masks():
    generator = torch.Generator().manual_seed(5)
    uneven = (torch.rand(7, 2, generator=generator, dtype=torch.float64) - 0.5) / 3
    return {
        "discs": SparseAperture(uneven, 0.1 / 3, 1 / 3),
        "hexagons": SparseAperture(uneven, 0.1 / 3, 1 / 3, shape="hexagon", orientation=2.1),
        "niriss": SparseAperture.from_catalog("niriss"),
    }


def same_bits(a, b):
    return (
        torch.equal(a.centers, b.centers)
        and a.centers.dtype == b.centers.dtype
        and (a.subaperture_diameter, a.mask_diameter, a.shape) == (b.subaperture_diameter, b.mask_diameter, b.shape)
    )


@pytest.mark.parametrize("name", masks())
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("suffix", [".json", ".fits"])
def test_json_and_fits_come_back_with_every_bit(tmp_path, name, dtype, suffix):
    mask = masks()[name].to(dtype)
    SAVE[suffix](tmp_path / f"mask{suffix}", mask)
    assert same_bits(load_mask(tmp_path / f"mask{suffix}"), mask)


place = st.floats(-0.3, 0.3, allow_nan=False)


@given(
    st.lists(st.tuples(place, place), min_size=1, max_size=8),
    st.floats(1e-6, 0.2),
    st.floats(1e-3, 1e3),
    st.floats(-10, 10),
)
@settings(max_examples=60, derandomize=True, deadline=None)
def test_json_is_exact_for_any_mask(tmp_path_factory, centers, hole, diameter, orientation):
    centers = torch.tensor(centers, dtype=torch.float64) * diameter
    mask = SparseAperture(centers, hole * diameter, diameter, "hexagon", orientation)
    path = tmp_path_factory.mktemp("exact") / "mask.json"
    save_json(path, mask)
    assert same_bits(load_mask(path), mask)


@pytest.mark.parametrize("name", masks())
@pytest.mark.parametrize("n_pixels", [128, 301])
def test_fits_map_has_the_area_and_centre_of_mass_of_the_mask(tmp_path, name, n_pixels):
    from astropy.io import fits

    mask = masks()[name]
    save_fits(tmp_path / "map.fits", mask, n_pixels=n_pixels)
    with fits.open(tmp_path / "map.fits") as content:
        image, header = np.array(content[0].data), content[0].header
    assert image.shape == (n_pixels, n_pixels)
    assert image.min() >= 0
    assert image.max() == pytest.approx(1, abs=1e-9)
    step = header["CDELT1"]
    x = (np.arange(n_pixels) + 1 - header["CRPIX1"]) * step + header["CRVAL1"]
    moments = np.array([(image * x).sum(), (image * x[:, None]).sum()]) / image.sum()
    if name == "niriss":  # the others overlap
        # Only cells on corners of a hexagon are not exact: a centred corner opens 1/3, the product of two edges 1/4.
        corners = 6 * mask.n_subapertures
        assert image.sum() * step**2 == pytest.approx(mask.area, abs=corners * step**2 / 12)
        np.testing.assert_allclose(moments, mask.centers.mean(0).numpy(), rtol=0, atol=0.01 * step)
    # Every hole is open at its centre, in rows that go up in y.
    nearest = np.round(mask.centers.numpy() / step).astype(int) + n_pixels // 2
    np.testing.assert_allclose(image[nearest[:, 1], nearest[:, 0]], 1, rtol=0, atol=1e-9)
    rim_column = image[:, [0, -1]].sum() + image[[0, -1]].sum()
    assert rim_column == 0


@pytest.mark.parametrize("suffix", SAVE)
def test_nothing_is_overwritten(tmp_path, suffix):
    path = tmp_path / f"mask{suffix}"
    SAVE[suffix](path, masks()["discs"])
    before = path.read_bytes()
    with pytest.raises(ValueError, match="not overwritten"):
        SAVE[suffix](path, masks()["niriss"])
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", SAVE)
def test_only_one_sparse_aperture_makes_a_file(tmp_path, suffix):
    path = tmp_path / f"mask{suffix}"
    with pytest.raises(ValueError, match="a file holds one mask"):
        SAVE[suffix](path, SparseAperture(torch.zeros(2, 3, 2), 0.1, 1.0))
    with pytest.raises(TypeError, match="aperture is of type FullAperture: it must be of type SparseAperture"):
        SAVE[suffix](path, FullAperture(1.0))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", READABLE)
def test_a_truncated_file_is_refused(tmp_path, suffix):
    path = tmp_path / f"mask{suffix}"
    SAVE[suffix](path, masks()["discs"])
    content = path.read_bytes()
    for cut in (0, 0.1, 0.12, 0.3, 0.5, 0.7, 0.97):
        path.write_bytes(content[: int(cut * len(content))])
        with pytest.raises(ValueError, match=f"mask{suffix} cannot be read as a mask"):
            load_mask(path)


@pytest.mark.parametrize("suffix", READABLE)
def test_a_damaged_file_is_refused_or_read_as_a_mask(tmp_path, suffix):
    path = tmp_path / f"mask{suffix}"
    SAVE[suffix](path, masks()["discs"])
    content, rng = path.read_bytes(), np.random.default_rng(2)
    for _ in range(20):
        damaged = bytearray(content)
        start = int(rng.integers(len(content)))
        damaged[start : start + 3] = rng.bytes(3) if suffix == ".fits" else b""
        path.write_bytes(bytes(damaged))
        with contextlib.suppress(ValueError):
            assert load_mask(path).n_subapertures > 0


@pytest.mark.parametrize("suffix", READABLE)
def test_noise_is_refused(tmp_path, suffix):
    path = tmp_path / f"mask{suffix}"
    path.write_bytes(np.random.default_rng(1).bytes(4000))
    with pytest.raises(ValueError, match="cannot be read as a mask"):
        load_mask(path)


def test_missing_and_unknown_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"there is no mask file .*absent\.json"):
        load_mask(tmp_path / "absent.json")
    with pytest.raises(ValueError, match=r"its name must end in \.json, \.dxf, \.fits"):
        load_mask(tmp_path / "mask.svg")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "other"}, "its 'format' is not 'torchmask mask, version 1'"),
        ({"units": {"length": "mm", "angle": "rad"}}, r"its 'units' are .*mm.*: convert its numbers to .*'m'"),
        ({"centers": None, "mask_diameter": None}, "lacks 'mask_diameter', 'centers'"),
        ({"centers": [[0, 1, 2]]}, "centers has shape"),
        ({"centers": "none"}, "cannot be read as a mask"),
        ({"subaperture_diameter": -1}, "subaperture_diameter is -1"),
        ({"shape": "star"}, "shape is 'star'"),
        ({"dtype": "int8"}, "int8: known are float64, float32"),
        ({"mask_diameter": "wide"}, "cannot be read as a mask"),
    ],
)
def test_json_with_wrong_content_is_refused(tmp_path, change, message):
    save_json(tmp_path / "mask.json", masks()["discs"])
    record = json.loads((tmp_path / "mask.json").read_text()) | change
    record = {key: value for key, value in record.items() if value is not None}
    (tmp_path / "changed.json").write_text(json.dumps(record))
    with pytest.raises(ValueError, match=message):
        load_mask(tmp_path / "changed.json")


@pytest.mark.parametrize("suffix", [".json", ".dxf", ".svg", ".fits"])
def test_masks_that_cannot_be_are_neither_written_nor_read(tmp_path, suffix):
    mask = SparseAperture([[-0.4, 0.0], [0.4, 0.0]], 0.1, 1.0)
    for wrong, said in (
        (mask.replace(centers=1000 * mask.centers), "holes reach 399.6 m beyond the rim of a mask_diameter of 1 m"),
        (SparseAperture(1200 * mask.centers, 120.0, 1200.0), "mask_diameter is 1200 m: give lengths in m"),
    ):
        with pytest.raises(ValueError, match=said):
            SAVE[suffix](tmp_path / f"mask{suffix}", wrong)
    path = tmp_path / "small.json"
    save_json(path, mask)
    path.write_text(path.read_text().replace('"mask_diameter": 1.0', '"mask_diameter": 0.5'))
    with pytest.raises(ValueError, match=r"small.json cannot be read as a mask: holes reach 0\.2 m beyond the rim"):
        load_mask(path)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            {"subaperture_diamter": 0.1},
            "it has 'subaperture_diamter', which is 0.1: the keys of such a mask are format",
        ),
        ({"Shape": "hexagon"}, "it has 'Shape'"),
        ({"orientation": 0.1}, "it has 'orientation'"),  # discs have none
        ({"wavelengths": 550e-9}, "it has 'wavelengths'"),
        ({"subaperture_diameter": True}, "its subaperture_diameter is True: it must be a number, in m"),
        ({"mask_diameter": "1.0"}, "its mask_diameter is '1.0'"),
    ],
)
def test_typing_errors_in_a_mask_file_are_told(tmp_path, given, said):
    path = tmp_path / "mask.json"
    save_json(path, SparseAperture([[-0.4, 0.0], [0.4, 0.0]], 0.1, 1.0))
    path.write_text(json.dumps(json.loads(path.read_text()) | given))
    with pytest.raises(ValueError, match=said):
        load_mask(path)


@pytest.mark.parametrize("extra", [{"comment": "as cut"}, {"orientation": 0.0, "central_obstruction": 0.0}])
def test_remarks_and_what_version_0_1_wrote_are_read_over(tmp_path, extra):
    path = tmp_path / "mask.json"
    save_json(path, SparseAperture([[-0.4, 0.0], [0.4, 0.0]], 0.1, 1.0))
    expected = load_mask(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | extra))
    assert same_bits(load_mask(path), expected)


def test_masks_for_a_bench_are_written(tmp_path):
    small = SparseAperture([[-2e-4, 0.0], [2e-4, 0.0]], 5e-5, 5e-4)
    save_json(tmp_path / "mask.json", small)
    assert same_bits(load_mask(tmp_path / "mask.json"), small)


def test_a_wavelength_in_nanometres_is_told(tmp_path):
    path = tmp_path / "mask.json"
    save_json(path, SparseAperture([[-0.4, 0.0], [0.4, 0.0]], 0.1, 1.0), wavelength=550.0)
    with pytest.raises(ValueError, match="550 nm are 550e-9"):
        mask_wavelength(path)


def test_maps_too_coarse_for_the_holes_are_refused(golay6):
    with pytest.raises(
        ValueError, match="n_pixels is 10: it must be a whole number of at least 15 for a hole"
    ) as error:
        amplitude_map(golay6, 10)
    amplitude_map(golay6, int(str(error.value).split("at least ")[1].split()[0]))


def test_files_of_no_folder_are_refused(tmp_path):
    with pytest.raises(ValueError, match="no folder"):
        save_json(Path(tmp_path / "absent" / "mask.json"), masks()["discs"])


def test_json_holds_the_wavelength_and_does_without(tmp_path):
    mask = masks()["niriss"]
    for name, wavelength in (("with.json", 4.8e-6), ("without.json", None)):
        save_json(tmp_path / name, mask, wavelength)
        assert mask_wavelength(tmp_path / name) == wavelength
        assert same_bits(load_mask(tmp_path / name), mask)
    save_fits(tmp_path / "mask.fits", mask)
    assert mask_wavelength(tmp_path / "mask.fits") is None
    record = json.loads((tmp_path / "with.json").read_text())
    for wrong in ("4.8 um", -1.0, 0, True, [4.8e-6]):
        (tmp_path / "wrong.json").write_text(json.dumps(record | {"wavelength": wrong}))
        with pytest.raises(ValueError, match=r"wrong\.json: its wavelength is .*: it must be a (number|wavelength)"):
            mask_wavelength(tmp_path / "wrong.json")
    with pytest.raises(ValueError, match=r"wavelength is -1\.0: it must be finite and positive, in m"):
        save_json(tmp_path / "new.json", mask, -1.0)
    assert not (tmp_path / "new.json").exists()
