"""How strong a hidden effect is, and what the effects draw alike."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy import signal

from bench.simulate.hidden_robot import Chain, Scene
from bench.simulate.simulated_robot import Array

Effect = Callable[[np.random.Generator, Scene, Chain, str], tuple[Chain, dict]]

ENR_DB = {"clear": 12.0, "moderate": 5.0, "near": -1.0}
RANGES = {
    "late_reverb": {
        "clear": (0.60, 0.85),
        "moderate": (0.45, 0.60),
        "near": (0.36, 0.45),
    },  # RT60 in s, calibrated at 0.18-0.32
    "bandlimit": {"clear": (2500, 3800), "moderate": (3800, 5000), "near": (5500, 6600)},  # Hz
    "clock_drift": {"clear": (100, 300), "moderate": (30, 100), "near": (10, 30)},  # ppm
    "delay_jump": {"clear": (100, 800), "moderate": (12, 100), "near": (2, 12)},  # samples
}


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def played_change_db(scene: Scene, chain: Chain) -> Callable[[Array], float]:
    """How far another played signal (n,) would be over the fan, with the loudspeaker taken as linear."""
    response = scene.linear_response()
    return lambda played: scene.over_fan_db(signal.oaconvolve(played - chain.played, response)[: played.size])
