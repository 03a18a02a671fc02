"""Chooses alpha of the paper's spectral subtraction on validation conversations (never on test ones).

    python -m bench.measure.tune_paper_ss --conversations DIR --whisper WHISPER --output bench/results/tune_paper_ss

Eq. (6) leaves the over-subtraction factor alpha open. Writes word errors and SI-SDR per alpha, OUTPUT.json and
OUTPUT.md. beta of eq. (7) scales the output alone: SI-SDR ignores it, and so does a recogniser that is given a
normalised level.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from bench import results_writer
from bench.measure.conversation import Conversation, every, find_conversations, progress
from bench.measure.recogniser import Recogniser, WordErrors, word_errors
from edgefilter.dsp.metrics import si_sdr
from edgefilter.engines.paper_ss import PAPER_STFT, PaperSpectralSubtraction
from edgefilter.errors import EdgefilterError
from edgefilter.filter.stream import Stream

ALPHAS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)


def score(talk: Conversation, alpha: float, recogniser: Recogniser) -> tuple[str, float, WordErrors]:
    """Room, SI-SDR in dB, word errors."""
    stream = Stream(PaperSpectralSubtraction(talk.profile.response_bins(PAPER_STFT), alpha=alpha), talk.profile)
    out = np.concatenate((stream.process(talk.read("mic"), talk.read("ref")), stream.flush()))
    found = word_errors(talk.meta["text"], recogniser.transcribe(out[talk.span]))
    return talk.meta["room"], si_sdr(out[talk.span], talk.read("clean")[talk.span]), found


def by_room(results: dict[float, list[tuple]]) -> list[dict]:
    """Capped word errors, weighted by words, and mean SI-SDR per alpha and room."""
    rows = []
    for alpha, found in results.items():
        for room in sorted({result[0] for result in found}):
            of = [result for result in found if result[0] == room]
            wer = sum(errors.capped * errors.words for _, _, errors in of) / sum(errors.words for _, _, errors in of)
            mean = float(np.mean([result[1] for result in of]))
            rows.append({"alpha": alpha, "room": room, "capped_wer": wer, "si_sdr_db": mean, "conversations": len(of)})
    return rows


def choose(rows: list[dict]) -> float:
    """Alpha with the fewest word errors, mean over rooms."""
    mean = {alpha: np.mean([row["capped_wer"] for row in rows if row["alpha"] == alpha]) for alpha in ALPHAS}
    return min(mean, key=mean.get)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--conversations", type=Path, required=True, metavar="DIR")
    parser.add_argument("--whisper", type=Path, required=True, metavar="DIR")
    parser.add_argument("--cache", type=Path, default=Path.home() / ".cache" / "edgefilter-bench", metavar="DIR")
    parser.add_argument("--output", type=Path, required=True, metavar="PATH", help="PATH.json and PATH.md are written")
    args = parser.parse_args()
    try:
        recogniser = Recogniser(args.whisper, args.cache / "transcripts.jsonl")
        talks = [talk for _, talk in every(find_conversations([args.conversations]))]
        made_with = results_writer.stamp({"conversations": [args.conversations]}, models={"WHISPER": args.whisper})
        results = {
            alpha: [score(talk, alpha, recogniser) for talk in progress(talks, name=f"alpha {alpha:g}")]
            for alpha in ALPHAS
        }
    except (EdgefilterError, OSError) as error:
        print(f"tune_paper_ss: {error}", file=sys.stderr)
        return 1
    rows = by_room(results)
    best = choose(rows)
    cells = [
        [f"{row['alpha']:g}", row["room"], f"{100 * row['capped_wer']:.0f}", f"{row['si_sdr_db']:.1f}"] for row in rows
    ]
    page = [
        f"alpha {best:g}.",
        "",
        *results_writer.table(["alpha", "room", "capped WER %", "SI-SDR dB"], cells),
    ]
    content = {"alpha": best, "rows": rows}
    print(results_writer.write(args.output, made_with, "alpha of paper-ss", "\n".join(page), content))
    return 0


if __name__ == "__main__":
    sys.exit(main())
