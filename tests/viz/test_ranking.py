"""Where the marks of a ranking lie: masks from the best down, errors to the right and over numbers of holes."""

import numpy as np
import pytest

from torchmask.design.ranking import Layout, RankedMask, Ranking
from torchmask.viz.ranking import ranking_figure

pytest.importorskip("matplotlib")

FLOOR = 0.07
# name, layout, number of holes, error: the best of a mask may be of either layout
MASKS = (
    ("a", Layout.AFRESH, 9, 0.5),
    ("a", Layout.AS_BUILT, 9, 0.2),
    ("b", Layout.AFRESH, 6, 0.3),
    ("c", Layout.AFRESH, 7, 0.6),
    ("c", Layout.AS_BUILT, 7, 0.9),
    ("ours_6", Layout.SEARCHED, 9, 0.25),
    ("ours_9", Layout.SEARCHED, 6, 0.4),
)
PLACES = {"a": 1, "ours_6": 2, "b": 3, "ours_9": 4, "c": 5}


@pytest.fixture(scope="module")
def figure():
    rows = tuple(
        RankedMask(rank, name, layout, n, 0.1, 0.05, error, error - FLOOR, None, n, True, 0.5, 0.6, 0.3)
        for rank, (name, layout, n, error) in enumerate(MASKS, 1)
    )
    return ranking_figure(Ranking(rows, {}, FLOOR), "")


def test_masks_are_listed_by_the_least_of_their_errors(figure):
    listing = figure.axes[0]
    names = dict(zip(listing.get_yticks(), (label.get_text() for label in listing.get_yticklabels()), strict=True))
    assert names == {place: name for name, place in PLACES.items()}
    assert listing.get_ylim()[0] > listing.get_ylim()[1]  # the best above
    drawn = [tuple(point) for marks in listing.collections if len(marks.get_offsets()) for point in marks.get_offsets()]
    assert {(error, PLACES[name]) for name, _, _, error in MASKS} <= set(drawn)


def test_a_line_leads_to_the_largest_error_of_each_mask(figure):
    ends = {}
    for marks in figure.axes[0].collections:
        if hasattr(marks, "get_segments"):
            for start, end in marks.get_segments():
                ends[int(start[1])] = (start[0], end[0])
    largest = {place: max(error for name, _, _, error in MASKS if PLACES[name] == place) for place in PLACES.values()}
    assert ends == {place: (0, error) for place, error in largest.items()}


def test_errors_stand_over_the_numbers_of_holes_with_a_line_along_searched_masks(figure):
    against = figure.axes[1]
    curves = [line for line in against.lines if line.get_marker() not in ("None", None, "")]
    points = sorted(tuple(point) for line in curves for point in line.get_xydata())
    assert points == sorted((n, error) for _, _, n, error in MASKS)
    (joined,) = (line for line in curves if line.get_linestyle() == "-")
    np.testing.assert_array_equal(joined.get_xydata(), [(6, 0.4), (9, 0.25)])  # from few holes to many


def test_what_no_mask_can_change_is_dashed_in_both(figure):
    (upright,) = (line for line in figure.axes[0].lines if line.get_linestyle() == "--")
    (level,) = (line for line in figure.axes[1].lines if line.get_linestyle() == "--")
    assert list(upright.get_xdata()) == list(level.get_ydata()) == [FLOOR] * 2
    assert figure.axes[0].get_xlim()[0] == figure.axes[1].get_ylim()[0] == 0
