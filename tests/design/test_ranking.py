"""Rankings: rows are the criterion's, with the light of each mask; what cannot be ranked is named with the reason."""

import csv
import io

import pytest
import torch

from torchmask.design.constraints import KeepOutDisc
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.pattern import Pattern
from torchmask.design.ranking import COLUMNS, Layout, rank_masks
from torchmask.design.rules import MaskRules
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.spectra import NoisePSD, PowerLawPSD
from torchmask.viz.ranking import ranking_figure

GRID = Grid.nyquist(1.0, 550e-9, 48)
NAMES = ("golay6", "jwst_niriss_ami_7", "keck_lws_pattern2a_9", "vlt_naco_18", "keck_lws_pattern6a_6")
OWN = SparseAperture.from_catalog("golay6", 1.0, 0.12)
OWN = OWN.replace(OWN.centers.flip(-1))  # the golay6 itself, mirrored: as good by any criterion


def criterion(area):
    return AsymptoticMSE(GRID, PowerLawPSD(1.5, 1e8 * area), NoisePSD(1e8 * area), 20)


def rank(**changes):
    patterns = [Pattern.from_catalog(name) for name in NAMES]
    return rank_masks(patterns, criterion, 1.0, 0.12, **changes)


@pytest.fixture(scope="module")
def ranking():
    return rank(searched={"torchmask_6": OWN})


def test_rows_are_the_criterion_with_the_light_of_the_mask(ranking):
    for row in ranking.rows:
        pattern = Pattern.from_catalog(row.mask) if row.layout is not Layout.SEARCHED else Pattern.of("own", OWN)
        mask = pattern.scaled(1.0) if row.layout is not Layout.AFRESH else pattern.afresh(1.0, 0.12)
        assert row.relative_mse == pytest.approx(float(criterion(float(mask.area)).relative(mask)), rel=1e-9)
        assert row.area == pytest.approx(float(mask.area), rel=1e-12)
    areas = {row.area for row in ranking.of(Layout.AFRESH, Layout.SEARCHED)}
    assert max(areas) == pytest.approx(min(areas), rel=1e-12)


def test_both_groups_are_in_order(ranking):
    for layouts in ((Layout.AFRESH, Layout.SEARCHED), (Layout.AS_BUILT,)):
        errors = [row.relative_mse for row in ranking.of(*layouts)]
        assert errors == sorted(errors)
        assert [row.rank for row in ranking.of(*layouts)] == list(range(1, len(errors) + 1))


def test_masks_are_compared_with_the_searched_one_of_as_many_holes(ranking):
    excess = {(row.mask, row.layout): row.excess_percent for row in ranking.rows}
    assert excess["golay6", Layout.AFRESH] == pytest.approx(0.0, abs=1e-9)
    assert excess["keck_lws_pattern6a_6", Layout.AFRESH] > 1
    assert excess["jwst_niriss_ami_7", Layout.AFRESH] is None
    assert excess["keck_lws_pattern6a_6", Layout.AS_BUILT] is None  # it has another area


@pytest.mark.parametrize("names", [("good", "worse"), ("worse", "good")])
def test_excess_is_over_the_best_searched_mask_and_errors_are_told_over_the_floor(names):
    searched = {"good": OWN, "worse": OWN.replace(0.7 * OWN.centers)}
    found = rank(searched={name: searched[name] for name in names})
    errors = {name: float(criterion(float(mask.area)).relative(mask)) for name, mask in searched.items()}
    assert errors["worse"] > 1.05 * errors["good"]
    psd = PowerLawPSD(1.5, 1e8)(GRID)
    beyond = torch.hypot(*GRID.frequencies(torch.float64)) >= 1 / GRID.period  # frequencies that a mask of 1 m lacks
    floor = float(psd[beyond].sum() / psd.sum())
    assert floor > 0.01
    for row in found.rows:
        assert row.above_floor == pytest.approx(row.relative_mse - floor, rel=1e-9)
        if row.n_subapertures == 6 and row.layout is not Layout.AS_BUILT:
            more = 100 * (row.relative_mse - errors["good"]) / errors["good"]
            assert row.excess_percent == pytest.approx(more, rel=1e-9, abs=1e-9)


def test_what_overlaps_is_named_with_the_reason(ranking):
    assert set(ranking.left_out) == {
        "golay6, as built",
        "keck_lws_pattern2a_9, as built",
        "vlt_naco_18, laid afresh",
    }
    assert ranking.left_out["golay6, as built"] == "it has no size of its own"
    assert "1 and 6 by 0.00412 m" in ranking.left_out["keck_lws_pattern2a_9, as built"]
    assert "give allow_overlap to accept it" in ranking.left_out["keck_lws_pattern2a_9, as built"]
    assert "at most 0.09167" in ranking.left_out["vlt_naco_18, laid afresh"]
    allowed = rank(allow_overlap=True)
    assert set(allowed.left_out) == {"golay6, as built", "vlt_naco_18, laid afresh"}


def test_masks_that_break_a_rule_of_the_telescope_are_left_out():
    found = rank(rules=MaskRules(central_obstruction=0.55))
    assert found.rows
    for name in NAMES:
        pattern, kept = Pattern.from_catalog(name), {row.layout for row in found.rows if row.mask == name}
        masks = {Layout.AS_BUILT: pattern.scaled(1.0)}
        if pattern.largest_fill_factor() > 0.12:
            masks[Layout.AFRESH] = pattern.afresh(1.0, 0.12)
        for layout, mask in masks.items():
            if mask is None or f"{name}, {layout.value}" == "keck_lws_pattern2a_9, as built":
                continue
            clear = float(KeepOutDisc(0.55).margins(mask).min()) > -1e-6
            assert (layout in kept) == clear
            assert clear or "KeepOutDisc" in found.left_out[f"{name}, {layout.value}"]
    assert any("KeepOutDisc" in reason for reason in found.left_out.values())
    with pytest.raises(ValueError, match=r"no mask is left to rank: golay6, .*; golay6, laid afresh: KeepOutDisc"):
        rank(rules=MaskRules(central_obstruction=0.95))


def test_tables_and_picture_say_which_is_which(ranking):
    text = str(ranking)
    assert text.index("The same collecting area") < text.index("As built") < text.index("Not ranked")
    assert sum(line.startswith("| ") for line in text.splitlines()) == len(ranking.rows) + 2
    rows = list(csv.DictReader(io.StringIO(ranking.csv())))
    assert [float(row["relative_mse"]) for row in rows] == [row.relative_mse for row in ranking.rows]
    assert {row["layout"] for row in rows} == {"laid afresh", "searched", "as built"}
    assert set(COLUMNS) < set(rows[0])
    figure = ranking_figure(ranking, "1e8 photons a frame")
    assert figure.legends[0].get_title().get_text() == "1e8 photons a frame"
    said = [text.get_text() for text in figure.legends[0].get_texts()]
    assert [any(word in line for line in said) for word in ("laid afresh", "searched", "as built")] == [True] * 3


def test_names_that_are_twice_are_refused():
    with pytest.raises(ValueError, match="two have one name"):
        rank_masks([Pattern.of("a", OWN), Pattern.of("a", OWN)], criterion, 1.0, 0.1)
