"""`torchmask plan`: how many holes, of what size, and what exposure."""

from __future__ import annotations

import dataclasses
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from torchmask.cli.obstacles import warn_of_blocked_holes
from torchmask.cli.options import CatalogOptions, InstrumentOptions, MaskOptions, RunOptions, load_aperture
from torchmask.cli.report import draw_zones
from torchmask.cli.run import Run, new_run
from torchmask.cli.wording import in_options
from torchmask.design.manufacture import save_json
from torchmask.design.rules import MaskRules
from torchmask.instrument.instrument import Instrument
from torchmask.instrument.parts import Source
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.pupil import Aperture
from torchmask.planning.plan import PlanInterrupted, plan_observation
from torchmask.planning.result import AXES, ObservationPlan
from torchmask.viz import style as drawing
from torchmask.viz.figures import mask_figure
from torchmask.viz.planning import plan_figure

_WORKSHOP = ("min_gap", "rim_margin", "keep_out")  # rules that the telescope does not set
_ALTERNATIVES = (("filter", "width"), ("n_frames", "observing_time"))  # of which an instrument has one
_SEARCH = ("n_subapertures", "hole_diameters", *_WORKSHOP, "budget", "seed")


@dataclass(frozen=True, kw_only=True)
class SourceOptions(Source):
    """The target: its brightness, by a magnitude or a rate, and the statistics of its image."""

    def __post_init__(self) -> None:
        """Leave the checks to the plan, which knows what stands in a file and not on the command line."""


@dataclass(frozen=True, kw_only=True)
class Options(Instrument, CatalogOptions, InstrumentOptions, RunOptions):
    """Plan an observation: how many holes, of what size, and what exposure restore the best image.

    A mask is searched, quickly, for every number of holes and hole diameter. For each of these masks and every exposure
    the error of the restored image is predicted from magnitude, band, telescope, site, camera and time. The prediction
    includes what restorations were measured to lose because they have to find the aberrations. Writes all predictions
    and the best of them (plan.md, plan.json, plan.png), its mask (mask.json), and the observation as one file for other
    commands (instrument.json) to a new folder. The full pupil stands beside the masks. Takes minutes.
    """

    source: SourceOptions
    """Target of the observation."""
    mask: Annotated[Path | None, tyro.conf.arg(metavar="FILE|NAME|full")] = None
    """A mask that exists, or the full pupil: then the exposure alone is planned. None: masks are searched."""
    n_subapertures: tuple[int, ...] = (6, 9, 12, 16)
    """Numbers of holes to compare."""
    hole_diameters: tuple[float, ...] = ()
    """Diameters of the holes to compare [m]; none: 0.5, 0.8 and 1.2 r0."""
    exposures: tuple[float, ...] = ()
    """Exposure times to compare [s]; none: 0.25, 0.5, 1, 2, 4 and 8 times the coherence time tau0."""
    widths: tuple[float, ...] = ()
    """Widths of the band to compare [m]; none: that of the band alone."""
    min_gap: float = MaskRules.min_gap
    """Smallest width of material between two holes of a searched mask [m]."""
    rim_margin: float = MaskRules.rim_margin
    """Smallest width of material between a hole of a searched mask and its rim [m]."""
    keep_out: tuple[tuple[float, float, float], ...] = MaskRules.keep_out
    """Discs to be kept free of holes besides the telescope's, three numbers each: x y of the centre, diameter [m]."""
    n_frequencies: int = 128
    """Frequency grid of the criterion, per side."""
    budget: int = 1000
    """Evaluations of the criterion in each search."""
    seed: int = 0
    """Random seed of the searches."""

    def __post_init__(self) -> None:
        """Put out what the file says where an option stands in its place, and check the instrument."""
        source, known = _fields(self.source, Source), self.known_instrument()
        if known is not None:
            source |= _put_out(self.source, known.source, ("magnitude", "photon_rate"))
            for pair in _ALTERNATIVES:
                for name, value in _put_out(self, known, pair).items():
                    object.__setattr__(self, name, value)
        object.__setattr__(self, "source", SourceOptions(**source))
        Source(**source)  # raises for a source that cannot be
        super().__post_init__()

    @classmethod
    def of_instrument(cls, known: Instrument) -> Options:
        """Return the options that an instrument sets: all of it."""
        return cls(**_fields(known, Instrument))


def instrument_of(options: Instrument) -> Instrument:
    """Return the instrument among the options."""
    values = _fields(options, Instrument)
    values["source"] = Source(**_fields(options.source, Source))
    return Instrument(**values)


def _fields(record: Any, kind: type) -> dict[str, Any]:
    return {item.name: getattr(record, item.name) for item in dataclasses.fields(kind)}


def _put_out(told: Any, known: Any, pair: tuple[str, str]) -> dict[str, None]:
    """Return which of two alternatives is the file's and goes, if both are told and the other one is not the file's."""
    if None in [getattr(told, name) for name in pair]:
        return {}
    same = [name for name in pair if getattr(told, name) == getattr(known, name)]
    return dict.fromkeys(same) if len(same) == 1 else {}


def existing_mask(options: Options) -> Aperture | None:
    """Return the mask that --mask names; patterns without a size, and full pupils, are as wide as the telescope.

    Raises ValueError for options of a mask that exists without --mask, and for those of a search beside it. Warns of
    holes that do not lie in the open pupil.
    """
    if options.mask is None:
        for name in ("mask_diameter", "fill_factor", "mirrored", "allow_overlap"):
            if (value := getattr(options, name)) is not None and value is not False:
                raise ValueError(
                    f"--{name.replace('_', '-')} is for a mask that exists: give --mask, or leave it out, as masks "
                    "that are searched are as wide as the telescope"
                )
        return None
    for name in _SEARCH:
        if getattr(options, name) != getattr(Options, name):
            raise ValueError(
                f"--{name.replace('_', '-')} is for masks that are searched, but --mask {options.mask} exists: leave "
                "out one of the two"
            )
    names = (item.name for item in dataclasses.fields(CatalogOptions))
    aperture = load_aperture(
        MaskOptions(mask=options.mask, **{name: getattr(options, name) for name in names}), options.telescope
    )
    warn_of_blocked_holes(options.mask, aperture, options.telescope)
    return aperture


def run(options: Options) -> None:
    """Plan, and write map, picture, mask and instrument, of the points reached if interrupted."""
    instrument, aperture = instrument_of(options), existing_mask(options)
    rules = MaskRules(**{name: getattr(options, name) for name in _WORKSHOP})
    rules.require_on_pupil(instrument.telescope.diameter)
    constraints = rules.constraints()
    with new_run("plan", options, options.seed) as output:
        try:
            plan = plan_observation(
                instrument,
                n_subapertures=options.n_subapertures,
                hole_diameters=options.hole_diameters or None,
                exposures=options.exposures or None,
                widths=options.widths or None,
                aperture=aperture,
                constraints=constraints,
                n_frequencies=options.n_frequencies,
                budget=options.budget,
                seed=options.seed,
                callback=output.callback,
            )
        except PlanInterrupted as stopped:
            write(stopped.plan, rules, output)
            raise
        except KeyboardInterrupt:
            print("\nno point of the map was reached: there is no plan and no mask, only the log", file=sys.stderr)
            raise
        table = write(plan, rules, output)
        told = str(plan).split("\n\n", 1)[0].splitlines()
        output.summary.extend(
            in_options(line, options) for line in (*told, *(f"left out: {reason}" for reason in plan.left_out))
        )
        output.summary.append(table)
        if options.mask is None and plan.shows_something:
            command = _design_command(plan.mask, rules, output.directory)
            output.summary.append(f"design the final mask with: {command}")


def write(plan: ObservationPlan, rules: MaskRules, output: Run) -> str:
    """Write map, picture, mask and instrument of a plan to its folder; return what follows for its best point."""
    best = plan.best_instrument
    table = f"{best.describe(float(plan.mask.area))}\n| outer scale | {best.site.outer_scale:.4g} m |"
    output.report("plan", numbers(plan), f"{plan}\n\n{table}\n", plan_figure(plan))
    output.keep_instrument(best)
    if isinstance(plan.mask, SparseAperture):
        save_json(output.directory / "mask.json", plan.mask, best.mean_wavelength)
        figure, telescope = mask_figure(plan.mask), best.telescope
        zones = dataclasses.replace(
            rules, central_obstruction=telescope.central_obstruction, spiders=telescope.spiders
        ).constraints()
        draw_zones(figure, zones, drawing.length_unit(plan.mask.mask_diameter)[1])
        output.logger.figure("plan_mask", figure)
    return table


def _design_command(mask: Aperture, rules: MaskRules, folder: Path) -> str:
    """Return the command that searches a mask of as many holes of this size, under the same rules."""
    file = shlex.quote(str(folder / "instrument.json"))
    words = [f"--n-subapertures {mask.n_subapertures} --fill-factor {mask.fill_factor:.4g}"]
    words += [f"--min-gap {rules.min_gap}"] * bool(rules.min_gap)
    words += [f"--rim-margin {rules.rim_margin}"] * bool(rules.rim_margin)
    if rules.keep_out:
        words.append(f"--keep-out {' '.join(str(number) for disc in rules.keep_out for number in disc)}")
    return f"torchmask design --instrument {file} {' '.join(words)}"


def numbers(plan: ObservationPlan) -> dict[str, object]:
    """Return the contents of plan.json: the best point, the whole map, and what is missing from it."""
    return {
        "best": dataclasses.asdict(plan.best),
        "best_known": dataclasses.asdict(plan.best_known),
        "best_exposure": plan.best_exposure,
        "at_edge": {name: plan.at_edge(name) for name in AXES},
        "map": [dataclasses.asdict(choice) for choice in plan.choices],
        "left_out": plan.left_out,
        "full_pupil": None if plan.full_pupil is None else numbers(plan.full_pupil),
    }
