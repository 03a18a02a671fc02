"""The transforms of the hop against numpy's, with scipy's kernel and without it."""

import importlib.util
import sys

import numpy as np
import pytest

from edgefilter.dsp import fourier


@pytest.fixture(params=["kernel", "public"])
def way(request, monkeypatch):
    """The module, with and without the kernel."""
    if request.param == "kernel":
        return fourier
    monkeypatch.setitem(sys.modules, "scipy.fft._pocketfft", None)  # not found where it was
    spec = importlib.util.find_spec(fourier.__name__)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("shape", [(512,), (320,), (3, 7), (2, 4, 60)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_it_is_the_real_transform_along_the_last_axis(way, shape, dtype):
    x = np.random.default_rng(0).standard_normal(shape).astype(dtype)
    spectrum = way.rfft(x)
    assert spectrum.dtype == (np.complex64 if dtype is np.float32 else np.complex128)
    tolerance = 1e-5 * np.sqrt(shape[-1])  # float32 sums of so many numbers of size 1
    np.testing.assert_allclose(spectrum, np.fft.rfft(x), atol=tolerance)
    back = way.irfft(spectrum, shape[-1])
    assert back.dtype == dtype
    np.testing.assert_allclose(back, x, atol=tolerance)


def test_strided_input_and_given_output(way):
    x = np.random.default_rng(1).standard_normal((4, 128)).astype(np.float32)[::2, ::2]
    spectrum, samples = np.zeros((2, 33), np.complex64), np.zeros((2, 64), np.float32)
    assert way.rfft(x, out=spectrum) is spectrum
    np.testing.assert_allclose(spectrum, np.fft.rfft(x), atol=1e-4)
    assert way.irfft(spectrum, 64, out=samples) is samples
    np.testing.assert_allclose(samples, x, atol=1e-5)


def test_other_types_go_the_public_way():
    counts = np.arange(8)
    np.testing.assert_allclose(fourier.rfft(counts), np.fft.rfft(counts))


def test_the_input_is_not_written_to(way):
    x = np.random.default_rng(2).standard_normal(64).astype(np.float32)
    x.flags.writeable = False
    spectrum = way.rfft(x)
    spectrum.flags.writeable = False
    way.irfft(spectrum, 64)
