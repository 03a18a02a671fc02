"""Simulated conversations with the running filter's front run over them, as arrays that training can crop.

    python -m export.dataset --humans DIR --robots DIR --output DIR [--recipe wide --noise DIR --responses DIR]
        [--count 2000] [--seed 1] [--minutes M] [--profile P.npz] [--scheduler ADDRESS]

Writes DIR/NNNNN.npz per item: mic, reference, error, and of it clean and fan, as an engine gets them ((n,) int16 with
their scale; echo = mic - error), noise, residual (the front's expected power spectra, simulate/linear_stage.py) and about (JSON), and
DIR/dataset.json. A second run goes on where the first stopped.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from bench.spread import spread
from edgefilter.dsp.stft import StftConfig
from edgefilter.errors import EdgefilterError
from edgefilter.profile.data import Profile
from export.corpus import read_corpus
from export.rooms import Room, draw_room
from export.simulate.conversation import Conversation, simulate
from export.simulate.linear_stage import front_end, listen
from export.simulate.material import Material, read_noises, read_responses
from export.simulate.recipe import RECIPES, Recipe

ROOMS = {"lab": 1 / 3, "office": 1 / 2, "hall": 1 / 6}
"""Shares of the kinds of room."""


def pack(conversation: Conversation, stft: StftConfig, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """The item's arrays as int16, the reference at its own scale, all else at one. rng: draws how wrong the simulated linear stage is."""
    front = front_end(conversation.stage, conversation.profile, stft, rng, learns=conversation.before > 0)
    signals = conversation.mic, conversation.reference, conversation.clean, conversation.fan
    heard = listen(front, *signals, stft, conversation.before)
    signals = {name: getattr(heard, name) for name in ("mic", "error", "clean", "fan", "reference")}
    peak = max(float(np.abs(samples).max()) for name, samples in signals.items() if name != "reference")
    signals["reference"] = np.roll(signals["reference"], conversation.stage.displaced)
    told = max(float(np.abs(signals["reference"]).max()), 1e-6)
    scales = {name: told if name == "reference" else max(peak, 1e-6) for name in signals}
    packed = {name: np.round(32767 * samples / scales[name]).astype(np.int16) for name, samples in signals.items()}
    powers = {"noise": heard.noise, "residual": heard.residual}
    return packed | powers | {"scale": np.float32(scales["mic"]), "reference_scale": np.float32(told)}


def _make(material: Material, job: tuple[Recipe, int, int, Path, StftConfig]) -> dict[str, object]:
    recipe, seed, index, path, stft = job
    conversation = simulate(recipe, seed, index, material)
    part = path.with_suffix(".part")
    arrays = pack(conversation, stft, np.random.default_rng([seed, index, 1]))
    with part.open("wb") as file:
        np.savez(file, about=json.dumps(conversation.about), **arrays)
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
    material: Material,
    output: Path,
    stft: StftConfig,
    jobs: int,
    scheduler: str | None = None,
) -> Iterator[dict[str, object]]:
    """Write the items that are not there yet; yields what each is about. jobs, scheduler: see spread."""
    output.mkdir(parents=True, exist_ok=True)
    about = {
        "recipe": asdict(recipe),
        "seed": seed,
        "stft": asdict(stft),
        "speakers": len(material.humans.speakers),
        "voices": len(material.robots.speakers),
    }
    (output / "dataset.json").write_text(json.dumps(about, indent=1, default=str) + "\n", encoding="utf-8")
    paths = [(index, output.resolve() / f"{index:05d}.npz") for index in range(count)]
    missing = [(recipe, seed, index, path, stft) for index, path in paths if not path.exists()]
    yield from spread(_make, material, missing, jobs, scheduler)


def arguments(argv: list[str] | None = None) -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--humans", type=Path, nargs="+", required=True, metavar="DIR")
    parser.add_argument("--robots", type=Path, nargs="+", required=True, metavar="DIR")
    parser.add_argument("--noise", type=Path, nargs="*", default=[], metavar="DIR", help="recorded noises")
    parser.add_argument(
        "--responses",
        type=Path,
        nargs="*",
        default=[],
        metavar="DIR",
        help="measured impulse responses in folders room, loudspeaker, microphone",
    )
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--recipe", choices=tuple(RECIPES), default="edge")
    parser.add_argument(
        "--hop", type=int, default=256, help="of the linear stage; the window is twice as long (default: %(default)s)"
    )
    parser.add_argument("--profile", type=Path, help="its effects are added to half of the items")
    parser.add_argument("--rooms", type=int, default=240, help="simulated, half of them offices, a third laboratories")
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop then, with what is there")
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="of a Dask cluster that makes the items instead; its machines see the same folders",
    )
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> int:
    options = arguments(argv)
    try:
        simulate_all(options)
    except (EdgefilterError, OSError) as error:
        print(f"dataset: {error}", file=sys.stderr)
        return 1
    return 0


def simulate_all(options: argparse.Namespace) -> None:
    """Read the material, make what is missing, show how far it is."""
    began = time.monotonic()
    recipe = RECIPES[options.recipe]
    if options.profile:
        recipe = replace(recipe, effects=Profile.load(options.profile).echo.effects)
    stft = StftConfig(2 * options.hop, options.hop, 2 * options.hop)
    material = Material(
        read_corpus(*options.humans),
        read_corpus(*options.robots),
        make_rooms(
            options.seed, {kind: math.ceil(share * options.rooms) for kind, share in ROOMS.items()}, options.jobs
        ),
        read_noises(*options.noise),
        read_responses(*options.responses),
    )
    work = make_dataset(
        recipe, options.seed, options.count, material, options.output, stft, options.jobs, options.scheduler
    )
    have = len(list(options.output.glob("*.npz")))
    for _ in tqdm(work, total=options.count - have, unit="item", desc=str(options.output)):
        if time.monotonic() - began > 60 * options.minutes:
            work.close()
            break


if __name__ == "__main__":
    sys.exit(main())
