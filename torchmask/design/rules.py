"""Rules that a telescope and a workshop set for the holes of a mask, as numbers."""

from __future__ import annotations

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
