"""The verdict on a restoration: whether it explains the frames, which frames it does not, and what to check."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, replace
from enum import Enum
from statistics import NormalDist
from typing import Any, NamedTuple

from torch import Tensor

from torchmask.restoration.model_error import ModelError
from torchmask.restoration.noise import FrameNoise

_SURE = 5.0  # standard deviations of the noise that do not occur by chance
_LOST = 2.0  # times the minimum tolerance of a stack is allowed for single frames: they end in minima of their own
_TELLING = 200.0  # signal to noise: below 180 errors are 1 to 20 times their standard deviations, above 0.6 to 1.8
_MANY_OBJECTS = "is explained by many objects with aberrations to suit"
_BY_CHANCE = 0.01  # of the good stacks have a frame that is named because of its noise


class Finding(Enum):
    """Outcome of a verdict."""

    EXPLAINED = "explained"
    NOT_EXPLAINED = "not explained"
    ONLY_NOISE = "not explained, the frames show nothing but noise"
    TOO_MUCH_NOISE = "not judged, the frames show less noise than assumed"


@dataclass(frozen=True)
class Verdict:
    """Whether a restoration explains the frames.

    finding : outcome
    chi_square : chi-square of the residuals over its degrees of freedom
    degrees_of_freedom : number of valid pixels, less the effective number of parameters fitted to each frame, given
        their prior. The object is not counted, as its prior constrains it and all frames share it
    model_error : expected contribution to the chi-square of modes that the search leaves out
    limit : chi-square up to which the frames count as explained
    phase_error : rms of the modes left out, over a sub-aperture [rad]
    frames : numbers of the frames that are not explained individually
    n_frames : number of frames in the stack
    check : what may be wrong, or was stopped early; empty if nothing is
    contradiction : what the fringes say against the mask as given, and which fits better; empty if nothing
    unseen : other orientations of the mask that would make the same fringes; empty if there are none
    least : chi-square below which no fit comes; 0 if that cannot be told
    is_scarce : whether the frames show too little of the object to tell it from others, such as much smoother ones

    Examples
    --------
    >>> verdict = Verdict(Finding.EXPLAINED, 1.39, 300000, 0.4, 1.8, 0.2, (), 20, "")
    >>> verdict.explained, str(verdict).partition(":")[0]
    (True, 'explained')
    """

    finding: Finding
    chi_square: float
    degrees_of_freedom: int
    model_error: float
    limit: float
    phase_error: float
    frames: tuple[int, ...]
    n_frames: int
    check: str
    contradiction: str = ""
    unseen: str = ""
    least: float = 0.0
    is_scarce: bool = False

    @property
    def explained(self) -> bool:
        """Whether the stack as a whole is explained."""
        return self.finding is Finding.EXPLAINED

    @property
    def excess(self) -> float:
        """Chi-square in excess of that of noise."""
        return self.chi_square - 1

    def of_measured_noise(self) -> Verdict:
        """Return the verdict for frames whose noise was not told but measured, which advises otherwise on it."""
        if self.finding is not Finding.TOO_MUCH_NOISE:
            return self
        advice = (
            "what was measured as noise in the frames: light that is cut off at their border, cosmic rays and hot "
            "pixels raise it, so tell readout_noise= or mark such pixels in valid="
        )
        return replace(self, check=advice)

    def __str__(self) -> str:
        numbers = f"chi-square is {self.chi_square:.4g} over {self.degrees_of_freedom} degrees of freedom"
        if self.finding is Finding.TOO_MUCH_NOISE:
            numbers += f"; a fit leaves {self.least:.2g} at least if the noise is right"
        elif self.finding is not Finding.ONLY_NOISE:  # whose chi-square explains nothing, however small
            numbers += f"; up to {self.limit:.4g} counts as explained"
            if self.phase_error:
                numbers += f", since modes left out ({self.phase_error:.2g} rad rms) add about {self.model_error:.2g}"
        head, parts = self.finding.value, [f"check {self.check}"] if self.check else []
        if self.frames and self.explained:
            head += f" as a whole, but {_listed(self.frames, self.n_frames)}"
        elif self.frames:
            parts.insert(0, f"{_listed(self.frames, self.n_frames)} explained")
        parts += [self.contradiction] if self.contradiction and not self.explained else []
        return f"{head}: {'; '.join([*parts, numbers])}"

    def to_json(self) -> dict[str, Any]:
        """Return the verdict as plain values, with the string of `str` as "text"."""
        return asdict(self) | {"finding": self.finding.name, "explained": self.explained, "text": str(self)}

    @classmethod
    def from_json(cls, text: str) -> Verdict:
        """Read a verdict from the output of `to_json` as JSON text. Raises ValueError for anything else."""
        try:
            values = {name: value for name, value in json.loads(text).items() if name not in ("explained", "text")}
            values |= {"finding": Finding[values["finding"]], "frames": tuple(values["frames"])}
            return cls(**values)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"there is no verdict in {text!r}") from error


@dataclass(frozen=True)
class Tolerance:
    """Excess of the chi-square up to which frames count as explained.

    model_errors : allowance for the model error, in units of its expected value
    chance : allowance for chance, in standard deviations of the chi-square, which is added
    least : minimum of the allowance for the model error
    """

    model_errors: float
    chance: float
    least: float = -math.inf


class FrameFits(NamedTuple):
    """How well single frames are fitted, and what their light lets expect.

    chi_square : (T,) mean square of the residuals, in units of the assumed noise
    pixels : (T,) number of valid pixels
    transmission : (T,) transmission of each frame, 1 on average
    noise : noise of each frame
    parameters : number of free parameters of the object and all frames; infinite if unknown
    """

    chi_square: Tensor
    pixels: Tensor
    transmission: Tensor
    noise: FrameNoise
    parameters: float = math.inf


def judge(
    frames: FrameFits,
    contrast: float,
    error: ModelError,
    tolerance: Tolerance,
    *,
    at_rest: bool,
    blind: bool,
    is_still: bool,
) -> Verdict:
    """Return the verdict on frames.

    `contrast` is the chi-square per pixel of the mean frame against a uniform one; `at_rest` says whether the search
    ran to its end, and `blind` that neither object nor aberrations were known. Then light is scarce if less than 200^2
    of the mean frame's chi-square is beyond noise, and a stack that `is_still` tells no more than a single frame, see
    `FrameStack`. Noise gives a frame the chi-square of its own noise level, whose variance is 2 over the degrees of
    freedom times `unevenness`; what the model lacks adds in proportion to the square of its transmission. Each free
    parameter takes the noise of one pixel at most, of a bright one where noise is uneven.
    """
    chi_square, pixels, transmission, level, unevenness = (
        values.double().cpu() for values in (*frames[:3], *frames.noise)
    )
    free = (pixels - error.fitted).clamp(min=1)
    total = float(free.sum())
    found = float((chi_square * pixels).sum()) / total
    deviation = level * (2 * unevenness / free).sqrt()
    expected = tolerance.model_errors * error.excess
    noise, chance = float((free * level).sum()) / total, float((free * deviation).norm()) / total
    limit = noise + max(expected, tolerance.least) + tolerance.chance * chance
    taken = frames.parameters * float((level * unevenness).max()) / total
    least = max(0.0, noise - taken - _SURE * chance)
    each = level + max(expected, _LOST * tolerance.least) * transmission**2
    each += NormalDist().inv_cdf(1 - _BY_CHANCE / len(pixels)) * deviation
    lost = tuple((chi_square * pixels / free > each).nonzero().flatten().tolist())
    if found < least:
        finding = Finding.TOO_MUCH_NOISE
    elif contrast - 1 < _SURE * math.sqrt(2 / float(pixels.max())):
        finding = Finding.ONLY_NOISE
    else:
        finding = Finding.EXPLAINED if found <= limit else Finding.NOT_EXPLAINED
    scarce = blind and (contrast - 1) * float(pixels.max()) < _TELLING**2
    check = _what_to_check(finding, len(lost), len(pixels), at_rest=at_rest, scarce=scarce)
    if finding is Finding.EXPLAINED and blind and len(pixels) == 1:
        check = f"against other frames: one alone {_MANY_OBJECTS}"
    elif finding is Finding.EXPLAINED and blind and is_still and not scarce:
        still = f"against frames under other aberrations: these do not change, and what they show {_MANY_OBJECTS}"
        check = f"{check}, and then {still}" if check else still
    numbers = (found, round(total), error.excess, limit, error.phase)
    return Verdict(finding, *numbers, lost, len(pixels), check, least=least, is_scarce=scarce)


def _what_to_check(finding: Finding, n_lost: int, n_frames: int, *, at_rest: bool, scarce: bool) -> str:
    if finding is Finding.ONLY_NOISE:
        return "the pointing, the crop and the exposure time"
    if finding is Finding.TOO_MUCH_NOISE:
        return "read-out noise, gain and errors of pixels"
    steps = []
    if scarce:
        steps.append("again with more light or more frames, as these show too little of the object to tell it")
    few = 0 < n_lost <= n_frames / 2
    stopped = [] if at_rest else ["again after more iterations, since this search was stopped early"]
    if finding is Finding.EXPLAINED:
        steps += [*stopped, *(["those frames for clouds, tracking errors and a gradient of the sky"] if n_lost else [])]
    elif few and at_rest:
        steps.append("those frames for clouds, tracking errors and a gradient of the sky, or leave them out")
    else:
        steps += stopped
        steps.append(
            "the mask (which one, how it lies), wavelength and pixel scale, gain and read-out noise, dead and hot "
            "pixels, and that all frames show one object"
        )
    return ", and then ".join(steps)


def _listed(frames: tuple[int, ...], n_frames: int) -> str:
    if len(frames) == n_frames:
        return "no frame is"
    names = ", ".join(map(str, frames))
    return f"frames {names} are not" if len(frames) > 1 else f"frame {names} is not"
