"""More voices for the robot: Debian's synthesizers espeak-ng and flite read sentences.

    python -m bench.simulate.synthesizers --sentences bench/simulate/robot_sentences.tsv --times 3 --output DIR

Each sentence is read --times times, by as many of the voices in turn. Writes 16 kHz FLAC files and transcripts.tsv
(path, speaker, seconds, text), as bench.simulate.conversations reads them. They sound like machines: a check on voices
that no network has heard, not a model of good ones.
"""

from __future__ import annotations

import argparse
import csv
import io
import subprocess
import sys
from pathlib import Path

import numpy as np
import soundfile as sf
import soxr

from bench.measure.conversation import progress
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.types import SAMPLE_RATE

ESPEAK = ("en-gb+m3", "en-us+f3", "en-gb-scotland+m1", "en-gb-x-rp+f2", "en-us+m7", "en-029+f4", "en-gb-x-gbcwmd+m5")
FLITE = ("kal16", "awb", "rms", "slt")
VOICES = tuple(f"espeak-{voice}" for voice in ESPEAK) + tuple(f"flite-{voice}" for voice in FLITE)


def command(voice: str, text: str) -> list[str]:
    """What reads a text aloud into a WAV on its standard output."""
    program, _, name = voice.partition("-")
    if program == "espeak":
        return ["espeak-ng", "-v", name, "-s", "165", "--stdout", text]
    return ["flite", "-voice", name, "-t", text, "-o", "/dev/stdout"]


def read_aloud(voice: str, text: str) -> np.ndarray:
    """(n,) at 16 kHz. Raises UsageError where the synthesizer is missing or fails."""
    asked = command(voice, text)
    try:
        spoken = subprocess.run(asked, capture_output=True, check=True).stdout
        samples, rate = sf.read(io.BytesIO(spoken))
    except (OSError, subprocess.CalledProcessError, sf.LibsndfileError) as error:
        raise UsageError(f"{asked[0]} does not speak ({error}): apt-get install espeak-ng flite") from error
    return soxr.resample(samples, rate, SAMPLE_RATE)


def sentences(path: Path) -> list[str]:
    """The column `text` of a table, each once."""
    with path.open(encoding="utf-8", newline="") as lines:
        return list(dict.fromkeys(row["text"] for row in csv.DictReader(lines, delimiter="\t") if row["text"]))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sentences", type=Path, required=True, metavar="TSV", help="a table with a column text")
    parser.add_argument(
        "--times", type=int, default=1, metavar="N", help="voices that read each (default: %(default)s)"
    )
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    options = parser.parse_args()
    try:
        texts = sentences(options.sentences)
        rows = []
        for number, text in enumerate(progress(texts, "sentence")):
            for turn in range(options.times):
                voice = VOICES[(number * options.times + turn) % len(VOICES)]
                path = Path(voice) / f"{number:04d}.flac"
                samples = read_aloud(voice, text)
                (options.output / voice).mkdir(parents=True, exist_ok=True)
                sf.write(options.output / path, samples, SAMPLE_RATE, subtype="PCM_16")
                rows.append(f"{path.as_posix()}\t{voice}\t{samples.size / SAMPLE_RATE:.2f}\t{text}\n")
        (options.output / "transcripts.tsv").write_text("".join(rows), encoding="utf-8")
    except (EdgefilterError, OSError) as error:
        print(f"synthesizers: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
