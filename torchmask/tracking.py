"""The log of a run, as TensorBoard events and as plain files.

A run folder contains

    events.out.tfevents...   scalars, images, figures, text and hyperparameters for TensorBoard
    VARIANT/events...        curves and images of stages "KIND/VARIANT", as a TensorBoard run of their own
    metrics.jsonl            one JSON object per line: stage, step, n_steps, seconds, scalars
    config.json              configuration of the run
    environment.json         command, seed, versions
    status.json              running, finished, interrupted or failed, and the conclusion
    checkpoints/STAGE.npz    last state of each stage
    NAME.png                 figures
"""

from __future__ import annotations

import io
import json
import math
import platform
import sys
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

import torchmask
from torchmask.folders import FileNames, new_folder
from torchmask.io import as_array, as_tensor, atomic_write, extra, save_npz, to_json, write_json
from torchmask.record import Record
from torchmask.viz.figures import stretch

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_IMAGES_PER_STAGE = 8  # of each array, besides the last one; TensorBoard shows 10 of a tag
_SMALLEST_IMAGE = 16  # pixels on a side; smaller arrays are tables of numbers
_CHECKPOINT_INTERVAL = 5.0  # s
_FLUSH_INTERVAL = 10  # s between writes of TensorBoard's events
_PACKAGES = ("torch", "numpy", "scipy", "cma", "scikit-image", "kornia", "astropy", "trimesh")


class RunLogger:
    """Logger of a run to its own folder; a callback for every algorithm of torchmask and for any training loop.

    As a context manager it always closes the log properly, and records how the run ended.

    Parameters
    ----------
    directory : str or Path
        Run folder, which must not exist yet.
    seed : int, optional
        Random seed of the run, to be logged.

    Raises
    ------
    ValueError
        If `directory` exists (the message suggests a free name) or cannot be created, more is logged after the end, an
        array is called "step", or a stage, variant or figure would share the file of another or of the run itself.

    Notes
    -----
    `logger(record)` writes the scalars of a `Record` at every step. Two-dimensional arrays of at least 16 x 16 become
    images, up to 8 times in a stage and at its end. All arrays are saved as a checkpoint every 5 seconds and at the
    end. `writer` is the SummaryWriter, for anything else that TensorBoard can show.

    TensorBoard gives each run one colour and draws runs together that have the same tags. The stages
    "restoration/mask" and "restoration/full" therefore become runs `mask` and `full` with the tag "restoration/cost".

    Examples
    --------
    >>> import tempfile, torch
    >>> x = torch.ones(3, requires_grad=True)
    >>> optimizer = torch.optim.SGD([x], lr=0.1)
    >>> with RunLogger(tempfile.mkdtemp() + "/mine", seed=0) as log:
    ...     for step in range(5):
    ...         loss = (x**2).sum()
    ...         optimizer.zero_grad(); loss.backward(); optimizer.step()
    ...         log(Record("fit", step + 1, 5, {"loss": loss.item()}, {"x": x.detach()}))
    """

    def __init__(self, directory: str | Path, *, seed: int | None = None) -> None:
        from torch.utils.tensorboard import SummaryWriter  # may not be installed, so imported before the folder is made

        self.directory: Path = new_folder(directory)
        self._start = time.monotonic()
        self._last: dict[str, Record] = {}
        self._unsaved: set[str] = set()
        self._last_checkpoint = self._start
        self._image_steps: dict[str, int] = {}
        self._session_end: Any = None
        self._conclusion: dict[str, Any] = {}
        self._new_writer = partial(SummaryWriter, flush_secs=_FLUSH_INTERVAL)
        self.writer: Any = self._new_writer(str(self.directory))
        self._writers: dict[str, Any] = {"": self.writer}  # of stages KIND/VARIANT, by VARIANT
        self._names = FileNames("metrics.jsonl", "config.json", "environment.json", "status.json", "checkpoints")
        self._checkpoint_names = FileNames()
        self._metrics = open(self.directory / "metrics.jsonl", "x", encoding="utf-8", buffering=1)  # noqa: SIM115
        self._write_status("running")
        self._log_json("environment", _environment(seed))

    def __call__(self, record: Record) -> None:
        """Log one step of an algorithm."""
        if record.arrays:
            self._checkpoint_names.of(record.stage, ".npz")
        if "step" in record.arrays:
            raise ValueError("an array is called 'step', as is the step's number in a checkpoint: rename the array")
        self._write_scalars(record.stage, record.step, record.scalars, n_steps=record.n_steps)
        if not record.arrays:
            return
        arrays = {name: _copy(values) for name, values in record.arrays.items()}  # the algorithm goes on
        self._last[record.stage] = Record(record.stage, record.step, record.n_steps, record.scalars, arrays)
        self._unsaved.add(record.stage)
        self._log_images(self._last[record.stage], every=math.ceil(record.n_steps / _IMAGES_PER_STAGE))
        if time.monotonic() - self._last_checkpoint >= _CHECKPOINT_INTERVAL:
            self._checkpoint()

    def log_config(self, config: Any) -> None:
        """Log a configuration (dataclass or mapping) to config.json, as text, and as hyperparameters for HPARAMS.

        TensorBoard's HPARAMS tab lists the run with all its scalars, even if it is interrupted. Call it once per run: a
        second call raises ValueError. Values that JSON cannot represent raise TypeError. Then nothing is written.
        """
        from torch.utils.tensorboard.summary import hparams

        values = to_json(config)
        self._log_json("config", values)
        # Not SummaryWriter.add_hparams, which writes a second run, and a list of hyperparameters and metrics that hides
        # those of later runs. Without that list TensorBoard collects the hyperparameters and scalars of every run.
        _, start, self._session_end = hparams(_flatten(values), {})
        self.writer._get_file_writer().add_summary(start)

    def scalar(self, tag: str, value: float, step: int = 0) -> None:
        """Log one number under "kind/name" or "kind/variant/name"; "summary/..." stands below the curves."""
        stage, _, name = tag.rpartition("/")
        self._write_scalars(stage or "scalars", step, {name: value})

    def image(self, tag: str, image: Any, step: int = 0) -> None:
        """Log an image (H, W), stretched by `viz.stretch`; tags as in `scalar`. Raises ValueError for other shapes."""
        values = as_array(_copy(image))
        if values.ndim != 2:
            raise ValueError(f"image {tag} has shape {values.shape}: it must be (rows, columns)")
        stage, _, name = tag.rpartition("/")
        writer, kind = self._place(stage or "images")
        writer.add_image(f"{kind}/{name}", (255 * stretch(values) + 0.5).astype(np.uint8), step, dataformats="HW")

    def figure(self, name: str, figure: Figure, step: int = 0) -> None:
        """Log a figure and write it to NAME.png in the run folder, replacing an earlier one of that name."""
        writer, kind = self._place("figures")
        path = self.directory / self._names.of(name, ".png")
        with extra("experiments"):
            import matplotlib.image

        picture = io.BytesIO()
        figure.savefig(picture, format="png", dpi=160)
        with atomic_write(path, replace=True) as file:
            file.write(picture.getvalue())
        picture.seek(0)
        pixels = matplotlib.image.imread(picture)[..., :3]
        writer.add_image(f"{kind}/{name}", (255 * pixels + 0.5).astype(np.uint8), step, dataformats="HWC")

    def text(self, tag: str, markdown: str, step: int = 0) -> None:
        """Log a text, formatted as Markdown."""
        self._place("")[0].add_text(tag, markdown, step)

    def table(self, tag: str, rows: Sequence[Mapping[str, Any]], step: int = 0) -> None:
        """Log rows, whose keys are the columns, as a table. Raises ValueError if there is no row or columns differ."""
        columns = list(rows[0]) if rows else []
        if not columns or any(list(row) != columns for row in rows):
            raise ValueError(f"table {tag} needs rows that all have the same columns; the first row has {columns}")
        cells = ([f"{value:.4g}" if isinstance(value, float) else str(value) for value in row.values()] for row in rows)
        lines = [columns, ["---"] * len(columns), *cells]
        self.text(tag, "\n".join(f"| {' | '.join(line)} |" for line in lines), step)

    def conclude(self, **values: Any) -> None:
        """Add conclusions such as a verdict to status.json. Raises TypeError for values that JSON cannot represent."""
        self._conclusion |= to_json(values)

    def close(self, status: str = "finished", error: str | None = None) -> None:
        """Write the last states and images and how the run ended. Further calls do nothing."""
        if self._metrics.closed:
            return
        try:
            for record in self._last.values():
                self._log_images(record, every=1)
            self._checkpoint()
            if status == "finished" and self._session_end is not None:
                self.writer._get_file_writer().add_summary(self._session_end)
        finally:
            self._metrics.close()
            for writer in self._writers.values():
                writer.close()
            self._write_status(status, error)

    def __enter__(self) -> RunLogger:
        return self

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if error is None:
            self.close()
        elif isinstance(error, KeyboardInterrupt):
            self.close("interrupted")
        else:
            self.close("failed", f"{type(error).__name__}: {error}")

    def _log_json(self, name: str, values: Any) -> None:
        write_json(self.directory / f"{name}.json", values)
        self.text(f"run/{name}", f"```json\n{json.dumps(values, indent=2)}\n```")

    def _write_scalars(self, stage: str, step: int, scalars: Mapping[str, float], **more: int) -> None:
        values = {name: float(_copy(value)) for name, value in scalars.items()}
        seconds = round(time.monotonic() - self._start, 3)
        writer, kind = self._place(stage)
        row = to_json({"stage": stage, "step": step, **more, "seconds": seconds, "scalars": values})
        self._metrics.write(json.dumps(row, allow_nan=False) + "\n")  # line-buffered: on disk at once
        for name, value in values.items():
            writer.add_scalar(f"{kind}/{name}", value, step)

    def _place(self, stage: str) -> tuple[Any, str]:
        """Return the writer of a stage "KIND/VARIANT", and KIND; without a variant, that of the whole run."""
        if self._metrics.closed:
            raise ValueError(f"this RunLogger of {self.directory} has been closed: log before that, or start another")
        kind, _, variant = stage.partition("/")
        if variant not in self._writers:
            self._writers[variant] = self._new_writer(str(self.directory / self._names.of(variant)))
        return self._writers[variant], kind

    def _log_images(self, record: Record, every: int) -> None:
        for name, values in record.arrays.items():
            if values.ndim != 2 or min(values.shape) < _SMALLEST_IMAGE or values.is_complex():
                continue
            tag = f"{record.stage}/{name}"
            if tag not in self._image_steps or record.step - self._image_steps[tag] >= every:
                self._image_steps[tag] = record.step
                self.image(tag, values, record.step)

    def _checkpoint(self) -> None:
        for stage in sorted(self._unsaved):
            record = self._last[stage]
            (folder := self.directory / "checkpoints").mkdir(exist_ok=True)
            path = folder / self._checkpoint_names.of(stage, ".npz")
            save_npz(path, {**record.arrays, "step": record.step}, replace=True)
        self._unsaved.clear()
        self._last_checkpoint = time.monotonic()

    def _write_status(self, status: str, error: str | None = None) -> None:
        seconds = round(time.monotonic() - self._start, 3)
        state = {"status": status, "seconds": seconds, "error": error, **self._conclusion}
        write_json(self.directory / "status.json", state, replace=True)


def read_metrics(directory: str | Path) -> list[dict[str, Any]]:
    """Return the rows of a run's metrics.jsonl, without a last line that a killed run left unfinished.

    Raises ValueError if the file is missing or another line is damaged.
    """
    path = Path(directory) / "metrics.jsonl"
    if not path.is_file():
        raise ValueError(f"there is no file {path}: {directory} is not a run folder")
    try:  # all lines but the last, which is empty, or unfinished
        return [json.loads(line) for line in path.read_text(encoding="utf-8").split("\n")[:-1]]
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}") from error


def _copy(values: Any) -> torch.Tensor:
    """Return a detached copy of a tensor, or of an array on the CPU; bfloat16, which NumPy lacks, becomes float32."""
    copy = (values if isinstance(values, torch.Tensor) else as_tensor(values, device="cpu")).detach().clone()
    return copy.float() if copy.dtype == torch.bfloat16 else copy


def _environment(seed: int | None) -> dict[str, Any]:
    versions = {"python": platform.python_version(), "torchmask": torchmask.__version__}
    for package in _PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return {
        "command": sys.argv,
        "seed": seed,
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "platform": platform.platform(),
        "versions": versions,
    }


def _flatten(value: Any, prefix: str = "") -> dict[str, float | str]:
    """Flatten nested mappings to dotted names, with numbers and text as values, as hyperparameters need them."""
    if isinstance(value, dict):
        return {name: leaf for key, item in value.items() for name, leaf in _flatten(item, f"{prefix}{key}.").items()}
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        value = json.dumps(value)
    return {prefix.rstrip(".") or "config": value}
