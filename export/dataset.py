"""Simulated conversations with the linear stage run over them, as arrays that training can crop.

    python -m export.dataset --humans DIR --robots DIR --output DIR --count 2000 --seed 1 [--recipe edge|paper] [--profile P.npz]

Writes DIR/NNNNN.npz per item (mic, reference, error, clean: (n,) int16 with one scale, about: JSON) and
DIR/dataset.json. reference is the aligned one; echo = mic - error. A second run goes on where the first stopped.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from edgefilter.dsp.stft import StftConfig
from edgefilter.engines.linear import Linear
from edgefilter.filter.front_end import FrontEnd
from edgefilter.profile.data import Profile
from edgefilter.types import Samples
from export.corpus import Corpus, read_corpus
from export.rooms import Room, draw_room
from export.simulate import RECIPES, Conversation, Recipe, simulate

ROOMS = {"lab": 80, "office": 120}


def linear_stage(conversation: Conversation, stft: StftConfig) -> tuple[Samples, Samples]:
    """The aligned reference and the linear stage's error, (n,) each, n a multiple of the hop: the runtime's own front."""
    front = FrontEnd(Linear(stft), conversation.profile)
    hop, references, errors = stft.hop, [], []
    for at in range(0, conversation.mic.size - hop + 1, hop):
        reference, error = front.signals(conversation.mic[at : at + hop], conversation.reference[at : at + hop])
        references.append(reference)
        errors.append(error)
    return np.concatenate(references), np.concatenate(errors)


def pack(conversation: Conversation, stft: StftConfig) -> dict[str, np.ndarray]:
    """The item's arrays: int16 at a scale at which the loudest sample is full."""
    reference, error = linear_stage(conversation, stft)
    signals = {"mic": conversation.mic, "error": error, "clean": conversation.clean, "reference": reference}
    signals = {name: samples[: error.size] for name, samples in signals.items()}
    peak = max(float(np.abs(signals[name]).max()) for name in ("mic", "error", "clean"))
    scales = {
        name: max(float(np.abs(reference).max()), 1e-6) if name == "reference" else max(peak, 1e-6) for name in signals
    }
    packed = {name: np.round(32767 * samples / scales[name]).astype(np.int16) for name, samples in signals.items()}
    return packed | {"scale": np.float32(scales["mic"]), "reference_scale": np.float32(scales["reference"])}


_shared: dict[str, object] = {}


def _start(humans: Corpus, robots: Corpus, rooms: list[Room]) -> None:
    _shared.update(humans=humans, robots=robots, rooms=rooms)


def _make(job: tuple[Recipe, int, int, Path, StftConfig]) -> dict[str, object]:
    recipe, seed, index, path, stft = job
    conversation = simulate(recipe, seed, index, **_shared)
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        np.savez(file, about=json.dumps(conversation.about), **pack(conversation, stft))
    part.replace(path)
    return conversation.about


def make_rooms(seed: int, rooms: dict[str, int], jobs: int) -> list[Room]:
    """That many rooms of each kind; the i-th is the same whatever the number."""
    tasks = [(kind, seed, number) for kind, count in rooms.items() for number in range(count)]
    with ProcessPoolExecutor(jobs) as pool:
        return list(tqdm(pool.map(_make_room, tasks, chunksize=4), total=len(tasks), desc="rooms", unit="room"))


def _make_room(task: tuple[str, int, int]) -> Room:
    kind, seed, number = task
    return draw_room(np.random.default_rng([seed, len(kind), number]), kind)


def make_dataset(
    recipe: Recipe,
    seed: int,
    count: int,
    humans: Corpus,
    robots: Corpus,
    rooms: list[Room],
    output: Path,
    stft: StftConfig,
    jobs: int,
) -> Iterator[dict[str, object]]:
    """Write the items that are not there yet; yields what each is about."""
    output.mkdir(parents=True, exist_ok=True)
    about = {
        "recipe": asdict(recipe),
        "seed": seed,
        "stft": asdict(stft),
        "speakers": len(humans.speakers),
        "voices": len(robots.speakers),
    }
    (output / "dataset.json").write_text(json.dumps(about, indent=1, default=str) + "\n", encoding="utf-8")
    paths = [(index, output / f"{index:05d}.npz") for index in range(count)]
    missing = [(recipe, seed, index, path, stft) for index, path in paths if not path.exists()]
    with ProcessPoolExecutor(jobs, initializer=_start, initargs=(humans, robots, rooms)) as pool:
        yield from pool.map(_make, missing)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--humans", type=Path, nargs="+", required=True, metavar="DIR")
    parser.add_argument("--robots", type=Path, nargs="+", required=True, metavar="DIR")
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--recipe", choices=tuple(RECIPES), default="edge")
    parser.add_argument(
        "--hop", type=int, default=256, help="of the linear stage; the window is twice as long (default: %(default)s)"
    )
    parser.add_argument("--profile", type=Path, help="add the lasting effects of this profile to half of the items")
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    options = parser.parse_args()
    recipe = RECIPES[options.recipe]
    if options.profile:
        recipe = replace(recipe, effects=Profile.load(options.profile).echo.lasting().effects)
    stft = StftConfig(2 * options.hop, options.hop, 2 * options.hop)
    humans, robots = read_corpus(*options.humans), read_corpus(*options.robots)
    rooms = make_rooms(options.seed, ROOMS, options.jobs)
    work = make_dataset(recipe, options.seed, options.count, humans, robots, rooms, options.output, stft, options.jobs)
    have = len(list(options.output.glob("*.npz")))
    for _ in tqdm(work, total=options.count - have, unit="item", desc=str(options.output)):
        pass


if __name__ == "__main__":
    main()
