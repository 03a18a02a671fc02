"""A conversation with a robot, simulated from speech, rooms and the physical effects: what the network trains on.

Each item is a pure function of (recipe, seed, index) and the material. The robot's voice is an EchoModel: a loudspeaker
and room response with effects of edgefilter.echo around it, drawn at random or taken from a profile that somebody
diagnosed in the field.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from edgefilter.echo.effects.clock_drift import ClockDrift
from edgefilter.echo.model import EchoModel
from edgefilter.profile.data import Profile
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Samples
from export.rooms import Room
from export.simulate import fan, path, script
from export.simulate.effects import draw_effects, elsewhere
from export.simulate.linear_stage import Stage
from export.simulate.loudspeaker import active_rms, distorted
from export.simulate.material import Material
from export.simulate.microphone import Microphone
from export.simulate.recipe import BENCHMARK, Recipe

LOUDEST = 0.95
"""Largest sample that a microphone which does not clip is given."""
KEPT = ("effects", "effects_share", "later", "other_voices")
"""What of a recipe also holds for its plain items."""
MOTORS_DB = (-28.0, -4.0)
"""Motors over the robot's voice at the microphone: servos beside it are about as loud as a human some metres away."""


@dataclass(frozen=True, eq=False)
class Conversation:
    """One simulated conversation.

    mic, clean, fan, reference: (n,) float32; clean is the human at the microphone, fan all that is neither human nor
    robot. profile: of a calibration elsewhere, or None. stage: the linear stage that is to run over it. before: samples at
    the beginning that are only there to be learned from.
    """

    mic: Samples
    clean: Samples
    fan: Samples
    reference: Samples
    profile: Profile | None
    stage: Stage = Stage()
    before: int = 0
    about: dict[str, object] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Voice:
    """The robot's at the microphone: echo (n,), reference (n,), the echo path (taps,) behind the player; what it is about.

    played: (n,) by the player.
    """

    echo: Samples
    played: Samples
    reference: Samples
    path: Samples
    about: dict[str, object]


def simulate(recipe: Recipe, seed: int, index: int, material: Material) -> Conversation:
    """Item `index` of that seed."""
    rng = np.random.default_rng([seed, index])
    if rng.random() < recipe.plain:
        kept = {name: getattr(recipe, name) for name in KEPT}
        recipe = replace(BENCHMARK, **kept)
    before = round(recipe.seconds * SAMPLE_RATE) if rng.random() < recipe.later else 0
    recipe = replace(recipe, seconds=recipe.seconds + before / SAMPLE_RATE)
    room = material.room(rng, _room_kind(rng, recipe))
    colour = path.device(rng, material, recipe.wideness)
    samples = round(recipe.seconds * SAMPLE_RATE)
    voice = _robot(rng, recipe, material, room, colour, samples)
    level = 0.08 * 10 ** (rng.uniform(*recipe.level_db) / 20)
    robot_gain = level / max(active_rms(voice.echo), 1e-9) if voice.echo.any() else 0.0
    near = rng.random() < recipe.near_share
    human_rms = level * 10 ** (rng.uniform(*(recipe.near_db if near else recipe.human_gain_db)) / 20)
    human = script.human(rng, recipe, material.humans, path.to_human(rng, material, room, recipe.wideness), samples)
    clean = human.clean * (human_rms / max(active_rms(human.clean), 1e-9))
    quiet = rng.random() < recipe.quiet_fan
    fan_rms = human_rms * 10 ** (-(rng.uniform(20, 45) if quiet else rng.uniform(*recipe.fan_db)) / 20)
    noise, psd = fan.noise(rng, material, samples, fan_rms, human_rms, recipe.wideness)
    moves, hums = rng.random(2) < (recipe.motors, recipe.hum)
    if moves:
        noise = noise + fan.motors(rng, material, voice.played, level * 10 ** (rng.uniform(*MOTORS_DB) / 20))
    if hums:
        noise = noise + fan.hum(rng, samples)
    if recipe.knocks and rng.random() < recipe.knocks:
        noise = noise + fan.knocks(rng, material, clean, human_rms)
    microphone = Microphone.draw(rng, recipe.wideness, recipe.seconds, recipe.processed)
    mic, clean, heard_fan, gain = _recorded(microphone, robot_gain * voice.echo, clean, noise)
    profile, known = _profile(rng, recipe, material, (room, colour), microphone, gain, (robot_gain, voice.path), psd)
    stage = recipe.setting.draw(rng, profile is not None)
    about = {
        "room": room.kind,
        "rt60_s": round(room.rt60_s, 3),
        "warm": profile is not None,
        "profile": known,
        "human_over_robot_db": round(20 * float(np.log10(human_rms / level)), 1),
        "quiet_fan": bool(quiet),
        "learned": bool(before),
        "motors": bool(moves),
        "hum": bool(hums),
        "processed": microphone.suppression is not None,
    }
    return Conversation(
        mic, clean, heard_fan, voice.reference, profile, stage, before, about | human.about | voice.about
    )


def _room_kind(rng: np.random.Generator, recipe: Recipe) -> str:
    drawn = rng.random()
    return "office" if drawn < recipe.office else "hall" if drawn < recipe.office + recipe.hall else "lab"


def _robot(
    rng: np.random.Generator, recipe: Recipe, material: Material, room: Room, colour: Samples, samples: int
) -> Voice:
    """What the robot says, as it arrives at the microphone."""
    moving, silent, person = rng.random(3) < (recipe.moving, 1.0 - recipe.robot, recipe.far_human)
    response = path.path(path.in_room(rng, material, room, recipe.wideness), colour)
    said = script.robot(rng, recipe, material.humans if person else material.robots, samples, moving)
    effects = elsewhere(rng, recipe.effects, recipe.seconds) if rng.random() < recipe.effects_share else ()
    effects += draw_effects(rng, recipe.catalogue, recipe.wideness, recipe.seconds)
    level_db, ppm = rng.uniform(*recipe.distortion_db), rng.uniform(*recipe.ppm)
    about = {"moving": bool(moving), "utterances": said.utterances, "effects": [name for name, _ in effects]}
    if silent:
        return Voice(*np.zeros((3, samples), np.float32), response, about)
    sound = distorted(rng, said.played, recipe.kinds, level_db)
    echo = EchoModel(response, effects).predict(sound)[PRE_ROLL:]
    echo = np.concatenate((echo, np.zeros(PRE_ROLL, np.float32)))
    if moving:
        echo = ClockDrift().apply(echo, {"ppm": ppm, "offset": 0.0}, SAMPLE_RATE)
    return Voice(echo, said.played, said.told, response, about | {"distortion_db": round(level_db, 1)})


def _recorded(
    microphone: Microphone, echo: Samples, clean: Samples, noise: Samples
) -> tuple[Samples, Samples, Samples, float]:
    """What the microphone makes of all three together, of the human, of the noise, and the gain at which it was recorded."""
    gain = microphone.gain(echo.size)
    mic, clean, noise = (gain * microphone.filtered(x) for x in (echo + clean + noise, clean, noise))
    if microphone.suppression is not None:
        mic, clean, noise = microphone.suppression.applied(mic, clean, noise)
    peak = float(np.abs(mic).max(initial=1e-9))
    level = min(1.0, LOUDEST / peak)
    limit = microphone.clip * peak * level
    return np.clip(level * mic, -limit, limit), level * clean, level * noise, level


def _profile(
    rng: np.random.Generator,
    recipe: Recipe,
    material: Material,
    robot: tuple[Room, Samples],
    microphone: Microphone,
    recorded: float,
    voice: tuple[float, Samples],
    psd: Samples,
) -> tuple[Profile | None, str]:
    """A calibration in a laboratory: right, wrong in what was measured, or none; and which.

    robot: its room and colour. recorded: the gain of the recording. voice: the robot's gain and path now. psd: of its
    fan.
    """
    elsewhere = material.room(rng, "lab")
    other = path.device(rng, material, recipe.wideness)
    drawn, which = rng.random(), int(rng.integers(3))
    gain_db, fan_db = rng.uniform(-1, 1), rng.uniform(-0.6, 0.6)
    if drawn >= recipe.warm + recipe.wrong:
        return None, "none"
    room, colour = robot
    wrong = drawn >= recipe.warm
    if wrong and which == 0:
        gain_db, fan_db = rng.uniform(-10, 10), rng.choice([-6, 6]) + fan_db
    if wrong and which == 1:
        colour = other
    response = path.path(elsewhere.robot / np.abs(elsewhere.robot).max() * np.abs(room.robot).max(), colour)
    if wrong and which == 2:  # the path that was measured has nothing to do with this one but its loudness
        response = rng.permutation(response[: SAMPLE_RATE // 8])
    robot_gain, now = voice
    if wrong and which:
        response *= np.linalg.norm(now) / max(float(np.linalg.norm(response)), 1e-9)
    scale = recorded * (robot_gain or 1e-3) * 10 ** (gain_db / 20)
    measured = microphone.filtered((scale * response).astype(np.float32))
    noise_psd = psd * microphone.power() * recorded**2 * 10 ** (fan_db / 10)
    return path.calibrated(measured, noise_psd), ("level", "device", "path")[which] if wrong else "right"
