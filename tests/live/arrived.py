"""Whether a sound came through."""

import numpy as np


def arrived(heard, played):
    """The greatest correlation coefficient that any 0.2 s of played have with what was heard.

    On a machine that is busy with something else the sound server leaves gaps; a piece that came through shows the way.
    """
    size = 1 << int(np.ceil(np.log2(heard.size + 3200)))
    spectrum = np.fft.rfft(heard, size)
    energy = np.convolve(np.square(heard), np.ones(3200), "valid")
    best = 0.0
    for piece in np.split(played[: played.size // 3200 * 3200], played.size // 3200):
        product = np.fft.irfft(spectrum * np.conj(np.fft.rfft(piece, size)), size)[: energy.size]
        best = max(best, float(np.max(product / np.sqrt(np.maximum(energy, 1e-3) * np.sum(piece**2)))))
    return best
