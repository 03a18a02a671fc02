"""Every example in a docstring runs and prints what it says."""

import doctest
import importlib.util
import pkgutil

import pytest

import edgefilter

MODULES = sorted(["edgefilter", *(module.name for module in pkgutil.walk_packages(edgefilter.__path__, "edgefilter."))])
EXAMPLES = [name for name in MODULES if ">>>" in (importlib.util.find_spec(name).loader.get_source(name) or "")]


def test_examples_were_found():
    assert {
        "edgefilter.filter.ego_filter",
        "edgefilter.alignment.aligner",
        "edgefilter.calibration.calibrate",
        "edgefilter.dsp.metrics",
    } <= set(EXAMPLES)


@pytest.mark.slow
@pytest.mark.parametrize("name", EXAMPLES)
def test_docstring_examples_run(name):
    result = doctest.testmod(importlib.import_module(name))
    assert result.attempted > 0 and result.failed == 0
