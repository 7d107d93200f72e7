"""Errors in the words of the command line: options in place of parameters, known by their value."""

import math
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import tyro

from torchmask.cli.wording import in_options


@dataclass(frozen=True)
class Imaging:
    n_photons: float = 1e7
    d_over_r0: float = 7.0


@dataclass(frozen=True, kw_only=True)
class Options:
    files: tyro.conf.Positional[tuple[Path, ...]] = ()
    fill_factor: float | None = None
    pixel_fill: float | None = None
    n_frequencies: int = 64
    n_pixels: int = 128
    min_gap: float = 0.0
    central_obstruction: float = 0.0
    keep_out: tuple[tuple[float, float, float], ...] = ()
    out: Path | None = None
    rim_margin: float = 0.0
    gain: float | None = None
    weights: tuple[float, ...] = ()
    sky: float | str = "if-seen"
    seed: int = 0
    refine: bool = True
    imaging: Imaging = field(default_factory=Imaging)


@pytest.mark.parametrize(
    ("message", "given", "said"),
    [
        (
            "fill_factor is 2.0: it must be a fraction",
            {"fill_factor": 2.0},
            "--fill-factor is 2.0: it must be a fraction",
        ),
        ("fill_factor is 2.0: no", {"fill_factor": 0.1, "pixel_fill": 2.0}, "--pixel-fill is 2.0: no"),
        (
            "fill_factor is 0 m and weights are [0.0, 9.0]: both are needed",
            {"weights": (0.0, 9.0)},
            "--fill-factor is 0 m and weights are [0.0, 9.0]: both are needed",
        ),
        ("telescope.gain is 0 m and no", {"weights": (0.0, 9.0)}, "--gain is 0 m and no"),
        ("weights is (): it must hold one", {}, "--weights is (): it must hold one"),
        ("n_pixels is -1: it must be 2", {"n_frequencies": -1}, "--n-frequencies is -1: it must be 2"),
        ("n_pixels is -1: it must be 2", {"n_pixels": -1}, "--n-pixels is -1: it must be 2"),
        ("gap is nan: no", {"min_gap": math.nan}, "--min-gap is nan: no"),
        ("gap is -1.0: no", {"min_gap": -1.0, "rim_margin": -1.0}, "--min-gap is -1.0: no"),
        ("width is -1.0: no", {"min_gap": -1.0, "rim_margin": -1.0}, "width is -1.0: no"),
        ("r0 is -0.1: it must be positive", {"imaging": Imaging(d_over_r0=-10.0)}, "r0 is -0.1: it must be positive"),
        ("imaging.d_over_r0 is 0.0: no", {"imaging": Imaging(d_over_r0=0.0)}, "--imaging.d-over-r0 is 0.0: no"),
        ("n_photons is 0.0: no", {"imaging": Imaging(n_photons=0.0)}, "--imaging.n-photons is 0.0: no"),
        ("weights are [1.0, -2.0]: no", {"weights": (1.0, -2.0)}, "--weights are [1.0, -2.0]: no"),
        ("gap is 0.0: no", {"min_gap": 0.0, "out": Path("runs/night-0")}, "gap is 0.0: no"),
        ("n_photons is 0.0: no", {"out": Path("night-0"), "imaging": Imaging(0.0)}, "--imaging.n-photons is 0.0: no"),
        ("weights are given without wavelengths: no", {}, "--weights are given without wavelengths: no"),
        ("a.fits: seed is 3: no", {"seed": 3}, "a.fits: --seed is 3: no"),
        (
            "a.fits has no GAIN: give gain [electrons per adu]",
            {},
            "a.fits has no GAIN: give --gain [electrons per adu]",
        ),
        ("holes overlap: lower fill_factor or n_holes", {}, "holes overlap: lower --fill-factor or n_holes"),
        (
            "the band is missing: give filter, or weights and min_gap [m], not wide",
            {},
            "the band is missing: give filter, or --weights and --min-gap [m], not wide",
        ),
        (
            "no mask that obeys MinimumGap(gap=0.1), RimMargin(margin=0.02): with a MinimumGap gap of at most 0.05 m",
            {},
            "no mask that obeys --min-gap 0.1, --rim-margin 0.02: with a --min-gap of at most 0.05 m",
        ),
        (
            "no room beside KeepOutSegment(start=(0.0, -1e-05), end=(0.5, 0.0), width=0.9), a KeepOutSegment width",
            {},
            "no room beside --spiders 0.0 -1e-05 0.5 0.0 0.9, a --spiders width",
        ),
        (
            "no room beside KeepOutDisc(diameter=0.2, center=(0.0, 0.0)), KeepOutDisc(diameter=0.1, center=(0.3, 0.0))",
            {"central_obstruction": 0.2, "keep_out": ((0.3, 0.0, 0.1),)},
            "no room beside --central-obstruction 0.2, --keep-out 0.3 0.0 0.1",
        ),
        (
            "no room beside KeepOutDisc(diameter=0.1, center=(0.0, 0.0)), a KeepOutDisc diameter of 0.05 m",
            {"keep_out": ((0.0, 0.0, 0.1),)},
            "no room beside --keep-out 0.0 0.0 0.1, a --keep-out diameter of 0.05 m",
        ),
        ("spiders is bad: for a round zone use KeepOutDisc", {}, "spiders is bad: for a round zone use --keep-out"),
        ("a.fits: refine is not positive at 1 pixel", {}, "a.fits: refine is not positive at 1 pixel"),
        ("there is no file /tmp/1/sky: give files", {"seed": 1}, "there is no file /tmp/1/sky: give files"),
        ("no fill_factor.npz in a/n_pixels/b", {}, "no fill_factor.npz in a/n_pixels/b"),
    ],
)
def test_an_error_names_the_option_that_was_given(message, given, said):
    assert in_options(message, Options(**given)) == said
