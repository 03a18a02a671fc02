"""The way of the robot's voice to its microphone: loudspeaker, shell, room, and the profile that a calibration has of it."""

from __future__ import annotations

import math

import numpy as np
from scipy import signal

from edgefilter.echo.model import EchoModel
from edgefilter.profile.data import GRID_BINS, Profile
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Samples
from export.rooms import Room
from export.simulate.material import Material

MEASURED_DEVICE, MEASURED_MICROPHONE, MEASURED_ROOM = 0.35, 0.4, 0.25
"""Shares of wide items with a measured loudspeaker, of those with a measured microphone too, and with a measured room."""


def device(rng: np.random.Generator, material: Material, wideness: float) -> Samples:
    """Response of loudspeaker, shell and microphone, (taps,)."""
    colour = draw_colour(rng)
    loudspeaker = material.response(rng, "loudspeaker")
    microphone = material.response(rng, "microphone")
    chosen, both = rng.random() < wideness * MEASURED_DEVICE, rng.random() < MEASURED_MICROPHONE
    if loudspeaker is None or microphone is None or not chosen:
        return colour
    measured = signal.oaconvolve(loudspeaker, microphone) if both else loudspeaker
    measured = signal.sosfilt(signal.butter(2, rng.uniform(60, 150), "high", fs=SAMPLE_RATE, output="sos"), measured)
    return (measured[:4096] / np.abs(measured).max()).astype(np.float32)


def in_room(rng: np.random.Generator, material: Material, room: Room, wideness: float) -> Samples:
    """Response from the robot's loudspeaker to its microphone, (n,): simulated, or with the tail of a measured room behind."""
    measured = material.response(rng, "room")
    level, chosen = 10 ** (rng.uniform(-20, -4) / 20), rng.random() < wideness * MEASURED_ROOM
    if measured is None or not chosen:
        return room.robot
    response = np.zeros(max(room.robot.size, measured.size + 400), np.float32)
    direct = int(np.argmax(np.abs(room.robot)))
    response[: direct + 40] = room.robot[: direct + 40]
    tail = measured[40:]
    response[direct + 40 : direct + 40 + tail.size] = (
        level * np.abs(room.robot).max() * tail[: response.size - direct - 40] / np.abs(measured).max()
    )
    return response


def to_human(rng: np.random.Generator, material: Material, room: Room, wideness: float) -> Samples:
    """Response from a human's mouth to the microphone, (n,)."""
    measured, chosen = material.response(rng, "room"), rng.random() < wideness * MEASURED_ROOM
    simulated = room.humans[int(rng.integers(len(room.humans)))]
    return simulated if measured is None or not chosen else measured


def draw_colour(rng: np.random.Generator) -> Samples:
    """Response of loudspeaker, shell and microphone, (taps,): band limits, broad peaks, reflections of the shell within 2 ms."""
    impulse = np.zeros(1024)
    impulse[0] = 1.0
    for delay in rng.integers(3, 40, size=6):
        impulse[delay] += rng.choice([-1, 1]) * 10 ** (-rng.uniform(8, 22) / 20)
    impulse = signal.sosfilt(signal.butter(2, rng.uniform(80, 260), "high", fs=SAMPLE_RATE, output="sos"), impulse)
    impulse = signal.sosfilt(signal.butter(2, rng.uniform(5500, 7800), fs=SAMPLE_RATE, output="sos"), impulse)
    for _ in range(5):
        frequency, gain = 10 ** rng.uniform(math.log10(250), math.log10(6500)), 10 ** (rng.uniform(-7, 7) / 20)
        width = min(frequency / rng.uniform(0.7, 4.0), SAMPLE_RATE / 4)  # beyond half the rate the filter is not stable
        b, a = signal.iirpeak(frequency, frequency / width, fs=SAMPLE_RATE)
        impulse = impulse + (gain - 1.0) * signal.lfilter(b, a, impulse)
    return impulse.astype(np.float32)


def path(room: Samples, colour: Samples) -> Samples:
    """The echo path: the room convolved with colour, the loudspeaker's response; direct sound at sample PRE_ROLL, half a second at most."""
    response = signal.oaconvolve(room, colour)
    start = max(0, int(np.argmax(np.abs(response))) - PRE_ROLL)
    missing = max(0, PRE_ROLL - int(np.argmax(np.abs(response))))
    return np.concatenate((np.zeros(missing), response[start:]))[: SAMPLE_RATE // 2].astype(np.float32)


def calibrated(response: Samples, noise_psd: Samples) -> Profile:
    """What a calibration would have written; the fields that only people read are flat."""
    magnitude = np.abs(np.fft.rfft(response, 2 * (GRID_BINS - 1)))[:GRID_BINS].astype(np.float32)
    bands = np.array([[100.0, 8000.0]])
    return Profile(
        EchoModel(response.astype(np.float32)),
        300.0,
        magnitude,
        noise_psd.astype(np.float32),
        bands,
        np.array([40.0]),
        np.full(4, -40.0),
        source="simulated",
    )
