#!/usr/bin/env python3
"""One of the two alone: how much of a human survives while the robot is silent, and how much of the robot while no human speaks.

    python bench/alone.py --conversations DIR [DIR ...] --engines linear,ss,crnn --output bench/results/alone

The human alone: the conversation's clean human at 1, 3 and 10 times its level with white noise 50 dB below, a silent reference; SI-SDR of the
output against the input. The robot alone: the microphone less the human; level of the output while the robot speaks (from its second second
on), over that of the fan. Writes OUTPUT.json and OUTPUT.md.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from tqdm import tqdm

import edgefilter
from bench import table
from bench.measure import quality
from edgefilter.dsp.metrics import si_sdr
from edgefilter.errors import EdgefilterError
from edgefilter.types import SAMPLE_RATE, Samples

GAINS = (1, 3, 10)
FRAME = 320


def human_alone(conversation: quality.Conversation, engine: str, gain: float) -> float:
    """SI-SDR in dB of what comes out against what went in."""
    clean = gain * conversation.read("clean")
    noise = np.random.default_rng(0).standard_normal(clean.size).astype(np.float32)
    mic = np.clip(clean + 10 ** (-50 / 20) * np.sqrt(np.mean(clean**2)) * noise, -1, 1).astype(np.float32)
    out = edgefilter.enhance(mic, np.zeros_like(mic), conversation.profile, engine)
    return si_sdr(out[conversation.span], mic[conversation.span])


def robot_alone(conversation: quality.Conversation, engine: str) -> float:
    """Level in dB of the output over the fan's, while the robot speaks."""
    ref = conversation.read("ref")
    out = edgefilter.enhance(conversation.read("mic") - conversation.read("clean"), ref, conversation.profile, engine)
    level = frame_power(ref)
    speaking = level > 1e-3 * level.max()
    speaking[: np.flatnonzero(speaking)[0] + SAMPLE_RATE // FRAME] = False
    return float(10 * np.log10(frame_power(out)[speaking].mean() / np.mean(conversation.read("fan_only") ** 2)))


def frame_power(x: Samples) -> Samples:
    """Mean power of each 20 ms."""
    return np.mean(x[: x.size // FRAME * FRAME].reshape(-1, FRAME).astype(np.float64) ** 2, axis=1)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--conversations", type=Path, nargs="+", required=True, metavar="DIR")
    parser.add_argument("--engines", default="linear,ss,crnn", metavar="A,B,...")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="take every N-th conversation of each folder (default: all)")
    parser.add_argument("--output", type=Path, required=True, metavar="PATH")
    options = parser.parse_args()
    try:
        sets = quality.find_conversations(options.conversations)
        conversations = [conversation for found in sets.values() for conversation in found[:: options.every]]
        rows = []
        for conversation in tqdm(conversations, unit="recording", disable=not sys.stderr.isatty()):
            for engine in options.engines.split(","):
                found = {f"human x {gain}": human_alone(conversation, engine, gain) for gain in GAINS}
                rows.append({"conversation": conversation.folder.name, "engine": engine, **found, "robot": robot_alone(conversation, engine)})
    except (EdgefilterError, OSError) as error:
        print(f"alone: {error}", file=sys.stderr)
        return 1
    head = table.machine()
    text = markdown(rows, head, len(conversations))
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.with_suffix(".json").write_text(json.dumps({"schema": 1, "machine": head, "rows": rows}, indent=1) + "\n", encoding="utf-8")
    options.output.with_suffix(".md").write_text(text, encoding="utf-8")
    print(text)
    return 0


def markdown(rows: list[dict], head: dict, conversations: int) -> str:
    """Medians, and the worst in brackets."""
    human = [f"human x {gain}" for gain in GAINS]
    lines = ["# One of the two alone", "", ", ".join(f"{key} {value}" for key, value in head.items()), ""]
    lines += [f"{conversations} conversations: median, and the worst in brackets. The human alone, robot silent, noise 50 dB below: SI-SDR of the output against"]
    lines += ["the input, by the human's level. The robot alone, while it speaks, from its second second on: level of the output over the fan's.", ""]
    lines += ["| engine | " + " | ".join(f"{name}, dB" for name in human) + " | robot alone over the fan, dB |", "| --- " * (2 + len(human)) + "|"]
    for engine in dict.fromkeys(row["engine"] for row in rows):
        own = [row for row in rows if row["engine"] == engine]
        cells = [f"{np.median([row[name] for row in own]):.1f} ({min(row[name] for row in own):.1f})" for name in human]
        cells.append(f"{np.median([row['robot'] for row in own]):.1f} ({max(row['robot'] for row in own):.1f})")
        lines.append(f"| {engine} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
