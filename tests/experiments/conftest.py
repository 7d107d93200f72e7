"""What the scripts of the experiments share when they run tiny."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from torch import Tensor

from torchmask.atmosphere import von_karman
from torchmask.optics.pupil import Aperture


@pytest.fixture(scope="session", autouse=True)
def covariances_once() -> Iterator[None]:
    """Covariances of modes are computed once for each mask and turbulence; tiny restorations consist of little else.

    They are the same to the last bit. How they are computed is for tests/atmosphere to ask.
    """
    compute, known = von_karman._gram, {}

    def gram(aperture: Aperture, n_modes: int, spectrum: Any, places: Tensor, start: float, stop: float) -> Tensor:
        holes = (aperture.shape, aperture.subaperture_diameter, aperture.outer_diameter, places.numpy().tobytes())
        key = (*holes, n_modes, spectrum, start, stop)
        if key not in known:
            known[key] = compute(aperture, n_modes, spectrum, places, start, stop)
        return known[key].clone()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(von_karman, "_gram", gram)
        yield
