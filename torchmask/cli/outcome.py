"""Write the results of a restoration: the image, its metrics, figures and a warning of clouds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchmask.cli.report import log_cost, restored_figure
from torchmask.data.light import clouded_frames
from torchmask.data.restored import save_restored
from torchmask.io import write_json
from torchmask.metrics import relative_error, ssim
from torchmask.observation import Observation
from torchmask.restoration.result import RestorationResult
from torchmask.tracking import RunLogger
from torchmask.viz.comparison import comparison_figure

POINTS = "points"  # pixels without a size


def write_outcome(
    folder: Path, observation: Observation, result: RestorationResult, history: Sequence[str]
) -> dict[str, Any]:
    """Write restored.npz, restored.fits and metrics.json; return the numbers of the last.

    `history` becomes the HISTORY of restored.fits.
    """
    result.save(folder / "restored.npz")
    save_restored(folder / "restored.fits", result, observation, history)
    table = metrics(observation, result)
    write_json(folder / "metrics.json", table)
    return table


def metrics(observation: Observation, result: RestorationResult) -> dict[str, Any]:
    """Return the content of metrics.json: fit, search, clouds, and the score if the truth is known."""
    table: dict[str, Any] = {
        "chi_square": float(result.chi_square.mean()),
        "worst_frame_chi_square": float(result.chi_square.max()),
        "noise": result.noise,
        "sky": result.sky,
        "r0": result.r0,
        "rotation": result.rotation,
        "magnification": result.magnification,
        "pixel": pixel_text(observation),
        "photons_per_frame": float(result.object.sum()),
        "cost": float(result.cost[-1]),
        "iterations": len(result.cost),
        "evaluations": result.n_evaluations,
        "converged": result.converged,
        "clouded_frames": clouded_frames(observation),
        "verdict": None if result.verdict is None else result.verdict.to_json(),
        "seconds": result.seconds,
    }
    if observation.object is not None:
        cutoff = observation.grid.cutoff(observation.aperture.mask_diameter)
        table["score"] = relative_error(result.object, observation.object, cutoff)
        table["ssim"] = ssim(result.object, observation.object, cutoff)
        table["mean_frame_score"] = relative_error(observation.frames.mean(0), observation.object, cutoff)
    return table


def pixel_text(observation: Observation) -> str:
    """Return the response of the detector's pixels in words."""
    return POINTS if observation.pixel is None else str(observation.pixel)


def log_outcome(
    observation: Observation, result: RestorationResult, table: Mapping[str, Any], logger: RunLogger, prefix: str = ""
) -> None:
    """Draw the figures and log the final metrics to TensorBoard; `prefix` distinguishes stacks."""
    scale, sky = observation.grid.pixel_scale, observation.sky_matrix
    logger.figure(
        f"{prefix}restored",
        restored_figure(
            *(result.object, observation.frames, result.residuals, scale),
            first_frame=observation.frame_numbers[0],
            deviation=result.object_std,
            sky=sky,
        ),
    )
    log_cost(f"{prefix}cost", {"restoration": result.cost.tolist()}, logger)
    if observation.object is not None:
        cutoff = observation.grid.cutoff(observation.aperture.mask_diameter)
        pictures = {"stack": (observation.frames[0], result.object)}
        logger.figure(f"{prefix}comparison", comparison_figure(observation.object, pictures, cutoff, scale, sky))
    for name, value in table.items():
        if name not in ("pixel", "verdict", "clouded_frames"):
            logger.scalar(f"summary/{prefix}{name}", float(value))


def summarise_outcome(result: RestorationResult, table: Mapping[str, Any], sky: float | str = "none") -> str:
    """Return the text to print: a warning of clouds, pixels, and the result, which ends in its verdict.

    `sky` is the option --sky. Where it leaves the choice to the frames and none was fitted, the text says so.
    """
    clouded = table["clouded_frames"]
    told = f"frames {clouded} have less than half the light of the others, as through a cloud: --skip leaves them out\n"
    pixels = "" if table["pixel"] == POINTS else f"pixels: {table['pixel']}\n"
    absent = "no sky was assumed: --sky per-frame fits one in each frame, if you expect one\n"
    first, _, rest = result.summary().partition("\n")  # what was restored comes before what was assumed
    summary = f"{first}\n{absent if sky == 'if-seen' and result.sky == 0 else ''}{rest}"
    return (told if clouded else "") + pixels + summary
