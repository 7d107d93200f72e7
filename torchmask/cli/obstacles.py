"""Warning of a mask that exists whose holes do not lie in the open pupil of the telescope."""

from __future__ import annotations

import warnings
from pathlib import Path

from torchmask.cli.options import is_mask_file
from torchmask.design.constraint_base import Constraint
from torchmask.design.constraints import InsideDisc, KeepOutDisc
from torchmask.design.rules import MaskRules
from torchmask.instrument.parts import Telescope
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.pupil import Aperture

_ROUNDING = 1e-6  # of the diameter, by which holes may reach out of the pupil


def warn_of_blocked_holes(mask: Path, aperture: Aperture, telescope: Telescope | None) -> None:
    """Warn if holes of --mask lie behind the secondary mirror or its vanes, or outside the pupil.

    Without a telescope the pupil is the mask's own disc. Masks of the catalogue are not judged by that, as real ones
    exceed their nominal pupils.

    Warns UserWarning, which names the holes, counted from 0, and by how many metres.
    """
    if not isinstance(aperture, SparseAperture) or (telescope is None and not is_mask_file(mask)):
        return
    rules: list[Constraint] = []
    if telescope is not None:
        aperture = aperture.replace(mask_diameter=telescope.diameter)
        rules = MaskRules(central_obstruction=telescope.central_obstruction, spiders=telescope.spiders).constraints()
    blocked = [
        f"hole {number} reaches {depth:.3g} m {_place(rule, aperture.mask_diameter)}"
        for number, center in enumerate(aperture.centers)
        for rule, depth in _broken(aperture.replace(centers=center[None]), rules)
    ]
    if blocked:
        warnings.warn(
            f"not all holes of --mask {mask} lie in the open pupil: {', '.join(blocked)} (counted from 0). All that "
            "follows supposes that nothing is in their way: move them, or correct the telescope",
            stacklevel=2,
        )


def _broken(hole: SparseAperture, rules: list[Constraint]) -> list[tuple[Constraint, float]]:
    """Return what a mask of one hole breaks, and by how much [m]."""
    depths = [(rule, float(rule.violation(hole))) for rule in (InsideDisc(), *rules)]
    return [(rule, depth) for rule, depth in depths if depth > _ROUNDING * hole.mask_diameter]


def _place(rule: Constraint, diameter: float) -> str:
    if isinstance(rule, InsideDisc):
        return f"beyond the rim of the pupil of {diameter:.4g} m"
    if isinstance(rule, KeepOutDisc):
        return f"into the central obstruction of {rule.diameter:.4g} m"
    return "into a vane"
