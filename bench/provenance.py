"""What a result is made with and from: command, commit, data, models, machine, and what each system does today.

Take `stamp` before measuring, so that it is of what ran and not of what was edited meanwhile.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import cache, cached_property
from pathlib import Path

import numpy as np

import edgefilter
from bench import results
from bench.recordings import Clip, Signals, read
from edgefilter import engines
from edgefilter.errors import EdgefilterError
from edgefilter.filter.budget import DEMO
from edgefilter.profile.data import Profile

PACKAGE = Path(edgefilter.__file__).parent
DIAGNOSIS = "diagnosis"
"""In the place of a system's name: the names and values that the diagnosis finds."""
TIMED, RUNNING = "timed code", ("alignment", "dsp", "engines", "filter")
"""Stands among the systems for the code of the running path, in these folders, where it is timed: slower code may give the same sound."""
LEARNING = "-learning"
"""Ends the names of systems that learn, which takes half of all the time here: they are judged by one demonstration."""


def stamp(
    data: Mapping[str, Sequence[Path]] | None = None,
    systems: Iterable[str] = (),
    models: Mapping[str, Path | None] | None = None,
) -> dict:
    """What a result is made with and from, ready for JSON; take it before measuring.

    data: folders (or files) that are read, by what they are: {"HUMAN": [Path("human/val")]}; of a folder its last
    part is written down, with its digest. systems: rows of bench/systems.py that are measured, DIAGNOSIS or TIMED;
    `python -m bench stale` compares what they do with today's. models: files or folders by name, None where none is used. Raises
    UsageError for what is not there.
    """
    data, systems = dict(data or {}), list(systems)
    files = models_of(systems) | {name: path for name, path in (models or {}).items() if path is not None}
    commit, dirty = results.revision()
    return {
        "command": command(data, files),
        "commit": commit,
        "dirty": dirty,
        "data": [
            {"what": w, "folder": p.resolve().name, **results.digest(p)} for w, paths in data.items() for p in paths
        ],
        "models": {name: results.digest(path) for name, path in files.items()},
        "judged": behaviour(systems),
        "machine": results.machine(),
        "date": datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
    }


def models_of(names: Iterable[str]) -> dict[str, Path]:
    """The model files that the engines behind these rows load, by file name; one whose model is missing has none."""
    from bench.systems import row  # slow to load

    found, wanted = {}, {row(name).engine for name in names}
    for engine in engines.HAVE_MODEL:
        if {engine, "auto"} & wanted:
            with suppress(EdgefilterError):
                path = engines.create(engine).model.path
                found[path.name] = path
    return found


def command(data: Mapping[str, Sequence[Path]], models: Mapping[str, Path]) -> str:
    """The present command line without the paths of this machine: data and models by their names here, other paths by their last part."""
    known = {path.resolve(): f"{what}/{path.resolve().name}" for what, paths in data.items() for path in paths}
    known |= {path.resolve(): name for name, path in models.items()}

    def without_folders(argument: str) -> str:
        if argument.startswith("-"):
            option, equals, value = argument.partition("=")
            return option + equals + without_folders(value) if value else argument
        path = Path(argument)
        return known.get(path.resolve()) or (path.name if path.is_absolute() or ".." in path.parts else argument)

    return " ".join(["python -m bench", *map(without_folders, sys.argv[1:])])


# ---------------------------------------------------------------- what a system does today


@dataclass(frozen=True)
class Demo:
    """A bundled demonstration, as a Clip has its source."""

    folder: Path

    @property
    def name(self) -> str:
        return self.folder.name

    @cached_property
    def profile(self) -> Profile:
        return Profile.load(self.folder / "profile.npz")

    def signals(self) -> Signals:
        mic, ref = (read(self.folder / f"{name}.flac") for name in ("mic", "reference"))
        human = self.folder / "human.flac"
        return Signals(mic, ref, read(human) if human.exists() else None)


@cache
def demos() -> tuple[Clip, ...]:
    """A human who interrupts a robot, and a robot alone with a hidden effect."""
    return tuple(Clip("demo", "demo", Demo(folder)) for folder in (DEMO, DEMO / "hidden" / "one"))


@cache
def digest_of(name: str) -> str | None:
    """Of what a system makes of the demonstrations, as 16-bit samples; None where it cannot run on them."""
    if name == DIAGNOSIS:
        return _of_diagnosis()
    if name == TIMED:
        return results.code_digest(path for one in RUNNING for path in sorted((PACKAGE / one).rglob("*.py")))[:16]
    from bench import systems  # slow to load

    found = systems.catalogue().get(name)
    if found is None:
        return None
    sounds = []
    for clip in demos()[:1] if name.endswith(LEARNING) else demos():
        with suppress(EdgefilterError):  # a row that needs what a demonstration does not have
            found.missing()
            sounds.append(np.rint(32767 * np.clip(found.run(clip).samples, -1, 1)).astype("<i2").tobytes())
    return hashlib.sha256(b"".join(sounds)).hexdigest()[:16] if sounds else None


def _of_diagnosis() -> str:
    clip = demos()[1]
    found = edgefilter.diagnose(clip.source.profile, clip.mic, clip.ref)
    said = []
    for one in found.ranking:
        values = {key: [f"{x:.2g}" for x in np.atleast_1d(value.value)] for key, value in one.parameters.items()}
        said.append((one.effect, sorted(values.items())))
    return hashlib.sha256(repr((found.verdict, said)).encode()).hexdigest()[:16]


_found: dict[str, str | None] = {}
"""Digests by system that `behaviour` has had made."""


def behaviour(systems: Iterable[str]) -> dict[str, str]:
    """The digests of those that can run, by name, each found once, in another process.

    A runtime that begins here, such as LiveKit's, could not be used by workers that are forked.
    """
    systems = list(systems)
    if new := [name for name in systems if name not in _found]:
        with ProcessPoolExecutor(1) as apart:
            _found.update(zip(new, apart.map(digest_of, new)))
    return {name: digest for name in systems if (digest := _found[name]) is not None}
