"""More voices for the robot: Debian's synthesizers espeak-ng, flite and festival read sentences.

    python -m bench.simulate.synthesizers --sentences bench/simulate/robot_sentences.tsv --times 3 --output DIR
    python -m bench.simulate.synthesizers --voices train --sentences ... --output DIR    (to train on)

Each sentence is read --times times, by as many of the voices in turn. Writes 16 kHz FLAC files and transcripts.tsv
(path, speaker, seconds, text), as bench.simulate.conversations reads them. They sound like machines: a check on voices
that no network has heard, not a model of good ones. Of the voices to train on none is among the others, and flite is not
among them at all.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import soundfile as sf
import soxr

from bench.measure.conversation import progress
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.types import SAMPLE_RATE

ESPEAK = ("en-gb+m3", "en-us+f3", "en-gb-scotland+m1", "en-gb-x-rp+f2", "en-us+m7", "en-029+f4", "en-gb-x-gbcwmd+m5")
FLITE = ("kal16", "awb", "rms", "slt")
VARIANTS = (
    "m1 m2 m4 m6 m8 f1 f5 klatt klatt2 klatt4 klatt6 croak whisper adam Andy Annie belinda boris ed Gene grandma iven3 john "
    "Lee linda Mario michael paul quincy robosoft robosoft4 robosoft7 shelby steph2 Storm travis UniRobot zac"
).split()
ACCENTS = ("en-us", "en-gb", "en-gb-x-gbclan", "en-us-nyc")
"""One after the other for VARIANTS; the pace goes round too."""
PACE = (135, 165, 195)
VOICES = {
    "test": tuple(f"espeak-{voice}" for voice in ESPEAK) + tuple(f"flite-{voice}" for voice in FLITE),
    "train": tuple(f"espeak-{ACCENTS[i % 4]}+{name}" for i, name in enumerate(VARIANTS)) + ("festival-ked_diphone",),
}


def command(voice: str, text: str, pace: int, output: str) -> list[str]:
    """What reads a text, festival's its standard input, aloud into a WAV file."""
    program, _, name = voice.partition("-")
    if program == "espeak":
        return ["espeak-ng", "-v", name, "-s", str(pace), "-w", output, text]
    if program == "festival":
        return ["text2wave", "-eval", f"(voice_{name})", "-o", output]
    return ["flite", "-voice", name, "-t", text, "-o", output]


def read_aloud(voice: str, text: str, pace: int = 165) -> np.ndarray:
    """(n,) at 16 kHz; pace: words a minute, espeak-ng's. Raises UsageError where the synthesizer is missing or fails."""
    with tempfile.TemporaryDirectory() as folder:
        output = str(Path(folder) / "spoken.wav")
        asked = command(voice, text, pace, output)
        try:
            subprocess.run(asked, input=text.encode(), capture_output=True, check=True)
            samples, rate = sf.read(output)
        except (OSError, subprocess.CalledProcessError, sf.LibsndfileError) as error:
            remedy = "apt-get install espeak-ng flite festival festvox-kdlpc16k"
            raise UsageError(f"{asked[0]} does not speak ({error}): {remedy}") from error
    return soxr.resample(samples, rate, SAMPLE_RATE)


def sentences(path: Path) -> list[str]:
    """The column `text` of a table, each once."""
    with path.open(encoding="utf-8", newline="") as lines:
        return list(dict.fromkeys(row["text"] for row in csv.DictReader(lines, delimiter="\t") if row["text"]))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sentences", type=Path, required=True, metavar="TSV", help="a table with a column text")
    parser.add_argument("--voices", choices=tuple(VOICES), default="test", help="default: %(default)s")
    parser.add_argument(
        "--times", type=int, default=1, metavar="N", help="voices that read each (default: %(default)s)"
    )
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    options = parser.parse_args()
    try:
        texts = sentences(options.sentences)
        rows, voices = [], VOICES[options.voices]
        for number, text in enumerate(progress(texts, "sentence")):
            for turn in range(options.times):
                index = number * options.times + turn
                voice = voices[index % len(voices)]
                pace = PACE[index % len(PACE)] if options.voices == "train" else 165
                path = Path(voice) / f"{number:04d}.flac"
                samples = read_aloud(voice, text, pace)
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
