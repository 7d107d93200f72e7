"""`torchmask rank`: masks of the catalogue and of files, by the error of the restored image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from torchmask.cli.criterion_options import ObservationOptions, Observed, observation_options
from torchmask.cli.options import RunOptions, is_mask_file
from torchmask.cli.run import Run, new_run
from torchmask.cli.wording import in_options
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.manufacture import load_mask, save_json
from torchmask.design.pattern import Pattern
from torchmask.design.ranking import Layout, Ranking, rank_masks
from torchmask.design.search import search_mask
from torchmask.instrument.instrument import Instrument
from torchmask.io import atomic_write
from torchmask.numbers import require_diameter
from torchmask.optics import catalog
from torchmask.optics.aperture import SparseAperture
from torchmask.record import Callback
from torchmask.viz.ranking import ranking_figure

_SHOWN = 5  # masks named on the terminal


@dataclass(frozen=True, kw_only=True)
class Options(ObservationOptions, RunOptions):
    """Rank masks by the error of the restored image, on one telescope.

    Each mask is ranked twice: as built, with its own holes and the light that they pass, scaled to the pupil; and laid
    afresh, its pattern fitted into the pupil with holes of the same collecting area for all. Masks that would overlap
    or break a rule are named with the reason. Writes ranking.md, ranking.csv, ranking.json, a picture and the searched
    masks to a new folder.
    """

    masks: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="NAME|FILE")] = ()
    """Masks, by their name in the catalogue or their file (.json, .dxf, .fits); none: the whole catalogue."""
    search: tuple[int, ...] = ()
    """Numbers of holes for which a mask is searched, to compare with."""
    fill_factor: float = 0.15
    """Common collecting area N d^2 / D^2 of round holes for masks laid afresh and searched."""
    n_frequencies: int = 256
    """Frequencies per side of the criterion's grid."""
    budget: int = 20_000
    """Evaluations of each search."""
    seed: int = 0
    """Random seed of the searches."""
    allow_overlap: bool = False
    """Rank a mask as built although its holes overlap; the criterion counts the light in overlaps twice."""

    @classmethod
    def of_instrument(cls, known: Instrument) -> Options:
        """Return the options that an instrument sets."""
        return cls(**observation_options(known))


def patterns(options: Options) -> list[Pattern]:
    """Return the masks of the options.

    Raises ValueError for an unknown name, a file that is no mask, two masks or searches of one name, and a search for
    a single hole.
    """
    if options.search and min(options.search) < 2:
        raise ValueError(f"--search is {min(options.search)}: masks of at least two holes can be ranked")
    searched = [_searched_name(n) for n in options.search]
    asked = options.masks or catalog.names()
    names = name_masks(asked, searched)
    twice = sorted(_repeated([*names, *searched]))
    if twice:
        raise ValueError(f"two masks are named {twice[0]}: leave one out")
    return [
        Pattern.of(name, load_mask(mask)) if is_mask_file(Path(mask)) else Pattern.from_catalog(mask)
        for name, mask in zip(names, asked, strict=True)
    ]


def name_masks(masks: Sequence[str], others: Sequence[str] = ()) -> list[str]:
    """Return a name for each mask: that of the catalogue, or that of its file, with its folders where others have it.

    Files of one folder that differ by their suffix alone keep it. One mask that is given twice has one name.
    """
    paths = [Path(mask).absolute() if is_mask_file(Path(mask)) else Path(catalog.entry(mask).name) for mask in masks]
    bare = _repeated([str(path.with_suffix("")) for path in set(paths)])
    parts = [(*path.parts[:-1], path.name if str(path.with_suffix("")) in bare else path.stem) for path in paths]
    depths = [1] * len(parts)
    while True:
        names = ["/".join(part[-depth:]) for part, depth in zip(parts, depths, strict=True)]
        twice = _repeated([*(name for name, _ in set(zip(names, parts, strict=True))), *others])
        longer = [i for i, name in enumerate(names) if name in twice and depths[i] < len(parts[i])]
        if not longer:
            return names
        for i in longer:
            depths[i] += 1


def _repeated(names: Sequence[str]) -> set[str]:
    return {name for name in names if names.count(name) > 1}


def _searched_name(n: int) -> str:
    return f"torchmask_{n}"


def search_masks(options: Options, criterion: AsymptoticMSE, output: Run) -> dict[str, SparseAperture]:
    """Search a mask for each number of holes, and write it."""
    masks = {}
    for n in options.search:
        result = search_mask(
            criterion,
            n,
            options.mask_diameter,
            options.fill_factor,
            seed=options.seed,
            budget=options.budget,
            constraints=options.rules().constraints(),
            callback=_in_one_run(output.callback, n),
        )
        name = _searched_name(n)
        masks[name] = result.aperture
        save_json(output.directory / f"{name}.json", result.aperture, options.observing_wavelength())
    return masks


def _in_one_run(callback: Callback, n: int) -> Callback:
    """Return a callback for one of several searches, which renames its stage "design/cma" to "cma_6_holes".

    A stage "KIND/VARIANT" would be a run of its own in TensorBoard, with a folder of its own.
    """
    return lambda record: callback(replace(record, stage=f"{record.stage.rpartition('/')[2]}_{n}_holes"))


def ranking(options: Options, output: Run) -> Ranking:
    """Rank, and write everything to the folder of the run."""
    require_diameter("mask_diameter", options.mask_diameter)
    chosen = patterns(options)
    observed = options.observation(options.n_frequencies, options.fill_factor)
    output.keep_instrument(options.kept_instrument(observed))
    rules = options.rules()
    rules.require_on_pupil(options.mask_diameter)
    found = rank_masks(
        chosen,
        lambda area: observed.through(area).criterion(),
        options.mask_diameter,
        options.fill_factor,
        searched=search_masks(options, observed.criterion(), output) if options.search else None,
        rules=rules,
        allow_overlap=options.allow_overlap,
        callback=output.callback,
    )
    found = replace(found, left_out={name: in_options(why, options) for name, why in found.left_out.items()})
    with atomic_write(output.directory / "ranking.csv") as file:
        file.write(found.csv().encode())
    rows = [asdict(row) | {"layout": row.layout.value} for row in found.rows]
    light = light_of(options, observed)
    numbers = {"light": light, "rows": rows, "not_ranked": found.left_out, "floor": found.floor}
    told = describe(light)
    output.report("ranking", numbers, f"{heading(options, observed, told)}\n\n{found}", ranking_figure(found, told))
    return found


def light_of(options: Options, observed: Observed) -> dict[str, float]:
    """Return the light through the common collecting area, and the noise [electrons per frame] beside it."""
    return {
        "fill_factor": options.fill_factor,
        "n_photons": observed.object_psd.n_photons,
        "readout_noise": options.readout_noise,
        "n_pixels": options.n_pixels,
        "sky": (observed.turbulence or {}).get("sky", 0.0),
    }


def describe(light: Mapping[str, float]) -> str:
    """Return the light in words."""
    return (
        f"{light['n_photons']:.4g} photons a frame at N d^2 / D^2 = {light['fill_factor']:g}, {light['sky']:.4g} "
        f"electrons of sky in each of {light['n_pixels']} x {light['n_pixels']} pixels, read-out noise "
        f"{light['readout_noise']:g} electrons rms"
    )


def heading(options: Options, observed: Observed, light: str) -> str:
    """Return what stands above the table."""
    air = "independent pistons"
    if options.criterion == "turbulent":
        outer = "infinite" if options.outer_scale is None else f"{options.outer_scale:g} m"
        air = f"turbulence of r0 = {options.r0:g} m and outer scale {outer}"
    wavelength = options.observing_wavelength()
    at = "" if wavelength is None else f"{1e9 * wavelength:g} nm, "
    return (
        f"# Masks ranked by the error of the restored image\n\nD = {options.mask_diameter:g} m, "
        f"{at}{air}, K = {observed.n_frames}, p = {options.exponent:g}, {light}: others have the light of their own "
        "area. That common collecting area is of round holes. The floor is the part no mask can change; torchmask_N "
        "are searched masks, with which `over our best` compares those of the same N and area."
    )


def run(options: Options) -> None:
    """Rank, and name the best."""
    with new_run("rank", options, options.seed) as output:
        found = ranking(options, output)
        for title, layouts in (
            ("the same collecting area", (Layout.AFRESH, Layout.SEARCHED)),
            ("as built", (Layout.AS_BUILT,)),
        ):
            best = [f"{row.mask} {row.relative_mse:.4f}" for row in found.of(*layouts)[:_SHOWN]]
            if best:
                output.summary.append(f"{title}, relative MSE of the best: {', '.join(best)}")
        output.summary.extend(f"not ranked: {name}: {reason}" for name, reason in found.left_out.items())
