"""The check of a number: what it lets pass, and what it says of the rest."""

import math

import pytest

from torchmask.numbers import require


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
