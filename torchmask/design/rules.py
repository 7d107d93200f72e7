"""Rules that a telescope and a workshop set for the holes of a mask, as numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torchmask.design.constraint_base import Constraint
from torchmask.design.constraints import KeepOutDisc, KeepOutSegment, MinimumGap, RimMargin
from torchmask.numbers import require


@dataclass(frozen=True, kw_only=True)
class MaskRules:
    """Rules for where a mask may have holes and how much material stays around them.

    Examples
    --------
    >>> MaskRules(min_gap=0.01, central_obstruction=0.2).constraints()
    [MinimumGap(gap=0.01), KeepOutDisc(diameter=0.2, center=(0.0, 0.0))]
    """

    min_gap: float = 0.0
    """Smallest width of material between two holes [m]."""
    rim_margin: float = 0.0
    """Smallest width of material between a hole and the rim of the mask [m]."""
    central_obstruction: float = 0.0
    """Diameter of a central disc to be kept free of holes [m]."""
    spiders: tuple[tuple[float, float, float, float, float], ...] = ()
    """Bars to be kept free of holes, five numbers each: from x y to x y, width [m]."""
    keep_out: tuple[tuple[float, float, float], ...] = ()
    """Discs to be kept free of holes, three numbers each: x y of the centre, diameter [m]."""

    def constraints(self) -> list[Constraint]:
        """Return the constraints in addition to those on the mask disc and on overlaps.

        Raises ValueError if a number is out of range.
        """
        for name in ("min_gap", "rim_margin", "central_obstruction"):
            require(name, getattr(self, name), ", in m", zero=True)
        rules: list[Constraint] = []
        if self.min_gap:
            rules.append(MinimumGap(self.min_gap))
        if self.central_obstruction:
            rules.append(KeepOutDisc(self.central_obstruction))
        if self.rim_margin:
            rules.append(RimMargin(self.rim_margin))
        try:
            rules += [KeepOutDisc(diameter, (x, y)) for x, y, diameter in self.keep_out]
        except ValueError as error:
            raise ValueError(f"keep_out has a disc whose {error}") from error
        try:
            return rules + [KeepOutSegment((x, y), (to_x, to_y), width) for x, y, to_x, to_y, width in self.spiders]
        except ValueError as error:
            raise ValueError(f"spiders has a bar whose {error}") from error

    def require_on_pupil(self, mask_diameter: float) -> None:
        """Raise ValueError if a disc or bar lies wholly outside a mask of this diameter [m], where it forbids nothing,
        or a bar is wider than the mask.

        Such a rule is most often in millimetres.
        """
        for x, y, diameter in self.keep_out:
            _require_near(f"keep_out has a disc {x:g} {y:g} {diameter:g}", math.hypot(x, y), diameter, mask_diameter)
        for x, y, to_x, to_y, width in self.spiders:
            bar = f"spiders has a bar {x:g} {y:g} {to_x:g} {to_y:g} {width:g}"
            if width >= mask_diameter:
                raise ValueError(f"{bar}: wider than a mask of {mask_diameter:g} m; give it in m (30 mm are 0.03)")
            _require_near(bar, _distance_from_centre((x, y), (to_x, to_y)), width, mask_diameter)


def _require_near(name: str, distance: float, width: float, mask_diameter: float) -> None:
    """Raise ValueError if a zone whose middle is `distance` [m] off the centre misses a mask of this diameter [m]."""
    if distance - width / 2 >= mask_diameter / 2:
        raise ValueError(
            f"{name}: it lies outside the mask, of {mask_diameter:g} m around 0 0; give it in m (300 mm are 0.3), or "
            "leave it out"
        )


def _distance_from_centre(start: tuple[float, float], end: tuple[float, float]) -> float:
    """Return the distance [m] of the origin from the line between two points [m]."""
    step = end[0] - start[0], end[1] - start[1]
    nearest = -(start[0] * step[0] + start[1] * step[1]) / (step[0] ** 2 + step[1] ** 2)
    share = min(max(nearest, 0.0), 1.0)
    return math.hypot(start[0] + share * step[0], start[1] + share * step[1])
