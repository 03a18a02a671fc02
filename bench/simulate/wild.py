"""Simulated robots whose sound passes through programs that nobody here wrote.

    python -m bench.simulate.wild --voices robot/val robot/train --output DIR --seed 1 --half tuning --count 40

A case is a folder HALF_NUMBER as bench.simulate.hidden_cases writes them; truth.json besides says what other names are
right (also), which program it was and its setting. Case i has program i mod their number, then comes a control for
every ten; the setting is drawn again, at most six times, while it changes less than LEAST_DB over the fan. Robot, room
and ordinary tolerances are those of hidden_robot. `--half reporting` is for figures, never for tuning: other suites.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from bench.simulate.conversations import Clip, read_clips
from bench.simulate.hidden_acoustics import Place, decibels, direction, power
from bench.simulate.hidden_cases import read_reference, scale, write_case
from bench.simulate.hidden_robot import Chain, Scene, draw_scene
from bench.simulate.simulated_robot import RATE, Array
from bench.simulate.wild_programs import Program
from bench.simulate.wild_reporting import REPORTING
from bench.simulate.wild_tools import put_back
from bench.simulate.wild_tuning import TUNING

HALVES = {"tuning": TUNING, "reporting": REPORTING}
CONTROL = Program("none", "source", ("none",), None)
EVERY = 10
ROBOT_OVER_FAN_DB = (20.0, 30.0)
LEAST_DB, CLEAR_DB = 2.0, 8.5
TRIES = 6
TAIL_S = 1.0
"""By which a program may lengthen the room's response."""


def program_of(half: str, index: int) -> Program:
    """Every EVERY-th case is a control; the others take the programs in turn."""
    if index % EVERY == EVERY - 1:
        return CONTROL
    programs = HALVES[half]
    return programs[(index - index // EVERY) % len(programs)]


def moved(rng: np.random.Generator, place: Place, program: Program) -> tuple[Place, str]:
    """The microphone some centimetres, or the robot some tenths of a metre, away in the same room."""
    if "robot" in program.name:
        step = rng.uniform(0.3, 1.2) * direction(rng) * np.array([1.0, 1.0, 0.1])
        return place.robot_moved(step), f"robot moved by {np.linalg.norm(step):.2f} m"
    step = rng.uniform(0.01, 0.06) * direction(rng)
    return place.microphone_moved(step), f"microphone moved by {100 * np.linalg.norm(step):.1f} cm"


def through(rng: np.random.Generator, scene: Scene, program: Program) -> tuple[Chain, str]:
    """The usual chain with a setting of the program in its place, and the words for that setting."""
    chain = scene.usual
    if program is CONTROL:
        return chain, ""
    start, fade, response = chain.paths[0]
    if program.draw is None:
        place, words = moved(rng, scene.moved, program)
        return replace(chain, paths=((start, fade, place.response()),)), words
    command = program.draw(rng)
    if program.place == "source":
        return replace(chain, played=command(chain.played)), command.words
    if program.place == "microphone":
        return replace(chain, microphone=(command,)), command.words
    longer = np.pad(response, (0, round(TAIL_S * RATE)))
    return replace(chain, paths=((start, fade, command(longer)),)), command.words


def make_case(seed: int, index: int, half: str, voices: dict[str, list[Clip]]) -> tuple[dict[str, Array], dict]:
    """Signals by name (n,) and the contents of truth.json, for case index of this seed and half."""
    rng = np.random.default_rng([seed, sorted(HALVES).index(half), index])
    program = program_of(half, index)
    voice = str(rng.choice(sorted(voices)))
    scene = draw_scene(rng, read_reference(rng, voices[voice]), rng.uniform(*ROBOT_OVER_FAN_DB))
    usual = scene.record(scene.usual)
    for _ in range(TRIES):
        chain, words = through(rng, scene, program)
        heard = scene.record(chain)
        change_db = scene.over_fan_db(put_back(heard, usual) - usual)
        if program is CONTROL or change_db >= LEAST_DB:
            break
    right = program.right
    strength = "control" if program is CONTROL else "clear" if change_db >= CLEAR_DB else "moderate"
    truth = {"effects": [right[0]], "also": list(right[1:]), "raw": [program.name], "strength": strength}
    truth |= {"setting": words, "effect_to_noise_db": change_db, "tolerances": scene.tolerances}
    truth |= {"robot_over_fan_db": decibels(power(scene.echo(scene.usual)) / scene.fan_power)}
    return scale(scene.signals | {"mic": heard}, {}), truth | {"voice": voice, "seed": [seed, index]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--voices", type=Path, required=True, nargs="+", metavar="DIR", help="the robot's voices")
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--half", choices=sorted(HALVES), required=True)
    parser.add_argument("--count", type=int, default=40, help="cases (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    voices: dict[str, list[Clip]] = {}
    for clip in (clip for folder in options.voices for clip in read_clips(folder, (1.0, 15.0))):
        voices.setdefault(clip.speaker, []).append(clip)
    for index in tqdm(range(options.count), unit="case", desc=options.half):
        write_case(
            options.output / f"{options.half}_{index:03d}", *make_case(options.seed, index, options.half, voices)
        )


if __name__ == "__main__":
    main()
