"""Frames that repeat earlier ones."""

import torch

from torchmask.optics.copies import copies_among


def test_frames_of_equal_light_are_compared_pixel_by_pixel():
    """Each with all earlier ones of the same sum."""
    frame = torch.arange(6.0).reshape(1, 2, 3)
    frames = torch.cat([frame, frame.flip(2), frame.flip(1), frame.flip(2), frame, frame + 1])
    assert copies_among(frames) == [3, 4]
    assert copies_among(frames[:1]) == []
