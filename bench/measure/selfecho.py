"""Whether a recogniser's text tells the robot's own words from a human's: edgefilter.selfecho on what Whisper hears.

    python -m bench.measure.selfecho --speech HUMAN/test --voices ROBOT/test --count 24 --whisper WHISPER \
        --output bench/results/selfecho

Conversations of bench.simulate.conversations, kinds paper and live in turn, calibrated. The robot: the conversation
less the human, over the robot's second utterance. The human: over the span of the interruption, the robot talking. Each
as every system leaves it; for `microphone` the human is taken alone, since unfiltered the robot drowns the human. A
passage in which Whisper hears nothing has no score. The robot's words have their times, from its own clock; the
probability of speech is the engine's, its mean over the passage. "repeating": the human's text is added to what the
robot has said, as if every human repeated the robot. Rows are kept in --cache as they are made. Writes OUTPUT.json, .md
and .png.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from bench import results_writer
from bench.measure import picture
from bench.measure.closed_loop_scenes import listen
from bench.measure.conversation import progress
from bench.measure.kept_rows import KeptRows
from bench.measure.recogniser import Recogniser
from bench.simulate.conversations import Scene, make_scene, read_clips, read_voices
from edgefilter.calibration.calibrate import calibrate
from edgefilter.engines import HAVE_LINEAR_STAGE
from edgefilter.errors import EdgefilterError
from edgefilter.selfecho import Said, score
from edgefilter.types import SAMPLE_RATE

KINDS = ("paper", "live")
MICROPHONE = "microphone"
SYSTEMS = (MICROPHONE, *HAVE_LINEAR_STAGE)
HALF = 0.5
"""The bound at which the table counts."""


def measure(scene: Scene, systems: list[str], recogniser: Recogniser) -> list[dict]:
    """A row for each system and passage: who speaks, what was recognised, its scores."""
    signals, meta = scene.signals, scene.meta
    profile = calibrate(*(signals[name].astype(np.float32) for name in ("sweep_ref", "sweep_mic", "fan_only")))
    lag, then = meta.get("lag2", meta["lag"]), [(i, j) for _, i, j in meta["said"] if i >= meta["t_main"]]
    spans = {
        "robot": slice(then[0][0] + lag + meta["delay"], then[-1][1] + lag + meta["delay"]),
        "human": slice(meta["start"], meta["end"]),
    }
    said = [Said(text, i / SAMPLE_RATE, j / SAMPLE_RATE) for text, i, j in meta["said"]]
    mics = {"robot": signals["mic"] - signals["clean"], "human": signals["mic"]}
    rows = []
    for system in systems:
        for who, span in spans.items():
            talk = None if system == MICROPHONE else listen(mics[who], signals["ref"], profile, system)
            unfiltered = mics["robot"] if who == "robot" else signals["clean"]
            out = talk.out if talk else unfiltered.astype(np.float32)
            text = recogniser.transcribe(out[span])
            probability = mean_probability(talk.probability, talk.hop, span) if talk else None
            heard = (span.start / SAMPLE_RATE, span.stop / SAMPLE_RATE)
            row = {"system": system, "who": who, "heard": text, "probability": probability}
            row["text"] = score(text, said, heard)
            row["both"] = None if probability is None else score(text, said, heard, probability)
            if who == "human":
                repeated = [*said, meta["text"]]
                row["repeating"] = score(text, repeated, heard)
                row["repeating_both"] = None if probability is None else score(text, repeated, heard, probability)
            rows.append(row)
    return rows


def mean_probability(probability: list[float | None], hop: int, span: slice) -> float | None:
    """Mean over a span, None where the engine does not judge speech."""
    found = probability[span.start // hop : span.stop // hop]
    return None if None in found else float(np.mean(found))


def points(robot: list[float], human: list[float]) -> list[tuple[float, float]]:
    """Part of the human's and of the robot's passages at or above every bound, from none to all."""
    bounds = sorted({*robot, *human, 2.0}, reverse=True)
    return [(float(np.mean(np.array(human) >= at)), float(np.mean(np.array(robot) >= at))) for at in bounds]


def summarise(rows: list[dict]) -> dict:
    """Per system and kind of score: numbers, the part at or above HALF, the area under the curve and its points."""
    found: dict = {}
    for system in dict.fromkeys(row["system"] for row in rows):
        own = [row for row in rows if row["system"] == system and row["heard"].strip()]
        for kind, human in (("text", "text"), ("both", "both"), ("text", "repeating"), ("both", "repeating_both")):
            scores = {"robot": [r[kind] for r in own if r["who"] == "robot"]}
            scores["human"] = [r[human] for r in own if r["who"] == "human"]
            if not scores["robot"] or not scores["human"] or None in scores["robot"] + scores["human"]:
                continue
            curve = points(scores["robot"], scores["human"])
            x, y = np.array(curve).T
            found.setdefault(system, {})[human] = {
                "robot": len(scores["robot"]),
                "robot_passages": sum(r["system"] == system and r["who"] == "robot" for r in rows),
                "human": len(scores["human"]),
                "robot_told": sum(s >= HALF for s in scores["robot"]),
                "human_taken": sum(s >= HALF for s in scores["human"]),
                "area": float(np.sum(np.diff(x) * (y[1:] + y[:-1])) / 2),
                "curve": curve,
            }
    return found


NAMES = {
    "text": "text",
    "both": "text and probability",
    "repeating": "text, humans repeating the robot",
    "repeating_both": "text and probability, humans repeating the robot",
}


def markdown(found: dict, image: str) -> str:
    """The page behind its head."""
    lines = ["Robot: passages of the robot alone in which Whisper-base heard something, of all. Told, taken: scores of"]
    lines += [f"{HALF} or more. Area: under the curve of told over taken, 1 for a perfect guard, 0.5 for chance.", ""]
    columns = ["system", "score of", "robot: something heard", "told", "humans", "taken for the robot", "area"]
    cells = [
        [system, NAMES[kind], f"{of['robot']} of {of['robot_passages']}", of["robot_told"]]
        + [of["human"], of["human_taken"], f"{of['area']:.2f}"]
        for system, kinds in found.items()
        for kind, of in kinds.items()
    ]
    return "\n".join([*lines, *results_writer.table(columns, cells), "", f"![curves]({image})"]) + "\n"


def draw(found: dict, output: Path) -> None:
    """A panel for each kind of score, a line for each system."""
    figure, axes = picture.panels(1, len(NAMES), (15, 4))
    for axis, (kind, name) in zip(axes, NAMES.items(), strict=True):
        for system, kinds in found.items():
            if kind in kinds:
                x, y = 100 * np.array(kinds[kind]["curve"]).T
                axis.plot([0, *x], [0, *y], marker=".", label=f"{system} ({kinds[kind]['area']:.2f})")
        axis.set(xlabel="human's passages above the bound, %", xlim=(-2, 102), ylim=(-2, 102))
        axis.set_title(name, fontsize=9)
        axis.grid(alpha=0.3)
        if axis.lines:
            axis.legend(loc="lower right", fontsize=8)
    axes[0].set_ylabel("robot's passages above the bound, %")
    picture.save(figure, output)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--speech", type=Path, required=True, metavar="DIR", help="humans, with a transcripts.tsv")
    parser.add_argument("--voices", type=Path, nargs="+", required=True, metavar="DIR", help="the robot's voices")
    parser.add_argument("--count", type=int, default=24, help="conversations (default: %(default)s)")
    parser.add_argument("--systems", type=lambda text: text.split(","), default=[*SYSTEMS], metavar="A,B,...")
    parser.add_argument("--whisper", type=Path, required=True, metavar="DIR", help="recogniser's folder")
    parser.add_argument("--cache", type=Path, default=Path.home() / ".cache" / "edgefilter-bench", metavar="DIR")
    parser.add_argument("--seed", type=int, default=17)
    parser.add_argument("--output", type=Path, required=True, metavar="PATH")
    options = parser.parse_args()
    try:
        data, networks = {"HUMAN": [options.speech], "ROBOT": options.voices}, set(options.systems) - {MICROPHONE}
        made_with = results_writer.stamp(data, sorted(networks), {"WHISPER": options.whisper})
        recogniser = Recogniser(options.whisper, options.cache / "transcripts.jsonl")
        kept = KeptRows(options.cache / "selfecho.jsonl", made_with, options.seed, options.systems)
        speech, voices = read_clips(options.speech, (3.0, 12.0)), read_voices(options.voices)
        rows = []
        for index in progress(range(options.count), "conversation"):
            kind = KINDS[index // 2 % 2]
            found = kept.get(
                f"conversation {index}",
                lambda i=index, k=kind: {
                    "rows": measure(make_scene(options.seed, i, k, speech, voices), options.systems, recogniser)
                },
            )
            rows += [{"index": index, **row} for row in found["rows"]]
    except (EdgefilterError, OSError) as error:
        print(f"selfecho: {error}", file=sys.stderr)
        return 1
    found = summarise(rows)
    page = markdown(found, f"{options.output.name}.png")
    print(results_writer.write(options.output, made_with, "A guard on text", page, {"rows": rows, "summary": found}))
    draw(found, options.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
