"""Verdicts on the starts of one restoration, and the choice of the better of two."""

from __future__ import annotations

import math
from functools import cached_property
from typing import NamedTuple

from torchmask.restoration.calibration import fit_of_frames
from torchmask.restoration.checkpoint import Ending, Status
from torchmask.restoration.frames import FrameStack
from torchmask.restoration.model_error import NO_MODEL_ERROR, LeftOut, ModelError, expected_error, fitted_parameters
from torchmask.restoration.motion import Setting
from torchmask.restoration.noise import FrameNoise
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.state import State
from torchmask.restoration.traits import Traits
from torchmask.restoration.verdict import Finding, FrameFits, Tolerance, Verdict, judge
