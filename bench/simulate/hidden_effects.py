"""Physical effects that a recording may hide (CATALOGUE), and disturbances outside that catalogue (OUTSIDE).

An effect is a function (rng, scene, chain, strength) -> (chain, parameters). Strength: "clear", "moderate" or "near",
by the power of what it changes at the microphone over the fan noise (ENR_DB), except where a physical range says it
better (RANGES). A disturbance also gets `person`: human speech (k,) at 16 kHz to draw a talker from; its strength is
the power of what cannot be explained at the microphone over the fan (of a codec: of what is not coherent with its
input).
"""

from __future__ import annotations

import math
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy import signal

from bench.simulate import hidden_robot as robot
from bench.simulate import simulated_robot as physics
from bench.simulate.hidden_robot import Chain, Scene, decibels, power, read_at, solve
from bench.simulate.simulated_robot import RATE, Array, Rng

Effect = Callable[[Rng, Scene, Chain, str], tuple[Chain, dict]]
Person = Callable[[Rng], Array]
Disturbance = Callable[[Rng, Scene, Chain, str, Person], tuple[Chain, dict]]

ENR_DB = {"clear": 12.0, "moderate": 5.0, "near": -1.0}
RANGES = {
    # RT60 in s; the calibration was made in rooms of 0.18-0.32 s
    "late_reverb": {"clear": (0.60, 0.85), "moderate": (0.45, 0.60), "near": (0.36, 0.45)},
    "bandlimit": {"clear": (2500, 3800), "moderate": (3800, 5000), "near": (5500, 6600)},  # Hz
    "clock_drift": {"clear": (100, 300), "moderate": (30, 100), "near": (10, 30)},  # ppm
    "delay_jump": {"clear": (100, 800), "moderate": (12, 100), "near": (2, 12)},  # samples
}


def log_uniform(rng: Rng, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def sign(rng: Rng) -> float:
    return float(rng.choice([-1.0, 1.0]))


def played_change_db(scene: Scene, chain: Chain) -> Callable[[Array], float]:
    """How far another played signal (n,) would be over the fan, with the loudspeaker taken as linear."""
    response = scene.linear_response()
    return lambda played: scene.over_fan_db(signal.oaconvolve(played - chain.played, response)[: played.size])


def levels_db(x: Array, step_ms: int) -> Array:
    """RMS level in dBFS of steps of so many ms, (m,)."""
    step = RATE * step_ms // 1000
    blocks = np.pad(x, (0, -x.size % step)).reshape(-1, step)
    return 10 * np.log10(np.mean(blocks**2, axis=1) + 1e-10)


def gain_curve(gain_db: Array, step_ms: int, n: int) -> Array:
    """Amplitude gain, interpolated in dB between the ends of the steps, (n,)."""
    ends = (np.arange(gain_db.size) + 1) * (RATE * step_ms // 1000)
    return 10 ** (np.interp(np.arange(n), ends, gain_db) / 20)


def smooth(x: Array, rise_ms: float, fall_ms: float) -> Array:
    """Smooth x (m,), a value a ms, by a first-order lag that rises with one time constant and falls with another."""
    rise, fall = (1.0 - math.exp(-1 / constant) for constant in (rise_ms, fall_ms))
    out, state = [], float(x[0])
    for value in x.tolist():
        state += (rise if value > state else fall) * (value - state)
        out.append(state)
    return np.array(out)


def compressor_gain_db(
    x: Array, threshold_db: float, ratio: float, knee_db: float, attack_ms: float, release_ms: float
) -> Array:
    """Gain per ms of a feed-forward compressor, (m,) (Giannoulis, Massberg & Reiss 2012, eq. (4) and (17))."""
    over = levels_db(x, 1) - threshold_db
    bend = np.clip(over + knee_db / 2, 0, knee_db) ** 2 / (2 * max(knee_db, 1e-6))
    reduction = (1.0 - 1.0 / ratio) * np.where(over > knee_db / 2, over, bend)
    return -smooth(reduction, attack_ms, release_ms)


def agc_gain_db(
    mic: Array, slope: float, target_db: float, attack_ms: float, release_ms: float, limit_db: float, hold_db: float
) -> Array:
    """Gain per 5 ms of a feedback loop that steers the output's level towards target_db, (m,).

    slope 0..1: how much of the deviation it takes away. Falls with attack_ms, rises with release_ms, within +-limit_db;
    stands still while the input is below hold_db.
    """
    fast, slow = (1.0 - math.exp(-5 / constant) for constant in (attack_ms, release_ms))
    loop = slope / max(1.0 - slope, 0.05)
    gain, out = 0.0, []
    for level in levels_db(mic, 5).tolist():
        if level > hold_db:
            wanted = min(max(loop * (target_db - level - gain), -limit_db), limit_db)
            gain += (fast if wanted < gain else slow) * (wanted - gain)
        out.append(gain)
    return np.array(out)


def soft_clip(x: Array, low: float, high: float, hardness: float) -> Array:
    """An amplifier that saturates towards high and -low, x / (1 + |x/limit|^h)^(1/h), at four times the rate."""
    up = signal.resample_poly(x, 4, 1)
    ratio = np.abs(up) / np.where(up > 0, high, low)
    return signal.resample_poly(up / (1.0 + ratio**hardness) ** (1.0 / hardness), 1, 4)[: x.size]


def playback_gain(rng: Rng, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    change = 10 ** ((ENR_DB[strength] - scene.over_fan_db(scene.echo(chain))) / 20)
    gain = 1.0 + change if rng.random() < 0.4 or change > 0.9 else 1.0 - change
    return replace(chain, played=gain * chain.played), {"gain_db": 20 * math.log10(gain)}


def bandlimit(rng: Rng, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    """Playback through a converter of a lower rate (its anti-aliasing filter), or an analogue low-pass."""
    cutoff = log_uniform(rng, *RANGES["bandlimit"][strength])
    if rng.random() < 0.5:
        down = RATE * 0.46 / cutoff
        up = 60
        rate = round(up * down)
        # resample_poly would cancel a common factor, and the taps would cut at another frequency
        while math.gcd(up, rate) > 1:
            rate += 1
        taps = signal.firwin(60 * 20 + 1, 2 * cutoff / (RATE * up), window=("kaiser", rng.uniform(5, 9)))
        low = signal.resample_poly(chain.played, up, rate, window=taps)
        back = signal.firwin(20 * rate + 1, 2 * cutoff / (RATE * up), window=("kaiser", 7))
        played = signal.resample_poly(low, rate, up, window=back)
        played = np.pad(played, (0, max(chain.played.size - played.size, 0)))[: chain.played.size]
        return replace(chain, played=played), {"cutoff_hz": cutoff, "kind": "converter", "rate_hz": RATE * up / rate}
    order = int(rng.integers(3, 9))
    sections = signal.butter(order, cutoff, fs=RATE, output="sos")
    low_hz = 300.0
    delay = -float(np.angle(signal.sosfreqz(sections, [low_hz], fs=RATE)[1][0])) / (2 * math.pi * low_hz) * RATE
    played = read_at(signal.sosfilt(sections, chain.played), np.arange(chain.played.size) + delay)
    return replace(chain, played=played), {"cutoff_hz": cutoff, "kind": "butterworth", "order": order}


def compression(rng: Rng, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    x = chain.played
    settings = {"ratio": rng.uniform(2, 8), "knee_db": rng.uniform(0, 8), "attack_ms": log_uniform(rng, 1, 25)}
    settings["release_ms"] = log_uniform(rng, 60, 500)
    makeup = bool(rng.random() < 0.6)
    change_db = played_change_db(scene, chain)

    def squeezed(threshold: float) -> Array:
        y = x * gain_curve(compressor_gain_db(x, threshold_db=20 * math.log10(threshold), **settings), 1, x.size)
        return y * math.sqrt(power(x) / power(y)) if makeup else y

    threshold = solve(lambda t: change_db(squeezed(t)), ENR_DB[strength], 10 ** (-45 / 20), 0.7)
    parameters = {"threshold_db": 20 * math.log10(threshold), "makeup": makeup, **settings}
    return replace(chain, played=squeezed(threshold)), parameters


def speaker_nonlinearity(rng: Rng, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    """A driver that reaches further into its suspension and magnet than when calibrated, or an amplifier that bends."""
    if rng.random() < 0.5:
        path = scene.gain_after * signal.oaconvolve(chain.paths[0][2], scene.shell)
        wanted = scene.fan_power * 10 ** (ENR_DB[strength] / 10)
        for _ in range(4):
            driver, _ = robot.with_distortion(chain.loudspeaker, chain.played, path, wanted)
            found_db = scene.over_fan_db(scene.echo(replace(chain, loudspeaker=driver)) - scene.echo(chain))
            if abs(found_db - ENR_DB[strength]) < 0.5:
                break
            wanted *= 10 ** ((ENR_DB[strength] - found_db) / 10)
        parameters = {"kind": "driver", "drive": driver.drive, "usual_drive": chain.loudspeaker.drive}
        return replace(chain, loudspeaker=driver), parameters
    hardness, skew = rng.uniform(1.8, 5.0), rng.uniform(0.8, 1.25)
    change_db = played_change_db(scene, chain)
    level = solve(lambda s: change_db(soft_clip(chain.played, s, skew * s, hardness)), ENR_DB[strength], 0.05, 30.0)
    parameters = {"kind": "amplifier", "level": level, "skew": skew, "hardness": hardness}
    return replace(chain, played=soft_clip(chain.played, level, skew * level, hardness)), parameters


def rattle(rng: Rng, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    """A loose part that the cone strikes: ringing modes, each strike of another force and a little late."""
    w = 2 * math.pi * chain.loudspeaker.resonance_hz
    displacement = signal.lfilter(*signal.bilinear([w * w], [1.0, w / chain.loudspeaker.q, w * w], RATE), chain.played)
    rate_hz = log_uniform(rng, 8, 60)
    peaks, _ = signal.find_peaks(sign(rng) * displacement, distance=RATE // 400)
    heights = np.abs(displacement[peaks])
    count = min(int(rate_hz * chain.played.size / RATE), peaks.size // 2)
    threshold = float(np.sort(heights)[-count])
    struck = heights >= threshold
    at = peaks[struck] + np.abs(rng.normal(0, 0.0004 * RATE, struck.sum())).astype(int)
    force = (heights[struck] / threshold - 0.8) * np.exp(rng.normal(0, 0.4, struck.sum()))
    blows = np.bincount(np.minimum(at, chain.played.size - 1), weights=force, minlength=chain.played.size)
    modes = [(log_uniform(rng, 900, 6000), log_uniform(rng, 0.001, 0.008), rng.uniform(0.3, 1.0))
             for _ in range(int(rng.integers(2, 6)))]  # fmt: skip
    t = np.arange(int(0.05 * RATE)) / RATE
    ring = sum(a * np.exp(-t / decay) * np.sin(2 * math.pi * f * t) for f, decay, a in modes)
    impacts = signal.oaconvolve(blows, ring)[: chain.played.size]
    unit_db = scene.over_fan_db(scene.echo(replace(chain, impacts=impacts)) - scene.echo(chain))
    impacts = impacts * 10 ** ((ENR_DB[strength] - unit_db) / 20)
    parameters = {"threshold": threshold, "impacts_per_s": int(struck.sum()) / chain.played.size * RATE}
    return replace(chain, impacts=impacts), parameters | {"modes_hz": [round(f) for f, _, _ in modes]}


def chassis_resonance(rng: Rng, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    """One panel of the shell, sometimes two, that rings beside the direct path."""
    t = np.arange(int(0.35 * RATE)) / RATE
    modes = []
    for _ in range(1 if rng.random() < 0.75 else 2):
        frequency, q = log_uniform(rng, 250, 3000), log_uniform(rng, 15, 90)
        ring = np.exp(-math.pi * frequency / q * t) * np.cos(2 * math.pi * frequency * t + rng.uniform(0, 2 * math.pi))
        modes.append((frequency, q, ring * math.pi * frequency / q / RATE))
    ringing = np.sum([ring for _, _, ring in modes], axis=0)
    unit_db = scene.over_fan_db(scene.echo(replace(chain, ringing=ringing)) - scene.echo(chain))
    gain = 10 ** ((ENR_DB[strength] - unit_db) / 20)
    parameters = {"frequency_hz": [f for f, _, _ in modes], "q": [q for _, q, _ in modes]}
    return replace(chain, ringing=gain * ringing), parameters | {"peak_gain_db": 20 * math.log10(gain)}


def late_reverb(rng: Rng, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    """The same robot carried to a more reverberant room, or its own room emptied of curtains and carpets."""
    rt60_s = rng.uniform(*RANGES["late_reverb"][strength])
    here = scene.moved
    place = robot.draw_place(rng, rt60_s, here.loudspeaker - here.microphone)
    if same_room := bool(rng.random() < 0.4):
        bare = robot.draw_place(rng, rt60_s, size=here.size)
        place = replace(here, absorption=bare.absorption, order=bare.order)
    parameters = {"rt60_s": rt60_s, "same_room": same_room, "room_m": place.size.tolist()}
    return replace(chain, paths=((0, 0, place.response()),)), parameters


def path_change(rng: Rng, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    """From some moment on the head has turned, the robot has moved, or a person stands by it."""
    n, before = chain.played.size, chain.paths[0][2]
    start, fade = int(rng.uniform(0.25, 0.7) * n), int(log_uniform(rng, 0.05, 0.8) * RATE)
    kind, step = str(rng.choice(["head", "robot", "person"])), robot.direction(rng)
    mirror = robot.reflector(rng, scene.moved)

    def after(metres: float) -> Array:
        if kind == "person":
            extra = mirror(metres)
            size = max(extra.size, before.size)
            return _padded(before, size) + _padded(extra, size)
        return (scene.moved.microphone_moved if kind == "head" else scene.moved.robot_moved)(metres * step).response()

    source = scene.gain_after * signal.oaconvolve(scene.pressure(chain), scene.shell)[:n]
    source[:start] = 0.0

    def change_db(metres: float) -> float:
        new = after(metres)
        size = max(new.size, before.size)
        return scene.over_fan_db(signal.oaconvolve(source, _padded(new, size) - _padded(before, size))[:n])

    bounds = {"head": (1e-3, 0.08), "robot": (2e-3, 0.5), "person": (0.08, 3.0)}[kind]
    metres = solve(change_db, ENR_DB[strength], *bounds, tolerance=0.3)
    parameters = {"time_s": start / RATE, "fade_s": fade / RATE, "kind": kind, "m": metres}
    return replace(chain, paths=(chain.paths[0], (start, fade, after(metres)))), parameters


def _padded(x: Array, size: int) -> Array:
    return np.pad(x, (0, size - x.size))


def clock_drift(rng: Rng, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    """Converters of two clocks, one of which warms up a little."""
    ppm, t = sign(rng) * log_uniform(rng, *RANGES["clock_drift"][strength]), np.arange(chain.played.size)
    samples, period = rng.uniform(0.01, 0.06), RATE * rng.uniform(15, 60)
    wander = samples * np.sin(2 * math.pi * t / period + rng.uniform(0, 2 * math.pi))
    return replace(chain, lag=-ppm * 1e-6 * t + wander), {"ppm": ppm}


def delay_jump(rng: Rng, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    """Buffers that run dry (silence or a repetition is put in) or overflow (samples are dropped) in speech."""
    n, x = chain.played.size, chain.played
    times = np.sort(rng.uniform(0.15, 0.85, size={"clear": 3, "moderate": 2, "near": 1}[strength]))
    times = times[np.insert(np.diff(times) > 0.1, 0, True)]
    jumps = [sign(rng) * log_uniform(rng, *RANGES["delay_jump"][strength]) for _ in times]
    starts = (times * n).astype(int)
    starts = np.array([start + int(np.argmax(np.abs(x[start : start + RATE]))) for start in starts])
    lag = np.zeros(n)
    for start, jump in zip(starts, jumps, strict=True):
        lag[start:] += jump
    played = read_at(x, np.arange(n) - lag)
    if silent := bool(rng.random() < 0.5):
        for start, jump in zip(starts, jumps, strict=True):
            played[start : start + int(max(jump, 0))] = 0.0
    parameters = {"time_s": (starts / RATE).tolist(), "samples": jumps}
    return replace(chain, played=played), parameters | {"filled_with": "silence" if silent else "repetition"}


def mic_agc(rng: Rng, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    mic = scene.record(chain)
    level_db = decibels(power(mic))
    settings = {"target_db": level_db + rng.uniform(-6, 6), "attack_ms": log_uniform(rng, 40, 600)}
    settings |= {"release_ms": log_uniform(rng, 500, 5000)}
    settings |= {"limit_db": rng.uniform(8, 20), "hold_db": level_db - rng.uniform(15, 40)}

    def steered(x: Array, slope: float) -> Array:
        return x * gain_curve(agc_gain_db(x, slope, **settings), 5, x.size)

    slope = solve(lambda s: scene.over_fan_db(steered(mic, s) - mic), ENR_DB[strength], 1e-3, 0.95)
    parameters = {"slope": slope, "range_db": float(np.ptp(agc_gain_db(mic, slope, **settings))), **settings}
    return replace(chain, microphone=(*chain.microphone, lambda x: steered(x, slope))), parameters


def mic_clipping(rng: Rng, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    """A converter at its limit, or a preamplifier that saturates in front of it."""
    mic = scene.record(chain)
    peak, hardness, skew = float(np.abs(mic).max()), rng.uniform(8, 20), rng.uniform(0.85, 1.15)
    preamplifier = bool(rng.random() < 0.3)

    def clipped(x: Array, level: float) -> Array:
        return soft_clip(x, level, skew * level, hardness) if preamplifier else np.clip(x, -level, level)

    level = solve(lambda s: scene.over_fan_db(clipped(mic, s) - mic), ENR_DB[strength], 0.02 * peak, 1.5 * peak)
    kind = "preamplifier" if preamplifier else "converter"
    parameters = {"level": level, "kind": kind, "level_of_peak": level / peak}
    return replace(chain, microphone=(*chain.microphone, lambda x: clipped(x, level))), parameters


def fan_noise(rng: Rng, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    """From the start or later on the fan turns faster, is louder, or a bearing or a vent has begun to sing."""
    f, old = np.linspace(0, RATE / 2, 1025), scene.fan_amplitude
    kind = str(rng.choice(["louder", "faster", "band", "lines"]))
    speed = rng.uniform(1.05, 1.4)
    if kind == "band":
        centre, width = log_uniform(rng, 300, 5000), rng.uniform(0.1, 0.4)
        shape = np.exp(-0.5 * (np.log2((f + 1) / centre) / width) ** 2)
    elif kind == "lines":
        blade, width = rng.uniform(110, 380), rng.uniform(5, 10)
        count = int(rng.integers(3, 8))
        lines = (rng.uniform(0.2, 1) * np.exp(-0.5 * ((f - k * blade) / (width * k)) ** 2) for k in range(1, count))
        shape = sum(lines)
    else:
        shape = np.interp(f / speed, f, old) if kind == "faster" else old
    n = chain.fan.size

    def new(s: float) -> Array:
        return s * shape if kind == "faster" else np.sqrt(old**2 + (s * shape) ** 2)

    low = 1.0 if kind == "faster" else 0.01
    s = solve(lambda s: decibels(float(np.mean(np.abs(new(s) ** 2 - old**2)))), ENR_DB[strength], low, 1000.0)
    noise = physics.fan_noise(rng, new(s), n)
    noise *= math.sqrt(scene.fan_power * np.mean(new(s) ** 2) / power(noise))
    start = int(rng.uniform(0.15, 0.5) * n) if rng.random() < 0.25 else -RATE
    grown = np.clip((np.arange(n) - start) / (rng.uniform(0.3, 2) * RATE), 0, 1) if start > 0 else np.ones(n)
    fan = np.sqrt(1 - grown) * chain.fan + np.sqrt(grown) * noise
    parameters = {"kind": kind, "change_db": decibels(float(np.mean(new(s) ** 2))), "from_s": max(start, 0) / RATE}
    parameters["spectral_change_db"] = decibels(float(np.mean(np.abs(new(s) ** 2 - old**2)) * np.mean(grown)))
    return replace(chain, fan=fan), parameters | ({"speed": speed} if kind == "faster" else {})


CATALOGUE: dict[str, Effect] = {effect.__name__: effect for effect in (
    late_reverb, chassis_resonance, playback_gain, bandlimit, clock_drift, delay_jump, path_change, compression,
    mic_agc, speaker_nonlinearity, mic_clipping, rattle, fan_noise,
)}  # fmt: skip


CODECS = {
    "opus": ("libopus", RATE, ["-application", "voip"], ("ogg", "ogg"), (8, 12, 16, 24, 32, 48)),
    "mp3": ("libmp3lame", RATE, [], ("mp3", "mp3"), (8, 16, 24, 32, 48, 64)),
    "speex": ("libspeex", RATE, [], ("ogg", "ogg"), (4, 8, 16)),
    "gsm": ("libgsm", 8000, [], ("gsm", "gsm"), (13,)),
    "g726": ("g726", 8000, [], ("wav", "wav"), (16, 24, 32)),
}
"""Encoder of ffmpeg, its rate in Hz, options, formats out and in, bit rates in kbit/s from bad to good."""


CUT_HZ = 6500.0
"""Where a codec passes little above this frequency, "bandlimit" counts as a right name as well."""


def _with_sound(scene: Scene, chain: Chain, sound: Array, strength: str) -> Chain:
    """The chain with a sound (n,) of any level, added at the microphone at the wanted one."""
    sound = sound * 10 ** ((ENR_DB[strength] - scene.over_fan_db(sound)) / 20)
    return replace(chain, others=sound if chain.others is None else chain.others + sound)


def in_room(rng: Rng, x: Array) -> Array:
    """Samples x (n,) from a few metres away: direct sound and a tail of 0.3-0.5 s that loses its treble first."""
    t = np.arange(RATE // 2) / RATE
    tail = rng.standard_normal(t.size) * np.exp(-6.9 * t / rng.uniform(0.3, 0.5))
    tail = signal.lfilter(*signal.butter(1, 3000, fs=RATE), tail)
    tail[: int(0.004 * RATE)] = 0.0
    response = 0.5 * tail / math.sqrt(np.sum(tail**2))
    response[0] = 1.0
    return signal.oaconvolve(x, response)[: x.size]


def mains_hum(rng: Rng, scene: Scene, chain: Chain, strength: str, _: Person) -> tuple[Chain, dict]:
    """A ground loop: lines at multiples of 50 or 60 Hz, the odd ones stronger, wandering by hundredths of a Hz."""
    n, mains = chain.fan.size, float(rng.choice([50.0, 60.0]))
    wander = np.cumsum(rng.normal(0, 1, n // RATE + 2))
    wander = wander / max(np.abs(wander).max(), 1.0)
    frequency = mains + 0.02 * np.interp(np.arange(n) / RATE, np.arange(wander.size), wander)
    phase = 2 * math.pi * np.cumsum(frequency) / RATE
    top, hum = int(rng.integers(6, 25)), np.zeros(n)
    for k in range(1, top):
        hum += (1.0 if k % 2 else 0.5) * k ** -rng.uniform(0.4, 1.2) * np.sin(k * phase + rng.uniform(0, 2 * math.pi))
    return _with_sound(scene, chain, hum, strength), {"mains_hz": mains, "lines": top - 1}


def talker(rng: Rng, scene: Scene, chain: Chain, strength: str, person: Person) -> tuple[Chain, dict]:
    """Somebody talks near by, now and then, also in the robot's pauses."""
    sound, at = np.zeros(chain.fan.size), int(rng.uniform(0.5, 4) * RATE)
    while at < sound.size - RATE:
        words = person(rng)[: sound.size - at]
        sound[at : at + words.size] = words
        at += words.size + int(rng.uniform(1, 5) * RATE)
    return _with_sound(scene, chain, in_room(rng, sound), strength), {}


def music(rng: Rng, scene: Scene, chain: Chain, strength: str, _: Person) -> tuple[Chain, dict]:
    """A radio: plucked chords (Karplus & Strong 1983) over a beat of noise bursts."""
    n, beat = chain.fan.size, int(rng.uniform(0.22, 0.45) * RATE)
    sound, scale_hz = np.zeros(n), 110 * 2 ** (rng.integers(0, 12) / 12) * 2 ** (np.array([0, 2, 4, 5, 7, 9, 11]) / 12)
    for i, start in enumerate(range(0, n - 2 * RATE, beat)):
        for pitch in rng.choice(scale_hz, size=int(rng.integers(1, 4)), replace=False) * 2.0 ** rng.integers(0, 3):
            period = int(RATE / pitch)
            excitation = np.concatenate([rng.uniform(-1, 1, period), np.zeros(RATE)])
            comb = np.zeros(period + 2)
            comb[0], comb[period], comb[period + 1] = 1.0, -0.498, -0.498
            sound[start : start + excitation.size] += signal.lfilter([1.0], comb, excitation)
        burst = rng.standard_normal(RATE // 20) * np.exp(-np.arange(RATE // 20) / (RATE * 0.01))
        sound[start : start + burst.size] += (2.0 if i % 4 == 0 else 0.5) * burst
    return _with_sound(scene, chain, in_room(rng, sound), strength), {"beat_s": beat / RATE}


def door_slams(rng: Rng, scene: Scene, chain: Chain, strength: str, _: Person) -> tuple[Chain, dict]:
    """Doors and things that fall, at times that have nothing to do with what the robot says."""
    n = chain.fan.size
    times, sound = np.sort(rng.uniform(0.03, 0.95, size=int(rng.integers(2, 7)))), np.zeros(n)
    for time in times:
        blow = rng.standard_normal(RATE // 3) * np.exp(-np.arange(RATE // 3) / (RATE * rng.uniform(0.01, 0.05)))
        blow = signal.sosfilt(signal.butter(2, rng.uniform(300, 3000), fs=RATE, output="sos"), blow)
        part = sound[int(time * n) :][: blow.size]
        part += rng.uniform(0.4, 1.0) * blow[: part.size]
    return _with_sound(scene, chain, in_room(rng, sound), strength), {"times_s": (times * n / RATE).tolist()}


def flutter(rng: Rng, scene: Scene, chain: Chain, strength: str, _: Person) -> tuple[Chain, dict]:
    """A clock that trembles (2-12 Hz), as a bad resampler or a loudspeaker on a spring makes it."""
    rate_hz, t = log_uniform(rng, 2, 12), np.arange(chain.fan.size) / RATE
    wave = np.sin(2 * math.pi * rate_hz * t + rng.uniform(0, 6))
    wave = wave + 0.3 * np.sin(2 * math.pi * rate_hz * 2.3 * t + rng.uniform(0, 6))
    echo, usual = scene.echo(chain), np.zeros(t.size) if chain.lag is None else chain.lag
    slope = np.fft.irfft(np.fft.rfft(echo) * 2j * math.pi * np.fft.rfftfreq(echo.size), echo.size)
    samples = solve(lambda s: scene.over_fan_db(s * wave * slope), ENR_DB[strength], 1e-4, 30.0)
    return replace(chain, lag=usual + samples * wave), {"rate_hz": rate_hz, "samples": samples}


def packet_loss(rng: Rng, scene: Scene, chain: Chain, strength: str, _: Person) -> tuple[Chain, dict]:
    """Streamed packets of 10-40 ms are lost: silence, or the last one again and fading; the clock goes on."""
    x, length = chain.played, int(rng.choice([10, 20, 40])) * RATE // 1000
    repeats, fade = bool(rng.random() < 0.5), np.linspace(0, 1, 32)
    order = rng.permutation(np.arange(8, x.size // length - 2))
    loud = np.add.reduceat(x**2, np.arange(0, x.size - length, length))
    order = order[loud[order] > 0.05 * loud.mean()]
    played, response = x.copy(), scene.linear_response()
    wanted = scene.fan_power * 10 ** (ENR_DB[strength] / 10) * x.size
    changed, lost = 0.0, 0
    for packet in order:
        part = slice(packet * length, (packet + 1) * length)
        new = 0.6 * x[part.start - length : part.start] if repeats else np.zeros(length)
        new[:32] = (1 - fade) * x[part][:32] + fade * new[:32]
        new[-32:] = fade * x[part][-32:] + (1 - fade) * new[-32:]
        energy = float(np.sum(signal.oaconvolve(new - x[part], response) ** 2))
        if changed + energy < 1.1 * wanted:
            played[part], lost, changed = new, lost + 1, changed + energy
        if changed > 0.9 * wanted:
            break
    parameters = {"lost_packets": lost, "packet_ms": length * 1000 // RATE}
    return replace(chain, played=played), parameters | {"filled_with": "repetition" if repeats else "silence"}


def codec(rng: Rng, scene: Scene, chain: Chain, strength: str, _: Person) -> tuple[Chain, dict]:
    """The playback through a codec of ffmpeg, at its lowest bit rate whose noise does not exceed the strength."""
    name = str(rng.choice(sorted(CODECS)))
    response, tries = scene.linear_response(), []
    for kbps in CODECS[name][-1]:
        played = through_codec(chain.played, name, kbps)
        heard, original = (signal.oaconvolve(x, response)[: x.size] for x in (played, chain.played))
        noise_db = incoherent_db(original, heard) + scene.over_fan_db(heard)
        parameters = {"codec": name, "kbps": kbps, "incoherent_over_fan_db": noise_db}
        tries.append((abs(noise_db - ENR_DB[strength]), parameters, played))
        if noise_db < ENR_DB[strength]:
            break
    _, parameters, played = min(tries, key=lambda entry: entry[0])
    return replace(chain, played=played), parameters | {"cuts_band": cuts_band(chain.played, played)}


def through_codec(x: Array, name: str, kbps: int) -> Array:
    """Samples x (n,) encoded and decoded, put back in time; needs ffmpeg."""
    encoder, rate, options, (outer, inner), _ = CODECS[name]
    if not shutil.which("ffmpeg"):
        sys.exit("ffmpeg was not found; the set `outside` needs it for its codecs (Debian: apt-get install ffmpeg)")
    quiet, raw = ["ffmpeg", "-v", "error", "-threads", "1"], ["-f", "f32le", "-ac", "1"]
    bits = [] if name == "gsm" else ["-b:a", f"{kbps}k"]
    pcm = signal.resample_poly(x, rate, RATE).astype(np.float32).tobytes()
    encode = [*quiet, *raw, "-ar", str(rate), "-i", "-", "-c:a", encoder, *bits, *options, "-f", outer, "-"]
    packed = subprocess.run(encode, input=pcm, capture_output=True, check=True).stdout
    decode = [*quiet, "-f", inner, "-i", "-", *raw, "-ar", str(rate), "-"]
    out = subprocess.run(decode, input=packed, capture_output=True, check=True).stdout
    return put_back(signal.resample_poly(np.frombuffer(out, np.float32).astype(np.float64), RATE, rate), x)


def put_back(y: Array, x: Array) -> Array:
    """Put y, of any length, at the lag of whole samples at which it is most like x (n,); (n,)."""
    lags = signal.correlate(y[: 1 << 18], x[: 1 << 18], method="fft")
    lag = int(np.argmax(np.abs(lags))) - min(x.size, 1 << 18) + 1
    y = y[lag:] if lag >= 0 else np.concatenate([np.zeros(-lag), y])
    return np.pad(y, (0, max(x.size - y.size, 0)))[: x.size]


def cuts_band(x: Array, y: Array) -> bool:
    """Whether of the power of x (n,) above CUT_HZ less than a quarter is in y (n,)."""
    hz, before = signal.welch(x, fs=RATE, nperseg=1024)
    after = signal.welch(y, fs=RATE, nperseg=1024)[1]
    return bool(after[hz > CUT_HZ].sum() < 0.25 * before[hz > CUT_HZ].sum())


def incoherent_db(x: Array, y: Array) -> float:
    """Share of y's power (n,), dB, that no linear filter of x (n,) explains: one minus the coherence (64 ms, Welch)."""
    _, coherence = signal.coherence(x, y, fs=RATE, nperseg=1024)
    _, spectrum = signal.welch(y, fs=RATE, nperseg=1024)
    return decibels(float(np.sum((1.0 - coherence) * spectrum) / np.sum(spectrum)))


OUTSIDE: dict[str, Disturbance] = {kind.__name__: kind for kind in (
    mains_hum, talker, codec, flutter, packet_loss, door_slams, music
)}  # fmt: skip
NAMED = ("packet_loss", "codec")
"""Of these, what the diagnosis has a name for."""
