"""The thirteen physical effects that a recording may hide: each changes a chain by a wanted strength.

An effect is a function (rng, scene, chain, strength) -> (chain, parameters). Strength: "clear", "moderate" or "near",
by the power of what it changes at the microphone over the fan noise (ENR_DB), except where a physical range says it
better (RANGES).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy import signal

from bench.simulate.hidden_acoustics import decibels, direction, draw_place, power, read_at, reflector, solve
from bench.simulate.hidden_dynamics import agc_gain_db, gain_curve, soft_clip
from bench.simulate.hidden_robot import Chain, Scene
from bench.simulate.hidden_strength import ENR_DB, RANGES, Effect, log_uniform, sign
from bench.simulate.hidden_voice import bandlimit, compression, playback_gain, rattle, speaker_nonlinearity
from bench.simulate.simulated_robot import RATE, Array, fan_noise


def chassis_resonance(rng: np.random.Generator, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
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
    parameters = {
        "frequency_hz": [f for f, _, _ in modes],
        "q": [q for _, q, _ in modes],
        "peak_gain_db": 20 * math.log10(gain),
    }
    return replace(chain, ringing=gain * ringing), parameters


def late_reverb(rng: np.random.Generator, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    """The same robot carried to a more reverberant room, or its own room emptied of curtains and carpets."""
    rt60_s = rng.uniform(*RANGES["late_reverb"][strength])
    here = scene.moved
    place = draw_place(rng, rt60_s, here.loudspeaker - here.microphone)
    if same_room := bool(rng.random() < 0.4):
        bare = draw_place(rng, rt60_s, size=here.size)
        place = replace(here, absorption=bare.absorption, order=bare.order)
    return replace(chain, paths=((0, 0, place.response()),)), {
        "rt60_s": rt60_s,
        "same_room": same_room,
        "room_m": place.size.tolist(),
    }


def path_change(rng: np.random.Generator, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    """From some moment on the head has turned, the robot has moved, or a person stands by it."""
    n, before = chain.played.size, chain.paths[0][2]
    start, fade = int(rng.uniform(0.25, 0.7) * n), int(log_uniform(rng, 0.05, 0.8) * RATE)
    kind, step = str(rng.choice(["head", "robot", "person"])), direction(rng)
    mirror = reflector(rng, scene.moved)

    def after(metres: float) -> Array:
        if kind == "person":
            extra = mirror(metres)
            return np.pad(before, (0, max(extra.size - before.size, 0))) + np.pad(
                extra, (0, max(before.size - extra.size, 0))
            )
        return (scene.moved.microphone_moved if kind == "head" else scene.moved.robot_moved)(metres * step).response()

    source = scene.gain_after * signal.oaconvolve(scene.pressure(chain), scene.shell)[:n]
    source[:start] = 0.0

    def change_db(metres: float) -> float:
        new = after(metres)
        size = max(new.size, before.size)
        return scene.over_fan_db(
            signal.oaconvolve(source, np.pad(new, (0, size - new.size)) - np.pad(before, (0, size - before.size)))[:n]
        )

    metres = solve(
        change_db,
        ENR_DB[strength],
        *{"head": (1e-3, 0.08), "robot": (2e-3, 0.5), "person": (0.08, 3.0)}[kind],
        tolerance=0.3,
    )
    parameters = {"time_s": start / RATE, "fade_s": fade / RATE, "kind": kind, "m": metres}
    return replace(chain, paths=(chain.paths[0], (start, fade, after(metres)))), parameters


def clock_drift(rng: np.random.Generator, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    """Converters of two clocks, one of which warms up a little."""
    ppm, t = sign(rng) * log_uniform(rng, *RANGES["clock_drift"][strength]), np.arange(chain.played.size)
    wander = rng.uniform(0.01, 0.06) * np.sin(
        2 * math.pi * t / (RATE * rng.uniform(15, 60)) + rng.uniform(0, 2 * math.pi)
    )
    return replace(chain, lag=-ppm * 1e-6 * t + wander), {"ppm": ppm}


def delay_jump(rng: np.random.Generator, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
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
    parameters = {
        "time_s": (starts / RATE).tolist(),
        "samples": jumps,
        "filled_with": "silence" if silent else "repetition",
    }
    return replace(chain, played=played), parameters


def mic_agc(rng: np.random.Generator, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    mic = scene.record(chain)
    level_db = decibels(power(mic))
    settings = {
        "target_db": level_db + rng.uniform(-6, 6),
        "attack_ms": log_uniform(rng, 40, 600),
        "release_ms": log_uniform(rng, 500, 5000),
    }
    settings |= {"limit_db": rng.uniform(8, 20), "hold_db": level_db - rng.uniform(15, 40)}

    def steered(x: Array, slope: float) -> Array:
        return x * gain_curve(agc_gain_db(x, slope, **settings), 5, x.size)

    slope = solve(lambda s: scene.over_fan_db(steered(mic, s) - mic), ENR_DB[strength], 1e-3, 0.95)
    parameters = {"slope": slope, "range_db": float(np.ptp(agc_gain_db(mic, slope, **settings))), **settings}
    return replace(chain, microphone=(*chain.microphone, lambda x: steered(x, slope))), parameters


def mic_clipping(rng: np.random.Generator, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    """A converter at its limit, or a preamplifier that saturates in front of it."""
    mic = scene.record(chain)
    peak, hardness, skew = float(np.abs(mic).max()), rng.uniform(8, 20), rng.uniform(0.85, 1.15)
    preamplifier = bool(rng.random() < 0.3)

    def clipped(x: Array, level: float) -> Array:
        return soft_clip(x, level, skew * level, hardness) if preamplifier else np.clip(x, -level, level)

    level = solve(lambda s: scene.over_fan_db(clipped(mic, s) - mic), ENR_DB[strength], 0.02 * peak, 1.5 * peak)
    parameters = {
        "level": level,
        "kind": "preamplifier" if preamplifier else "converter",
        "level_of_peak": level / peak,
    }
    return replace(chain, microphone=(*chain.microphone, lambda x: clipped(x, level))), parameters


def fan_noise_change(rng: np.random.Generator, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    """The fan turns faster, is louder, or a bearing or a vent has begun to sing.

    From the start or from some moment on.
    """
    f, old = np.linspace(0, RATE / 2, 1025), scene.fan_amplitude
    kind = str(rng.choice(["louder", "faster", "band", "lines"]))
    speed = rng.uniform(1.05, 1.4)
    if kind == "band":
        centre, width = log_uniform(rng, 300, 5000), rng.uniform(0.1, 0.4)
        shape = np.exp(-0.5 * (np.log2((f + 1) / centre) / width) ** 2)
    elif kind == "lines":
        blade, width = rng.uniform(110, 380), rng.uniform(5, 10)
        shape = sum(
            rng.uniform(0.2, 1) * np.exp(-0.5 * ((f - k * blade) / (width * k)) ** 2)
            for k in range(1, int(rng.integers(3, 8)))
        )
    else:
        shape = np.interp(f / speed, f, old) if kind == "faster" else old
    n = chain.fan.size

    def new(s: float) -> Array:
        return s * shape if kind == "faster" else np.sqrt(old**2 + (s * shape) ** 2)

    s = solve(
        lambda s: decibels(float(np.mean(np.abs(new(s) ** 2 - old**2)))),
        ENR_DB[strength],
        1.0 if kind == "faster" else 0.01,
        1000.0,
    )
    noise = fan_noise(rng, new(s), n)
    noise *= math.sqrt(scene.fan_power * np.mean(new(s) ** 2) / power(noise))
    start = int(rng.uniform(0.15, 0.5) * n) if rng.random() < 0.25 else -RATE
    grown = np.clip((np.arange(n) - start) / (rng.uniform(0.3, 2) * RATE), 0, 1) if start > 0 else np.ones(n)
    fan = np.sqrt(1 - grown) * chain.fan + np.sqrt(grown) * noise
    parameters = {"kind": kind, "change_db": decibels(float(np.mean(new(s) ** 2))), "from_s": max(start, 0) / RATE}
    parameters["spectral_change_db"] = decibels(float(np.mean(np.abs(new(s) ** 2 - old**2)) * np.mean(grown)))
    return replace(chain, fan=fan), parameters | ({"speed": speed} if kind == "faster" else {})


CATALOGUE: dict[str, Effect] = {
    "late_reverb": late_reverb,
    "chassis_resonance": chassis_resonance,
    "playback_gain": playback_gain,
    "bandlimit": bandlimit,
    "clock_drift": clock_drift,
    "delay_jump": delay_jump,
    "path_change": path_change,
    "compression": compression,
    "mic_agc": mic_agc,
    "speaker_nonlinearity": speaker_nonlinearity,
    "mic_clipping": mic_clipping,
    "rattle": rattle,
    "fan_noise": fan_noise_change,
}
