"""How soon an interrupting human is noticed, and how often the robot is taken for one.

    python -m bench.measure.barge_in --conversations DIR [DIR ...] --output bench/results/barge_in

Each conversation is filtered twice: as it is, and less the human, so that every event speech_started in the second is a
false alarm. Noticed: the first speech_started that ends after the human's first sound (a 20 ms frame within 25 dB of
the loudest), or at once where speech had been announced before, which counts as early. The second table sweeps the
threshold of the probability. Writes OUTPUT.json and OUTPUT.md. The same on a real loudspeaker, with a picture:

    python -m bench.measure.real RECORDINGS --parts laid,alone --systems crnn --speech HUMAN --output ...
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench import results_writer
from bench.measure.conversation import Conversation, every, find_conversations, progress
from bench.measure.real_barge_in import IN_TIME_S, THRESHOLDS, first_sound, in_time, noticed, replay, starts
from edgefilter import EgoFilter
from edgefilter.errors import EdgefilterError
from edgefilter.types import SAMPLE_RATE, Event, Samples

ENGINE = "crnn"
IN_TIME_MS = 200
"""Barge-in that takes longer is felt as a robot that does not listen."""


class Talk(NamedTuple):
    """The beginnings and ends of speech, and the probability after each hop of so many samples."""

    events: list[Event]
    probability: list[float]
    hop: int


def talk(conversation: Conversation, mic: Samples) -> Talk:
    """What the engine notices of the human."""
    ego, ref = EgoFilter(conversation.profile, engine=ENGINE), conversation.read("ref")
    probability = []
    for at in range(0, mic.size, ego.hop):
        ego.process(mic[at : at + ego.hop], ref[at : at + ego.hop])
        probability.append(ego.speech_probability or 0.0)
    return Talk([event for event in ego.events() if event.kind.startswith("speech")], probability, ego.hop)


def measure(conversation: Conversation) -> dict:
    """delay_ms from the human's first sound until it is noticed, None if never.

    Early: speech was on already; alarms without the human. in_time_at, alarms_at: the same at each of THRESHOLDS.
    """
    mic, clean = conversation.read("mic"), conversation.read("clean")
    onset = first_sound(clean)
    heard, alone = talk(conversation, mic), talk(conversation, mic - clean)
    found = noticed(heard.events, onset)
    delay = None if found["delay_s"] is None else 1000 * found["delay_s"]
    row = {"delay_ms": 0.0 if found["early"] else delay, "early": found["early"], "alarms": starts(alone.events)}
    row["in_time_at"] = [in_time(noticed(replay(heard.probability, heard.hop, at), onset)) for at in THRESHOLDS]
    row["alarms_at"] = [starts(replay(alone.probability, alone.hop, at)) for at in THRESHOLDS]
    return {"conversation": conversation.folder.name, **row, "seconds": mic.size / SAMPLE_RATE}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--conversations", type=Path, nargs="+", required=True, metavar="DIR")
    parser.add_argument("--output", type=Path, required=True, metavar="PATH")
    options = parser.parse_args()
    try:
        sets = find_conversations(options.conversations)
        made_with = results_writer.stamp({"conversations": options.conversations}, [ENGINE])
        rows = [{"set": name, **measure(conversation)} for name, conversation in progress(every(sets))]
    except (EdgefilterError, OSError) as error:
        print(f"barge_in: {error}", file=sys.stderr)
        return 1
    print(results_writer.write(options.output, made_with, "Barge-in", markdown(rows), {"rows": rows}))
    return 0


def markdown(rows: list[dict]) -> str:
    """A row a set."""
    lines = [
        f"Engine `{ENGINE}`. Delay: from the human's first sound to the event `speech_started`, 20-26 dB below the "
        "robot that"
    ]
    lines += ["talks meanwhile.", ""]
    columns = ["set", "conversations", "delay p50 / p90, ms", f"within {IN_TIME_MS} ms", "early", "never"]
    cells_of = []
    for name in dict.fromkeys(row["set"] for row in rows):
        own = [row for row in rows if row["set"] == name]
        delays = np.array([np.inf if row["delay_ms"] is None else row["delay_ms"] for row in own if not row["early"]])
        p50, p90 = (np.quantile(delays, share, method="higher") for share in (0.5, 0.9))
        minutes = sum(row["seconds"] for row in own) / 60
        in_time = f"{np.count_nonzero(delays <= IN_TIME_MS)} of {delays.size}"
        cells = [name, len(own), f"{p50:.0f} / {p90:.0f}", in_time, len(own) - delays.size, int(np.isinf(delays).sum())]
        alarms = sum(row["alarms"] for row in own)
        cells_of.append([*cells, f"{alarms} in {minutes:.0f} minutes, {alarms / minutes:.2f}"])
    lines += results_writer.table([*columns, "false alarms a minute, the human left out"], cells_of)
    return "\n".join([*lines, *curve(rows)]) + "\n"


def curve(rows: list[dict]) -> list[str]:
    """A row a threshold, all sets together."""
    hours = sum(row["seconds"] for row in rows) / 3600
    alarms = np.sum([row["alarms_at"] for row in rows], axis=0) / hours
    shares = np.mean([row["in_time_at"] for row in rows], axis=0)
    columns = ["threshold of the probability", f"noticed in {IN_TIME_S} s, %", "false alarms an hour"]
    points = zip(THRESHOLDS, shares, alarms, strict=True)
    cells = [[at, f"{100 * share:.0f}", f"{count:.0f}"] for at, share, count in points]
    return ["", *results_writer.table(columns, cells)]


if __name__ == "__main__":
    sys.exit(main())
