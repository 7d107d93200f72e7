"""`torchmask restore`: the image behind a stack of short exposures."""

from __future__ import annotations

import dataclasses
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from torchmask import __version__
from torchmask.cli.config import stored
from torchmask.cli.options import MaskOptions, RunOptions, load_aperture
from torchmask.cli.report import restored_figure
from torchmask.cli.run import Run, new_run
from torchmask.data.observe import read_observation
from torchmask.data.restored import save_restored
from torchmask.grid import ARCSEC, Grid
from torchmask.io import write_json
from torchmask.metrics import relative_error, ssim
from torchmask.observation import Observation
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.priors import TotalVariation
from torchmask.restoration.result import RestorationResult
from torchmask.viz import figures as viz

CHECKPOINT = "resume.npz"  # of a run: from here it can go on


@dataclass(frozen=True)
class FITSOptions:
    """What the header of a FITS file may lack, and calibration. What is given wins over the header."""

    unit: str | None = None
    """Such as "adu", "electron / s" or "250 electron"; None: BUNIT, else adu if a gain is known, else electron."""
    gain: float | None = None
    """Electrons per adu; None: from the header (EGAIN, GAIN)."""
    exposure_time: float | None = None
    """Of one frame [s], for units per second; None: from the header."""
    dark: Path | None = None
    """FITS image that is subtracted, in the units of the files."""
    flat: Path | None = None
    """FITS image to divide by, of any scale."""
    bad_pixels: Path | None = None
    """FITS image, not 0 where a pixel is bad."""
    crop: int | None = None
    """Side of the field that is cut out around the target [pixels]; None: all of the image."""
    target: tuple[int, int] | None = None
    """Pixel of the target in every file: row column, counted from 0; None: where the mean frame is brightest."""
    keep: float | None = None
    """Fraction of the frames to keep, the best ones; None: all."""
    keep_by: Literal["sharpness", "flux"] = "sharpness"
    """What makes a frame good."""


@dataclass(frozen=True, kw_only=True)
class Options(MaskOptions, FITSOptions, RunOptions):
    """Restore the image behind a stack of short exposures with unknown aberrations (myopic deconvolution).

    A stack is one .npz file (`torchmask simulate` writes such), or FITS files: cubes or images, of one filter and
    orientation. FITS files need --mask. Writes restored.fits (with the sky coordinates of the input, and in HISTORY
    what was done), restored.npz, figures, metrics.json, config.yaml and the log to a new folder.
    """

    stack: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Stack of exposures, .npz or .fits."""
    wavelength: float | None = None
    """Of the observation [m]; None: as the file says."""
    pixel_scale_arcsec: float | None = None
    """Angle on the sky of one pixel [arcsec]; None: as the file says."""
    readout_noise: float | None = None
    """Electrons rms per pixel and frame; None: as the file says, or else measured on the frames."""
    r0: float | None = None
    """Fried parameter of the turbulence at the wavelength [m]; None: as a simulated stack says, or else estimated."""
    outer_scale: float | None = None
    """Of the turbulence [m]; None: as a simulated stack says, or else 20 mask diameters."""
    n_modes: int | None = None
    """Zernike modes per hole, Noll 1 (piston) to this; None: 6, or 231 for a full pupil."""
    wavelengths: tuple[float, ...] = ()
    """A broad band as a few wavelengths [m]; none: --wavelength alone."""
    weights: tuple[float, ...] = ()
    """Share of the light of each of them, any positive numbers; none: equal."""
    static_modes: int = 0
    """Zernike modes per hole of aberrations that all frames share, such as those of the telescope."""
    prior: bool = True
    """Weigh aberrations by their von Karman statistics."""
    tv_weight: float = 1.0
    """Of the total variation of the object, without unit: more is smoother."""
    max_iterations: int = 4000
    """Upper limit of iterations, of all starts together; one start takes 1000 at most."""
    tolerance: float = 1e-4
    """Converged when 100 iterations lower the cost by less than this fraction."""
    n_samples: int = 0
    """Drawn for the standard deviations of the image, extension ERR of restored.fits: 8 are enough; 0: none."""
    resume: Path | None = None
    """Folder of an interrupted run: go on with its options from its checkpoint, of every 100th iteration."""


def run(options: Options) -> None:
    """Restore, and write the image."""
    observation = load_observation(options)
    checkpoint = None if options.resume is None else options.resume / CHECKPOINT
    if checkpoint is not None and not checkpoint.is_file():
        raise ValueError(f"there is no {checkpoint} to go on from: it is written at the 100th iteration")
    inversion = MyopicDeconvolution(
        observation.aperture,
        observation.grid,
        options.n_modes,
        r0=observation.r0 if options.r0 is None else options.r0,
        outer_scale=observation.outer_scale if options.outer_scale is None else options.outer_scale,
        readout_noise=observation.readout_noise,
        wavelengths=options.wavelengths or None,
        weights=options.weights or None,
        static_modes=options.static_modes,
        prior=TotalVariation(options.tv_weight),
        aberration_prior=options.prior,
        max_iterations=options.max_iterations,
        tolerance=options.tolerance,
    )
    with new_run("restore", options) as output:
        state = output.directory / CHECKPOINT
        if checkpoint is not None:
            shutil.copyfile(checkpoint, state)
        result = inversion.restore(
            observation.frames,
            valid=observation.valid,
            n_samples=options.n_samples,
            checkpoint=state,
            callback=output.callback,
        )
        result.save(output.directory / "restored.npz")
        save_restored(output.directory / "restored.fits", result, observation, history(options, result))
        table = metrics(observation, result)
        write_json(output.directory / "metrics.json", table)
        _log(observation, result, table, output)
        output.summary.append(result.summary())


def load_observation(options: Options) -> Observation:
    """The stack, with what the options say in place of what its file says. Raises ValueError for what is missing."""
    stack = list(options.stack)
    if not stack:
        raise ValueError("there is no stack to restore: give an .npz file or FITS files")
    if stack[0].suffix.lower() != ".npz":
        return _from_fits(stack, options)
    if len(stack) > 1:
        raise ValueError(f"{len(stack)} stacks are given: of .npz files one is restored at a time")
    for item in dataclasses.fields(FITSOptions):
        if getattr(options, item.name) != item.default:
            raise ValueError(f"--{item.name.replace('_', '-')} is for FITS files; {stack[0]} is none")
    observation = Observation.load(stack[0])
    grid, scale = observation.grid, options.pixel_scale_arcsec
    changes: dict[str, Any] = {
        "grid": Grid(
            grid.n_pixels, scale * ARCSEC if scale else grid.pixel_scale, options.wavelength or grid.wavelength
        )
    }
    if options.mask is not None:
        changes["aperture"] = load_aperture(options)
    if options.readout_noise is not None:
        changes["readout_noise"] = options.readout_noise
    return dataclasses.replace(observation, **changes)


def _from_fits(stack: list[Path], options: Options) -> Observation:
    """Read FITS files; what their header lacks is named as the option of the command line that supplies it."""
    aperture = load_aperture(options)
    scale = options.pixel_scale_arcsec
    given = {item.name: getattr(options, item.name) for item in dataclasses.fields(FITSOptions)}
    given |= {"wavelength": options.wavelength, "readout_noise": options.readout_noise}
    try:
        return read_observation(stack, aperture, pixel_scale=None if scale is None else scale * ARCSEC, **given)
    except ValueError as error:
        message = str(error).replace("give pixel_scale [rad]", "give --pixel-scale-arcsec [arcsec]")
        for name in given:
            message = message.replace(f"give {name}", f"give --{name.replace('_', '-')}")
        raise ValueError(message) from error


def metrics(observation: Observation, result: RestorationResult) -> dict[str, Any]:
    """What metrics.json says: the fit, the search, and the score where the truth is known."""
    table: dict[str, Any] = {
        "chi_square": float(result.chi_square.mean()),
        "worst_frame_chi_square": float(result.chi_square.max()),
        "noise": result.noise,
        "r0": result.r0,
        "photons_per_frame": float(result.object.sum()),
        "cost": float(result.cost[-1]),
        "iterations": len(result.cost),
        "evaluations": result.n_evaluations,
        "converged": result.converged,
        "seconds": result.seconds,
    }
    if observation.object is not None:
        cutoff = observation.grid.cutoff(observation.aperture.mask_diameter)
        table["score"] = relative_error(result.object, observation.object, cutoff)
        table["ssim"] = ssim(result.object, observation.object, cutoff)
        table["mean_frame_score"] = relative_error(observation.frames.mean(0), observation.object, cutoff)
    return table


def _log(observation: Observation, result: RestorationResult, table: dict[str, Any], output: Run) -> None:
    """Figures, and the final metrics for TensorBoard."""
    logger, scale = output.logger, observation.grid.pixel_scale
    logger.figure(
        "restored",
        restored_figure(result.object, observation.frames, result.residuals, scale, deviation=result.object_std),
    )
    logger.figure("cost", viz.history_figure({"restoration": result.cost.tolist()}, "cost"))
    if observation.object is not None:
        cutoff = observation.grid.cutoff(observation.aperture.mask_diameter)
        pictures = {"stack": (observation.frames[0], result.object)}
        logger.figure("comparison", viz.comparison_figure(observation.object, pictures, cutoff, scale))
    for name, value in table.items():
        logger.scalar(f"comparison/restored/{name}", float(value))


def history(options: Options, result: RestorationResult) -> list[str]:
    """What was done, for a FITS header: version, files, options that are not at their default, and what came out."""
    default = stored(Options())
    changed = {name: value for name, value in stored(options).items() if name != "stack" and value != default[name]}
    return [
        f"torchmask {__version__}",
        *(f"stack {path}" for path in options.stack),
        *(f"{name} = {value}" for name, value in changed.items()),
        *result.summary().splitlines(),
    ]
