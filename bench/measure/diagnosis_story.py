r"""A robot calibrated in one room is heard in another.

Compare, diagnose, add what is missing, and filter with both profiles.

    python -m bench.measure.diagnosis_story --conversations DIR --room office --whisper DIR \
        --output bench/results/diagnosis_story [--files DIR]

Conversations are folders as bench.simulate.conversations makes them: the sweep was recorded in a laboratory, the
conversation in the room. What the robot says alone, up to the onset of its second utterance, is diagnosed; what comes
after it, with the human, is filtered and scored. So the figures of the filter are from sound that no fit has seen. It
is filtered twice: "heard before", the filter having heard the first utterance as well, and "restarted", the filter
having heard nothing before the robot is interrupted. Writes OUTPUT.json and OUTPUT.md. --files: keep, in a folder for
each conversation, the profile and the recordings that the command line takes.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import soundfile as sf

import edgefilter
from bench import results_writer
from bench.measure.conversation import Conversation, every, find_conversations, progress
from bench.measure.recogniser import Recogniser, word_errors
from edgefilter.diagnosis.compare import compare
from edgefilter.diagnosis.diagnose import diagnose
from edgefilter.dsp.metrics import si_sdr
from edgefilter.errors import EdgefilterError
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE

ENGINE = "ss"
STARTS = ("heard before", "restarted")


def tell(conversation: Conversation, recogniser: Recogniser | None) -> dict:
    """One conversation's figures.

    Excess before and after on the robot alone, what was found, SI-SDR and word errors per start.
    """
    alone = slice(0, conversation.meta["t_main"])
    recording, reference = conversation.read("mic")[alone], conversation.read("ref")[alone]
    began = time.process_time()
    found = diagnose(conversation.profile, recording, reference)
    seconds = time.process_time() - began
    better = conversation.profile.with_echo(found.model)
    after = compare(better, recording, reference)
    row = {
        "conversation": conversation.folder.name,
        "verdict": found.verdict,
        "effects": [finding.effect for finding in found.ranking],
        "excess_before_db": found.comparison.excess_db,
        "excess_after_db": after.excess_db,
        "seconds": seconds,
        "duration": recording.size / SAMPLE_RATE,
    }
    for start in STARTS:
        for name, profile in (("before", conversation.profile), ("after", better)):
            row[f"{start}_{name}"] = score(
                conversation, profile, 0 if start == "heard before" else conversation.meta["t_main"], recogniser
            )
    return row


def score(conversation: Conversation, profile: Profile, start: int, recogniser: Recogniser | None) -> dict:
    """SI-SDR and word errors of the human's stretch, the conversation filtered from sample start on."""
    out = edgefilter.enhance(conversation.read("mic")[start:], conversation.read("ref")[start:], profile, ENGINE)
    heard = out[conversation.meta["start"] - start : conversation.meta["end"] - start]
    figures = {"si_sdr": si_sdr(heard, conversation.read("clean")[conversation.span])}
    if recogniser:
        errors = word_errors(conversation.meta["text"], recogniser.transcribe(heard))
        figures |= {"errors": errors.errors, "words": errors.words}
    return figures


def markdown(rows: list[dict]) -> str:
    """The table of all conversations and a line of means."""
    columns = ["conversation", "found", "excess dB", *(f"{start}: SI-SDR dB, words wrong %" for start in STARTS)]
    lines = []
    for row in rows:
        found = ", ".join(row["effects"]) or row["verdict"]
        excess = f"{row['excess_before_db']:.1f} -> {row['excess_after_db']:.1f}"
        lines.append([row["conversation"], found, excess, *(_change([row], start) for start in STARTS)])
    before, after = (np.mean([row[f"excess_{when}_db"] for row in rows]) for when in ("before", "after"))
    lines.append(["mean", "", f"{before:.1f} -> {after:.1f}", *(_change(rows, start) for start in STARTS)])
    slowest = max(rows, key=lambda row: row["seconds"])
    took = f"Diagnosis: at most {slowest['seconds']:.1f} s of one core for {slowest['duration']:.1f} s of recording."
    return "\n".join([*results_writer.table(columns, lines), "", took, ""])


def _change(rows: list[dict], start: str) -> str:
    """Before -> after: mean SI-SDR, and the mean share of wrong words, at most 100 % an utterance."""
    parts = []
    for when in ("before", "after"):
        scores = [row[f"{start}_{when}"] for row in rows]
        text = f"{np.mean([s['si_sdr'] for s in scores]):.1f}"
        if "errors" in scores[0]:
            text += f" / {100 * np.mean([min(s['errors'] / s['words'], 1.0) for s in scores]):.0f}"
        parts.append(text)
    return " -> ".join(parts)


def keep(conversation: Conversation, folder: Path) -> None:
    """What the command line takes: robot.npz, mic.wav and tts.wav of the robot alone."""
    folder.mkdir(parents=True, exist_ok=True)
    conversation.profile.save(folder / "robot.npz")
    for name, file in (("mic", "mic.wav"), ("ref", "tts.wav")):
        sf.write(folder / file, conversation.read(name)[: conversation.meta["t_main"]], SAMPLE_RATE)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--conversations", type=Path, required=True, metavar="DIR")
    parser.add_argument("--room", default="office", help="only conversations in this room (default: %(default)s)")
    parser.add_argument("--whisper", type=Path, metavar="DIR", help="recogniser's folder; without it only SI-SDR")
    parser.add_argument("--output", type=Path, required=True, metavar="PATH", help="PATH.json and PATH.md are written")
    parser.add_argument(
        "--files", type=Path, metavar="DIR", help="keep each conversation's profile and recordings here"
    )
    parser.add_argument("--cache", type=Path, default=Path.home() / ".cache" / "edgefilter-bench", metavar="DIR")
    options = parser.parse_args()
    try:
        recogniser = Recogniser(options.whisper, options.cache / "transcripts.jsonl") if options.whisper else None
        found = every(find_conversations([options.conversations]))
        chosen = [conversation for _, conversation in found if conversation.meta["room"] == options.room]
        models = {"WHISPER": options.whisper}
        made_with = results_writer.stamp({"conversations": [options.conversations]}, [ENGINE], models)
        for conversation in chosen if options.files else ():
            keep(conversation, options.files / conversation.folder.name)
        rows = [tell(conversation, recogniser) for conversation in progress(chosen)]
    except (EdgefilterError, OSError) as error:
        print(f"diagnosis_story: {error}", file=sys.stderr)
        return 1
    title = f"The story of a robot that was calibrated in a laboratory: {options.room}"
    print(results_writer.write(options.output, made_with, title, markdown(rows), {"conversations": rows}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
