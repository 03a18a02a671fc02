r"""Judge engines and public echo cancellers on whole robot conversations.

SI-SDR and a recogniser's word errors, per room.

    python -m bench.measure.quality --conversations DIR [DIR ...] \
        --engines unfiltered,paper-ss,linear,ss,speexdsp,aec3,clean \
        --whisper DIR --output bench/results/quality

Writes OUTPUT.json and OUTPUT.md. Conversations are folders as bench.simulate.conversations makes them. An engine is any
of the package's, or `unfiltered`, `clean` (the human at the microphone: the bound), `speexdsp`, `speexdsp-suppressed`
(with its preprocessor), `aec3`. The package's engines get a profile calibrated from the conversation's own sweep and
fan recording, and the raw reference; `-uncalibrated` after a name: no profile; `-learning` after that: it learns while
it runs. Peers get the raw reference too; with `-true-lag` after any name the reference is
delayed by each utterance's true lag beforehand (drift and volume left in), which no robot knows: a favour to cancellers
that have no search of their own. Scores are kept in --cache by recording and code, so that a run that was cut off goes
on where it stopped.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import edgefilter
from bench import results_writer
from bench.measure import peers, scores, taught
from bench.measure.conversation import Conversation, every, find_conversations, progress
from bench.measure.recogniser import Recogniser, word_errors
from bench.measure.score_cache import ScoreCache, key_of
from edgefilter.dsp.metrics import si_sdr
from edgefilter.engines import CATALOGUE
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.types import SAMPLE_RATE, Samples

Processor = Callable[[Conversation, Samples], Samples]
"""Takes a conversation and the reference to use, (n,), and returns (n,) samples aligned with the microphone."""
TRUE_LAG = "-true-lag"
PEERS = ("speexdsp", "speexdsp-suppressed", "aec3")
NO_ENGINE = ("unfiltered", "clean", *PEERS)


def processor(name: str) -> Processor:
    """The function behind a row's name.

    A name that is no peer is handed to edgefilter.enhance, which knows its engines.
    """
    if name == "unfiltered":
        return lambda conversation, ref: conversation.read("mic")
    if name == "clean":
        return lambda conversation, ref: conversation.read("clean")
    if name in PEERS:
        peer = getattr(peers, name.replace("-", "_"))
        return lambda conversation, ref: peer(conversation.read("mic"), ref)
    wanted = taught.row(name)

    def enhance(conversation: Conversation, ref: Samples) -> Samples:
        profile = conversation.profile if wanted.calibrated else None
        learner = taught.learner(wanted, conversation.fingerprint, lambda: profile)
        return edgefilter.enhance(conversation.read("mic"), ref, profile, wanted.engine, learn=learner)

    return enhance


def code_version(name: str) -> str:
    """Hash of the code that makes a row: changed code is scored anew.

    Of the package it is what filtering and calibrating import, and of the engines the row's own. Raises UsageError for
    an engine that there is not.
    """
    if name in NO_ENGINE:
        files = [Path(peers.__file__)]
    else:
        package = Path(edgefilter.__file__).parent
        wanted = taught.row(name)
        if wanted.engine not in CATALOGUE:
            raise UsageError(f"unknown engine '{wanted.engine}': choose one of {', '.join(CATALOGUE)}")
        module = CATALOGUE[wanted.engine].module
        models = [*package.rglob(f"{module}*.onnx"), *package.parent.glob(f"models/{module}*.onnx")]
        entered = {
            package / "filter" / "ego_filter.py",
            package / "calibration" / "calibrate.py",
            package / "engines" / "__init__.py",
            package / "engines" / f"{module}.py",
            *([package / "learning" / "path_learner.py"] if wanted.learning else []),
        }
        files = sorted(imported_by(entered, package)) + sorted(models)
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


def imported_by(files: set[Path], package: Path) -> set[Path]:
    """These files of the package and all of it that they import, at whatever place in the code.

    The package's own __init__ leads to every public name but loads none before it is asked for, so it counts for
    nothing; nor does what is imported for its types alone.
    """
    found, new = set(), set(files)
    while new:
        path = new.pop()
        found.add(path)
        nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
        only_types = {
            inner
            for node in nodes
            if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
            for inner in node.body
        }
        for node in nodes:
            if node in only_types:
                continue
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == package.name:
                place = package.parent.joinpath(*node.module.split("."))
                asked = {
                    place.with_suffix(".py"),
                    place / "__init__.py",
                    *((place / f"{alias.name}.py") for alias in node.names),
                }
                new |= {file for file in asked if file.exists()} - found - {package / "__init__.py"}
    return found


def score(conversation: Conversation, engine: str, recogniser: Recogniser | None) -> dict:
    """One row and utterance: si_sdr, errors, words, heard, seconds, duration.

    Or the problem that made the output unusable.
    """
    base = engine.removesuffix(TRUE_LAG)
    ref = conversation.delayed_reference() if base != engine else conversation.read("ref")
    size, run = ref.size, processor(base)
    if base not in NO_ENGINE:
        conversation.profile  # noqa: B018  calibrated here, so that its time is not the engine's
    began = time.perf_counter()
    out = run(conversation, ref)
    result = {"seconds": time.perf_counter() - began, "duration": size / SAMPLE_RATE, "room": conversation.meta["room"]}
    if out.size != size:
        return result | {"problem": f"{out.size} samples for {size}"}
    if not np.isfinite(out).all():
        return result | {"problem": "samples that are not finite"}
    heard = out[conversation.span]
    if not heard.any():
        return result | {"problem": "silence where the human speaks"}
    result["si_sdr"] = None if base == "clean" else si_sdr(heard, conversation.read("clean")[conversation.span])
    if recogniser:
        text = recogniser.transcribe(heard)
        errors = word_errors(conversation.meta["text"], text)
        result |= {"errors": errors.errors, "words": errors.words, "heard": text}
    return result


def run(
    sets: dict[str, list[Conversation]], engines: list[str], recogniser: Recogniser | None, cache: Path
) -> list[dict]:
    """Every score with its set, conversation and engine."""
    kept = ScoreCache(cache)
    hearing = Path(__file__).with_name("recogniser.py").read_text(encoding="utf-8") if recogniser else "no recogniser"
    versions = {engine: code_version(engine.removesuffix(TRUE_LAG)) for engine in engines}
    jobs = [(name, conversation, engine) for name, conversation in every(sets) for engine in engines]
    rows = []
    for name, conversation, engine in progress(jobs):
        key = key_of((conversation.fingerprint, engine, versions[engine], hearing))
        if (made := kept.get(key)) is None:
            made = score(conversation, engine, recogniser)
            kept.keep(key, made)
        rows.append({"set": name, "conversation": conversation.folder.name, "engine": engine, **made})
    return rows


def summarise(rows: list[dict]) -> dict[str, dict[str, dict[str, dict]]]:
    """[set][room][engine] -> figures, in the order in which they were asked for."""
    groups: dict[str, dict[str, dict[str, list[dict]]]] = {}
    for row in rows:
        groups.setdefault(row["set"], {}).setdefault(row["room"], {}).setdefault(row["engine"], []).append(row)
    return {
        name: {
            room: {engine: scores.summarise(found) for engine, found in engines.items()}
            for room, engines in rooms.items()
        }
        for name, rooms in groups.items()
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--conversations", type=Path, nargs="+", required=True, metavar="DIR")
    parser.add_argument(
        "--engines", default="unfiltered,paper-ss,linear,ss,speexdsp,speexdsp-suppressed,aec3,clean", metavar="A,B,..."
    )
    parser.add_argument("--whisper", type=Path, metavar="DIR", help="recogniser's folder; without it only SI-SDR")
    parser.add_argument("--output", type=Path, required=True, metavar="PATH", help="PATH.json and PATH.md are written")
    parser.add_argument("--cache", type=Path, default=Path.home() / ".cache" / "edgefilter-bench", metavar="DIR")
    parser.add_argument("--title", default="Quality on robot conversations")
    options = parser.parse_args()
    engines = options.engines.split(",")
    try:
        recogniser = Recogniser(options.whisper, options.cache / "transcripts.jsonl") if options.whisper else None
        sets = find_conversations(options.conversations)
        own = [taught.row(engine.removesuffix(TRUE_LAG)).engine for engine in engines]
        made_with = results_writer.stamp({"conversations": options.conversations}, own, {"WHISPER": options.whisper})
        rows = run(sets, engines, recogniser, options.cache / "scores.jsonl")
    except (EdgefilterError, OSError) as error:
        print(f"quality: {error}", file=sys.stderr)
        return 1
    summaries = summarise(rows)
    content = {"summary": summaries, "utterances": rows}
    print(results_writer.write(options.output, made_with, options.title, scores.markdown(summaries), content))
    return 0


if __name__ == "__main__":
    sys.exit(main())
