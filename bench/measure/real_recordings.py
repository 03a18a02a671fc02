"""What the tool says of real recordings without a calibration, and how far `linear` and `ss` lower the robot in them.

    OMP_NUM_THREADS=1 python -m bench.measure.real_recordings --recordings DIR --output bench/results/real_recordings

DIR holds pairs NAME_lpb.wav (what the loudspeaker was sent) and NAME_mic.wav, 16 kHz, as in the Microsoft AEC
Challenge. The level drop (ERLE where nobody else is heard) is measured from START_S on, in half seconds in which the
robot talks and what the diagnosed model leaves is less than the model's voice; where no path could be learned, over
everything from START_S on, human included.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import soundfile

from bench import results_writer
from bench.measure.levels import frame_power
from edgefilter import EgoFilter
from edgefilter.calibration.from_recording import self_calibrate
from edgefilter.diagnosis.diagnose import diagnose
from edgefilter.errors import EdgefilterError
from edgefilter.report.text import headline, in_order
from edgefilter.types import SAMPLE_RATE, Samples

START_S = 2.0
BLOCK = SAMPLE_RATE // 2
ENGINES = ("linear", "ss")


def read(path: Path) -> Samples:
    samples, rate = soundfile.read(path, dtype="float32")
    if rate != SAMPLE_RATE or samples.ndim != 1:
        raise EdgefilterError(f"{path}: {rate} Hz, {samples.ndim} channels, expected 16000 Hz mono")
    return samples


def drop_db(before: Samples, after: Samples, blocks: np.ndarray) -> float:
    """Level before over level after, dB, over these blocks (n // BLOCK,) bool."""
    return float(10 * np.log10(frame_power(before, BLOCK)[blocks].sum() / frame_power(after, BLOCK)[blocks].sum()))


def filtered(engine: str, recording: Samples, reference: Samples) -> Samples:
    ego = EgoFilter(engine=engine)
    return np.concatenate((ego.process(recording, reference), ego.flush()))


def examine(recording: Samples, reference: Samples) -> dict[str, object]:
    """What is said, and the level drops in dB."""
    reference = np.pad(reference, (0, max(recording.size - reference.size, 0)))[: recording.size]
    alone = np.arange(recording.size // BLOCK) * BLOCK >= START_S * SAMPLE_RATE
    row: dict[str, object] = {"seconds": recording.size / SAMPLE_RATE}
    started = time.perf_counter()
    try:
        profile = self_calibrate(recording, reference)
        found = diagnose(profile, recording, reference)
    except EdgefilterError as error:
        row |= {"verdict": "declined", "says": str(error), "robot_alone": False}
    else:
        steps = in_order(found.ranking)
        prediction = steps[-1].prediction if steps else found.comparison.prediction
        rest, voice = frame_power(recording - prediction, BLOCK), frame_power(prediction, BLOCK)
        alone &= (rest < voice) & (voice > 1e-3 * voice.max())
        notes = [text for text in (*profile.warnings[1:], *found.comparison.warnings, found.evidence) if text]
        row |= {
            "verdict": found.verdict,
            "says": " ".join(
                [headline(found.verdict, [step.effect for step in steps], calibrated=False), "; ".join(notes)]
            ),
            "excess_db": found.comparison.excess_db,
            "remaining_db": found.remaining_db,
            "effects": {
                step.effect: {name: value.to_dict() for name, value in step.parameters.items()} for step in steps
            },
            "robot_alone": True,
        }
        if alone.any():
            row["model_db"] = drop_db(recording, recording - prediction, alone)
    row["diagnosis_s"] = time.perf_counter() - started
    row["measured_s"] = float(alone.sum() * BLOCK / SAMPLE_RATE)
    for engine in ENGINES:
        row[f"{engine}_db"] = drop_db(recording, filtered(engine, recording, reference), alone) if alone.any() else None
    return row


def markdown(rows: dict[str, dict]) -> str:
    """A row a recording, and what was said of each."""
    lines, cells = [__doc__.split("\n\n")[2].strip(), ""], []
    for name, row in rows.items():
        over = f"{row['measured_s']:.1f} s " + ("robot alone" if row["robot_alone"] else "of everything")
        keys = ("excess_db", "remaining_db", "model_db", "linear_db", "ss_db")
        figures = [f"{row[key]:.1f}" if row.get(key) is not None else "" for key in keys]
        cells.append([name, row["verdict"], *figures[:2], over, *figures[2:]])
    lines += results_writer.table(
        ["recording", "verdict", "excess dB", "left dB", "measured", "model", "linear", "ss"], cells
    )
    lines += [
        "",
        "Excess: over the fan, with a stationary linear path made from the recording; left: with the effects found.",
    ]
    lines += [
        (
            "Model, linear, ss: level drop, dB. The thresholds of edgefilter/calibration/from_recording.py were chosen"
            " while looking at these recordings."
        ),
        "",
    ]
    lines += [f"- {name}: {row['says']}" for name, row in rows.items()]
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path, required=True)
    parser.add_argument("--output", type=Path, default=Path("bench/results/real_recordings"))
    args = parser.parse_args()
    files, rows = sorted(args.recordings.glob("*_lpb.wav")), {}
    if not files:
        parser.error(f"{args.recordings} holds no *_lpb.wav")
    try:
        made_with = results_writer.stamp({"RECORDINGS": [args.recordings]}, ENGINES)
        for file in files:
            name = file.name.removesuffix("_lpb.wav")
            rows[name] = examine(read(file.with_name(f"{name}_mic.wav")), read(file))
    except (EdgefilterError, OSError) as error:
        print(f"real_recordings: {error}", file=sys.stderr)
        return 1
    title = "Real recordings without a calibration"
    print(results_writer.write(args.output, made_with, title, markdown(rows), {"results": rows}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
