"""The check of a number: what it lets pass, and what it says of the rest."""

import math
import re

import numpy as np
import pytest

from torchmask.numbers import require, whole_number


def test_what_is_in_range_or_not_told_passes():
    require("width", 1e-300)
    require("width", None)
    require("noise", 0.0, zero=True)
    require("share", 1.0, most=1.0)


@pytest.mark.parametrize(
    ("value", "options", "message"),
    [
        (0.0, {}, "width is 0.0: it must be finite and positive, in m"),
        (math.nan, {}, "width is nan: it must be finite and positive, in m"),
        (math.inf, {}, "width is inf: it must be finite and positive, in m"),
        (-1.0, {"zero": True}, "width is -1.0: it must be finite and at least 0, in m"),
        (1.5, {"most": 1.0}, "width is 1.5: it must be finite and positive, at most 1, in m"),
    ],
)
def test_what_is_out_of_range_is_named_with_its_unit(value, options, message):
    with pytest.raises(ValueError, match=message):
        require("width", value, ", in m", **options)


# --- whole numbers


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
