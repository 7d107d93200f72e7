"""Restoration of several stacks in parallel, one on each core of a machine or a cluster."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
from torch import Tensor

from torchmask.design.workers import require_backend, run_side_by_side
from torchmask.observation import Observation
from torchmask.record import Callback, Record
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.result import RestorationResult


def restore_many(
    method: MyopicDeconvolution | Sequence[MyopicDeconvolution],
    stacks: Sequence[Tensor | Observation],
    *,
    n_samples: int = 0,
    seed: int = 0,
    backend: str = "loky",
    n_workers: int | None = None,
    callback: Callback | None = None,
) -> list[RestorationResult | Exception]:
    """Restore every stack, each on one core; an error in one does not affect the others.

    Parameters
    ----------
    method : MyopicDeconvolution or sequence of MyopicDeconvolution
        One method for all stacks, or one for each.
    stacks : sequence
        Frames (T, H, W) [electrons], or observations, whose valid pixels, errors and frame numbers are used.
    n_samples : int
        Number of posterior samples, as for `MyopicDeconvolution.restore`.
    seed : int
        Seed of random starts, as for `MyopicDeconvolution.restore`, the same for all stacks. Posterior samples have
        one of their own.
    backend : {"loky", "ray"}
        Processes on this machine (extra `design`), or a Ray cluster (extra `cluster`).
    n_workers : int, optional
        Number of stacks restored at a time, one per core by default. With 1 and "loky" no process is started.
    callback : callable, optional
        Receives a `Record` of stage "stacks" after each stack, with the number of finished stacks, and the index,
        chi-square and iterations of the latest one, NaN if it failed.

    Returns
    -------
    list
        In the order of `stacks`, a `RestorationResult` or the exception that the restoration raised.

    Raises
    ------
    ValueError
        Before any work, if the backend is unknown or not installed, `n_workers` is below 1, the numbers of methods and
        stacks differ, or `stacks` is a single tensor or array.
    TypeError
        Before any work, if `stacks` is a single observation, or `method` is no method of restoration.

    Examples
    --------
    >>> import torch
    >>> from torchmask.grid import Grid
    >>> from torchmask.optics.aperture import SparseAperture
    >>> mask = SparseAperture([[0.0, 0.3], [-0.3, -0.2], [0.3, -0.2]], 0.2, 1.0)
    >>> method = MyopicDeconvolution(mask, Grid.nyquist(1.0, 550e-9, 32), n_modes=3, max_iterations=3)
    >>> x = torch.arange(32.0) - 16; frames = (20 + 1000 * torch.exp(-(x[:, None] ** 2 + x**2) / 20)).expand(4, 32, 32)
    >>> frames = torch.poisson(frames, generator=torch.Generator().manual_seed(0))
    >>> one, other = restore_many(method, [frames, -frames], n_workers=1)
    >>> one.object.shape, type(other)
    (torch.Size([32, 32]), <class 'ValueError'>)
    """
    turns = restore_in_turn(
        method, stacks, n_samples=n_samples, seed=seed, backend=backend, n_workers=n_workers, callback=callback
    )
    results = dict(turns)
    return [results[number] for number in range(len(stacks))]


def restore_in_turn(
    method: MyopicDeconvolution | Sequence[MyopicDeconvolution],
    stacks: Sequence[Tensor | Observation],
    *,
    n_samples: int = 0,
    seed: int = 0,
    backend: str = "loky",
    n_workers: int | None = None,
    callback: Callback | None = None,
) -> Iterator[tuple[int, RestorationResult | Exception]]:
    """Yield the index and the result of each stack as it finishes; otherwise the same as `restore_many`."""
    require_backend(backend, n_workers)
    if isinstance(stacks, Tensor | np.ndarray):
        raise ValueError(
            f"stacks is one {'tensor' if isinstance(stacks, Tensor) else 'array'} of shape {tuple(stacks.shape)}: give "
            "a list of stacks (T, H, W), or use method.restore for a single one"
        )
    if isinstance(stacks, Observation):
        raise TypeError("stacks is one Observation: give a list of them, such as [observation]")
    methods = [method] * len(stacks) if not isinstance(method, Sequence) else list(method)
    for one in methods:
        if not isinstance(one, MyopicDeconvolution):
            raise TypeError(f"method is a {type(one).__name__}: it must be a MyopicDeconvolution, or a list of them")
    if len(methods) != len(stacks):
        raise ValueError(
            f"{len(methods)} methods are given for {len(stacks)} stacks: give one for all, or one for each"
        )
    restore = partial(_restore, n_samples=n_samples, seed=seed)
    tasks = dict(enumerate(zip(methods, stacks, strict=True)))
    for step, outcome in enumerate(run_side_by_side(restore, tasks, backend, n_workers), 1):
        result = outcome.value if outcome.error is None else outcome.error
        if callback is not None:
            callback(Record("stacks", step, len(tasks), _numbers(outcome.key, result)))
        yield outcome.key, result


def _restore(task: tuple[MyopicDeconvolution, Tensor | Observation], n_samples: int, seed: int) -> RestorationResult:
    method, stack = task
    if isinstance(stack, Observation):
        result = method.restore(stack.frames, valid=stack.valid, errors=stack.errors, n_samples=n_samples, seed=seed)
        return result.with_frame_numbers(stack.frame_numbers)
    return method.restore(stack, n_samples=n_samples, seed=seed)


def _numbers(number: int, result: RestorationResult | Exception) -> dict[str, float]:
    if isinstance(result, Exception):
        return {"stack": number, "chi_square": float("nan"), "iterations": float("nan")}
    return {"stack": number, "chi_square": float(result.chi_square.mean()), "iterations": len(result.cost)}
