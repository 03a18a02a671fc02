"""Which results are of another behaviour than today's; exit 1 and their names, if there are any.

Each result holds a digest of what every system that it measured makes of the bundled demonstrations; of the diagnosis, of
the names and values that it finds there. A pure move of code leaves them equal. Make a stale result anew, or delete it
with the sentences that quote it.
"""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import numpy as np

import edgefilter
from bench import results
from bench.cache import Cache
from bench.recordings import Clip, Signals, read
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.filter.budget import DEMO
from edgefilter.profile.data import Profile

DIAGNOSIS = "diagnosis"
"""Stands among the systems for the names and values that the diagnosis finds."""
LEARNING = "-learning"
"""Ends the names of systems that learn, which takes half of all the time here: they are judged by one demonstration."""


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


def digests_of(systems: Iterable[str]) -> dict[str, str]:
    return {name: digest for name in systems if (digest := digest_of(name)) is not None}


def today(name: str, kept: Cache) -> str | None:
    """As digest_of; what takes long, to learn and to diagnose, is done once for the same code, models, sounds and versions."""
    if not name.endswith(LEARNING) and name != DIAGNOSIS:
        return digest_of(name)
    code = [path for package in (Path(edgefilter.__file__), Path(__file__)) for path in package.parent.rglob("*.py")]
    models = {model: results.digest(path) for model, path in results.models_of([name]).items()}
    made_of = results.code_digest(sorted(code)), models, results.digest(DEMO), results.machine()
    return kept.get(lambda: digest_of(name), name, *made_of)


def stale(path: Path, kept: Cache) -> list[str]:
    """Why a result does not hold today, one line a reason; empty where it does."""
    parts = results.read(path)["parts"]
    if not parts:
        return [f"{path.name}: of an earlier form"]
    found = []
    for name, part in parts.items():
        if changed := [one for one, digest in part["stamp"]["judged"].items() if today(one, kept) != digest]:
            found.append(f"{path.name}, {name}: {', '.join(changed)} behave differently now")
    return found


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("results", type=Path, nargs="*", metavar="FILE.json", help="default: all of bench/results")


def run(options: argparse.Namespace) -> str:
    files = options.results or sorted(results.RESULTS.glob("*.json"))
    kept = Cache(options.cache, "digests")
    reasons = [reason for path in files for reason in stale(path, kept)]
    if reasons:
        raise UsageError("make these results anew, or delete them:\n" + "\n".join(reasons))
    return f"{len(files)} results are of today's behaviour"
