"""`torchmask restore`: restore the images of one or several stacks of short exposures."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import tyro

from torchmask import __version__
from torchmask.cli.agreement import exposure_in_tau0
from torchmask.cli.band_options import BandOptions, band_of_instrument
from torchmask.cli.calibrate import read_star, require_one_pixel, write_calibration
from torchmask.cli.config import stored
from torchmask.cli.oifits import OIFITSOptions, measure_frames, write_frames
from torchmask.cli.options import RunOptions, WorkerOptions
from torchmask.cli.outcome import log_outcome, pixel_text, summarise_outcome, write_outcome
from torchmask.cli.program import NOT_EXPLAINED
from torchmask.cli.resume import find_checkpoint, resumed
from torchmask.cli.run import CHECKPOINT, new_run
from torchmask.cli.stacks import StackOptions, group_files, read_stack, require_fine_pixels
from torchmask.folders import new_folder, require_new
from torchmask.instrument.instrument import Instrument
from torchmask.interferometry.calibration import MaskCalibration
from torchmask.interferometry.observables import Observables
from torchmask.io import write_json
from torchmask.numbers import require_wavelength
from torchmask.observation import Observation
from torchmask.restoration.background import Background
from torchmask.restoration.many import restore_in_turn
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.result import RestorationResult
from torchmask.restoration.variation import TotalVariation

REFINEMENTS = {"if-seen": None, "yes": True, "no": False}
SKIES = {
    "if-seen": Background.IF_SEEN,
    "per-frame": Background.PER_FRAME,
    "common": Background.COMMON,
    "none": Background.NONE,
}


@dataclass(frozen=True, kw_only=True)
class Options(BandOptions, StackOptions, OIFITSOptions, WorkerOptions, RunOptions):
    """Restore an image from a stack of short exposures with unknown aberrations (myopic deconvolution).

    A stack is an .npz file, such as `torchmask simulate` writes, or a FITS cube; several are restored in parallel and
    independently. With --join all FITS files, cubes or images of one filter and orientation, form one stack. FITS files
    need --mask, and so do .npz files with nothing but frames [electrons], which need --wavelength and
    --pixel-scale-arcsec too. The command writes restored.fits (with the sky coordinates of the input, and the settings
    in HISTORY), restored.npz, figures, metrics.json, config.yaml, the log and, with --instrument, instrument.json to a
    new folder, or for several stacks to a subfolder for each. The last line says whether the restoration explains the
    frames; the exit status is 3 if it does not.
    """

    stacks: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Stacks of exposures, .npz or .fits."""
    join: tyro.conf.FlagCreatePairsOff[bool] = False
    """Treat all FITS files together as one stack."""
    r0: float | None = None
    """Fried parameter of the turbulence at the wavelength [m]; None: estimated."""
    outer_scale: float | None = None
    """Outer scale of the turbulence [m]; None: 20 mask diameters."""
    n_modes: int | None = None
    """Number of Zernike modes per hole, from Noll mode 1 (piston); None: 6, or 231 for a full pupil, and more in a
    last descent unless a mask's frames are faint. Those of a mask after the sixth are found at the end."""
    static_modes: int = 0
    """Number of Zernike modes per hole for aberrations that all frames share, such as those of the telescope."""
    sky: float | Literal["if-seen", "per-frame", "common", "none"] = "if-seen"
    """Known sky [electrons per pixel]; or per-frame to fit a constant in each frame, common to fit one for all frames,
    none if there is no sky; if-seen: per-frame if the frames show a sky."""
    wind: float | None = None
    """Speed of the wind [m/s]; with --r0 and the exposure time it says how much turbulence changes during a frame, for
    which the model then allows; None: that of --instrument, or else frames are snapshots."""
    star: Path | None = None
    """Exposures of a star through the same mask, .npz or .fits, which give its geometry (`torchmask calibrate`)."""
    estimate_pixel: tyro.conf.FlagCreatePairsOff[bool] = False
    """Estimate the sensitive fraction of a pixel on --star, instead of --pixel-fill."""
    refine_geometry: Literal["if-seen", "yes", "no"] = "if-seen"
    """Estimate a rotation and magnification of the mask with the image; if-seen: if the frames show an error in it."""
    prior: bool = True
    """Weight the aberrations by their von Karman statistics."""
    tv_weight: float = 1.0
    """Weight of the total variation of the object, dimensionless; a larger weight gives a smoother image. At the end it
    is multiplied by what suits the object: its slopes say by what, or in bright light the frames, if that is less."""
    max_iterations: int = 4000
    """Maximum number of iterations over all starts, each of at most 1000; a full pupil averages three starts, unless
    its phases are retrieved before."""
    tolerance: float = 1e-4
    """Converged when 100 iterations lower the cost by less than this fraction; behind a mask, 0.001 is enough where
    bright frames are explained, as another descent follows."""
    n_samples: int = 0
    """Number of posterior samples for the standard deviations of the image (ERR in restored.fits): 8 suffice; 0:
    none."""
    resume: Path | None = None
    """Folder of an interrupted run, which is continued with its options from its last checkpoint (every 100 iterations
    have one)."""

    @classmethod
    def of_instrument(cls, known: Instrument) -> Options:
        """Return the options that an instrument sets: its band. It completes what the exposures say."""
        return cls(**band_of_instrument(known))

    @staticmethod
    def from_v01(values: Mapping[str, Any]) -> dict[str, Any]:
        """Translate a config of version 0.1, in which all files were one stack."""
        values = dict(values)
        if "stack" in values:
            values["stacks"] = values.pop("stack")
            values["join"] = isinstance(values["stacks"], list) and len(values["stacks"]) > 1
        return values


def run(options: Options) -> int:
    """Restore and write the images; return the exit status, which says whether the frames are explained."""
    stacks = group_files(options.stacks, options.join)
    if not stacks:
        raise ValueError("there is no stack to restore: give .npz or FITS files")
    if options.out is not None:
        require_new(options.out)  # said before the star is measured
    if options.resume is not None and len(stacks) > 1:
        raise ValueError(f"--resume continues one stack, but {len(stacks)} are given")
    if options.wavelength is not None:
        require_wavelength("--wavelength", options.wavelength)
        options.require_its_wavelength(options.wavelength)
    if options.oifits and options.bandwidth is None:
        options = replace(options, bandwidth=options.told_width())
    require_one_pixel(options, options.estimate_pixel)
    if options.estimate_pixel and options.star is None:
        raise ValueError("--estimate-pixel needs a star, whose size is known: give --star, or --pixel-fill")
    star = None if options.star is None else read_star(options.star, options, options.estimate_pixel)
    if len(stacks) > 1:
        return restore_several(stacks, options, star)
    (files,) = stacks.values()
    return restore_one(files, options, star)


def read_calibrated(files: Sequence[Path], options: Options, star: MaskCalibration | None) -> Observation:
    """Read one stack, with the mask's geometry, and pixels if asked for, as measured on the star if there is one."""
    observation = read_stack(files, options)
    require_fine_pixels(observation, options, files[0])
    if star is None:
        return observation
    pixel = star.pixel if options.estimate_pixel else observation.pixel
    return dataclasses.replace(observation, aperture=star.aperture, pixel=pixel)


def restore_one(files: Sequence[Path], options: Options, star: MaskCalibration | None) -> int:
    """Restore one stack on all cores, with a checkpoint for --resume; return the exit status."""
    observation = read_calibrated(files, options, star)
    if options.resume is not None:
        find_checkpoint(options.resume)  # said before a folder is made
    method = deconvolution(observation, options)
    observables = measure_frames(observation, options, known_sky(options))
    with new_run("restore", options) as output:
        output.keep_instrument(options.known_instrument())
        state = output.directory / CHECKPOINT
        with resumed(options.resume, state, "restore", options):
            result = method.restore(
                observation.frames,
                valid=observation.valid,
                errors=observation.errors,
                n_samples=options.n_samples,
                checkpoint=state,
                callback=output.callback,
            ).with_frame_numbers(observation.frame_numbers)
        if star is not None and options.star is not None:
            write_calibration(output, star, [options.star], observation.grid.wavelength)
        output.summary.extend(
            write_frames(output.directory, observables, observation, options, result, known_sky(options))
        )
        table = write_outcome(output.directory, observation, result, history(files, observation, result, options))
        log_outcome(observation, result, table, output.logger)
        output.logger.conclude(verdict=table["verdict"], clouded_frames=table["clouded_frames"])
        output.summary.append(summarise_outcome(result, table, options.sky))
    return 0 if table["verdict"]["explained"] else NOT_EXPLAINED


def restore_several(stacks: Mapping[str, Sequence[Path]], options: Options, star: MaskCalibration | None) -> int:
    """Restore each stack on one core, into a folder of its name; report failures when all have ended.

    Returns the exit status, which is that of the worst verdict.
    """
    observations: dict[str, Observation] = {}
    methods: list[MyopicDeconvolution] = []
    observables: dict[str, Observables | None] = {}
    failures: dict[str, Exception] = {}
    for name, files in stacks.items():
        try:
            observations[name] = read_calibrated(files, options, star)
            method = deconvolution(observations[name], options)
            observables[name] = measure_frames(observations[name], options, known_sky(options))
            methods.append(method)
        except (ValueError, OSError) as error:
            observations.pop(name, None)
            failures[name] = error
    if not observations:
        raise _failed(failures, len(stacks))
    with new_run("restore", options) as output:
        output.keep_instrument(options.known_instrument())
        names, seen = list(observations), list(observations.values())
        if star is not None and options.star is not None:
            write_calibration(output, star, [options.star], seen[0].grid.wavelength)
        keywords = options.keywords(output.callback)
        tables: dict[str, Any] = {}
        for number, result in restore_in_turn(methods, seen, n_samples=options.n_samples, **keywords):
            name = names[number]
            if isinstance(result, Exception):
                failures[name] = result
                continue
            folder = new_folder(output.directory / name)
            tables[name] = write_outcome(
                folder, seen[number], result, history(stacks[name], seen[number], result, options)
            )
            output.summary.extend(
                write_frames(folder, observables[name], seen[number], options, result, known_sky(options))
            )
            log_outcome(seen[number], result, tables[name], output.logger, f"{name}/")
            output.summary.append(f"{name}: {summarise_outcome(result, tables[name], options.sky)}")
        verdicts = {name: table["verdict"] for name, table in tables.items()}
        clouded = {name: table["clouded_frames"] for name, table in tables.items()}
        output.logger.conclude(verdicts=verdicts, clouded_frames=clouded)
        lacking = [name for name, verdict in verdicts.items() if not verdict["explained"]]
        told = f"{len(verdicts) - len(lacking)} of {len(stacks)} stacks are explained"
        output.summary.append(told + (f"; not explained: {', '.join(lacking)}" if lacking else ""))
        tables |= {name: {"error": str(error)} for name, error in failures.items()}
        write_json(output.directory / "metrics.json", tables)
        if failures:
            raise _failed(failures, len(stacks))
    return NOT_EXPLAINED if lacking else 0


def _failed(failures: Mapping[str, Exception], n_stacks: int) -> ValueError:
    told = "; ".join(f"{name}: {error}" for name, error in failures.items())
    return ValueError(f"{len(failures)} of {n_stacks} stacks failed: {told}")


def deconvolution(observation: Observation, options: Options) -> MyopicDeconvolution:
    """Return the restoration method for a stack. Raises ValueError for settings that it does not allow."""
    return MyopicDeconvolution(
        observation.aperture,
        observation.grid,
        options.n_modes,
        r0=options.r0,
        outer_scale=options.outer_scale,
        readout_noise=observation.readout_noise,
        background=SKIES[options.sky] if isinstance(options.sky, str) else known_sky(options),
        **options.band(observation.grid.wavelength),
        static_modes=options.static_modes,
        pixel=observation.pixel,
        exposure_tau0=motion(observation, options),
        refine_geometry=REFINEMENTS[options.refine_geometry],
        prior=TotalVariation(options.tv_weight),
        aberration_prior=options.prior,
        max_iterations=options.max_iterations,
        tolerance=options.tolerance,
    )


def motion(observation: Observation, options: Options) -> float:
    """Return the exposure time of a frame [tau0]; 0 where an instrument tells a wind, but the model has no motion."""
    has_motion = options.prior and not observation.aperture.is_full
    if options.wind is None and not has_motion:
        return 0.0
    if options.wind is not None and observation.aperture.is_full:
        raise ValueError("--wind is for masks: the model of a full pupil does not move during a frame, leave it out")
    known = options.known_instrument()
    return exposure_in_tau0(observation, known, options.exposure_time, options.wind, options.r0)


def known_sky(options: Options) -> float:
    """Return the sky of --sky [electrons per pixel]; 0 if it is to be estimated. ValueError if it is no light."""
    if isinstance(options.sky, str):
        return 0.0
    if not (math.isfinite(options.sky) and options.sky >= 0):
        raise ValueError(f"--sky is {options.sky:g}: it must be finite and at least 0, in electrons per pixel")
    return options.sky


def history(files: Sequence[Path], observation: Observation, result: RestorationResult, options: Options) -> list[str]:
    """Return the HISTORY of a FITS header: version, files, options other than their defaults, pixels, and outcome."""
    default = stored(Options())
    changed = {name: value for name, value in stored(options).items() if value != default[name]}
    return [
        f"torchmask {__version__}",
        *(f"stack {path}" for path in files),
        *(f"{name} = {value}" for name, value in changed.items() if name not in ("stacks", "join")),
        f"pixels: {pixel_text(observation)}",
        *result.summary().splitlines(),
    ]
