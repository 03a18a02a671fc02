"""Hidden effects of what is played: another gain, a narrower band, a compressor, a distorting or rattling speaker."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy import signal

from bench.simulate.hidden_acoustics import power, read_at, solve
from bench.simulate.hidden_dynamics import compressor_gain_db, gain_curve, soft_clip
from bench.simulate.hidden_robot import Chain, Scene, with_distortion
from bench.simulate.hidden_strength import ENR_DB, RANGES, log_uniform, played_change_db, sign
from bench.simulate.simulated_robot import RATE, Array


def playback_gain(rng: np.random.Generator, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    change = 10 ** ((ENR_DB[strength] - scene.over_fan_db(scene.echo(chain))) / 20)
    gain = 1.0 + change if rng.random() < 0.4 or change > 0.9 else 1.0 - change
    return replace(chain, played=gain * chain.played), {"gain_db": 20 * math.log10(gain)}


def bandlimit(rng: np.random.Generator, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    """Playback through a converter of a lower rate (its anti-aliasing filter), or an analogue low-pass."""
    cutoff = log_uniform(rng, *RANGES["bandlimit"][strength])
    if rng.random() < 0.5:
        down = RATE * 0.46 / cutoff
        up = 60
        rate = round(up * down)
        while (
            math.gcd(up, rate) > 1
        ):  # resample_poly would cancel the factor, and the taps would cut at another frequency
            rate += 1
        taps = signal.firwin(60 * 20 + 1, 2 * cutoff / (RATE * up), window=("kaiser", rng.uniform(5, 9)))
        low = signal.resample_poly(chain.played, up, rate, window=taps)
        played = signal.resample_poly(
            low, rate, up, window=signal.firwin(20 * rate + 1, 2 * cutoff / (RATE * up), window=("kaiser", 7))
        )
        played = np.pad(played, (0, max(chain.played.size - played.size, 0)))[: chain.played.size]
        return replace(chain, played=played), {"cutoff_hz": cutoff, "kind": "converter", "rate_hz": RATE * up / rate}
    order = int(rng.integers(3, 9))
    sections = signal.butter(order, cutoff, fs=RATE, output="sos")
    low_hz = 300.0
    delay = -float(np.angle(signal.sosfreqz(sections, [low_hz], fs=RATE)[1][0])) / (2 * math.pi * low_hz) * RATE
    played = read_at(signal.sosfilt(sections, chain.played), np.arange(chain.played.size) + delay)
    return replace(chain, played=played), {"cutoff_hz": cutoff, "kind": "butterworth", "order": order}


def compression(rng: np.random.Generator, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    x = chain.played
    settings = {"ratio": rng.uniform(2, 8), "knee_db": rng.uniform(0, 8), "attack_ms": log_uniform(rng, 1, 25)}
    settings["release_ms"] = log_uniform(rng, 60, 500)
    makeup = bool(rng.random() < 0.6)
    change_db = played_change_db(scene, chain)

    def squeezed(threshold: float) -> Array:
        y = x * gain_curve(compressor_gain_db(x, threshold_db=20 * math.log10(threshold), **settings), 1, x.size)
        return y * math.sqrt(power(x) / power(y)) if makeup else y

    threshold = solve(lambda t: change_db(squeezed(t)), ENR_DB[strength], 10 ** (-45 / 20), 0.7)
    return replace(chain, played=squeezed(threshold)), {
        "threshold_db": 20 * math.log10(threshold),
        "makeup": makeup,
        **settings,
    }


def speaker_nonlinearity(rng: np.random.Generator, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    """A driver that reaches further into its suspension and magnet than when calibrated, or an amplifier that bends."""
    if rng.random() < 0.5:
        path = scene.gain_after * signal.oaconvolve(chain.paths[0][2], scene.shell)
        wanted = scene.fan_power * 10 ** (ENR_DB[strength] / 10)
        for _ in range(4):
            driver, _ = with_distortion(chain.loudspeaker, chain.played, path, wanted)
            found_db = scene.over_fan_db(scene.echo(replace(chain, loudspeaker=driver)) - scene.echo(chain))
            if abs(found_db - ENR_DB[strength]) < 0.5:
                break
            wanted *= 10 ** ((ENR_DB[strength] - found_db) / 10)
        return replace(chain, loudspeaker=driver), {
            "kind": "driver",
            "drive": driver.drive,
            "usual_drive": chain.loudspeaker.drive,
        }
    hardness, skew = rng.uniform(1.8, 5.0), rng.uniform(0.8, 1.25)
    change_db = played_change_db(scene, chain)
    level = solve(lambda s: change_db(soft_clip(chain.played, s, skew * s, hardness)), ENR_DB[strength], 0.05, 30.0)
    parameters = {"kind": "amplifier", "level": level, "skew": skew, "hardness": hardness}
    return replace(chain, played=soft_clip(chain.played, level, skew * level, hardness)), parameters


def rattle(rng: np.random.Generator, scene: Scene, chain: Chain, strength: str) -> tuple[Chain, dict]:
    """A loose part that the cone's displacement makes strike.

    Ringing modes, each strike of another force and a little late.
    """
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
    modes = [
        (log_uniform(rng, 900, 6000), log_uniform(rng, 0.001, 0.008), rng.uniform(0.3, 1.0))
        for _ in range(int(rng.integers(2, 6)))
    ]
    t = np.arange(int(0.05 * RATE)) / RATE
    ring = sum(a * np.exp(-t / decay) * np.sin(2 * math.pi * f * t) for f, decay, a in modes)
    impacts = signal.oaconvolve(blows, ring)[: chain.played.size]
    unit_db = scene.over_fan_db(scene.echo(replace(chain, impacts=impacts)) - scene.echo(chain))
    impacts = impacts * 10 ** ((ENR_DB[strength] - unit_db) / 20)
    parameters = {"threshold": threshold, "impacts_per_s": int(struck.sum()) / chain.played.size * RATE}
    return replace(chain, impacts=impacts), parameters | {"modes_hz": [round(f) for f, _, _ in modes]}
