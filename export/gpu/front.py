"""The running filter's front end over many conversations at once: edgefilter/filter/canceller.py and residual_echo.py on tensors.

All with the reference where the microphone hears it, its lag being known and constant. Left out: the tracking of the
lag, of a volume that is turned, and of hum, an array, effects beside the path, and what sounds with the voice (which
simulated items do not hold either). A diverged path begins anew with its reference's past. All else is as there;
tests/export/test_gpu.py says how closely.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d, pad

from edgefilter.alignment.utterances import LAST_BIT, SUSTAINED
from edgefilter.dsp import fourier
from edgefilter.dsp.membrane import displacement_taps
from edgefilter.dsp.shelf import Shelf
from edgefilter.dsp.stft import StftConfig
from edgefilter.filter import canceller as c
from edgefilter.filter import residual_echo as r
from edgefilter.filter import volume as v
from edgefilter.types import LOUDEST, SAMPLE_RATE

SHELF_TAPS = 4096
"""Length of the shelves' responses, which at 300 Hz have fallen by more than 200 dB there."""
TINY = float(fourier.TINY)


class Cancelled(NamedTuple):
    """`CancellerOutput` of all hops of a batch: echo (batch, n), uncertainty (batch, hops, hop + 1)."""

    echo: Tensor
    uncertainty: Tensor


def convolved(x: Tensor, taps: Tensor) -> Tensor:
    """The first n samples of x (..., n) convolved with taps (..., m)."""
    size = x.shape[-1] + taps.shape[-1]
    both = torch.fft.rfft(x.double(), size) * torch.fft.rfft(taps.double(), size)
    return torch.fft.irfft(both, size)[..., : x.shape[-1]].float()


def power(spectrum: Tensor) -> Tensor:
    """Return |spectrum|^2."""
    return spectrum.real.square() + spectrum.imag.square()


@torch.no_grad()
def cancel(
    mic: Tensor, reference: Tensor, hop: int, taps: int, adaptation: c.Adaptation, path: Tensor | None = None
) -> Cancelled:
    """Cancel the echo of all these conversations (batch, n), n a multiple of the hop; path (batch, taps): None for a cold start."""
    device, batch, hops = mic.device, mic.shape[0], mic.shape[1] // hop
    partitions = -(-taps // hop)
    lowered, raised = (_shelf(corners, device) for corners in (c.SHELF_HZ, c.SHELF_HZ[::-1]))
    heard = convolved(mic, lowered).view(batch, hops, hop)
    past, scales = _references(reference, hop, adaptation.products, lowered, partitions)
    rows = partitions + c.PRODUCT_PARTITIONS * (len(past) - 1)
    talks = reference.view(batch, hops, hop).square().sum(-1) > LAST_BIT * hop
    first = torch.zeros(batch, rows, 2 * hop, device=device)
    if path is not None:
        known = pad(path[:, : partitions * hop], (0, max(0, partitions * hop - path.shape[1])))
        first[:, :partitions, :hop] = known.view(batch, partitions, hop)
    first_weights = torch.fft.rfft(first)
    decay = 10.0 ** (-6.0 / c.DECAY_RT60_S * hop / SAMPLE_RATE * torch.arange(partitions, device=device))[:, None]
    first_covariance = torch.zeros(batch, rows, hop + 1, device=device)
    if path is not None:
        before = power(first_weights[:, :partitions])
        known = c.PRIOR_VARIANCE * before
        first_covariance = _expected(first_covariance, before.sum(1), c.LATE_VARIANCE * decay, known)
    weights, covariance = first_weights, first_covariance
    kept = adaptation.transition**2
    ageing, aged = (1.0 - kept) * power(weights), 0
    noise, quiet = torch.zeros(2, batch, hop + 1, device=device)
    silent = torch.ones(batch, dtype=torch.bool, device=device)
    unknown = torch.full((batch,), 0 if path is not None else c.UNKNOWN_HOPS, device=device)
    emphasis = torch.arange(hop + 1, device=device, dtype=torch.float32).square()
    limiter = _Limiter(batch, hop, device)
    echoes, uncertain = torch.empty(batch, hops, hop, device=device), torch.empty(batch, hops, hop + 1, device=device)

    for t in range(hops):
        at = hops - 1 - t
        spectra = past[0][:, at : at + partitions]
        if adaptation.products:
            turned = [x[:, at : at + c.PRODUCT_PARTITIONS] * s[:, t, None, None] for x, s in zip(past[1:], scales)]
            spectra = torch.cat((spectra, *turned), 1)
        played = power(spectra)
        echo = _predicted(weights, spectra)
        lost = ~(echo.square().sum(-1) < LOUDEST**2 * hop)
        # the program waits here for the GPU, so this is asked only now and then
        if t % c.UNKNOWN_HOPS == 0 and bool(lost.any()):
            weights = torch.where(lost[:, None, None], first_weights, weights)
            covariance = torch.where(lost[:, None, None], first_covariance, covariance)
        echo = torch.where(lost[:, None], 0.0, echo)
        excessive = limiter.measure(heard[:, t], echo)
        spectrum = torch.fft.rfft(pad(heard[:, t] - echo, (hop, 0)))
        noise = adaptation.noise_memory * noise + (1.0 - adaptation.noise_memory) * power(spectrum)
        silent = silent & ~talks[:, t]
        quiet = torch.where(silent[:, None], noise, quiet)
        if path is None:
            begins = talks[:, t] & (unknown > 0)
            unknown = unknown - begins.int()
            mean = played[:, :partitions].mean(1)
            added = 2.0 * (noise - quiet).clamp(min=0.0)
            whole = (emphasis * added).sum(-1) / ((emphasis * mean).sum(-1) + TINY)
            guess = torch.minimum(2.0 * noise / (mean + TINY), c.BOOST * whole[:, None])
            raised_covariance = _expected(covariance, guess, c.UNKNOWN_VARIANCE / decay.sum() * decay, 0.0)
            covariance = torch.where(begins[:, None, None], raised_covariance, covariance)
        expected = covariance * played
        misalignment = 0.5 * expected.sum(1)
        adapts = talks[:, t, None, None]
        reopened = limiter.changed[:, None, None] & adapts
        covariance = torch.where(reopened, torch.maximum(covariance, c.REOPEN * power(weights)), covariance)
        weights = torch.where(reopened, limiter.heard[:, None, None] * weights, weights)
        divisor = 1.0 / (misalignment + noise + TINY)
        blocks = torch.fft.irfft(spectra.conj() * covariance * (adapts[:, 0] * spectrum * divisor)[:, None], 2 * hop)
        blocks[..., hop:] = 0.0
        weights = weights + torch.fft.rfft(blocks)
        shrunk = covariance * (kept - adaptation.certainty * kept * expected * divisor[:, None])
        ageing[:, aged : aged + c.AGED_ROWS] = (1.0 - kept) * power(weights[:, aged : aged + c.AGED_ROWS])
        aged = aged + c.AGED_ROWS if aged + c.AGED_ROWS < rows else 0
        covariance = torch.where(adapts, shrunk + ageing, covariance)
        if adaptation.posterior:
            echo = torch.where((adapts[:, 0] & ~excessive[:, None]), _predicted(weights, spectra), echo)
        echoes[:, t], uncertain[:, t] = echo, misalignment
    echo = limiter.apply(convolved(echoes.view(batch, -1), raised).view(batch, hops, hop))
    gain = torch.from_numpy(Shelf(hop, *c.SHELF_HZ[::-1]).power).to(device)
    return Cancelled(echo.reshape(batch, -1), uncertain * gain)


def _shelf(corners: tuple[float, ...], device: torch.device) -> Tensor:
    impulse = np.eye(1, SHELF_TAPS, dtype=np.float32)[0]
    return torch.from_numpy(Shelf(SHELF_TAPS, *corners).step(impulse, 0.0)[0]).to(device)


def _references(
    reference: Tensor, hop: int, products: bool, lowered: Tensor, behind: int
) -> tuple[list[Tensor], list[Tensor]]:
    """Spectra of reference and products, the latest first and hops of silence behind, and by what the products are scaled in each hop."""
    batch, hops = reference.shape[0], reference.shape[1] // hop
    channels, scales = [reference], []
    if products:
        loudness = pad(reference.view(batch, hops, hop).square().mean(-1), (SUSTAINED - 1, 0))
        loudest = loudness.unfold(1, SUSTAINED, 1).amin(-1).clamp(min=LAST_BIT).cummax(1)[0].sqrt()
        size = loudest.repeat_interleave(hop, 1)
        low_pass = torch.from_numpy((displacement_taps() / c.DISPLACEMENT_SCALE).astype(np.float32)).to(reference)
        moved = size * (convolved(reference, low_pass) / size).clamp(-c.FURTHEST, c.FURTHEST)
        channels += [moved * reference, moved * moved * reference]
        scales = [1.0 / loudest, 1.0 / loudest.square()]
    blocks = [pad(convolved(x, lowered), (hop, 0)).unfold(1, 2 * hop, hop) for x in channels]
    silence = reference.new_zeros(batch, behind, hop + 1, dtype=torch.complex64)
    return [torch.cat((torch.fft.rfft(each).flip(1), silence), 1) for each in blocks], scales


def _predicted(weights: Tensor, spectra: Tensor) -> Tensor:
    hop = weights.shape[-1] - 1
    return torch.fft.irfft((weights * spectra).sum(1), 2 * hop)[:, hop:]


def _expected(covariance: Tensor, path_power: Tensor, decay: Tensor, known: Tensor | float) -> Tensor:
    """The covariance, raised where it is below what is expected of the path and of the products."""
    linear = known + decay * path_power[:, None]
    products = c.PRODUCT_VARIANCE * path_power[:, None].expand(-1, covariance.shape[1] - linear.shape[1], -1)
    return torch.maximum(covariance, torch.cat((linear, products), 1))


class _Limiter:
    """edgefilter.filter.volume.EchoLimiter of many conversations; its gains are applied at the end."""

    def __init__(self, batch: int, hop: int, device: torch.device) -> None:
        self._parts = hop // v.PART
        self._patience = round(v.PATIENCE_S * SAMPLE_RATE / hop)
        self._smoothed = torch.zeros(3, batch, device=device)
        self._waited = torch.zeros(batch, device=device)
        self._weights = [torch.ones(batch, 1, device=device)]
        self.changed = torch.zeros(batch, dtype=torch.bool, device=device)

    @property
    def heard(self) -> Tensor:
        _, cross, echo = self._smoothed
        return torch.where(echo > 0, _weight(cross / (echo + TINY)), 0.0)

    def measure(self, mic: Tensor, echo: Tensor) -> Tensor:
        """Take in a hop (batch, hop) of both; where any of the echo is too loud, (batch,)."""
        m, e = mic.view(-1, self._parts, v.PART), echo.reshape(-1, self._parts, v.PART)
        parts = torch.stack((m.square().sum(-1), (m * e).sum(-1), e.square().sum(-1)))
        now = parts.sum(-1)
        self._smoothed = v.MEMORY * self._smoothed + (1.0 - v.MEMORY) * now
        self._waited = torch.where(_left(now) > v.EXCESS * now[0], self._waited + 1, (self._waited - 1).clamp(min=0))
        self.changed = self._waited >= self._patience
        self._waited = torch.where(self.changed, 0.0, self._waited)
        loud = (_left(now) > now[0]) & (_left(self._smoothed) > self._smoothed[0])
        weights = torch.where(loud, _weight(now[1] / (now[2] + TINY)), 1.0)[:, None].expand(-1, self._parts)
        gross = _left(parts) > v.GROSS * parts[0]
        weights = torch.where(gross, torch.minimum(weights, _weight(parts[1] / (parts[2] + TINY))), weights)
        limited = (torch.cat((self._weights[-1][:, -1:], weights), 1) < 1.0).any(1)
        self._weights.append(weights)
        return limited

    def apply(self, echo: Tensor) -> Tensor:
        """All hops of the echo (batch, hops, hop) with their weights."""
        target = torch.cat(self._weights, 1)
        start = torch.minimum(target[:, :-1], target[:, 1:])[..., None]
        ramp = torch.arange(1, v.PART + 1, device=echo.device) / v.PART
        return (start + (target[:, 1:, None] - start) * ramp).reshape(echo.shape) * echo


def _left(moments: Tensor) -> Tensor:
    return moments[0] - 2.0 * moments[1] + moments[2]


def _weight(part: Tensor) -> Tensor:
    return torch.where(part < v.ABSENT, 0.0, part.clamp(max=1.0))


@torch.no_grad()
def expected_powers(
    echo: Tensor, error: Tensor, uncertainty: Tensor, stft: StftConfig, warm: Tensor, fan: Tensor
) -> tuple[Tensor, Tensor]:
    """Power of noise and of residual echo that residual_echo.Residual expects, (batch, frames, bins) each.

    echo, error: spectra (batch, frames, bins). warm (batch,): whether there is a profile, of which the fan's power is
    `fan` (batch, bins); its leakage begins as that of an unknown loudspeaker.
    """
    batch, frames, bins = error.shape
    observed, heard = power(error), power(echo)
    noises, residuals = torch.empty_like(observed), torch.empty_like(observed)
    width = max(1, round(r.SPREAD_HZ / stft.frequencies[1]))
    ends = (width // 2, width - 1 - width // 2)
    misalignment = torch.where(warm, r.MISALIGNMENT_WARM, r.MISALIGNMENT_COLD)[:, None]
    held = noise = present = torch.zeros(batch, bins, device=error.device)
    loudest = left = brought = torch.zeros(batch, 1, device=error.device)
    leakage = torch.full_like(left, r.LEAKAGE)
    track = r.NoiseTracker
    prior = float(track.PRESENT)
    for t in range(frames):
        held, now = torch.maximum(heard[:, t], r.TAIL_DECAY * held), observed[:, t]
        loudest = torch.maximum(loudest, now.mean(1, keepdim=True))
        if t < track.FIRST:
            noise = noise + (now - noise) / (t + 1)
        else:
            likelihood = (now / noise).clamp(max=100.0) * (prior / (1.0 + prior))
            speech = 1.0 / (1.0 + (1.0 + prior) * torch.exp(-likelihood))
            present = present + float(track.STUCK_RENEWED) * (speech - present)
            stuck = float(track.STUCK)
            speech = torch.where(present > stuck, speech.clamp(max=stuck), speech)
            noise = noise + float(track.RENEWED) * (1.0 - speech) * (now - noise)
        noise = torch.maximum(noise, fourier.LEAST * loudest + TINY)
        level = (noise / fan.clamp(min=TINY)).median(1, keepdim=True)[0]
        known = torch.where(warm[:, None], fan * level, noise)
        total = known.sum(1, keepdim=True)
        around = avg_pool1d(pad(held[:, None], ends, "replicate"), width, 1)[:, 0]
        spread = held + r.SPREAD * around
        unknown = misalignment * uncertainty[:, t]
        loud = spread.sum(1, keepdim=True)
        audible = loud > r.OVER_NOISE * total
        excess = now.sum(1, keepdim=True) - total - unknown.sum(1, keepdim=True)
        part = 1.0 - r.LEAKAGE_MEMORY
        left = torch.where(audible, left + part * (excess - left), left)
        brought = torch.where(audible, brought + part * (loud - brought), brought)
        change = (r.MARGIN * left.clamp(min=0.0) / (brought + TINY) / leakage).clamp(*r.STEPS)
        leakage = torch.where(audible, (leakage * change).clamp(*r.BOUNDS), leakage)
        noises[:, t], residuals[:, t] = known, leakage * spread + unknown
    return noises, residuals
