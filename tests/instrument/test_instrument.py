"""From what a team knows to photons, frames, sky and noise; files; and what is refused, in the unit of the field."""

import dataclasses
import json
import math
import warnings

import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st

from torchmask.design.rules import MaskRules
from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import ARCSEC, Grid
from torchmask.instrument.instrument import Instrument
from torchmask.instrument.parts import Camera, Site, Source, Telescope
from torchmask.io import to_json
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import Band
from torchmask.optics.passband import VEGA_IN_AB, Passband
from torchmask.optics.shapes import TelescopePupil
from torchmask.spectra import NoisePSD, PowerLawPSD

BAND = {"wavelength": 550e-9, "width": 50e-9}


def make(**changes):
    known = {
        "telescope": Telescope(diameter=2.0, central_obstruction=0.3, throughput=0.4),
        "source": Source(magnitude=5.0),
        "site": Site(r0=0.15, wind=10.0, sky=20.5),
        "camera": Camera(n_pixels=96, readout_noise=3.0, readout_time=2e-3),
        "exposure": 8e-3,
        "observing_time": 0.5,
        **BAND,
    }
    return Instrument(**(known | changes))


@given(st.floats(-5, 20), st.floats(1e-3, 1e2), st.floats(1e-4, 10), st.floats(1e-9, 2e-7), st.floats(0.01, 1))
def test_photons_are_those_of_the_magnitude(magnitude, area, exposure, width, throughput):
    """3631 Jy of AB magnitude 0, over h, times the integral of 1 / wavelength over an even band."""
    known = make(
        telescope=Telescope(diameter=2.0, throughput=throughput),
        source=Source(magnitude=magnitude),
        exposure=exposure,
        observing_time=None,
        n_frames=3,
        width=width,
    )
    rate = 3631e-26 / 6.62607015e-34 * math.log((550e-9 + width / 2) / (550e-9 - width / 2)) * 10 ** (-0.4 * magnitude)
    # the logarithm of a narrow band rounds by eps over width / wavelength
    assert known.photons(area) == pytest.approx(rate * area * exposure * throughput, rel=1e-12 + 1e-15 * 550e-9 / width)


def test_a_rate_of_photons_needs_no_magnitude():
    known = make(source=Source(photon_rate=1e6))
    assert known.photons(0.5) == pytest.approx(1e6 * 0.4 * 0.5 * 8e-3)
    assert known.with_width(25e-9).photons(0.5) == pytest.approx(known.photons(0.5) / 2)


def test_magnitudes_of_vega_are_moved_to_ab():
    for name, offset in VEGA_IN_AB.items():
        of_vega, of_ab = (
            make(source=Source(magnitude=m, system=system), filter=name, wavelength=None, width=None)
            for m, system in ((3.0, "Vega"), (3.0 + offset, "AB"))
        )
        assert of_vega.photons(1.0) == pytest.approx(of_ab.photons(1.0), rel=1e-12)
        assert of_vega.sky(1.0) == pytest.approx(
            dataclasses.replace(of_ab, site=Site(r0=0.15, wind=10.0, sky=20.5 + offset)).sky(1.0), rel=1e-12
        )


def test_the_sky_fills_a_pixel_as_its_square():
    known = make()
    coarse = dataclasses.replace(known, camera=Camera(pixel_scale=2 * known.pixel_scale / ARCSEC))
    assert coarse.sky(1.0) == pytest.approx(4 * known.sky(1.0))
    per_square_arcsec = make(source=Source(magnitude=20.5)).photons(1.0)
    assert known.sky(1.0) == pytest.approx(per_square_arcsec * (known.pixel_scale / ARCSEC) ** 2)
    assert make(site=Site(r0=0.15, wind=10.0)).sky(1.0) == 0.0


def test_frames_follow_each_other_with_their_readout():
    assert make().frames == 50  # 0.5 s / (8 + 2) ms, which rounding must not make 49
    assert make(observing_time=None, n_frames=7).frames == 7


def test_noise_counts_the_pixels_of_the_camera_whatever_the_frequencies():
    known = make()
    level = known.photons(0.2) + 96**2 * 3.0**2
    for n in (32, 64):
        psd = known.noise_psd(0.2)(known.grid(n))
        torch.testing.assert_close(psd, torch.full((n, n), level, dtype=torch.float64))


def test_the_target_is_flat_below_the_inverse_of_its_size():
    known = make(source=Source(magnitude=5.0, size=2.0, exponent=2.5))
    psd = known.object_psd(0.2)
    assert (psd.n_photons, psd.exponent) == (known.photons(0.2), 2.5)
    assert psd.knee == pytest.approx(known.pixel_scale / (2.0 * ARCSEC))
    assert make().object_psd(0.2).knee == 1 / 64


@pytest.mark.parametrize(
    ("size", "said"), [(30.0, "30 arcsec, which is more than the field, 2.68 "), (3e-6, "less than a pixel, 0.0279 ")]
)
def test_a_target_that_the_frames_cannot_show_is_warned_of(size, said):
    with pytest.warns(UserWarning, match=f"source.size is .*{said}"):
        known = make(source=Source(magnitude=5.0, size=size), wavelength=550e-9, width=20e-9)
    assert known.knee == min(0.5, known.pixel_scale / (size * ARCSEC))


def test_pixels_are_fine_enough_for_the_shortest_wavelength():
    known = make(filter="bessell-V", wavelength=None, width=None)
    assert known.pixel_scale == pytest.approx(Band.from_filter("bessell-V").shortest / (2 * 2.0))
    assert known.mean_wavelength == Passband.find("bessell-V").mean_wavelength
    assert known.grid().shape == (96, 96)
    assert known.grid(32).pixel_scale == known.pixel_scale


def test_the_band_holds_the_light_of_the_source():
    sunlight = make(source=Source(magnitude=5.0, temperature=5772.0), width=100e-9)
    assert sunlight.band == Band.from_filter(Passband.top_hat(550e-9, 100e-9), 5, 5772.0)


def test_the_seeing_knows_exposure_and_wind():
    seeing = make().seeing
    assert (seeing.r0, seeing.outer_scale, seeing.exposure, seeing.wind) == (0.15, 20.0, 8e-3, 10.0)
    assert make().with_exposure(4e-3).seeing.exposure == 4e-3


def test_files_give_it_back_to_the_last_bit(tmp_path):
    known = make(exposure=0.1 / 3)
    known.save(tmp_path / "instrument.json")
    assert Instrument.load(tmp_path / "instrument.json") == known
    assert json.loads((tmp_path / "instrument.json").read_text())["format"].startswith("torchmask instrument")
    (tmp_path / "instrument.yaml").write_text(yaml.safe_dump(to_json(known)))
    assert Instrument.load(tmp_path / "instrument.yaml") == known
    with pytest.raises(ValueError, match="exists"):
        known.save(tmp_path / "instrument.json")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("exposure: 1", r"instrument.telescope is missing"),
        ("exposre: 1", r"unknown key instrument.exposre; known keys are instrument.telescope"),
        ("- 1", r"instrument is \[1\]"),
        ("format: torchmask mask, version 1", "it is 'torchmask mask, version 1'"),
        ("a: [", "not valid YAML"),
    ],
)
def test_files_that_hold_none_say_why(text, said, tmp_path):
    path = tmp_path / "instrument.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=said):
        Instrument.load(path)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"wavelength": None}, "wavelength is missing"),
        ({"wavelength": 550.0}, r"wavelength is 550.*in m"),
        ({"filter": "bessell-V"}, "missing or given twice"),
        ({"width": None}, "missing or given twice"),
        ({"width": None, "filter": "twomass-Ks"}, r"passes 1\.9\d+e-06 to .* leave the wavelength out"),
        ({"wavelength": 5e-3}, r"wavelength is 0.005: .* from 1e-07 to 5e-05"),
        ({"exposure": 0.0}, r"exposure is 0.0: .* to 100000 s .* nearest possible is 1e-06 s"),
        (
            {"exposure": 1.0},
            r"observing_time is 0.5 s, but one frame takes 1.002 s: .* or expose for at most 0.498 s",
        ),
        ({"camera": Camera(readout_time=1.0)}, r"takes 1.008 s: .* or expose for any time with a faster read-out"),
        ({"n_frames": 3}, "not both"),
        ({"n_frames": 3, "width": None}, "missing or given twice: .*; give observing_time .* not both"),
        ({"observing_time": None}, "not both"),
        ({"observing_time": None, "n_frames": 0}, "n_frames is 0"),
        ({"observing_time": None, "n_frames": math.inf}, "n_frames is inf: it must be a whole number"),
        ({"n_wavelengths": 0}, "n_wavelengths is 0: it must be a whole number from 1 to 32"),
        ({"n_wavelengths": 2.5}, r"n_wavelengths is 2\.5: it must be a whole number from 1 to 32"),
        ({"n_wavelengths": 33}, "n_wavelengths is 33: it must be a whole number from 1 to 32"),
        ({"source": Source(magnitude=3.0, system="Vega")}, "known for the filters bessell-U"),
    ],
)
def test_observations_that_cannot_be_are_refused(changes, said):
    with pytest.raises(ValueError, match=said):
        make(**changes)


@pytest.mark.parametrize(("percent", "given", "enough"), [(20, 1, 2), (6, 1, 2), (30, 2, 3), (80, 5, 6)])
def test_too_few_wavelengths_for_the_band_are_warned_of_with_the_number_that_does(percent, given, enough):
    band = {"width": 550e-9 * percent / 100}
    with pytest.warns(
        UserWarning, match=rf"is {given} for a band {percent} % wide: .*; {enough} wavelengths do"
    ) as said:
        make(n_wavelengths=given, **band)
    assert len(said) == 1
    make(n_wavelengths=enough, **band)  # a warning would be an error here


def test_few_wavelengths_are_warned_of_once_whatever_is_made_of_the_instrument():
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("default")
        known = make(n_wavelengths=1, width=100e-9)
        known.with_exposure(4e-3)
        make(n_wavelengths=1, width=100e-9, exposure=2e-3)
    assert len(said) == 1


@pytest.mark.parametrize("width", [0.05, 0.2, 0.35])
def test_the_number_of_wavelengths_that_does_tells_errors_to_four_percent(width):
    """Of masks of wide and narrow holes, against nine wavelengths."""
    grid = Grid(32, 400e-9 / 2, 550e-9)
    masks = [SparseAperture.from_catalog(*case) for case in (("golay9", 1.0, 0.15), ("golay6", 1.0, 0.05))]

    def errors(n_wavelengths):
        band = Band.top_hat(550e-9, width * 550e-9, n_wavelengths)
        light = {"wavelengths": band.wavelengths, "weights": band.shares}
        criterion = TurbulentMSE(grid, PowerLawPSD(1.5, 1e6), NoisePSD(1e6), 20, r0=1 / 7, **light)
        return torch.stack([criterion.relative(mask) for mask in masks])

    enough = 1 + math.ceil((width - 0.05) / 0.15 - 1e-9)
    torch.testing.assert_close(errors(enough), errors(9), rtol=0.04, atol=0)


@pytest.mark.parametrize(
    ("part", "numbers", "said"),
    [
        (Telescope, {"diameter": 0.0}, r"telescope.diameter is 0.0: .*in m"),
        (Telescope, {"diameter": 8200.0}, r"telescope.diameter is 8200.0: .* to 1000 m .* 8.2 m are 8.2"),
        (Telescope, {"diameter": 1.0, "central_obstruction": 1.0}, "less than the diameter, 1 m"),
        (Telescope, {"diameter": 1.0, "throughput": 1.5}, "at most 1"),
        (Telescope, {"diameter": 1.0, "vane_width": 0.1}, r"vane_angles are \[\] degrees"),
        (
            Telescope,
            {"diameter": 1.0, "vane_width": -0.1, "vane_angles": (0.0,)},
            r"telescope.vane_width is -0.1: .*in m",
        ),
        (Telescope, {"diameter": 1.0, "vane_width": 0.1, "vane_angles": (math.nan,)}, "hold nan: .* in degrees"),
        (Telescope, {"diameter": 1.0, "vane_width": 0.1, "vane_angles": (0.0, 5.0)}, "vanes 5 degrees apart"),
        (Source, {}, "and not both"),
        (Source, {"magnitude": 1.0, "photon_rate": 1.0}, "and not both"),
        (Source, {"magnitude": math.nan}, r"magnitude is nan: .* from -27 to 40 .*sees.$"),
        (Source, {"magnitude": -3e5}, r"magnitude is -300000.0: .* the nearest possible is -27$"),
        (Source, {"magnitude": 3e5}, r"magnitude is 300000.0: .* the nearest possible is 40$"),
        (Source, {"photon_rate": 1e300}, r"source.photon_rate is 1e\+300: .* at most 1e\+22"),
        (Source, {"magnitude": 1.0, "system": "vega"}, "source.system is 'vega': known systems are AB and Vega"),
        (Source, {"photon_rate": -1.0}, r"photons / \(s m\^2\)"),
        (Source, {"magnitude": 1.0, "temperature": 0.0}, "in K"),
        (Source, {"magnitude": 1.0, "size": 0.0}, "in arcsec"),
        (Site, {"r0": 0.0, "wind": 1.0}, r"site.r0 is 0.0: .* from 0.001 to 20 m .* nearest possible is 0.001 m"),
        (Site, {"r0": 120.0, "wind": 1.0}, "site.r0 is 120.0: .* nearest possible is 20 m"),
        (Site, {"r0": 0.1, "wind": 0.0}, r"site.wind is 0.0: .* nearest possible is 0.01 m/s"),
        (Site, {"r0": 0.1, "wind": 1e30}, r"site.wind is 1e\+30: .* nearest possible is 200 m/s"),
        (Site, {"r0": 0.1, "wind": 1.0, "outer_scale": 1e-9}, "site.outer_scale is 1e-09: .* possible is 0.1 m"),
        (Site, {"r0": 0.1, "wind": 1.0, "sky": math.inf}, "nearest possible is 30 magnitudes per square arcsec"),
        (Site, {"r0": 0.1, "wind": 1.0, "sky": -50.0}, "site.sky is -50.0: .* nearest possible is -5 magnitudes"),
        (Camera, {"n_pixels": 1}, "at least 2"),
        (Camera, {"n_pixels": math.inf}, "camera.n_pixels is inf: it must be a whole number"),
        (Camera, {"readout_noise": -1.0}, "in electrons rms"),
        (Camera, {"pixel_scale": 0.0}, "in arcsec"),
        (Camera, {"pixel_fill": 2.0}, "camera.pixel_fill is 2.0: .* at most 1"),
        (Camera, {"pixel_fill": -0.5}, "camera.pixel_fill is -0.5"),
    ],
)
def test_parts_that_cannot_be_are_refused(part, numbers, said):
    with pytest.raises(ValueError, match=said):
        part(**numbers)


def test_vanes_go_from_a_file_to_the_pupil_and_to_the_rules_of_masks(tmp_path):
    telescope = Telescope(diameter=2.0, central_obstruction=0.3, vane_width=0.02, vane_angles=(0.0, 120.0, 240.0))
    make(telescope=telescope).save(tmp_path / "a.json")
    back = Instrument.load(tmp_path / "a.json").telescope
    assert back == telescope
    assert back.pupil().shape == TelescopePupil(0.15, 0.01, tuple(math.radians(angle) for angle in (0, 120, 240)))
    zones = MaskRules(spiders=back.spiders).constraints()
    on, beside = SparseAperture([[-0.3, 0.3 * math.sqrt(3)]], 0.1, 2.0), SparseAperture([[-0.5, 0.3]], 0.1, 2.0)
    assert [float(zone.margins(on)) < 0 for zone in zones] == [False, True, False]
    assert all(float(zone.margins(beside)) > 0 for zone in zones)


def test_whole_numbers_may_be_given_as_floats_and_are_kept_as_ints():
    counts = {"observing_time": None, "n_frames": 20.0, "n_wavelengths": 3.0, "camera": Camera(n_pixels=64.0)}
    instrument = make(**counts)
    kept = instrument.frames, instrument.n_wavelengths, instrument.camera.n_pixels
    assert kept == (20, 3, 64)
    assert {type(number) for number in kept} == {int}
    assert (instrument.grid().shape, len(instrument.band.wavelengths)) == ((64, 64), 3)


def test_the_table_says_what_follows():
    table = make().describe(0.2)
    assert f"| photons per frame | {make().photons(0.2):.4g} electrons |" in table
    assert "| frames | 50 |" in table
    assert "| D / r0 | 13.33 |" in table
