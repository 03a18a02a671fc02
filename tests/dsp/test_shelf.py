"""The low shelf: what SciPy makes of the same analogue filter, undone by its inverse, whatever the hop."""

import numpy as np
import pytest
from scipy import signal

from edgefilter.dsp.shelf import Shelf


def analogue(hz):
    """Coefficients of s^2 + s w sqrt 2 + w^2, w warped for the bilinear transform."""
    w = 2 * 16_000 * np.tan(np.pi * hz / 16_000)
    return [1.0, np.sqrt(2.0) * w, w**2]


@pytest.mark.parametrize("shape", [(2560,), (2, 2560)])
@pytest.mark.parametrize("hop", [128, 320])
def test_hops_are_filtered_as_one_signal_and_the_inverse_gives_it_back(hop, shape):
    x = np.random.default_rng(0).standard_normal(shape).astype(np.float32)
    shelf, inverse, state, back, lowered, given = Shelf(hop, 100, 400), Shelf(hop, 400, 100), 0.0, 0.0, [], []
    for part in np.split(x, x.shape[-1] // hop, axis=-1):
        y, state = shelf.step(part, state)
        z, back = inverse.step(y, back)
        lowered.append(y)
        given.append(z)
    b, a = signal.bilinear(analogue(100), analogue(400), 16_000)
    np.testing.assert_allclose(np.concatenate(lowered, axis=-1), signal.lfilter(b, a, x), atol=1e-5)
    np.testing.assert_allclose(np.concatenate(given, axis=-1), x, atol=1e-5)
    gain = np.abs(signal.freqz(b, a, np.pi * np.arange(hop + 1) / hop, include_nyquist=True)[1])
    np.testing.assert_allclose(shelf.power, gain**2, rtol=1e-4)
    assert shelf.power[0] == pytest.approx((100 / 400) ** 4, rel=0.01) and shelf.power[-1] == pytest.approx(1.0)
