"""Which results are of another behaviour than today's; exit 1 and their names, if there are any.

Each result holds a digest of what every system that it measured makes of the bundled demonstrations; of the diagnosis, of
the names and values that it finds there; of computing times, of the code that ran. A pure move of code leaves all but the
last equal. Make a stale result anew, or delete it with the sentences that quote it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import edgefilter
from bench import provenance, results
from bench.cache import Cache
from bench.provenance import DIAGNOSIS, LEARNING, digest_of
from edgefilter.errors import UsageError
from edgefilter.filter.budget import DEMO


def today(name: str, kept: Cache) -> str | None:
    """As digest_of; what takes long, to learn and to diagnose, is done once for the same code, models, sounds and versions."""
    if not name.endswith(LEARNING) and name != DIAGNOSIS:
        return digest_of(name)
    code = [path for package in (Path(edgefilter.__file__), Path(__file__)) for path in package.parent.rglob("*.py")]
    models = {model: results.digest(path) for model, path in provenance.models_of([name]).items()}
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
