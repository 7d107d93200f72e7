"""OIFITS files read back: this library's own, and files that another program has written."""

import dataclasses
import datetime
import math

import numpy as np
import pytest
import torch

from torchmask.grid import Grid
from torchmask.interferometry.fringes import frame_observables
from torchmask.interferometry.oifits import save_oifits
from torchmask.interferometry.oifits_reader import load_oifits
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture

package = pytest.importorskip("oifits")
fits = pytest.importorskip("astropy.io.fits")

MASK = SparseAperture([[0.0, 0.42], [0.38, -0.2], [-0.4, -0.15], [0.1, -0.05]], 0.1, 1.0)
GRID = Grid.nyquist(MASK.extent, 550e-9, 48, 1.1)


@pytest.fixture
def observation(expose_points):
    frames = torch.poisson(expose_points(MASK, GRID, electrons=1e5, n_frames=8), torch.Generator().manual_seed(0))
    return Observation(frames, MASK, GRID, 0.0)


@pytest.fixture
def seen(observation):
    return frame_observables(observation)


@pytest.fixture
def path(tmp_path, seen, observation):
    """A file of what was seen."""
    save_oifits(tmp_path / "a.fits", seen, observation, bandwidth=1e-8)
    return tmp_path / "a.fits"


def test_what_was_written_is_read_back(path, seen):
    read, expected = load_oifits(path), seen.measurements(GRID.wavelength)
    for field in dataclasses.fields(expected):
        # EFF_WAVE has single precision in the standard
        tolerance = 1e-7 if "wavelength" in field.name else 1e-12
        values = getattr(read, field.name), getattr(expected, field.name)
        torch.testing.assert_close(*values, rtol=tolerance, atol=1e-12, msg=field.name)


def test_the_package_reads_the_same_correlations(path, seen):
    with fits.open(path) as hdus:
        assert hdus["OI_CORR"].header["NDATA"] == 6 + 4 + 4
        data = package.open(hdus, quiet=True)
    assert data.isvalid()
    assert data.isconsistent()
    corr = data.corr["MASK"]
    assert (corr.iindx < corr.jindx).all()
    matrix = np.eye(14)
    matrix[corr.iindx - 1, corr.jindx - 1] = matrix[corr.jindx - 1, corr.iindx - 1] = corr.corr
    for rows, name, covariance in (
        (data.vis2, "corrindx_vis2data", seen.vis2_covariance),
        (data.t3, "corrindx_t3phi", seen.closure_covariance),
        (data.t3, "corrindx_t3amp", seen.triple_covariance),
    ):
        places = np.array([int(getattr(row, name)) for row in rows]) - 1
        scale = covariance.diagonal().rsqrt()
        expected = covariance * scale[:, None] * scale
        np.testing.assert_allclose(matrix[np.ix_(places, places)], expected, atol=1e-12)
    assert abs(matrix - np.eye(14)).max() > 0.1


def interferometer(revision=1):
    """Two targets, three wavelengths, four telescopes, two times: in the order of the package's own classes."""
    data = package.oifits()
    wave = package.OI_WAVELENGTH(np.array([1.6e-6, 1.7e-6, 1.8e-6]), np.full(3, 5e-8), revision=revision)
    data.wavelength = {"PIONIER": wave}
    places = np.array([[0.0, 0.0], [40.0, 5.0], [10.0, 60.0], [-30.0, 20.0]])
    stations = [
        {"TEL_NAME": f"U{n}", "STA_NAME": f"U{n}", "STA_INDEX": n, "DIAMETER": 8.0, "STAXYZ": [x, y, 0.0]}
        for n, (x, y) in enumerate(places, 1)
    ]
    array = package.OI_ARRAY("GEOCENTRIC", (1.0, 1.0, 1.0), stations, revision=1)
    data.array = {"VLTI": array}
    targets = [package.OI_TARGET(name, 10.0, 20.0, revision=revision) for name in ("star", "binary")]
    data.target = np.array(targets)
    vis2, t3 = [], []
    for number, target in enumerate(targets):
        for hour in range(2):
            time = datetime.datetime(2024, 1, 1, hour)
            common = {"timeobs": time, "int_time": 60.0, "wavelength": wave, "target": target, "array": array}
            for i, j in ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)):
                u, v = places[j] - places[i]
                flag = np.array([False, hour == 1 and (i, j) == (0, 1), False])
                values = np.array([0.5, 0.6, 0.7]) + 0.1 * number
                vis2.append(
                    package.OI_VIS2(
                        vis2data=values,
                        vis2err=np.full(3, 0.01),
                        flag=flag,
                        ucoord=u,
                        vcoord=v,
                        station=[array.station[i], array.station[j]],
                        revision=revision,
                        **common,
                    )
                )
            for i, j, k in ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)):
                (u1, v1), (u2, v2) = places[j] - places[i], places[k] - places[j]
                error = np.array([1.0, 1.0, math.nan if hour == 0 and k == 2 else 2.0])
                t3.append(
                    package.OI_T3(
                        t3amp=np.ones(3),
                        t3amperr=np.ones(3),
                        t3phi=np.array([10.0, 20.0, 180.0 * number]),
                        t3phierr=error,
                        flag=np.zeros(3, bool),
                        u1coord=u1,
                        v1coord=v1,
                        u2coord=u2,
                        v2coord=v2,
                        station=[array.station[n] for n in (i, j, k)],
                        revision=revision,
                        **common,
                    )
                )
    data.vis2, data.t3 = np.array(vis2), np.array(t3)
    return data


@pytest.mark.parametrize("revision", [1, 2])
def test_a_file_of_a_spectrograph_on_telescopes(revision, tmp_path):
    path = tmp_path / "pionier.fits"
    interferometer(revision).save(str(path))
    with pytest.raises(ValueError, match=r"several targets: say which of star, binary is meant"):
        load_oifits(path)
    with pytest.raises(ValueError, match=r"no target 'moon': it has star, binary"):
        load_oifits(path, "moon")
    with pytest.warns(UserWarning, match="1 of 24 closure phases are left out"):
        seen = load_oifits(path, "binary")
    # two times of six baselines and four triangles at three wavelengths, one flagged, one without error
    assert seen.vis2.shape == (2 * 6 * 3 - 1,)
    assert seen.closure_phases.shape == (2 * 4 * 3 - 1,)
    torch.testing.assert_close(seen.vis2[:3], torch.tensor([0.6, 0.7, 0.8], dtype=torch.float64))
    assert seen.wavelengths[:3].tolist() == pytest.approx([1.6e-6, 1.7e-6, 1.8e-6], rel=1e-7)
    torch.testing.assert_close(seen.baselines[3], torch.tensor([10.0, 60.0], dtype=torch.float64))
    assert seen.triangles[0].flatten().tolist() == [40.0, 5.0, -30.0, 55.0]
    assert seen.closure_phases[:3].tolist() == pytest.approx([math.radians(10), math.radians(20), math.radians(10)])
    assert seen.vis2_correlation is None
    # triangles 0-1-2, 0-1-3, 0-2-3, 1-2-3 of the first time and wavelength; no other shares a baseline with them
    correlation = seen.closure_correlation
    ours = [0, 2, 5, 8]
    torch.testing.assert_close(correlation[ours][:, ours], ONE_EXPOSURE)
    others = [n for n in range(len(correlation)) if n not in ours]
    assert not correlation[ours][:, others].any()
    assert int((torch.linalg.eigvalsh(ONE_EXPOSURE) > 1e-9).sum()) == 3


def test_values_without_a_positive_error_are_left_out(tmp_path, path, seen):
    with fits.open(path) as hdus:
        hdus["OI_VIS2"].data["VIS2ERR"][:2] = [[0.0], [-0.01]]
        hdus["OI_T3"].data["T3PHIERR"][1] = 0.0
        hdus.writeto(tmp_path / "b.fits")
        hdus["OI_VIS2"].data["FLAG"][0] = True
        hdus.writeto(tmp_path / "c.fits")
    with pytest.warns(
        UserWarning, match=r"b\.fits: 2 of 6 \|V\|\^2 and 1 of 4 closure phases are left out, as they"
    ) as told:
        read = load_oifits(tmp_path / "b.fits")
    assert told[0].filename == __file__
    with pytest.warns(UserWarning, match=r"c\.fits: 1 of 5 \|V\|\^2 and 1 of 4"):
        load_oifits(tmp_path / "c.fits")
    torch.testing.assert_close(read.vis2, seen.vis2[2:], rtol=1e-12, atol=0)
    torch.testing.assert_close(read.closure_phases, seen.closure_phases[[0, 2, 3]], rtol=1e-12, atol=1e-15)


def test_a_target_of_several_numbers_is_read_whole(tmp_path, path, seen):
    """As of a star that was added again in each night; another target stays out."""
    with fits.open(path) as hdus:
        hdus["OI_VIS2"].data["TARGET_ID"] = [1, 1, 1, 2, 2, 3]
        hdus["OI_T3"].data["TARGET_ID"] = [1, 2, 2, 3]
        targets = hdus["OI_TARGET"]
        three = fits.BinTableHDU(np.repeat(targets.data, 3), targets.header)
        three.data["TARGET_ID"], three.data["TARGET"] = [1, 2, 3], ["star", "star", "moon"]
        others = [hdu.copy() for hdu in hdus if hdu.name != "OI_TARGET"]
        fits.HDUList([*others, three]).writeto(tmp_path / "b.fits")
    read = load_oifits(tmp_path / "b.fits", "star")
    torch.testing.assert_close(read.vis2, seen.vis2[:5], rtol=1e-12, atol=0)
    assert len(read.closure_phases) == 3
    assert len(load_oifits(tmp_path / "b.fits", "moon").vis2) == 1


ONE_EXPOSURE = torch.tensor([[3, 1, -1, 1], [1, 3, 1, -1], [-1, 1, 3, 1], [1, -1, 1, 3]], dtype=torch.float64) / 3


def test_exposures_of_one_day_are_told_apart_by_their_time(tmp_path, path):
    """As in files of version 1 of the standard with the MJD of midnight."""
    with fits.open(path) as hdus:
        both = fits.BinTableHDU(hdus["OI_T3"].data[np.tile(np.arange(4), 2)], hdus["OI_T3"].header)
        both.data["TIME"][4:] = 1800.0
        kept = [hdu.copy() for hdu in hdus if hdu.name not in ("OI_CORR", "OI_T3")]
        fits.HDUList([*kept, both]).writeto(tmp_path / "b.fits")
    correlation = load_oifits(tmp_path / "b.fits").closure_correlation
    torch.testing.assert_close(correlation, torch.block_diag(ONE_EXPOSURE, ONE_EXPOSURE))


@pytest.mark.parametrize("unset", [0, -1])
def test_triangles_without_stations_share_baselines_of_equal_coordinates(unset, tmp_path, path):
    with fits.open(path) as hdus:
        hdus["OI_T3"].data["STA_INDEX"] = unset
        fits.HDUList([hdu.copy() for hdu in hdus if hdu.name != "OI_CORR"]).writeto(tmp_path / "b.fits")
    torch.testing.assert_close(load_oifits(tmp_path / "b.fits").closure_correlation, ONE_EXPOSURE)


def test_closure_phases_of_two_tables_are_independent_even_at_one_time(tmp_path, path):
    """As of two instruments in one night: only triangles of one table share the noise of a baseline."""
    with fits.open(path) as hdus:
        kept = [hdu.copy() for hdu in hdus if hdu.name != "OI_CORR"]
        fits.HDUList([*kept, hdus["OI_T3"].copy()]).writeto(tmp_path / "b.fits")
    correlation = load_oifits(tmp_path / "b.fits").closure_correlation
    torch.testing.assert_close(correlation, torch.block_diag(ONE_EXPOSURE, ONE_EXPOSURE))


def test_what_is_no_oifits_is_refused(tmp_path, path):
    with pytest.raises(ValueError, match=r"there is no file .*none\.fits"):
        load_oifits(tmp_path / "none.fits")
    (tmp_path / "text.fits").write_text("no FITS at all")
    with pytest.raises(ValueError, match=r"text\.fits is not an OIFITS file, or is damaged"):
        load_oifits(tmp_path / "text.fits")
    fits.PrimaryHDU(np.zeros((4, 4))).writeto(tmp_path / "image.fits")
    with pytest.raises(
        ValueError, match=r"image\.fits has no squared visibility and no closure phase .*: give an OIFITS"
    ):
        load_oifits(tmp_path / "image.fits")
    with fits.open(path) as hdus:
        kept = [hdu.copy() for hdu in hdus if hdu.name != "OI_WAVELENGTH"]
        fits.HDUList(kept).writeto(tmp_path / "b.fits")
        hdus["OI_VIS2"].data["FLAG"] = True
        hdus["OI_T3"].data["FLAG"] = True
        hdus.writeto(tmp_path / "c.fits")
    with pytest.raises(ValueError, match=r"OI_VIS2 is of instrument UNKNOWN, which has no OI_WAVELENGTH"):
        load_oifits(tmp_path / "b.fits")
    with pytest.raises(ValueError, match=r"has no squared visibility and no closure phase"):
        load_oifits(tmp_path / "c.fits")


def test_an_empty_table_and_places_that_are_not_finite_are_left_out(tmp_path, path, seen):
    """Two holes have no triangle, and some programs write a table of none."""
    with fits.open(path) as hdus:
        hdus["OI_VIS2"].data["VCOORD"][2] = np.nan
        empty = fits.BinTableHDU(hdus["OI_T3"].data[:0], hdus["OI_T3"].header)
        kept = [hdu.copy() for hdu in hdus if hdu.name not in ("OI_T3", "OI_CORR")]
        fits.HDUList([*kept, empty]).writeto(tmp_path / "b.fits")
    with pytest.warns(UserWarning, match=r"1 of 6 \|V\|\^2 are left out"):
        read = load_oifits(tmp_path / "b.fits")
    torch.testing.assert_close(read.vis2, seen.vis2[[0, 1, 3, 4, 5]], rtol=1e-12, atol=0)
    assert len(read.closure_phases) == 0


@pytest.mark.parametrize(
    ("table", "column", "factor", "message"),
    [
        ("OI_WAVELENGTH", "EFF_WAVE", 1e6, r"b\.fits: EFF_WAVE is 0\.55: .* in m, .* micrometres are 0\.55e-6"),
        ("OI_T3", "U2COORD", 1 / 550e-9, r"b\.fits: U2COORD reaches .*: it must be in m, not divided by"),
    ],
)
def test_other_units_are_refused(table, column, factor, message, tmp_path, path):
    with fits.open(path) as hdus:
        hdus[table].data[column] *= factor
        hdus.writeto(tmp_path / "b.fits")
    with pytest.raises(ValueError, match=message):
        load_oifits(tmp_path / "b.fits")


@pytest.mark.parametrize("column", ["T3PHI", "T3PHIERR"])
def test_phases_in_radians_are_refused(column, tmp_path, path):
    with fits.open(path) as hdus:
        hdus["OI_T3"].columns[column].unit = "rad"
        hdus.writeto(tmp_path / "b.fits")
    with pytest.raises(ValueError, match=rf"b\.fits: {column} is in rad by its TUNIT: OIFITS phases must be in deg"):
        load_oifits(tmp_path / "b.fits")


def test_files_with_a_part_missing_are_refused(tmp_path, path):
    with fits.open(path) as hdus:
        of_t3, waves = hdus.fileinfo("OI_T3")["hdrLoc"], hdus["OI_WAVELENGTH"]
        twice = fits.BinTableHDU(np.concatenate([waves.data, waves.data]), waves.header)
        others = [hdu.copy() for hdu in hdus if hdu.name != "OI_WAVELENGTH"]
        fits.HDUList([*others, twice]).writeto(tmp_path / "b.fits")
    (tmp_path / "c.fits").write_bytes((path).read_bytes()[: of_t3 - 100])
    with pytest.raises(ValueError, match=r"b\.fits: OI_VIS2 has 6 values of VIS2DATA in 6 rows, and .* 2 wavelengths"):
        load_oifits(tmp_path / "b.fits")
    with pytest.raises(ValueError, match=r"c\.fits is not an OIFITS file, or is damaged: File may have been truncated"):
        load_oifits(tmp_path / "c.fits")
