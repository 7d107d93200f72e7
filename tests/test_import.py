"""What `import torchmask` promises: the public names of the design, and nothing heavy behind them."""

import subprocess
import sys

import pytest
import torch

import torchmask
from torchmask.design.drawing import save_dxf
from torchmask.optics.passband import Passband

HEAVY = (
    "kornia",
    "cma",
    "tensorboard",
    "skimage",
    "matplotlib",
    "astropy",
    "trimesh",
    "tyro",
    "rich",
    "joblib",
    "ezdxf",
    "deepinv",
    "torchvision",
    "ray",
    "yaml",
    "sphinx",
    "speclite",
)


def test_every_public_name_is_there_and_documented():
    assert len(set(torchmask.__all__)) == len(torchmask.__all__)
    for name in torchmask.__all__:
        assert (getattr(torchmask, name).__doc__ or "").strip(), name


def test_import_needs_torch_numpy_and_scipy_only():
    """In a process of its own, with the extras made impossible to import."""
    program = f"""
import sys
for name in {HEAVY!r}:
    sys.modules[name] = None
import torchmask
mask = torchmask.SparseAperture.random(6, 1.0, 0.15)
grid = torchmask.Grid.nyquist(1.0, 550e-9, 64)
criterion = torchmask.AsymptoticMSE(grid, torchmask.PowerLawPSD(1.5, 1e7), torchmask.NoisePSD(1e7), 20)
print(0 < float(criterion.relative(mask)) < 1)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "True"


@pytest.mark.parametrize(
    ("missing", "name", "call"),
    [
        ("trimesh", "data", lambda: torchmask.make_scene((32, 32), 1e4)),
        ("skimage", "data", lambda: torchmask.shift_and_add(torch.rand(2, 8, 8))),
        ("astropy", "data", lambda: torchmask.read_observation("cube.fits", torchmask.FullAperture(1.0))),
        ("speclite", "filters", lambda: Passband.find("bessell-V")),
        ("ezdxf", "design", lambda: save_dxf("mask.dxf", torchmask.SparseAperture([[0.0, 0.0]], 0.1, 1.0))),
    ],
)
def test_what_is_missing_is_named_with_its_extra(missing, name, call, monkeypatch):
    for loaded in [missing, *(module for module in sys.modules if module.startswith(f"{missing}."))]:
        monkeypatch.setitem(sys.modules, loaded, None)  # as if not installed
    with pytest.raises(ModuleNotFoundError, match=rf"{missing}.* is not installed: pip install 'torchmask\[{name}\]'"):
        call()
