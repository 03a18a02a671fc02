"""The running filter's own front over a simulated conversation, in settings as wide as its errors are in reality."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from edgefilter.dsp.stft import Analyser, StftConfig, Synthesiser
from edgefilter.engines.linear import Linear
from edgefilter.filter.canceller import COLD, WARM, Adaptation, Canceller, CancellerOutput
from edgefilter.filter.echo_path import EchoPath
from edgefilter.filter.front_end import Centred, FrontEnd
from edgefilter.learning.path_learner import PathLearner
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE, Samples

LOUDNESS_STEP_DB, LEAST_DB = 0.5, -90.0
"""Power spectra are kept as one byte a bin: steps of so many dB from there on, to +37.5 dB."""


@dataclass(frozen=True)
class Stage:
    """One linear stage. taps, adaptation: None for the running filter's own choice.

    missing_db: what is missing of its echo estimate, over that estimate, None for nothing; infinite where the reference
    was never found: the error is then the microphone. missing_taps: of the filter that makes it. displaced: samples by
    which the reference that the engine is told of is late.
    """

    taps: int | None = None
    adaptation: Adaptation | None = None
    missing_db: float | None = None
    missing_taps: int = 64
    displaced: int = 0


class Setting(Protocol):
    """Draws the linear stage of an item."""

    def draw(self, rng: np.random.Generator, warm: bool) -> Stage: ...


@dataclass(frozen=True)
class BenchSetting:
    """The running filter as it is."""

    def draw(self, rng: np.random.Generator, warm: bool) -> Stage:
        return Stage()


@dataclass(frozen=True)
class WideSetting:
    """Shares of items whose linear stage is another one; a network that has seen one setting only follows its quirks.

    own: as it is. products, posterior: of the others, each switched to the contrary. taps: (least, most), as powers of
    two. weakened: echo estimates of which missing_db is missing, so that ERLE is 3 to 25 dB. lost: the reference was
    never found, or only to displaced_s.
    """

    own: float = 0.5
    products: float = 0.4
    posterior: float = 0.4
    taps: tuple[int, int] = (1024, 8192)
    weakened: float = 0.25
    missing_db: tuple[float, float] = (-25.0, -3.0)
    lost: float = 0.05
    displaced_s: float = 0.0

    def draw(self, rng: np.random.Generator, warm: bool) -> Stage:
        stage = Stage()
        if rng.random() >= self.own:
            usual = WARM if warm else COLD
            adaptation = replace(
                usual,
                products=usual.products != (rng.random() < self.products),
                posterior=usual.posterior != (rng.random() < self.posterior),
            )
            stage = Stage(int(2 ** rng.uniform(*np.log2(self.taps))), adaptation)
        drawn, missing = rng.random(), rng.uniform(*self.missing_db)
        if drawn < self.lost:
            displaced = round(rng.uniform(-self.displaced_s, self.displaced_s) * SAMPLE_RATE)
            return replace(stage, missing_db=np.inf, displaced=displaced)
        if drawn < self.lost + self.weakened:
            return replace(stage, missing_db=missing, missing_taps=int(2 ** rng.uniform(0, 9)))
        return stage


class WeakCanceller(Canceller):
    """A canceller whose echo estimate lacks a part, filtered at random: misalignment that it does not know of."""

    def __init__(self, usual: Canceller, profile: Profile | None, stage: Stage, rng: np.random.Generator) -> None:
        response = profile.echo.running_response() if profile else None
        super().__init__(usual.hop, stage.taps or usual.taps, response, stage.adaptation or usual.adaptation)
        self._never = stage.missing_db == np.inf
        taps = rng.standard_normal(stage.missing_taps)
        missing_db = -np.inf if stage.missing_db is None or self._never else stage.missing_db
        self._missing = 10 ** (missing_db / 20) * taps / np.linalg.norm(taps)
        self._past = np.zeros(taps.size - 1 + self.hop, np.float32)

    def step(self, mic: Samples, reference: Samples, located: bool = True) -> CancellerOutput:
        echo, error, uncertainty, innovation = super().step(mic, reference, located)
        if self._never:
            return CancellerOutput(np.zeros_like(echo), mic.copy(), uncertainty, innovation)
        self._past = np.concatenate((self._past[self.hop :], echo))
        part = np.convolve(self._past, self._missing, "valid").astype(np.float32)
        return CancellerOutput(echo - part, error + part, uncertainty, innovation)


def front_end(
    stage: Stage, profile: Profile | None, stft: StftConfig, rng: np.random.Generator, learns: bool = False
) -> FrontEnd:
    """The running filter's front with that linear stage; learns: while it runs, where the stage is the filter's own."""
    own = stage == Stage()
    front = FrontEnd(Linear(stft), profile, PathLearner(profile) if learns and own else None)
    assert front.linear_stage is not None
    if not own:
        path = front.linear_stage.path
        front.linear_stage.path = EchoPath(WeakCanceller(path.canceller, profile, stage, rng), path.effects)
    return front


@dataclass(frozen=True, eq=False)
class Heard:
    """What an engine gets, as sound: mic, reference, error, clean, fan (n,) float32, n a multiple of the hop.

    noise, residual: (n / hop, bins) uint8 by `to_bytes`; row t belongs to the frame whose last sample is (t + 1) hop.
    clean and fan have the gate's gain and the low cut of a front without a profile, which nothing after them can undo.
    """

    mic: Samples
    reference: Samples
    error: Samples
    clean: Samples
    fan: Samples
    noise: np.ndarray
    residual: np.ndarray


def listen(
    front: FrontEnd,
    mic: Samples,
    reference: Samples,
    clean: Samples,
    fan: Samples,
    stft: StftConfig,
    before: int = 0,
) -> Heard:
    """Run the front over a conversation, (n,) each, and put its frames together to sound again, without what was before.

    The synthesis is the inverse of the analysis, so that frames cut from that sound are the engine's own, but for bins
    beside a low cut.
    """
    hop, hops = stft.hop, mic.size // stft.hop
    own, centred, voices = Analyser(stft, 2), Centred(hop), [Synthesiser(stft) for _ in range(5)]
    cut = np.float32(1.0) if front.cut is None else front.cut
    sound = np.zeros((5, (hops + 1) * hop), np.float32)
    noise, residual = np.zeros((2, hops, stft.bins), np.uint8)
    inputs = np.stack([np.append(x[: hops * hop], np.zeros(hop, np.float32)) for x in (mic, reference, clean, fan)])
    for t in range(hops + 1):
        at = slice(t * hop, (t + 1) * hop)
        frame, _ = front.step(inputs[0, at], inputs[1, at])
        spectra = frame.mic, frame.reference, frame.error, *(cut * own.push(*centred.step(inputs[2:, at])))
        for row, voice, spectrum in zip(sound, voices, spectra):
            row[at] = voice.push(spectrum)
        if t < hops:
            noise[t], residual[t] = to_bytes(frame.noise_psd), to_bytes(frame.residual_psd)
        if front.linear_stage:
            front.linear_stage.learn()
    left = before // hop
    return Heard(*sound[:, (1 + left) * hop :], noise[left:], residual[left:])


def to_bytes(power: Samples) -> np.ndarray:
    """Power spectra as uint8, LOUDNESS_STEP_DB a step."""
    level_db = 10 * np.log10(power + 1e-12)
    return np.clip(np.rint((level_db - LEAST_DB) / LOUDNESS_STEP_DB), 0, 255).astype(np.uint8)


def from_bytes(level: np.ndarray) -> Samples:
    """The inverse of to_bytes, to half a step."""
    return (10 ** ((LEAST_DB + LOUDNESS_STEP_DB * np.arange(256)) / 10)).astype(np.float32)[level]
