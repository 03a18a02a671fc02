"""What every engine must do inside the stream and every effect inside the echo model, whatever they compute.

Each check_ takes a function that makes a new stream, each effect_check_ the name of an effect.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache

import numpy as np
from scipy import signal

from edgefilter import Profile, enhance
from edgefilter.dsp.psd import floored
from edgefilter.echo.effect import RECORDING, complete, neutral
from edgefilter.echo.effects import catalogue
from edgefilter.echo.effects.free_laws import FreeCurve
from edgefilter.echo.measurement import Measurement
from edgefilter.echo.model import EchoModel
from edgefilter.echo.running import SourceChain, reach, stream_form
from edgefilter.filter.stream import Stream
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Frame

MakeStream = Callable[[], Stream]


def robot() -> Profile:
    """A profile that fits conversation: direct sound and a short decaying tail."""
    rng = np.random.default_rng(0)
    response = np.zeros(2048, np.float32)
    response[PRE_ROLL : PRE_ROLL + 600] = 0.1 * rng.standard_normal(600) * np.exp(-np.arange(600) / 120)
    response[PRE_ROLL] = 0.6
    return Profile(
        echo=EchoModel(response),
        delay=900.0,
        response=np.full(601, 0.6, np.float32),
        noise_psd=np.full(601, 1e-10, np.float32),
        band_hz=np.array([[100.0, 8000.0]]),
        band_snr_db=np.array([40.0]),
        distortion_db=np.full(4, -40.0),
    )


def conversation(n: int = 24_000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A robot-like reference in bursts, its echo 900 samples later with a decaying tail, a weak human and a fan.

    Read-only.
    """
    rng = np.random.default_rng(seed)
    bursts = np.repeat(rng.uniform(0, 1, n // 800 + 1) > 0.3, 800)[:n]
    ref = (0.2 * rng.standard_normal(n) * bursts).astype(np.float32)
    tail = rng.standard_normal(600) * np.exp(-np.arange(600) / 120)
    tail[0] = 6.0
    echo = np.convolve(np.concatenate((np.zeros(900), ref)), tail)[:n] * 0.1
    human = 0.01 * np.sin(np.arange(n) * 0.3) * (np.arange(n) > n // 2)
    mic = (echo + human + 0.001 * rng.standard_normal(n)).astype(np.float32)
    mic.flags.writeable = ref.flags.writeable = False
    return mic, ref


def run(stream: Stream, mic: np.ndarray, ref: np.ndarray, sizes: list[int] | None = None) -> np.ndarray:
    """All output of one pass, the input cut into blocks of the given sizes over and over."""
    out, at, turn = [], 0, 0
    while at < mic.size:
        size = sizes[turn % len(sizes)] if sizes else mic.size
        out.append(stream.process(mic[at : at + size], ref[at : at + size]))
        at, turn = at + size, turn + 1
    out.append(stream.flush())
    return np.concatenate(out)


def check_any_partition_gives_the_same_bits(make: MakeStream) -> None:
    mic, ref = conversation()
    whole = run(make(), mic, ref)
    for sizes in ([1, 7, 255], [256], [160], [4096], [0, 513, 1, 0, 3001]):
        assert np.array_equal(run(make(), mic, ref, sizes), whole), f"blocks of {sizes} change the output"


def check_length_out_is_length_in(make: MakeStream) -> None:
    for n in (0, 1, 2, 159, 160, 255, 256, 257, 1000, 5001):
        mic, ref = conversation(24_000)
        out = run(make(), mic[:n], ref[:n])
        assert out.shape == (n,) and out.dtype == np.float32


def check_is_finite_on_hard_input(make: MakeStream) -> None:
    n = 12_000
    hard = {
        "silence": np.zeros(n),
        "full-scale square": np.sign(np.sin(np.arange(n) * 0.05)),
        "denormals": np.full(n, 1e-40),
        "one impulse": np.eye(1, n, 3000)[0],
    }
    for name, x in hard.items():
        x = x.astype(np.float32)
        for ref in (x, np.zeros_like(x)):
            assert np.isfinite(run(make(), x, ref)).all(), f"not finite on {name}"


def check_silence_gives_silence(make: MakeStream) -> None:
    nothing = np.zeros(8000, np.float32)
    assert not run(make(), nothing, nothing).any()


def check_declared_latency_is_the_true_one(make: MakeStream) -> None:
    """Sample n is out once n + latency samples are in, for every n, and for some n not a sample earlier."""
    stream = make()
    mic, ref = conversation(6000)
    out, slack = 0, []
    for n in range(mic.size):
        out += stream.process(mic[n : n + 1], ref[n : n + 1]).size
        slack.append(out - (n + 1 - stream.latency))
    assert min(slack[stream.latency :]) == 1, "sample n may use samples up to n + latency - 1 and no later ones"


def check_is_causal_beyond_its_latency(make: MakeStream) -> None:
    mic, ref = conversation()
    at = 15_000
    changed = mic.copy()
    changed[at:] = 0.3
    changed_ref = ref.copy()
    changed_ref[at:] = -0.3
    stream = make()
    before, after = run(stream, mic, ref), run(make(), changed, changed_ref)
    first = at - stream.latency + 1
    assert np.array_equal(before[:first], after[:first]) and not np.array_equal(before, after)


def check_reset_starts_anew(make: MakeStream) -> None:
    mic, ref = conversation()
    stream = make()
    first = run(stream, mic, ref)
    stream.reset()
    assert np.array_equal(run(stream, mic, ref), first)


def check_two_streams_share_an_engine(make: MakeStream) -> None:
    stream = make()
    other = Stream(stream.engine, stream.profile)
    mic, ref = conversation()
    alone = run(make(), mic, ref)
    out = []
    for at in range(0, mic.size, 1000):
        out.append(stream.process(mic[at : at + 1000], ref[at : at + 1000]))
        other.process(ref[at : at + 1000], mic[at : at + 1000])
    assert np.array_equal(np.concatenate((*out, stream.flush())), alone)


def check_step_writes_neither_frame_nor_state(make: MakeStream) -> None:
    engine = make().engine
    rng = np.random.default_rng(4)
    bins = engine.stft.bins

    def spectrum() -> np.ndarray:
        x = (rng.standard_normal(bins) + 1j * rng.standard_normal(bins)).astype(np.complex64)
        x.flags.writeable = False
        return x

    psd = np.ones(bins, np.float32)
    psd.flags.writeable = False
    frames = [Frame(spectrum(), spectrum(), spectrum(), spectrum(), psd, psd) for _ in range(6)]
    states = [engine.initial_state()]
    first = []
    for frame in frames:
        output, state = engine.step(frame, states[-1])
        states.append(state)
        first.append(output.spectrum.copy())
    again = [engine.step(frame, state)[0].spectrum for frame, state in zip(frames, states)]
    assert np.array_equal(first, again), "a state was changed by a later step"


def check_says_nothing_before_the_end(make: MakeStream) -> None:
    stream = make()
    mic, ref = conversation()
    assert all(stream.process(mic[at : at + 999], ref[at : at + 999]).size == 0 for at in range(0, mic.size, 999))
    assert stream.flush().shape == mic.shape


def check_the_beginning_depends_on_the_end(make: MakeStream) -> None:
    mic, ref = conversation(8000)
    changed = mic.copy()
    changed[6000:] = 0.3
    before, after = run(make(), mic, ref)[:4000], run(make(), changed, ref)[:4000]
    assert not np.array_equal(before, after)


OF_CLIPS = (check_says_nothing_before_the_end, check_the_beginning_depends_on_the_end)
"""What an engine must do that needs the whole recording."""
OF_STREAMS = (
    check_declared_latency_is_the_true_one,
    check_is_causal_beyond_its_latency,
    check_step_writes_neither_frame_nor_state,
)
"""What only an engine can do that answers frame by frame."""
_ALL = [check for name, check in sorted(globals().items()) if name.startswith("check_")]
CHECKS = [check for check in _ALL if check not in OF_CLIPS]
CLIP_CHECKS = [check for check in _ALL if check not in OF_STREAMS]


SECONDS = 12
FAN = 0.002
"""Amplitude of the fan's low-passed noise, about 25 dB under the robot's voice at the microphone."""


@lru_cache(maxsize=4)
def robot_speech(seconds: float = SECONDS, seed: int = 0) -> np.ndarray:
    """Speech-like (n,) float32, read-only: voiced pulses of a gliding pitch and hiss through formants, in syllables with pauses."""
    rng = np.random.default_rng(seed)
    n = int(seconds * SAMPLE_RATE)
    t = np.arange(n) / SAMPLE_RATE
    phase = np.cumsum(130 + 25 * np.sin(2 * np.pi * 0.4 * t) + 10 * np.sin(2 * np.pi * 1.7 * t)) / SAMPLE_RATE
    pulses = np.diff(np.floor(phase), prepend=0.0) * 8
    syllables = np.repeat(rng.uniform(0.1, 1.0, n // 3200 + 1) * (rng.uniform(size=n // 3200 + 1) > 0.2), 3200)[:n]
    x = (pulses + 0.15 * rng.standard_normal(n)) * signal.lfilter(*signal.butter(1, 12, fs=SAMPLE_RATE), syllables)
    for hz, width in ((500, 80), (1500, 120), (2600, 160)):
        r = np.exp(-np.pi * width / SAMPLE_RATE)
        x = signal.lfilter([1.0, -0.7], [1.0, -2 * r * np.cos(2 * np.pi * hz / SAMPLE_RATE), r * r], x)
    x = (0.7 * x / np.abs(x).max()).astype(np.float32)
    x.flags.writeable = False
    return x


def robot_model(seed: int = 1) -> EchoModel:
    """A direct sound, reflections and a tail that falls by 60 dB in 0.25 s."""
    rng = np.random.default_rng(seed)
    h = np.zeros(4000)
    h[PRE_ROLL:] = 0.15 * rng.standard_normal(4000 - PRE_ROLL) * np.exp(-np.arange(4000 - PRE_ROLL) * 6.9 / 4000)
    h[PRE_ROLL] = 1.0
    return EchoModel((0.5 * h).astype(np.float32))


def fan(n: int, seed: int = 2) -> np.ndarray:
    """The fan (n,): noise, louder below 1 kHz."""
    white = np.random.default_rng(seed).standard_normal(n)
    return (FAN * (signal.lfilter(*signal.butter(1, 1000, fs=SAMPLE_RATE), white) * 2 + 0.2 * white)).astype(np.float32)


def robot_alone(
    name: str | None = None, values: Mapping[str, object] | None = None, gain_db: float = 0.05
) -> tuple[Measurement, EchoModel]:
    """A recording with that effect, the fan as it lets that through, a gain that is a little off and a faint cubic distortion.

    And the model without the effect.
    """
    x, model = robot_speech(), robot_model()
    truth = model.with_effect(name, values) if name else model
    drive = x - np.float32(0.005) * x**3
    noise = truth.passed(changed_fan(name, values or {}, x.size), drive) + unpredictable(truth, x)
    psd = _fan_psd()
    recording = (truth.predict(drive) * np.float32(10 ** (gain_db / 20)) + noise).astype(np.float32)
    return Measurement(x, recording, psd, np.arange(x.size) // 8000 % 2 == 0), model


def unpredictable(model: EchoModel, reference: np.ndarray) -> np.ndarray:
    """(n,) what the model says that no waveform predicts: noise of that expected square and colour."""
    rng, hz = np.random.default_rng(7), np.linspace(0, SAMPLE_RATE / 2, 601)
    noise = np.zeros(reference.size)
    for square, density in model.unpredictable(reference):
        spectrum = np.fft.rfft(rng.standard_normal(reference.size))
        magnitude = np.sqrt(np.interp(np.fft.rfftfreq(reference.size, 1 / SAMPLE_RATE), hz, density * SAMPLE_RATE / 2))
        noise += np.sqrt(square) * np.fft.irfft(spectrum * magnitude, reference.size)
    return noise


def _fan_psd() -> np.ndarray:
    """(601,) of the fan, from another recording of it."""
    return signal.welch(fan(8 * SAMPLE_RATE, seed=3), SAMPLE_RATE, nperseg=1200, detrend=False)[1].astype(np.float32)


def changed_fan(name: str | None, values: Mapping[str, object], n: int) -> np.ndarray:
    """The fan (n,), its spectrum as an effect of stage "noise" says."""
    if name is None or catalogue.find(name).stage != "noise":
        return fan(n)
    hz = np.linspace(0, SAMPLE_RATE / 2, 601)
    effect = catalogue.find(name)
    gain = np.sqrt(effect.noise_psd(complete(effect, values), np.ones(601, np.float32)))
    spectrum = np.fft.rfft(fan(n)) * np.interp(np.fft.rfftfreq(n, 1 / SAMPLE_RATE), hz, gain)
    return np.fft.irfft(spectrum, n).astype(np.float32)


def held_out_power(
    measurement: Measurement, predicted: np.ndarray, noise: tuple[tuple[np.ndarray, np.ndarray], ...] = ()
) -> float:
    """Mean square of the whitened residual on the samples that no fit may use; 1 is the fan and, besides, the noise that is expected."""
    white = measurement.whiten(measurement.recording - predicted)
    expected = np.ones(white.size)
    for square, density in noise:
        expected += square * np.mean(density / floored(measurement.noise_psd))
    held = ~measurement.fit
    return float(np.mean(white[held].astype(np.float64) ** 2) / np.mean(expected[held]))


def effect_check_neutral_is_the_identity(name: str) -> None:
    x, effect = robot_speech(), catalogue.find(name)
    out = effect.apply(x, neutral(effect), SAMPLE_RATE)
    assert np.array_equal(out, x) and out.dtype == np.float32


def effect_check_any_length_goes_through(name: str) -> None:
    effect = catalogue.find(name)
    values = complete(effect, effect_case(name))
    for n in (0, 1, 100, 5000):
        x = robot_speech()[:n]
        out = effect.apply(x, values, SAMPLE_RATE)
        assert out.shape == (n,) and out.dtype == np.float32 and np.isfinite(out).all()


def effect_check_fit_stays_within_the_bounds_on_hard_input(name: str) -> None:
    """Silence, noise without a robot, a recording that has nothing to do with the reference."""
    measurement, model = robot_alone()
    n = measurement.recording.size
    silence = np.zeros(n, np.float32)
    for reference, recording in (
        (silence, silence),
        (silence, fan(n)),
        (robot_speech(), silence),
        (robot_speech(), np.roll(robot_speech(), 50_000)),
    ):
        hard = Measurement(reference, recording, measurement.noise_psd, measurement.fit)
        complete(catalogue.find(name), catalogue.find(name).fit(hard, model))


def effect_check_fit_on_a_neutral_recording_stays_neutral(name: str) -> None:
    """What the fit adds to a recording with ordinary tolerances stays under a tenth of the fan's power."""
    measurement, model = robot_alone()
    fitted = model.fit(name, measurement)
    if catalogue.find(name).stage == "noise":
        expected = catalogue.find(name).noise_psd(dict(fitted.effects)[name], measurement.noise_psd)
        assert abs(float(np.sum(expected) / np.sum(measurement.noise_psd)) - 1.0) < 0.1, dict(fitted.effects)[name]
    change = measurement.whiten(
        fitted.predict(measurement.reference) - model.predict(measurement.reference) * np.float32(10 ** (0.05 / 20))
    )
    assert np.mean(change.astype(np.float64) ** 2) < 0.1, dict(fitted.effects)[name]


def effect_check_fit_explains_what_its_own_apply_made(name: str) -> None:
    """Of what the effect puts over the fan on held-out samples, at most a tenth is left, or LEFT_OVER."""
    measurement, model = robot_alone(name, effect_case(name), gain_db=0.0)
    before = held_out_power(measurement, model.predict(measurement.reference))
    fitted = model.fit(name, measurement)
    if catalogue.find(name).stage == "noise":
        expected = catalogue.find(name).noise_psd(dict(fitted.effects)[name], measurement.noise_psd)
        measurement = Measurement(measurement.reference, measurement.recording, expected, measurement.fit)
    noise = (
        fitted.unpredictable(measurement.reference)
        if catalogue.find(name).adds_noise and catalogue.find(name).followed
        else ()
    )
    after = held_out_power(measurement, fitted.predict(measurement.reference), noise)
    assert before > 2.0, f"the case is too weak to show anything: {before:.2f} times the fan"
    assert abs(after - 1.0) < LEFT_OVER.get(name, 0.1) * (before - 1.0), (
        f"residual power {before:.2f} -> {after:.2f} times the fan"
    )


def effect_check_runs_on_a_stream_as_on_a_recording(name: str) -> None:
    """Ahead of the path, hop by hop, and after a realignment in the middle. Rounding differs by the block: -60 dB."""
    effect, values = catalogue.find(name), complete(catalogue.find(name), effect_case(name))
    if effect.stage != "source" or stream_form(effect, values) is None:
        assert np.array_equal(SourceChain([(name, values)])(robot_speech()), robot_speech())
        return
    x, source = robot_speech()[: 4 * SAMPLE_RATE], SourceChain([(name, values)])
    expected = effect.apply(x, values, SAMPLE_RATE)
    half, energy = x.size // 2, np.sum(expected.astype(np.float64) ** 2)
    whole = [source(x[at : at + 256]) for at in range(0, x.size, 256)]
    again = [source.restart(x[:half]), *(source(x[at : at + 256]) for at in range(half, x.size, 256))]
    for hops in (whole, again):
        assert np.sum((np.concatenate(hops).astype(np.float64) - expected) ** 2) < 1e-6 * energy


def effect_check_lowers_what_the_running_filter_leaves_or_says_why_not(name: str) -> None:
    """Of a robot that has the effect `ss` leaves less at first, by 3 dB, where the profile knows it; or nothing changes and it is said.

    A volume the filter finds by itself with the first words, and the level of a noise: there the profile must not harm, and
    brings the noise's spectrum.
    """
    effect, values = (
        catalogue.find(name),
        complete(catalogue.find(name), {**effect_case(name), **RUN_CASES.get(name, {})}),
    )
    mic, ref, profile = running_robot(name, values)
    knowing = profile.with_echo(profile.echo.with_effect(name, values))
    without, with_it = (
        enhance(mic, ref, known, engine="ss")[SAMPLE_RATE // 4 : SAMPLE_RATE] for known in (profile, knowing)
    )
    if np.allclose(without, with_it, rtol=0.0, atol=1e-6):  # the last bits of a float32
        assert "changes nothing" in reach(effect, values)
        return
    fall = 10 * np.log10(np.mean(without.astype(np.float64) ** 2) / np.mean(with_it.astype(np.float64) ** 2))
    least = -0.5 if effect.followed else 1.0 if effect.stage == "noise" else 3.0
    assert fall > least, f"{fall:.2f} dB"


def running_robot(name: str, values: Mapping[str, object]) -> tuple[np.ndarray, np.ndarray, Profile]:
    """Microphone and reference of two seconds of a robot with that effect, 900 samples late, and its profile without it."""
    ref = robot_speech()[2 * SAMPLE_RATE : 4 * SAMPLE_RATE]
    late = np.concatenate((np.zeros(900 - PRE_ROLL, np.float32), ref))[: ref.size]
    model = robot_model().with_effect(name, values)
    mic = (model.predict(late) + changed_fan(name, values, ref.size) + unpredictable(model, late)).astype(np.float32)
    psd = _fan_psd()
    bands = np.array([[900.0, 1100.0]])
    profile = Profile(robot_model(), 900.0, np.ones(601, np.float32), psd, bands, np.array([40.0]), np.full(4, -50.0))
    return mic, ref, profile


def _decaying(taps: int, per: float, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(taps) * np.exp(-np.arange(taps) / per)


COMPRESSED = {"loudest_db": -10.0, "gain_db": -(np.linspace(0.0, 3.5, 11) ** 2), "attack_ms": 5.0, "release_ms": 100.0}
BENT = {"peak": 0.4, "bend": np.tanh(2.0 * FreeCurve.knots) / 2.0 - FreeCurve.knots}
EFFECT_CASES: dict[str, dict[str, object]] = {
    "playback_gain": {"gain_db": -2.5},
    "speaker_nonlinearity": {
        "force_factor": np.array([0.4, -0.3]),
        "stiffness": 0.2,
        "damping": np.array([0.4, -0.2]),
        "excursion": 0.2,
        "even": 0.05,
        "odd": -0.2,
        "knee": 0.3,
    },
    "clock_drift": {"ppm": -80.0, "offset": 3.5},
    "delay_jump": {"times_s": np.array([3.3, 8.1]), "samples": np.array([37.4, -61.0])},
    "packet_loss": {"times_s": np.array([1.14, 1.16, 3.7, 5.2, 6.86, 8.9, 10.1]), "length_ms": 20.0, "fill": 0.5},
    "codec": {
        "power": 0.3 * np.exp(-np.arange(16) / 6),
        "decay_ms": 8.0,
        "exponent": 1.0,
        "below_voice_db": 10.0,
    },
    "compression": {"threshold_db": -20.0, "ratio": 4.0, "attack_ms": 8.0, "release_ms": 200.0, "makeup_db": 3.0},
    "limiter": {"ceiling_db": -16.0, "release_ms": 150.0, "makeup_db": 2.0},
    "multiband_compression": {
        "crossover_hz": np.array([350.0, 2000.0]),
        "threshold_db": np.array([-30.0, -33.0, -40.0]),
        "ratio": np.array([3.0, 2.0, 4.0]),
        "attack_ms": 8.0,
        "release_ms": 150.0,
        "makeup_db": np.array([6.0, 3.0, 5.0]),
    },
    "mic_agc": {"gain_db": 3.0 * np.sin(np.arange(4 * SECONDS) / 5.0)},
    "mic_clipping": {"level": 0.15},
    "noise_suppression": {
        "gain_db": np.linspace(-30.0, -9.0, 8),
        "fan_db": 10.0 * np.log10(_fan_psd()),
        "softer_db": -20.0,
    },
    "free_gain": COMPRESSED,
    "free_gain_behind": COMPRESSED,
    "free_curve": BENT,
    "free_curve_behind": BENT,
    "free_filter": {"taps": np.eye(256)[[32, 75]].T @ [-0.3, 0.6]},
    "free_filter_ahead": {"taps": np.eye(128)[[32, 75]].T @ [-0.3, 0.6]},
    "free_modulation": {"rate_hz": 4.0, "waves": np.eye(8)[[0, 5]].T @ [0.5, 0.2]},
    "free_lag": {"lag": 1.5 * np.sin(np.arange(SECONDS + 1.0))},
    "bandlimit": {"cutoff_hz": 2500.0, "order": 6.0},
    "chassis_resonance": {"frequency_hz": 820.0, "q": 40.0, "gain_db": 0.0, "phase_deg": 30.0},
    "late_reverb": {"taps": 0.04 * _decaying(6000, 1200.0, 11)},
    "early_path": {"taps": 0.1 * _decaying(400, 60.0, 13)},
    "equaliser": {"gain_db": 6.0 * np.sin(np.arange(27) / 4.0)},
    "path_change": {"time_s": 6.3, "duration_s": 0.01, "taps": 0.05 * _decaying(600, 120.0, 12)},
    "fan_noise": {"spectrum_db": np.linspace(9.0, 3.0, 601)},
    "rattle": {
        "threshold": 0.02,
        "resonance_hz": 210.0,
        "outward": 0.004 * np.sin(np.arange(200) * 0.8) * np.exp(-np.arange(200) / 60),
        "inward": 0.003 * np.cos(np.arange(200) * 0.6) * np.exp(-np.arange(200) / 40),
    },
}
"""A strength that an effect's own fit has to find again, where half of the way to a bound is not one."""


RUN_CASES: dict[str, dict[str, object]] = {
    # other crossovers shift the lag at which the aligner finds a robot that it does not know
    "multiband_compression": {"crossover_hz": np.array([100.0, 6500.0])},
    "mic_agc": {"gain_db": 4.0 * np.sin(np.arange(4 * SECONDS) / 2.0), "range_db": 8.0, "time_constant_s": 0.5},
    "path_change": {"time_s": 0.0},
    "rattle": {"power": 1e-3, "decay_ms": 4.0},
}
"""What of an effect the running filter needs besides, or what shows in two seconds."""


def effect_case(name: str) -> Mapping[str, object]:
    """The effect at its case, or every number half of the way from neutral to its farther bound."""
    if name in EFFECT_CASES:
        return EFFECT_CASES[name]
    numbers = [p for p in catalogue.find(name).parameters if p is not RECORDING]
    return {p.name: (p.neutral + max(p.low, p.high, key=lambda bound: abs(bound - p.neutral))) / 2 for p in numbers}


LEFT_OVER = {"mic_agc": 0.25, "rattle": 0.4}
"""The gain within held-out blocks is interpolated; knocks of a regular voice hardly tell resonance and threshold
apart."""

EFFECT_CHECKS = [check for name, check in sorted(globals().items()) if name.startswith("effect_check_")]
