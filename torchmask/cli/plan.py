"""`torchmask plan`: how many holes, of what size, and what exposure."""

from __future__ import annotations

import dataclasses
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from torchmask.cli.options import CatalogOptions, InstrumentOptions, MaskOptions, RunOptions, load_aperture
from torchmask.cli.run import new_run
from torchmask.cli.wording import in_options
from torchmask.design.manufacture import save_json
from torchmask.instrument.instrument import Instrument
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.pupil import Aperture
from torchmask.planning.plan import plan_observation
from torchmask.planning.result import AXES, ObservationPlan
from torchmask.viz.figures import mask_figure
from torchmask.viz.planning import plan_figure


@dataclass(frozen=True, kw_only=True)
class Options(Instrument, CatalogOptions, InstrumentOptions, RunOptions):
    """Plan an observation: how many holes, of what size, and what exposure restore the best image.

    A mask is searched, quickly, for every number of holes and hole diameter. For each of these masks and every exposure
    the error of the restored image is predicted from magnitude, band, telescope, site, camera and time. The prediction
    includes what restorations were measured to lose because they have to find the aberrations. Writes all predictions
    and the best of them (plan.md, plan.json, plan.png), its mask (mask.json), and the observation as one file for other
    commands (instrument.json) to a new folder. The full pupil stands beside the masks. Takes minutes.
    """

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
    n_frequencies: int = 128
    """Frequency grid of the criterion, per side."""
    budget: int = 1000
    """Evaluations of the criterion in each search."""
    seed: int = 0
    """Random seed of the searches."""

    @classmethod
    def of_instrument(cls, known: Instrument) -> Options:
        """Return the options that an instrument sets: all of it."""
        return cls(**_fields(known))


def instrument_of(options: Instrument) -> Instrument:
    """Return the instrument among the options."""
    return Instrument(**_fields(options))


def _fields(known: Instrument) -> dict[str, Any]:
    return {item.name: getattr(known, item.name) for item in dataclasses.fields(Instrument)}


def existing_mask(options: Options) -> Aperture | None:
    """Return the mask that --mask names; patterns without a size, and full pupils, are as wide as the telescope."""
    if options.mask is None:
        for name in ("mask_diameter", "fill_factor", "mirrored", "allow_overlap"):
            if (value := getattr(options, name)) is not None and value is not False:
                raise ValueError(
                    f"--{name.replace('_', '-')} is for a mask that exists: give --mask, or leave it out, as masks "
                    "that are searched are as wide as the telescope"
                )
        return None
    names = (item.name for item in dataclasses.fields(CatalogOptions))
    return load_aperture(
        MaskOptions(mask=options.mask, **{name: getattr(options, name) for name in names}), options.telescope
    )


def run(options: Options) -> None:
    """Plan, and write map, picture, mask and instrument."""
    instrument, aperture = instrument_of(options), existing_mask(options)
    with new_run("plan", options, options.seed) as output:
        plan = plan_observation(
            instrument,
            n_subapertures=options.n_subapertures,
            hole_diameters=options.hole_diameters or None,
            exposures=options.exposures or None,
            widths=options.widths or None,
            aperture=aperture,
            n_frequencies=options.n_frequencies,
            budget=options.budget,
            seed=options.seed,
            callback=output.callback,
        )
        best = plan.best_instrument
        table = best.describe(float(plan.mask.area))
        output.report("plan", numbers(plan), f"{plan}\n\n{table}\n", plan_figure(plan))
        output.keep_instrument(best)
        if isinstance(plan.mask, SparseAperture):
            save_json(output.directory / "mask.json", plan.mask, best.mean_wavelength)
            output.logger.figure("plan_mask", mask_figure(plan.mask))
        told = str(plan).split("\n\n", 1)[0].splitlines()
        output.summary.extend(
            in_options(line, options) for line in (*told, *(f"left out: {reason}" for reason in plan.left_out))
        )
        output.summary.append(table)
        if options.mask is None and plan.shows_something:
            output.summary.append(f"design the final mask with: {_design_command(plan.mask, output.directory)}")


def _design_command(mask: Aperture, folder: Path) -> str:
    """Return the command that searches a mask of as many holes of this size."""
    file = shlex.quote(str(folder / "instrument.json"))
    size = f"--n-subapertures {mask.n_subapertures} --fill-factor {mask.fill_factor:.4g}"
    return f"torchmask design --instrument {file} {size}"


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
