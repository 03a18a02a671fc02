"""How much of a human survives while the robot is silent, and how much of the robot while no human speaks.

    python -m bench.measure.alone --conversations DIR [DIR ...] --engines linear,ss,crnn --output bench/results/alone

The human alone: the conversation's clean human at 1, 3 and 10 times its level with white noise 50 dB below, a silent
reference; SI-SDR of the output against the input. The robot alone: the microphone less the human; level of the output
while the robot speaks (from its second second on), over that of the fan. Writes OUTPUT.json and OUTPUT.md.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

import edgefilter
from bench import results_writer
from bench.measure.conversation import Conversation, every, find_conversations, progress
from bench.measure.levels import FRAME, frame_power
from edgefilter.dsp.metrics import si_sdr
from edgefilter.errors import EdgefilterError
from edgefilter.types import SAMPLE_RATE

GAINS = (1, 3, 10)


def human_alone(conversation: Conversation, engine: str, gain: float) -> float:
    """SI-SDR in dB of what comes out against what went in."""
    clean = gain * conversation.read("clean")
    noise = np.random.default_rng(0).standard_normal(clean.size).astype(np.float32)
    mic = np.clip(clean + 10 ** (-50 / 20) * np.sqrt(np.mean(clean**2)) * noise, -1, 1).astype(np.float32)
    out = edgefilter.enhance(mic, np.zeros_like(mic), conversation.profile, engine)
    return si_sdr(out[conversation.span], mic[conversation.span])


def robot_alone(conversation: Conversation, engine: str) -> float:
    """Level in dB of the output over the fan's, while the robot speaks."""
    ref = conversation.read("ref")
    out = edgefilter.enhance(conversation.read("mic") - conversation.read("clean"), ref, conversation.profile, engine)
    level = frame_power(ref)
    speaking = level > 1e-3 * level.max()
    speaking[: np.flatnonzero(speaking)[0] + SAMPLE_RATE // FRAME] = False
    return float(10 * np.log10(frame_power(out)[speaking].mean() / np.mean(conversation.read("fan_only") ** 2)))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--conversations", type=Path, nargs="+", required=True, metavar="DIR")
    parser.add_argument("--engines", default="linear,ss,crnn", metavar="A,B,...")
    parser.add_argument(
        "--every", type=int, default=1, metavar="N", help="take every N-th conversation of each folder (default: all)"
    )
    parser.add_argument("--output", type=Path, required=True, metavar="PATH")
    options = parser.parse_args()
    try:
        chosen = every(find_conversations(options.conversations), options.every)
        engines = options.engines.split(",")
        made_with = results_writer.stamp({"conversations": options.conversations}, engines)
        rows = []
        for name, conversation in progress(chosen):
            for engine in engines:
                found = {f"human x {gain}": human_alone(conversation, engine, gain) for gain in GAINS}
                about = {"set": name, "conversation": conversation.folder.name, "engine": engine}
                rows.append({**about, **found, "robot": robot_alone(conversation, engine)})
    except (EdgefilterError, OSError) as error:
        print(f"alone: {error}", file=sys.stderr)
        return 1
    page = markdown(rows, len(chosen))
    print(results_writer.write(options.output, made_with, "One of the two alone", page, {"rows": rows}))
    return 0


def markdown(rows: list[dict], conversations: int) -> str:
    """Medians, and the worst in brackets."""
    human = [f"human x {gain}" for gain in GAINS]
    lines = [
        f"{conversations} conversations: median, and the worst in brackets. The human alone, robot silent, noise 50 dB "
        "below:"
    ]
    lines += [
        "SI-SDR of the output against the input, by the human's level. The robot alone, while it speaks, from its "
        "second second"
    ]
    lines += ["on: level of the output over the fan's.", ""]
    cells_of = {}
    for engine in dict.fromkeys(row["engine"] for row in rows):
        own = [row for row in rows if row["engine"] == engine]
        cells = [f"{np.median([row[name] for row in own]):.1f} ({min(row[name] for row in own):.1f})" for name in human]
        cells.append(f"{np.median([row['robot'] for row in own]):.1f} ({max(row['robot'] for row in own):.1f})")
        cells_of[engine] = cells
    columns = ["engine", *(f"{name}, dB" for name in human), "robot alone over the fan, dB"]
    lines += results_writer.table(columns, [[engine, *cells] for engine, cells in cells_of.items()])
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
