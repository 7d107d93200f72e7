"""Ranking of masks by the error of the restored image: as built on their telescopes, and laid afresh at equal area."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from enum import Enum
from typing import Any

import torch

from torchmask.design.constraint_base import Constraint
from torchmask.design.constraints import check_mask
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.pattern import Pattern
from torchmask.design.redundancy import analyse_redundancy
from torchmask.design.rules import MaskRules
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.overlaps import require_apart
from torchmask.record import Callback, Record

_ROUNDING = 1e-6  # of the mask diameter, by which holes may overlap or break a rule


class Layout(Enum):
    """Where the holes of a ranked mask come from."""

    AS_BUILT = "as built"
    """Its own holes, with the whole mask scaled to the pupil; the collecting area is its own."""
    AFRESH = "laid afresh"
    """The pattern alone, fitted into the pupil, with holes of a common collecting area."""
    SEARCHED = "searched"
    """A mask of this library at that area."""


@dataclass(frozen=True)
class RankedMask:
    """One row of a ranking. Errors are relative to the mean of the object's PSD.

    rank : place among the masks as built, or among all others, which share their collecting area
    area : open area [m^2]
    relative_mse : error by the criterion
    above_floor : the same without the part that no mask of this diameter can change
    excess_percent : what the error exceeds that of the searched mask with as many holes by; None: there is none
    distinct_baselines, strictly_nonredundant, uv_filling, fwhm, side_lobe : see `RedundancyReport`
    """

    rank: int
    mask: str
    layout: Layout
    n_subapertures: int
    subaperture_diameter: float
    area: float
    relative_mse: float
    above_floor: float
    excess_percent: float | None
    distinct_baselines: int
    strictly_nonredundant: bool
    uv_filling: float
    fwhm: float
    side_lobe: float


COLUMNS = {
    "rank": "rank",
    "mask": "mask",
    "n_subapertures": "N",
    "subaperture_diameter": "d [m]",
    "area": "area [m^2]",
    "relative_mse": "relative MSE",
    "above_floor": "above the floor",
    "excess_percent": "over our best, %",
    "distinct_baselines": "distinct baselines",
    "strictly_nonredundant": "strictly non-redundant",
    "uv_filling": "u-v filling",
    "fwhm": "PSF width, wavelength/D",
    "side_lobe": "side lobe",
}


@dataclass(frozen=True)
class Ranking:
    """Ranked masks, which `print` shows as Markdown tables.

    rows : the masks laid afresh and searched, then those as built, each from the best to the worst
    left_out : why a mask is not ranked, by its name and layout
    floor : relative error that no mask of this diameter can change
    """

    rows: tuple[RankedMask, ...]
    left_out: Mapping[str, str]
    floor: float

    def of(self, *layouts: Layout) -> list[RankedMask]:
        """Return the rows of these layouts."""
        return [row for row in self.rows if row.layout in layouts]

    def csv(self) -> str:
        """Return all rows as CSV with all digits, names first."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        names = [item.name for item in fields(RankedMask)]
        writer.writerow(names)
        for row in self.rows:
            values = [getattr(row, name) for name in names]
            writer.writerow([value.value if isinstance(value, Layout) else value for value in values])
        return text.getvalue()

    def __str__(self) -> str:
        parts = []
        for title, layouts in (
            ("The same collecting area", (Layout.AFRESH, Layout.SEARCHED)),
            ("As built, each with its own collecting area", (Layout.AS_BUILT,)),
        ):
            if rows := self.of(*layouts):
                parts += [f"## {title}", "", _markdown(rows), ""]
        if self.left_out:
            parts += ["Not ranked:", "", *(f"- {name}: {reason}" for name, reason in self.left_out.items()), ""]
        return "\n".join(parts)


def rank_masks(
    patterns: Sequence[Pattern],
    criterion: Callable[[float], AsymptoticMSE],
    mask_diameter: float,
    fill_factor: float,
    *,
    searched: Mapping[str, SparseAperture] | None = None,
    rules: MaskRules | None = None,
    allow_overlap: bool = False,
    callback: Callback | None = None,
) -> Ranking:
    """Rank masks by the error of the restored image.

    Parameters
    ----------
    patterns : sequence of Pattern
        Each is ranked as built, if it has a size of its own, and laid afresh.
    criterion : callable
        From an open area of the pupil [m^2] to the criterion with the light that passes.
    mask_diameter : float
        Of all masks, D [m].
    fill_factor : float
        Common collecting area N d^2 / D^2 of round holes for masks laid afresh; others get the same area.
    searched : mapping of str to SparseAperture, optional
        Masks to compare with, of the same area.
    rules : MaskRules, optional
        Those of the telescope, which every ranked mask obeys to within a millionth of its diameter.
    allow_overlap : bool
        Whether masks as built are ranked even if their holes overlap, as one real mask's do.
    callback : callable, optional
        Receives a `Record` of stage "ranking" after each mask.

    Raises
    ------
    ValueError
        If no mask is left to rank, two have one name, the fill factor is not finite and positive, or the criterion
        refuses a mask.

    Examples
    --------
    >>> from torchmask.design.pattern import Pattern
    >>> from torchmask.grid import Grid
    >>> from torchmask.spectra import NoisePSD, PowerLawPSD
    >>> grid = Grid.nyquist(1.0, 550e-9, 64)
    >>> patterns = [Pattern.from_catalog(name) for name in ("golay6", "jwst_niriss_ami_7")]
    >>> light = lambda area: AsymptoticMSE(grid, PowerLawPSD(1.5, 1e8 * area), NoisePSD(1e8 * area), 20)
    >>> [(row.mask, row.layout.value) for row in rank_masks(patterns, light, 1.0, 0.1).rows]
    [('jwst_niriss_ami_7', 'laid afresh'), ('golay6', 'laid afresh'), ('jwst_niriss_ami_7', 'as built')]
    """
    names = [pattern.name for pattern in patterns] + list(searched or {})
    if len(set(names)) < len(names):
        raise ValueError(f"masks are named {', '.join(names)}: two have one name, so rename one")
    masks, left_out = _lay_out(patterns, mask_diameter, fill_factor, rules or MaskRules(), allow_overlap)
    masks += [(name, Layout.SEARCHED, mask) for name, mask in (searched or {}).items()]
    if not masks:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in left_out.items())
        raise ValueError(f"no mask is left to rank: {reasons or 'none is given'}")
    known: dict[float, AsymptoticMSE] = {}
    measured = []
    for step, (name, layout, mask) in enumerate(masks, 1):
        area = float(f"{float(mask.area):.12g}")  # equal areas have one criterion, rounding notwithstanding
        if area not in known:
            known[area] = criterion(area)
        judge = known[area]
        with torch.no_grad():
            error = float(judge.relative(mask))
        measured.append((error, name, layout, mask))
        if callback is not None:
            callback(Record("ranking", step, len(masks), {"relative_mse": error}))
    judge = next(iter(known.values()))  # the floor is relative, and the same for all
    floor = judge.relative_floor(mask_diameter)
    return Ranking(tuple(_rows(measured, floor)), left_out, floor)


def _lay_out(
    patterns: Sequence[Pattern], mask_diameter: float, fill_factor: float, rules: MaskRules, allow_overlap: bool
) -> tuple[list[tuple[str, Layout, SparseAperture]], dict[str, str]]:
    """Return the masks that can be ranked, and why the others cannot."""
    masks, left_out, constraints = [], {}, rules.constraints()
    for pattern in patterns:
        built = pattern.scaled(mask_diameter)
        if built is None:
            left_out[f"{pattern.name}, {Layout.AS_BUILT.value}"] = pattern.unbuilt
        else:
            try:
                require_apart(built, allow_overlap)
                _check_rules(built, constraints)
                masks.append((pattern.name, Layout.AS_BUILT, built))
            except ValueError as error:
                left_out[f"{pattern.name}, {Layout.AS_BUILT.value}"] = str(error)
        try:
            afresh = pattern.afresh(mask_diameter, fill_factor, rules.rim_margin)
            check_mask(afresh, _ROUNDING, constraints)
            masks.append((pattern.name, Layout.AFRESH, afresh))
        except ValueError as error:
            left_out[f"{pattern.name}, {Layout.AFRESH.value}"] = str(error)
    return masks, left_out


def _check_rules(mask: SparseAperture, constraints: Sequence[Constraint]) -> None:
    """Raise ValueError if a mask breaks a rule; that it exceeds its nominal pupil, as some real ones do, is none."""
    for constraint in constraints:
        worst = float(constraint.violation(mask).max())
        if worst > _ROUNDING * mask.mask_diameter:
            raise ValueError(f"{constraint} is broken by {worst:.3g} m")


def _rows(measured: Sequence[tuple[float, str, Layout, SparseAperture]], floor: float) -> list[RankedMask]:
    ours: dict[int, float] = {}
    for error, _, layout, mask in measured:
        if layout is Layout.SEARCHED:
            ours[mask.n_subapertures] = min(error, ours.get(mask.n_subapertures, math.inf))
    rows: list[RankedMask] = []
    for built in (False, True):
        group = sorted((item for item in measured if (item[2] is Layout.AS_BUILT) == built), key=lambda item: item[0])
        for place, (error, name, layout, mask) in enumerate(group, 1):
            report, best = analyse_redundancy(mask), ours.get(mask.n_subapertures)
            rows.append(
                RankedMask(
                    rank=place,
                    mask=name,
                    layout=layout,
                    n_subapertures=mask.n_subapertures,
                    subaperture_diameter=mask.subaperture_diameter,
                    area=float(mask.area),
                    relative_mse=error,
                    above_floor=error - floor,
                    excess_percent=None if best is None or built else 100 * (error / best - 1),
                    distinct_baselines=report.n_distinct,
                    strictly_nonredundant=report.strictly_nonredundant,
                    uv_filling=report.uv_filling,
                    fwhm=report.fwhm,
                    side_lobe=report.side_lobe,
                )
            )
    return rows


def _markdown(rows: Sequence[RankedMask]) -> str:
    lines = ["| " + " | ".join(COLUMNS.values()) + " |", "|" + "---|" * len(COLUMNS)]
    lines += ["| " + " | ".join(_cell(name, getattr(row, name)) for name in COLUMNS) + " |" for row in rows]
    return "\n".join(lines)


def _cell(name: str, value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if name == "excess_percent":
        return f"{value:.1f}"
    return f"{value:.4f}" if isinstance(value, float) else str(value)
