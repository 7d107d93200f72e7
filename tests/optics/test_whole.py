"""The check of whole numbers: what it lets pass, and what it says of the rest."""

import math
import re

import numpy as np
import pytest

from torchmask.optics.whole import whole_number


@pytest.mark.parametrize("value", [20, 20.0, np.float32(20), np.int64(20)])
def test_a_number_without_a_fraction_is_an_int(value):
    found = whole_number("n_frames", value)
    assert (found, type(found)) == (20, int)


def test_the_limits_belong_to_what_is_taken():
    assert [whole_number("seed", value, least=0, most=2) for value in (0, 2)] == [0, 2]


@pytest.mark.parametrize(
    ("value", "options", "message"),
    [
        (2.5, {}, "n is 2.5: it must be a whole number of at least 1"),
        (math.nan, {}, "n is nan: it must be a whole number of at least 1"),
        (math.inf, {}, "n is inf: it must be a whole number of at least 1"),
        (-1, {"least": 0, "note": ", in frames"}, "n is -1: it must be a whole number of at least 0, in frames"),
        (33, {"most": 32}, "n is 33: it must be a whole number from 1 to 32"),
    ],
)
def test_others_are_refused_by_name_and_limits(value, options, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        whole_number("n", value, **options)
