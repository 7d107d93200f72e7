"""A number of frames that is given beside an instrument with an observing time replaces that time."""

import dataclasses

import pytest

from torchmask.cli.instrument_used import instrument_used


@pytest.mark.parametrize(("exposure", "n_frames"), [(0.0, 7), (6e-3, 7), (6e-3, 40)])
def test_the_frames_are_those_that_were_given(recorded, exposure, n_frames):
    timed = dataclasses.replace(recorded, n_frames=None, observing_time=0.6)
    found = instrument_used(timed, {"exposure": exposure, "n_frames": n_frames})
    assert (found.frames, found.exposure) == (n_frames, exposure or recorded.exposure)


def test_an_instrument_of_which_nothing_changes_keeps_its_observing_time(recorded):
    timed = dataclasses.replace(recorded, n_frames=None, observing_time=0.6)
    assert instrument_used(timed, {"exposure": 0.0, "n_frames": None}) == timed
