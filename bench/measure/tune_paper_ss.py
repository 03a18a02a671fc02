"""Chooses alpha of the paper's spectral subtraction on validation conversations (never on test ones).

    python -m bench.measure.tune_paper_ss --conversations DIR --whisper DIR --output bench/results/tune_paper_ss.json

Eq. (6) leaves the over-subtraction factor alpha open. Prints word errors and SI-SDR per alpha. beta of eq. (7) scales the output
alone: SI-SDR ignores it, and so does a recogniser that is given a normalised level.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from tqdm import tqdm

from bench.measure.quality import Conversation
from bench.measure.recogniser import Recogniser, word_errors
from edgefilter.dsp.metrics import si_sdr
from edgefilter.engines.paper_ss import PAPER_STFT, PaperSpectralSubtraction
from edgefilter.filter.stream import Stream

ALPHAS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--conversations", type=Path, required=True)
    parser.add_argument("--whisper", type=Path, required=True)
    parser.add_argument("--cache", type=Path, default=Path("transcripts.jsonl"), help="transcripts by hash of the audio (default: %(default)s)")
    parser.add_argument("--output", type=Path, required=True)
    args = parser.parse_args()
    recogniser = Recogniser(args.whisper, args.cache)
    folders = sorted(path.parent for path in args.conversations.glob("*/meta.json"))
    rows = {alpha: [] for alpha in ALPHAS}
    for folder in tqdm(folders):
        talk = Conversation(folder)
        meta, profile, span = talk.meta, talk.profile, talk.span
        mic, ref, clean = (talk.read(name) for name in ("mic", "ref", "clean"))
        for alpha in ALPHAS:
            stream = Stream(PaperSpectralSubtraction(profile.response_bins(PAPER_STFT), alpha=alpha), profile)
            out = np.concatenate((stream.process(mic, ref), stream.flush()))
            found = word_errors(meta["text"], recogniser.transcribe(out[span]))
            rows[alpha].append((meta["room"], si_sdr(out[span], clean[span]), found))
    table = []
    for alpha, results in rows.items():
        for room in sorted({r[0] for r in results}):
            of = [r for r in results if r[0] == room]
            wer = sum(r[2].capped * r[2].words for r in of) / sum(r[2].words for r in of)
            table.append({"alpha": alpha, "room": room, "capped_wer": wer, "si_sdr_db": float(np.mean([r[1] for r in of])), "conversations": len(of)})
            print(table[-1])
    mean = {alpha: np.mean([row["capped_wer"] for row in table if row["alpha"] == alpha]) for alpha in ALPHAS}
    best = min(mean, key=mean.get)
    print(f"alpha {best}")
    args.output.write_text(json.dumps({"alpha": best, "rows": table}, indent=1) + "\n")


if __name__ == "__main__":
    main()
