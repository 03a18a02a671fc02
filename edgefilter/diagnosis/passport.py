"""What one recording of an unknown device tells: how its robot reaches the microphone, what to expect of the filter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from scipy import fft

from edgefilter.alignment.belief import believe, find_lag
from edgefilter.calibration.from_recording import fan_in_silences, find_drift, silences
from edgefilter.calibration.multisine import PERIOD
from edgefilter.diagnosis.compare import rounded
from edgefilter.diagnosis.prepare import leads
from edgefilter.diagnosis.straightened import FRAME, HOP
from edgefilter.dsp.fourier import power
from edgefilter.dsp.fractional_delay import delayed, interpolate
from edgefilter.dsp.frames import block_power, decibels, frames
from edgefilter.dsp.metrics import si_sdr
from edgefilter.dsp.psd import frequencies, hann, third_octave_bands, total_power
from edgefilter.echo.recording import paired
from edgefilter.errors import SignalError
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.types import SAMPLE_RATE, Samples

ENGINES = ("linear", "ss", "crnn")
"""Those that follow any device without knowing it."""
LEAST_S, MOST_S = 10.0, 60.0
"""Seconds of the shortest recording that is accepted, and of the longest part of one, from its beginning, that is analysed."""
SETTLED_S = 5.0
"""The filter has this long with the robot alone before it is measured, and before the human speaks."""
PAUSE_S = 2.0
"""Between two turns of the human; a turn that is cut shorter by the recording's end does not count."""
LONG, LEAST_FRAMES = 4 * PERIOD, 4
"""Samples of the longer of two analysis frames: 2 s, longer than the reverberation of any room in which people talk. A frame length is used
only if the recording holds at least LEAST_FRAMES such frames."""
MOSTLY_NOISE_DB = 2.0
"""Level of the nonlinear part of the microphone signal above the background noise, dB, up to which that part counts as mostly noise: at
2 dB 63 % of it is. Of ten real devices one that distorts loudly (yw9vi) has 2.7 dB."""
GATED = 1e-9
"""Mean square, -90 dBFS, which no microphone with a converter of 16 bit stays under in 20 ms, unless it was shut."""
GATED_SHARE = 0.02
"""Share of such moments from which on the microphone is taken for gated: 0.20 on the one device of six (AEC challenge)
that is, 0 on the others."""
FULL, CLIPPED_SHARE = 0.999, 1e-4
"""Level, relative to full scale, from which on a sample may be clipped, and the share of such samples from which on the recording is. One
or two such samples only show that a file was normalised to full scale, as two of the same six were."""
FOLLOWS = 0.5
"""Correlation of band levels from which on the microphone holds the robot, however changed: 0.36 where noise covers it,
0.57 where it is gated, 0.65 and more elsewhere, on the same six."""

Cause = Literal["nothing", "noise", "gate", "clipping", "other", "change"]
"""What bounds a linear filter: nothing up to ENOUGH_DB, the noise, a microphone that shuts, one that is overdriven, a sound
that does not follow the reference, or distortion or processing, which one recording cannot tell apart."""
ENOUGH_DB = 15.0
"""Echo reduction, dB, that is enough: with 15 dB of it a human 10 dB softer than the robot is 5 dB louder than the residual echo."""


@dataclass(frozen=True)
class Band:
    """An octave (Hz): what linear filtering can remove, robot over noise, how well the levels follow the reference's.

    removable_db: from the magnitude-squared coherence, 10 lg 1 / (1 - C). removed_db: what each engine takes off the robot.
    """

    low: float
    high: float
    mic_db: float
    removable_db: float
    over_noise_db: float
    follows: float
    removed_db: dict[str, float]


@dataclass(frozen=True)
class Expected:
    """What an engine does: dB by which it lowers the robot, false starts of speech, SI-SDR in dB of a human laid on, before and after it."""

    removed_db: float
    false_starts: int | None
    si_sdr_before_db: float
    si_sdr_db: float


@dataclass(frozen=True)
class Passport:
    """All that one recording tells; levels in dB of full scale.

    lag_ms, lag_spread_ms: median of the seconds whose lag is certain, and the span of their middle eight tenths; sharp:
    the share of such seconds. lost_ms: what is missing in the reference. drift_ppm: parts of a million by which the
    reference's clock is faster (the lag shrinks). change_db: what is neither linear in the reference nor noise, against
    what is linear. pauses: whether the robot is silent for long enough to know the noise; if not, it is at most that of
    the quietest moments. gated, clipped: shares of time and of samples.
    """

    seconds: float
    mic_db: float
    mic_peak_db: float
    ref_db: float
    ref_peak_db: float
    noise_db: float
    clipped: float
    gated: float
    human_db: float
    pauses: bool
    lag_ms: float
    lag_spread_ms: float
    sharp: float
    lost_ms: float
    drift_ppm: float
    removable_db: float
    over_noise_db: float
    change_db: float
    follows: float
    cause: Cause
    bands: tuple[Band, ...]
    engines: dict[str, Expected]

    def to_dict(self) -> dict[str, Any]:
        """Ready for JSON, schema 1."""
        return {"schema": 1, **rounded(asdict(self))}


def measure(
    mic: Samples,
    ref: Samples,
    voice: Samples,
    human_db: float = -10.0,
    engines: Sequence[str] = ENGINES,
    progress: Callable[[str], None] = lambda step: None,
) -> Passport:
    """The passport of a device from its robot alone.

    mic, ref: (n,), (m,), what the microphone heard and what the robot said, 16 kHz, full scale +-1; the first MOST_S are
    taken. voice: (v,), a human without pauses at the ends, laid on at human_db of the microphone's power in the same
    seconds. engines: which are tried, without a profile and without learning. Raises SignalError where there are fewer
    than LEAST_S, the reference or the microphone is silent, or the reference is not found in the recording or after its echo.

    Notes
    -----
    Coherence: Carter, Knapp & Nuttall 1973, over half-overlapping Hann frames of half a second and of two, less its bias.
    What it calls linear bounds any filter of that length, so that the longer frames count in a room whose response outlasts
    the shorter ones. What the engine `linear` removes is removable in any case.
    Levels follow: correlation of log energies, frame by frame.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> said = rng.standard_normal(192_000).astype(np.float32) * (0.05 + 0.05 * np.sin(np.arange(192_000) / 900))
    >>> heard = 0.5 * np.roll(said, 800) + 1e-4 * rng.standard_normal(192_000)
    >>> found = measure(heard.astype(np.float32), said.astype(np.float32), said[:32_000], engines=["linear"])
    >>> round(found.lag_ms), found.removable_db > 20
    (50, True)
    """
    most = round(MOST_S * SAMPLE_RATE)
    mic, ref = paired(mic[:most], ref[:most])
    _check(mic, ref)
    known = _levels(mic, ref) | {"human_db": human_db}
    progress("lag and drift")
    believed = believe(mic, ref)
    lag, lags = find_lag(mic, ref, believed), believed.certain
    if early := leads(lag):
        raise SignalError(early)
    ppm, behind = find_drift(mic, delayed(ref, lag))
    near = delayed(ref, lag + behind)
    if ppm:
        near = interpolate(near, np.arange(near.size) * (1.0 + 1e-6 * ppm))
    progress("coherence")
    fan, pauses_s = fan_in_silences(mic, silences(near))
    # echo later than a frame lasts looks like distortion: take the frame length that explains most of the microphone
    seen = [_Spectra(mic, near, fan, period) for period in (PERIOD, LONG) if mic.size >= LEAST_FRAMES * period]
    spectra = max(seen, key=lambda each: each.over(0.0, SAMPLE_RATE / 2)[0])
    outputs, told = {}, {}
    for engine in engines:
        progress(f"{engine} on the robot alone")
        outputs[engine], starts = _filtered(mic, ref, engine)
        progress(f"{engine} with a human")
        told[engine] = Expected(_removed(mic, outputs[engine]), starts, *expected(mic, ref, voice, human_db, engine))
    removable, over_noise, follows = spectra.over(0.0, SAMPLE_RATE / 2)
    removable = max(removable, *(one.removed_db for name, one in told.items() if name == "linear"), 0.0)
    return Passport(
        **known,
        noise_db=float(decibels(total_power(fan))),
        pauses=pauses_s > 0.0,
        lag_ms=lag / SAMPLE_RATE * 1000,
        lag_spread_ms=float(np.quantile(lags, 0.9) - np.quantile(lags, 0.1)) / SAMPLE_RATE * 1000,
        sharp=lags.size / believed.lags.size,
        lost_ms=believed.lost / SAMPLE_RATE * 1000,
        drift_ppm=ppm,
        removable_db=removable,
        over_noise_db=over_noise,
        change_db=spectra.change_db(),
        follows=follows,
        cause=_cause(removable, over_noise, follows, known["gated"], known["clipped"]),
        bands=tuple(_bands(mic, spectra, outputs)),
        engines=told,
    )


def expected(mic: Samples, ref: Samples, voice: Samples, human_db: float, engine: str) -> tuple[float, float]:
    """SI-SDR (dB) of a human who is laid on the robot alone, before and behind the engine: the mean of all turns.

    mic, ref: (n,). The voice (v,) speaks from SETTLED_S on, again and again until the end, human_db over the
    microphone's power in the same seconds.
    """
    human, spans = np.zeros(mic.size), []
    begin, pause = round(SETTLED_S * SAMPLE_RATE), round(PAUSE_S * SAMPLE_RATE)
    while begin + min(voice.size, pause) <= mic.size:
        span = slice(begin, min(begin + voice.size, mic.size))
        turn = voice[: span.stop - begin].astype(np.float64)
        echo = float(np.mean(np.square(mic[span], dtype=np.float64)))
        human[span] = turn * np.sqrt(echo / np.mean(turn**2)) * 10 ** (human_db / 20)
        if echo > 0.0:
            spans.append(span)
        begin += voice.size + pause
    full = max(1.0, float(np.abs(mic + human).max()))
    mixed, human = ((mic + human) / full).astype(np.float32), human / full
    output, _ = _filtered(mixed, ref, engine)
    before, after = (float(np.mean([si_sdr(x[span], human[span]) for span in spans])) for x in (mixed, output))
    return before, after


def _check(mic: Samples, ref: Samples) -> None:
    seconds = mic.size / SAMPLE_RATE
    if seconds < LEAST_S:
        raise SignalError(
            f"the recording is {seconds:.1f} s long, expected {LEAST_S:.0f} to {MOST_S:.0f} s of the robot alone: record more"
        )
    for samples, name in ((mic, "recording"), (ref, "reference")):
        if not samples.any():
            raise SignalError(
                f"the {name} is silent in the first {seconds:.0f} s, expected the robot's voice: check what was recorded"
            )


def _levels(mic: Samples, ref: Samples) -> dict[str, Any]:
    told: dict[str, Any] = {"seconds": mic.size / SAMPLE_RATE, "clipped": float(np.mean(np.abs(mic) >= FULL))}
    for name, x in (("mic", mic), ("ref", ref)):
        told[f"{name}_db"] = float(decibels(np.mean(np.square(x, dtype=np.float64))))
        told[f"{name}_peak_db"] = float(decibels(float(np.abs(x).max()) ** 2))
    shut, played = (block_power(x, SAMPLE_RATE // 50) for x in (mic, ref))
    return told | {"gated": float(np.mean((shut < GATED) & (played > 0.0)))}


class _Spectra:
    """Powers by bin of the microphone, of its part that is incoherent with the aligned reference, and of the noise."""

    def __init__(self, mic: Samples, near: Samples, fan: Samples, period: int) -> None:
        window = hann(period)
        # with half a frame of silence around it each sample counts the same, those at the ends too
        x, y = (fft.rfft(frames(np.pad(s, period // 2), period, period // 2) * window, axis=1) for s in (near, mic))
        played, heard = power(x), power(y)
        self.hz = frequencies(period // 2 + 1)
        self._scale = 2 / period / np.sum(window**2)
        self.mic = heard.mean(axis=0)
        coherent = np.abs((x.conj() * y).mean(axis=0)) ** 2 / np.maximum(played.mean(axis=0), 1e-30)
        # a filter fitted to few frames explains some of anything: as much as the frames that count are few
        count = np.square(played.sum(axis=0)) / np.maximum(np.square(played).sum(axis=0), 1e-30)
        self.rest = np.clip((self.mic - coherent) / (1.0 - 1.0 / np.maximum(count, 1.5)), 0.0, self.mic)
        self.noise = np.interp(self.hz, frequencies(fan.size), fan) * SAMPLE_RATE / 2 * np.sum(window**2)
        self._short = [power(fft.rfft(frames(s, FRAME, HOP) * hann(FRAME), axis=1)) for s in (near, mic)]

    def mic_db(self, low: float, high: float) -> float:
        """Level of the microphone from low to high Hz, dB of full scale."""
        return float(decibels(self.mic[(self.hz >= low) & (self.hz < high)].sum() * self._scale))

    def over(self, low: float, high: float) -> tuple[float, float, float]:
        """Removable dB, microphone over noise in dB and correlation of the levels, from low to high Hz."""
        at = (self.hz >= low) & (self.hz < high)
        mic, rest, noise = (float(s[at].sum()) for s in (self.mic, self.rest, self.noise))
        ratios = [float(decibels(mic / max(part, 1e-6 * mic, 1e-20))) for part in (rest, noise)]
        return ratios[0], ratios[1], self._follows(low, high)

    def _follows(self, low: float, high: float) -> float:
        """Correlation of log energies down to 50 dB under the loudest; of the whole spectrum, the median of its bands."""
        if high - low > 5000.0:
            return float(np.median([self._follows(*band) for band in octaves()]))
        hz = frequencies(FRAME // 2 + 1)
        at = (hz >= low) & (hz < high)
        energies = [s[:, at].sum(axis=1) for s in self._short]
        levels = [np.log(e + 1e-5 * e.max() + 1e-20) for e in energies]
        return float(np.corrcoef(*levels)[0, 1]) if all(float(np.ptp(one)) > 0.0 for one in levels) else 0.0

    def change_db(self) -> float:
        """What is neither linear in the reference nor noise, against what is linear."""
        linear = float((self.mic - self.rest).sum())
        return float(decibels(np.maximum(self.rest - self.noise, 0.0).sum() / max(linear, 1e-20), 1e-6))


def octaves() -> list[tuple[float, float]]:
    """Octave bands, Hz: the third-octaves of IEC 61260-1 from 88 Hz on, three by three, up to 8 kHz."""
    bands = third_octave_bands()
    return [(float(bands[i, 0]), float(bands[min(i + 2, len(bands) - 1), 1])) for i in range(3, len(bands), 3)]


def _filtered(mic: Samples, ref: Samples, engine: str) -> tuple[Samples, int | None]:
    """The output without a profile, (n,), and how often a human's speech has begun, None where no engine tells."""
    with EgoFilter(engine=engine) as ego:
        output = np.concatenate((ego.process(mic, ref), ego.flush()))
        starts = sum(event.kind == "speech_started" for event in ego.events())
        return output, starts if ego.judges_speech else None


def _removed(mic: Samples, output: Samples) -> float:
    """By how much the level falls once the filter has settled, dB."""
    begin = round(SETTLED_S * SAMPLE_RATE)
    before, after = (decibels(np.mean(np.square(x[begin:], dtype=np.float64))) for x in (mic, output))
    return float(before - after)


def _bands(mic: Samples, spectra: _Spectra, outputs: dict[str, Samples]) -> list[Band]:
    begin, window, told = round(SETTLED_S * SAMPLE_RATE), hann(PERIOD), []
    density = {
        name: power(fft.rfft(frames(x[begin:], PERIOD, PERIOD // 2) * window, axis=1)).mean(axis=0)
        for name, x in {"": mic, **outputs}.items()
    }
    hz = frequencies(PERIOD // 2 + 1)
    for low, high in octaves():
        at = (hz >= low) & (hz < high)
        level = {name: float(decibels(d[at].sum(), 1e-20)) for name, d in density.items()}
        removed = {name: level[""] - db for name, db in level.items() if name}
        removable, over_noise, follows = spectra.over(low, high)
        removable = max(removable, removed.get("linear", 0.0))
        told.append(Band(low, high, spectra.mic_db(low, high), removable, over_noise, follows, removed))
    return told


def _cause(removable_db: float, over_noise_db: float, follows: float, gated: float, clipped: float) -> Cause:
    """A gate before all else, since it takes the human too; noise where it alone explains what is not linear."""
    if gated >= GATED_SHARE:
        return "gate"
    if removable_db >= ENOUGH_DB:
        return "nothing"
    if removable_db > over_noise_db - MOSTLY_NOISE_DB:
        return "noise"
    if clipped >= CLIPPED_SHARE:
        return "clipping"
    return "change" if follows >= FOLLOWS else "other"
