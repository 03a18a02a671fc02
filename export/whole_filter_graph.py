"""Linear stage, STFT and inverse STFT as torch modules with explicit state, for export/whole_filter.py to trace."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from edgefilter.dsp.membrane import DISPLACEMENT_TAPS
from edgefilter.dsp.stft import StftConfig
from edgefilter.engines.crnn import SPECTRA
from edgefilter.filter import canceller as linear
from edgefilter.filter.canceller import Canceller
from edgefilter.types import SAMPLE_RATE

CANCELLER_STATES = (
    "weights", "doubt", "ageing", "spectra", "recent",
    "product_weights", "product_doubt", "product_ageing", "product_spectra", "product_recent", "moving",
    "noise", "correlation", "phantoms", "fade",
)  # fmt: skip
FRONT_STATES = (*CANCELLER_STATES, "analysed")


class Fourier(nn.Module):
    """Real Fourier transforms of one size as matrix products; a complex tensor is (2, ..., bins), real and imaginary part.

    At these sizes a product is as fast as onnxruntime's DFT operator, and exists in every build of it.
    """

    def __init__(self, size: int, window_length: int) -> None:
        super().__init__()
        forward = np.fft.rfft(np.eye(size)[:window_length])
        self.register_buffer("forward_matrix", _float(np.stack((forward.real, forward.imag))))
        bins = np.eye(size // 2 + 1)
        self.register_buffer("inverse_matrix", _float(np.stack((np.fft.irfft(bins, size), np.fft.irfft(1j * bins, size)))))

    def forward(self, x: Tensor) -> Tensor:
        """(..., n) with n up to window_length, zero-padded to size, to (2, ..., bins)."""
        count = x.shape[-1]
        return torch.stack((x @ self.forward_matrix[0, :count], x @ self.forward_matrix[1, :count]))

    def inverse(self, x: Tensor, begin: int, end: int) -> Tensor:
        """(2, ..., bins) to samples begin to end, (..., end - begin)."""
        return x[0] @ self.inverse_matrix[0, :, begin:end] + x[1] @ self.inverse_matrix[1, :, begin:end]


class Front(nn.Module):
    """edgefilter.filter.canceller.Canceller.step and the analysis of its four signals, hop by hop, as one graph."""

    def __init__(self, stft: StftConfig, taps: int) -> None:
        super().__init__()
        self.stft, self.hop = stft, stft.hop
        oracle = Canceller(stft.hop, taps)
        self.partitions = oracle.partitions
        self.fourier = Fourier(2 * self.hop, 2 * self.hop)
        alike = (stft.n_fft, stft.window_length) == (2 * self.hop, 2 * self.hop)
        self.analysis = self.fourier if alike else Fourier(stft.n_fft, stft.window_length)
        self.register_buffer("window", _float(stft.analysis_window))
        self.register_buffer("ramp", torch.linspace(0.0, 1.0, self.hop))
        kernel = np.zeros((self.hop + DISPLACEMENT_TAPS - 1, self.hop))
        for column in range(self.hop):
            kernel[column : column + DISPLACEMENT_TAPS, column] = oracle._lowpass_reversed
        self.register_buffer("lowpass", _float(kernel))

    def forward(self, mic: Tensor, reference: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        """mic, reference (hop,) to the spectra (1, bins, 2) of error, mic, reference and echo, and the next FRONT_STATES."""
        echo, error, following = self.cancel(mic, reference, dict(zip(CANCELLER_STATES, state)))
        recent = torch.cat((state[-1], torch.stack((error, mic, reference, echo))), dim=1)
        spectra = self.analysis(recent * self.window).permute(1, 2, 0)
        return (*spectra.unsqueeze(1), *(following[name] for name in CANCELLER_STATES), recent[:, self.hop :])

    def cancel(self, mic: Tensor, reference: Tensor, s: dict[str, Tensor]) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """echo (hop,), error (hop,) and the next state; the names are those of Canceller."""
        newest = self.fourier(torch.cat((s["recent"], reference)))
        spectra = torch.cat((newest.unsqueeze(1), s["spectra"][:, :-1]), dim=1)
        moving = torch.cat((s["moving"], reference))
        products, product_spectra = self._push_products(moving, reference, s)
        expected, product_expected = s["doubt"] * _power(spectra), s["product_doubt"] * _power(product_spectra)
        misalignment = expected.sum(0) + product_expected.sum((0, 1))
        predicted = _times(s["weights"], spectra).sum(1) + _times(s["product_weights"], product_spectra).sum((1, 2))
        echo = self.fourier.inverse(predicted, self.hop, 2 * self.hop)
        factor, correlation = self._follow_gain(mic, echo, s["correlation"])
        echo = factor * echo
        echo, phantom, phantoms, fade = self._without_phantom(mic, echo, s)
        error = mic - echo
        error_spectrum = self.fourier(torch.cat((torch.zeros_like(error), error)))
        observed = _power(error_spectrum)
        fresh = torch.maximum(observed - 0.5 * linear.OWN_SHARE * misalignment, 0.05 * observed)
        noise = linear.NOISE_MEMORY * s["noise"] + (1.0 - linear.NOISE_MEMORY) * fresh
        divisor = 1.0 / (misalignment + 2.0 * noise + 1e-12)
        active = (reference.dot(reference) > linear.SILENCE * self.hop) & ~phantom
        step = error_spectrum * divisor
        following = {
            "weights": self._corrected(factor * s["weights"], spectra, s["doubt"], step.unsqueeze(1), active),
            "doubt": torch.where(active, _aged(s["doubt"], expected, divisor, s["ageing"]), s["doubt"]),
            "ageing": s["ageing"],
            "spectra": spectra,
            "recent": reference,
            "product_weights": self._corrected(
                factor * s["product_weights"], product_spectra, s["product_doubt"], step.unsqueeze(1).unsqueeze(1), active
            ),
            "product_doubt": torch.where(active, _aged(s["product_doubt"], product_expected, divisor, s["product_ageing"]), s["product_doubt"]),
            "product_ageing": s["product_ageing"],
            "product_spectra": product_spectra,
            "product_recent": products,
            "moving": moving[self.hop :],
            "noise": noise,
            "correlation": correlation,
            "phantoms": phantoms,
            "fade": fade,
        }
        return echo, error, following

    def _push_products(self, moving: Tensor, reference: Tensor, s: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """The loudspeaker's products of this hop (2, hop), and their spectra (2, 2, partitions, bins), the newest first."""
        moved = moving @ self.lowpass
        first = moved * reference
        products = torch.stack((first, moved * first))
        newest = self.fourier(torch.cat((s["product_recent"], products), dim=1))
        return products, torch.cat((newest.unsqueeze(2), s["product_spectra"][:, :, :-1]), dim=2)

    def _follow_gain(self, mic: Tensor, echo: Tensor, correlation: Tensor) -> tuple[Tensor, Tensor]:
        """The factor by which the volume was turned, 1 where it was not, and the next correlation (3,)."""
        found = torch.stack((mic.dot(mic), mic.dot(echo), echo.dot(echo)))
        correlation = linear.GAIN_MEMORY * correlation + (1.0 - linear.GAIN_MEMORY) * found
        mic_power, cross, echo_power = correlation[0], correlation[1], correlation[2]
        loud = echo_power > linear.SILENCE * self.hop
        factor = cross / torch.where(loud, echo_power, torch.ones_like(echo_power))
        excess = mic_power - 2.0 * cross + echo_power > linear.GAIN_EXCESS * (mic_power - cross * factor)
        turned = (cross > 0.0) & loud & excess & (factor > 0.5) & (factor < 2.0)
        return torch.where(turned, factor, torch.ones_like(factor)), torch.where(turned, torch.zeros_like(correlation), correlation)

    def _without_phantom(self, mic: Tensor, echo: Tensor, s: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The echo, faded out where it is not there; whether that is so; the next phantoms and fade, (1,) each."""
        error = mic - echo
        phantom = (error.dot(error) > linear.PHANTOM * mic.dot(mic)) & (s["phantoms"] < linear.PHANTOM_PATIENCE)
        phantoms = torch.where(phantom, s["phantoms"] + 1.0, torch.relu(s["phantoms"] - 1.0))
        gain = torch.where(phantom, torch.zeros_like(s["fade"]), torch.ones_like(s["fade"]))
        return echo * (s["fade"] + (gain - s["fade"]) * self.ramp), phantom, phantoms, gain

    def _corrected(self, weights: Tensor, spectra: Tensor, doubt: Tensor, step: Tensor, active: Tensor) -> Tensor:
        """Weights after the Kalman correction, each partition kept to hop taps."""
        conjugate = torch.stack((spectra[0], -spectra[1]))
        taps = self.fourier.inverse(_times(conjugate * doubt, step), 0, self.hop)
        return torch.where(active, weights + self.fourier(taps), weights)


class Start(nn.Module):
    """Impulse response (taps,) to all states before the first hop; all zeros stand for a path that nobody knows.

    others: shapes of the states behind FRONT_STATES, which start at zero.
    """

    def __init__(self, front: Front, others: Sequence[tuple[int, ...]]) -> None:
        super().__init__()
        self.front, self.others = front, others
        seconds = np.arange(front.partitions) * front.hop / SAMPLE_RATE
        self.register_buffer("decay", _float(10.0 ** (-6.0 * seconds / linear.DECAY_RT60_S))[:, None])

    def forward(self, impulse_response: Tensor) -> tuple[Tensor, ...]:
        front, stft = self.front, self.front.stft
        hop, bins, partitions = front.hop, front.hop + 1, front.partitions
        blocks = impulse_response.reshape(partitions, hop)
        weights = front.fourier(blocks)
        power = _power(weights)
        warm = impulse_response.abs().sum() > 0
        path_power = torch.where(warm, power.sum(0), torch.ones(bins))
        known = linear.WARM_DOUBT * power + linear.LATE_DOUBT * self.decay * path_power
        doubt = torch.where(warm, known, (self.decay / self.decay.sum()).expand(partitions, bins))
        product_doubt = (linear.PRODUCT_DOUBT * path_power).expand(2, linear.PRODUCT_PARTITIONS, bins)
        ageing = 1.0 - linear.TRANSITION**2
        states = {
            "weights": weights,
            "doubt": doubt,
            "ageing": ageing * doubt,
            "spectra": torch.zeros(2, partitions, bins),
            "recent": torch.zeros(hop),
            "product_weights": torch.zeros(2, 2, linear.PRODUCT_PARTITIONS, bins),
            "product_doubt": product_doubt,
            "product_ageing": ageing * product_doubt,
            "product_spectra": torch.zeros(2, 2, linear.PRODUCT_PARTITIONS, bins),
            "product_recent": torch.zeros(2, hop),
            "moving": torch.zeros(DISPLACEMENT_TAPS - 1),
            "noise": torch.zeros(bins),
            "correlation": torch.zeros(3),
            "phantoms": torch.zeros(1),
            "fade": torch.ones(1),
            "analysed": torch.zeros(len(SPECTRA), stft.window_length - hop),
        }
        return (*(states[name] for name in FRONT_STATES), *(torch.zeros(shape) for shape in self.others))


class Back(nn.Module):
    """Inverse STFT: spectrum (1, bins, 2) and the sum of earlier frames to the hop that is finished, and the next sum."""

    def __init__(self, stft: StftConfig) -> None:
        super().__init__()
        self.hop = stft.hop
        self.fourier = Fourier(stft.n_fft, stft.window_length)
        self.register_buffer("window", _float(stft.synthesis_window))

    def forward(self, spectrum: Tensor, overlap: Tensor) -> tuple[Tensor, Tensor]:
        frame = self.fourier.inverse(spectrum.squeeze(0).permute(1, 0), 0, self.window.numel()) * self.window
        total = torch.cat((overlap, torch.zeros(self.hop))) + frame
        return total[: self.hop], total[self.hop :]


def _float(x: np.ndarray) -> Tensor:
    return torch.from_numpy(np.asarray(x, np.float32))


def _power(x: Tensor) -> Tensor:
    return x[0] * x[0] + x[1] * x[1]


def _times(a: Tensor, b: Tensor) -> Tensor:
    """Product of two complex tensors."""
    return torch.stack((a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]))


def _aged(doubt: Tensor, expected: Tensor, divisor: Tensor, ageing: Tensor) -> Tensor:
    """Covariance after one observation and one hop of time."""
    return doubt * (1.0 - 0.5 * divisor * expected) * linear.TRANSITION**2 + ageing
