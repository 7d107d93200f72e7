"""Differentiable co-design of aperture masks and image restoration for imaging through turbulence.

mask -> pupil field -> PSF / OTF -> short exposures -> restored object
"""

from torchmask.atmosphere.layers import Layers
from torchmask.atmosphere.phase import LayeredPhase, TurbulencePhase
from torchmask.atmosphere.profiles import named_layers
from torchmask.data.observe import read_observation
from torchmask.data.restored import save_restored
from torchmask.design.constraints import check_mask
from torchmask.design.criterion import AsymptoticMSE, wiener_mse
from torchmask.design.manufacture import load_mask
from torchmask.design.refine import refine_mask
from torchmask.design.search import SearchResult, search_mask
from torchmask.design.table import design_table
from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import Grid
from torchmask.instrument.instrument import Instrument
from torchmask.instrument.parts import Camera, Site, Source, Telescope
from torchmask.interferometry.calibration import MaskCalibration, calibrate_mask
from torchmask.interferometry.companion_map import map_companions
from torchmask.interferometry.fringes import frame_observables
from torchmask.interferometry.measurements import Measurements
from torchmask.interferometry.observables import Observables
from torchmask.interferometry.oifits import save_oifits
from torchmask.interferometry.oifits_reader import load_oifits
from torchmask.interferometry.pair_fit import fit_pair
from torchmask.interferometry.visibilities import restored_observables
from torchmask.observation import Observation
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.detector import Detector
from torchmask.optics.geometry import MaskGeometry
from torchmask.optics.otf import OTF
from torchmask.optics.psf import PSF
from torchmask.optics.zernike import ZernikePhase
from torchmask.planning.bounds import MyopicBound, myopic_bound
from torchmask.planning.plan import plan_observation
from torchmask.planning.result import ObservationPlan
from torchmask.planning.smearing import SmearingMap, smearing_map
from torchmask.planning.success import BlindOutlook, SuccessMap, success_map
from torchmask.restoration.baselines import average_psf, shift_and_add
from torchmask.restoration.many import restore_many
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.priors import EdgePreserving
from torchmask.restoration.result import RestorationResult
from torchmask.restoration.variation import SmoothVariation, TotalVariation
from torchmask.restoration.wiener import multiframe_wiener
from torchmask.simulation.conditions import Conditions
from torchmask.simulation.dataset import StackDataset, StackRanges
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import SceneOptions, make_scene
from torchmask.spectra import NoisePSD, PowerLawPSD
from torchmask.tracking import RunLogger

__version__ = "0.2.0"

__all__ = [
    "OTF",
    "PSF",
    "AsymptoticMSE",
    "BlindOutlook",
    "Camera",
    "Conditions",
    "Detector",
    "EdgePreserving",
    "FullAperture",
    "Grid",
    "Instrument",
    "LayeredPhase",
    "Layers",
    "MaskCalibration",
    "MaskGeometry",
    "Measurements",
    "MyopicBound",
    "MyopicDeconvolution",
    "NoisePSD",
    "Observables",
    "Observation",
    "ObservationPlan",
    "PowerLawPSD",
    "RestorationResult",
    "RunLogger",
    "SceneOptions",
    "SearchResult",
    "Site",
    "SmearingMap",
    "SmoothVariation",
    "Source",
    "SparseAperture",
    "StackDataset",
    "StackRanges",
    "SuccessMap",
    "Telescope",
    "TotalVariation",
    "TurbulencePhase",
    "TurbulentMSE",
    "ZernikePhase",
    "average_psf",
    "calibrate_mask",
    "check_mask",
    "design_table",
    "fit_pair",
    "frame_observables",
    "load_mask",
    "load_oifits",
    "make_scene",
    "map_companions",
    "multiframe_wiener",
    "myopic_bound",
    "named_layers",
    "plan_observation",
    "read_observation",
    "refine_mask",
    "restore_many",
    "restored_observables",
    "save_oifits",
    "save_restored",
    "search_mask",
    "shift_and_add",
    "simulate_observation",
    "smearing_map",
    "success_map",
    "wiener_mse",
]
