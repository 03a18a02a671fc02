r"""What it brings the running filter to be told what the robot's first seconds teach, and whether the proof is right.

    python -m bench.measure.apply DIR [DIR ...] --output bench/results/apply [--room office] [--every N]

Conversations are folders as bench.simulate.conversations makes them: calibrated in a laboratory; then the robot speaks
alone, then a human interrupts. What the robot says alone, up to the onset of its second utterance, is the recording. The
whole conversation is then filtered from its first sample on with each of PROFILES, and scored where the human speaks:
SI-SDR, mean with its 95 % bootstrap interval and the standard deviation. The proof of each, from the recording alone, is
held against what `linear` gained or lost in the human's span.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench import results_writer
from bench.measure.conversation import Conversation, every, find_conversations, progress
from bench.measure.intervals import interval
from edgefilter import enhance, self_calibrate
from edgefilter.commands.fitting import Fitted, Refused, fit, long_paths
from edgefilter.diagnosis.diagnose import add, diagnose
from edgefilter.diagnosis.prepare import Prepared, prepare
from edgefilter.diagnosis.proof import WORSE_DB, HeldOut, prove
from edgefilter.dsp.metrics import si_sdr
from edgefilter.errors import EdgefilterError, SignalError
from edgefilter.profile.data import Profile
from edgefilter.types import Samples

ENGINES = ("linear", "ss", "crnn")
NAMES = ("late_reverb", "speaker_nonlinearity")
PROFILES = {
    "none": "no profile",
    "made": "no profile, `diagnose --apply`",
    "calibrated": "the calibrated profile",
    "crooked": f"`{' '.join(NAMES)}` in turn, not straightened",
    "added": f"`add {' '.join(NAMES)}`",
    "applied": "`diagnose --apply`",
}
AGAINST = {"made": "none", "crooked": "calibrated", "added": "calibrated", "applied": "calibrated"}
"""By what is proven the profile that it would replace."""


def tell(conversation: Conversation, engines: Iterable[str]) -> dict:
    """One conversation's SI-SDR by profile and engine, and the proofs' verdicts (None: none could be given)."""
    alone, known = slice(0, conversation.meta["t_main"]), conversation.profile
    y, x = conversation.read("mic")[alone], conversation.read("ref")[alone]
    began = time.process_time()
    added = add(known, NAMES, y, x)[0]
    seconds = time.process_time() - began
    found = [finding.effect for finding in diagnose(known, y, x).ranking]
    applied, applied_worse = _outcome(lambda: fit(known, known, tuple(found), y, x, force=False, drop=True))
    crooked, crooked_worse = _crooked(known, y, x)
    made, made_worse = _outcome(lambda: _made(y, x))
    profiles = {"none": None, "calibrated": known, "crooked": crooked, "added": added}
    profiles |= {"applied": applied or known, "made": made}
    worse: dict[str, bool | None] = {"added": prove(known, NAMES, y, x).worse, "crooked": crooked_worse}
    worse |= {"applied": applied_worse, "made": made_worse}
    scores = {
        name: {engine: _score(conversation, profile, engine) for engine in engines}
        for name, profile in profiles.items()
    }
    effects = [] if applied is None else [name for name, _ in applied.echo.effects]
    meta = {key: conversation.meta[key] for key in ("room", "ppm")}
    meta["ppm"] = meta["ppm"] if conversation.meta["live"] else 0.0
    return {
        "conversation": conversation.folder.name,
        **meta,
        "effects": effects,
        "si_sdr": scores,
        "worse": worse,
        "add_seconds": seconds,
    }


def _outcome(work: Callable[[], Fitted]) -> tuple[Profile | None, bool | None]:
    """What a command would have written, if anything, and whether the proof refused it."""
    try:
        return work().profile, False
    except Refused:
        return None, True
    except SignalError:
        return None, None


def _made(y: Samples, x: Samples) -> Fitted:
    start = self_calibrate(y, x)
    names = [finding.effect for finding in diagnose(start, y, x).ranking]
    return fit(None, start, (*names, *long_paths()), y, x, force=False, drop=True)


def _crooked(known: Profile, y: Samples, x: Samples) -> tuple[Profile, bool]:
    """The effects fitted one after the other to the recording as it is, and what the proof says of that."""

    def fitted(prepared: Prepared) -> Profile:
        model, everywhere = prepared.model, replace(prepared.measurement, fit=prepared.usable)
        for name in NAMES:
            model = model.fit(name, everywhere)
        return known.with_echo(model)

    prepared, held = prepare(known, y, x), HeldOut(known, y, x)
    before_db, after_db = (held.erle_db(profile) for profile in (known, fitted(held.before(prepared))))
    return fitted(prepared), after_db < before_db - WORSE_DB


def _score(conversation: Conversation, profile: Profile | None, engine: str) -> float:
    out = enhance(conversation.read("mic"), conversation.read("ref"), profile, engine)
    return si_sdr(out[conversation.span], conversation.read("clean")[conversation.span])


def summarise(rows: list[dict], engines: Iterable[str]) -> dict:
    """By profile: SI-SDR by engine, and of the proofs how many refused, and how many were right to refuse or not to."""
    summary: dict = {"conversations": len(rows)}
    for name in PROFILES:
        summary[name] = {}
        for engine in engines:
            values = [row["si_sdr"][name][engine] for row in rows]
            low, high = interval(lambda x: x.mean(axis=1), values)
            summary[name][engine] = {"mean": np.mean(values), "low": low, "high": high, "std": np.std(values)}
    summary["proofs"] = {name: _proofs(name, rows) for name in AGAINST}
    return summary


def _proofs(name: str, rows: list[dict]) -> dict:
    """refused, rightly (`linear` would have lost, where the refused profile is at hand), passed, passed but lost."""
    judged = [row for row in rows if row["worse"][name] is not None]
    lost = [row["si_sdr"][name]["linear"] < row["si_sdr"][AGAINST[name]]["linear"] - WORSE_DB for row in judged]
    refused = [row["worse"][name] for row in judged]
    return {
        "proofs": len(judged),
        "refused": sum(refused),
        "refused_and_lost": sum(r and w for r, w in zip(refused, lost, strict=True)),
        "passed_but_lost": sum(w and not r for r, w in zip(refused, lost, strict=True)),
        "written_if_refused": name in ("added", "crooked"),
    }


def markdown(summaries: dict[str, dict], engines: Iterable[str]) -> str:
    """A table of SI-SDR and one of proofs for each set and room."""
    lines = ["SI-SDR in the human's span, dB: mean [95 % interval] (standard deviation)."]
    for group, summary in summaries.items():
        lines += ["", f"## {group}: {summary['conversations']} conversations", ""]
        cells = [[words, *(_figure(summary[name][engine]) for engine in engines)] for name, words in PROFILES.items()]
        lines += [*results_writer.table(["profile", *engines], cells), ""]
        proofs = [[PROFILES[name], *_counts(proof)] for name, proof in summary["proofs"].items()]
        lines += results_writer.table(["proof of", "given", "refused", "rightly", "passed, but lost"], proofs)
    return "\n".join(lines)


def _figure(row: dict) -> str:
    return f"{row['mean']:.1f} [{row['low']:.1f}, {row['high']:.1f}] ({row['std']:.1f})"


def _counts(proof: dict) -> list[object]:
    rightly = proof["refused_and_lost"] if proof["written_if_refused"] else "not written"
    return [proof["proofs"], proof["refused"], rightly if proof["refused"] else "", proof["passed_but_lost"]]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR")
    parser.add_argument("--room", help="only conversations in this room")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="every Nth conversation of a set")
    parser.add_argument("--engines", nargs="+", default=list(ENGINES), metavar="ENGINE", help="linear among them")
    parser.add_argument("--output", type=Path, required=True, metavar="PATH", help="PATH.json and PATH.md are written")
    options = parser.parse_args()
    try:
        found = every(find_conversations(options.folders), options.every)
        chosen = [(name, talk) for name, talk in found if options.room in (None, talk.meta["room"])]
        made_with = results_writer.stamp({"CONVERSATIONS": options.folders}, options.engines)
        rows = [{"set": name, **tell(talk, options.engines)} for name, talk in progress(chosen)]
    except (EdgefilterError, OSError) as error:
        print(f"apply: {error}", file=sys.stderr)
        return 1
    groups = dict.fromkeys((row["set"], row["room"]) for row in rows)
    summaries = {
        f"{name}, {room}": summarise([r for r in rows if (r["set"], r["room"]) == (name, room)], options.engines)
        for name, room in groups
    }
    page, content = markdown(summaries, options.engines), {"summary": summaries, "conversations": rows}
    title = "Told what the robot's first seconds teach"
    print(results_writer.write(options.output, made_with, title, page, content))
    return 0


if __name__ == "__main__":
    sys.exit(main())
