"""How soon an interrupting human is noticed, and how often the robot is taken for one.

    python -m bench.measure.barge_in --conversations DIR [DIR ...] --output bench/results/barge_in

Each conversation is filtered twice: as it is, and less the human, so that every event speech_started in the second is a
false alarm. Noticed: the first speech_started that ends after the human's first sound (a 20 ms frame within 25 dB of
the loudest), or at once where speech had been announced before, which counts as early. Writes OUTPUT.json and
OUTPUT.md.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from bench import results_writer
from bench.measure.conversation import Conversation, every, find_conversations, progress
from bench.measure.levels import FRAME, frame_power
from edgefilter import EgoFilter
from edgefilter.errors import EdgefilterError
from edgefilter.types import SAMPLE_RATE, Event, Samples

ENGINE = "crnn"
IN_TIME_MS = 200
"""Barge-in that takes longer is felt as a robot that does not listen."""


def talk(conversation: Conversation, mic: Samples) -> list[Event]:
    """The beginnings and ends of speech that the engine notices."""
    ego = EgoFilter(conversation.profile, engine=ENGINE)
    ego.process(mic, conversation.read("ref"))
    return [event for event in ego.events() if event.kind.startswith("speech")]


def measure(conversation: Conversation) -> dict:
    """delay_ms from the human's first sound until it is noticed, None if never.

    Early: speech was on already; alarms without the human.
    """
    mic, clean = conversation.read("mic"), conversation.read("clean")
    power = frame_power(clean)
    onset = int(np.flatnonzero(power > 10**-2.5 * power.max())[0]) * FRAME
    heard = talk(conversation, mic)
    before = [event for event in heard if event.sample < onset]
    after = [event.sample for event in heard if event.sample >= onset and event.kind == "speech_started"]
    early = bool(before) and before[-1].kind == "speech_started"
    alarms = sum(event.kind == "speech_started" for event in talk(conversation, mic - clean))
    delay = (after[0] - onset) / SAMPLE_RATE * 1000 if after else None
    found = {"delay_ms": 0.0 if early else delay, "early": early, "alarms": alarms, "seconds": mic.size / SAMPLE_RATE}
    return {"conversation": conversation.folder.name, **found}


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
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
