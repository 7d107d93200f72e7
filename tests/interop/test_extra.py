"""Without the extra `deepinv`, its module says so."""

import importlib
import sys

import pytest


def test_a_missing_deepinv_is_named_with_its_extra(monkeypatch):
    monkeypatch.delitem(sys.modules, "torchmask.interop.deepinv", raising=False)
    for loaded in ["deepinv", *(module for module in sys.modules if module.startswith("deepinv."))]:
        monkeypatch.setitem(sys.modules, loaded, None)  # as if not installed
    with pytest.raises(ModuleNotFoundError, match=r"deepinv.* is not installed: pip install 'torchmask\[deepinv\]'"):
        importlib.import_module("torchmask.interop.deepinv")
