r"""Compare trained networks: size, cost per hop, learning curve, and what they do in the whole path.

    python -m bench.measure.networks --runs RUN [RUN ...] --conversations DIR [DIR ...] --whisper WHISPER \
        --output bench/results/networks

RUN is a folder that export/train.py wrote (best.pt, log.jsonl). Give validation conversations, never test ones: this is
what networks are chosen by. Writes OUTPUT.json, OUTPUT.md and OUTPUT.png. Times are of the ONNX file alone, in
onnxruntime, on one thread: hot, and paced with 16 ms of sleep and 8 MB of other memory touched between hops.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from bench import results_writer
from bench.measure import picture, scores
from bench.measure.conversation import Conversation, every, find_conversations, progress
from bench.measure.intervals import percentiles
from bench.measure.recogniser import Recogniser, word_errors
from edgefilter.dsp.metrics import si_sdr
from edgefilter.engines import create
from edgefilter.engines.crnn import SPECTRA, Crnn
from edgefilter.engines.onnx_session import FixedPlaces
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.filter.stream import Stream
from edgefilter.types import SAMPLE_RATE
from export import onnx_export
from export.network import count

HOPS = 300
"""Timed, for each network and pace."""


@dataclass(frozen=True)
class Run:
    """A folder of export/train.py."""

    folder: Path

    @cached_property
    def trained(self) -> onnx_export.Trained:
        return onnx_export.load(self.folder / "best.pt")

    @cached_property
    def curve(self) -> list[dict]:
        """Validation figures by step."""
        return [json.loads(line) for line in (self.folder / "log.jsonl").read_text(encoding="utf-8").splitlines()]

    @cached_property
    def model(self) -> Path:
        """The ONNX file, made anew."""
        path = self.folder / "model.onnx"
        onnx_export.export(self.trained, path)
        return path

    def facts(self) -> dict:
        """Shape, size, cost and validation loss."""
        config, size, last = self.trained.network.config, count(self.trained.network), self.curve[-1]
        channels = "-".join(map(str, config.channels))
        gru = f"GRU {config.layers} x {config.hidden}"
        shape = f"{config.n_fft}/{config.hop}, {channels}, {gru}, {config.norm} norm"
        hot, paced = per_hop(Crnn(self.model))
        return {
            "run": self.folder.name,
            "shape": shape,
            "parameters": size["parameters"],
            "mmac_per_s": size["macs_per_frame"] * SAMPLE_RATE / config.hop / 1e6,
            "hot_ms": hot,
            "paced_ms": paced,
            "steps": last["step"],
            "items": last["items"],
            "training_s": last["seconds"],
            "validation": last,
        }


def per_hop(engine: Crnn) -> tuple[dict, dict]:
    """p50 and p99 in ms of a step of the network, back to back and paced."""
    rng, slots = np.random.default_rng(0), FixedPlaces(engine.model.session)
    for name in SPECTRA:
        slots.inputs[name][:] = rng.standard_normal((1, engine.stft.bins, 2))
    elsewhere = np.zeros(2_000_000, np.float32)

    def times(pause_s: float) -> dict:
        found = []
        for _ in range(HOPS):
            if pause_s:
                time.sleep(pause_s)
                np.add(elsewhere, 1, out=elsewhere)
            began = time.perf_counter()
            slots.run()
            found.append(1000 * (time.perf_counter() - began))
        return {name: round(ms, 3) for name, ms in percentiles(found, 50, 99).items()}

    times(0.0)
    return times(0.0), times(engine.stft.hop / SAMPLE_RATE)


def judge(name: str, engine_of: object, conversations: list[Conversation], recogniser: Recogniser) -> list[dict]:
    """A row per conversation: room, SI-SDR, word errors."""
    rows = []
    for conversation in progress(conversations, name=name):
        stream = Stream(engine_of(), conversation.profile)
        out = np.concatenate((stream.process(conversation.read("mic"), conversation.read("ref")), stream.flush()))
        out = out[conversation.span]
        errors = word_errors(conversation.meta["text"], recogniser.transcribe(out))
        rows.append(
            {
                "engine": name,
                "conversation": f"{conversation.folder.parent.name}/{conversation.folder.name}",
                "room": conversation.meta["room"],
                "si_sdr": si_sdr(out, conversation.read("clean")[conversation.span]),
                "errors": errors.errors,
                "words": errors.words,
                "seconds": 0.0,
                "duration": 1.0,
            }
        )
    return rows


FACTS = (
    "run",
    "shape",
    "parameters",
    "MMAC/s",
    "ms a hop hot, p50 / p99",
    "paced",
    "steps",
    "items",
    "validation SI-SDR, dB",
    "loss",
)


def markdown(facts: list[dict], rows: list[dict], name: str) -> str:
    """Both tables; name: of the picture, without suffix."""
    rooms = sorted({row["room"] for row in rows})
    count_of = {room: sum(row["room"] == room and row["engine"] == rows[0]["engine"] for row in rows) for room in rooms}
    cells = []
    for fact in facts:
        cost = [f"{fact[key]['p50']:.2f} / {fact[key]['p99']:.2f}" for key in ("hot_ms", "paced_ms")]
        size = [f"{fact['parameters'] / 1e6:.2f} M", f"{fact['mmac_per_s']:.0f}"]
        reached = [f"{fact['validation']['si_sdr_db']:.2f}", f"{fact['validation']['total']:.4f}"]
        cells.append([fact["run"], fact["shape"], *size, *cost, fact["steps"], fact["items"], *reached])
    lines = results_writer.table(FACTS, cells)
    shown = ", ".join(f"{number} in the {room}" for room, number in count_of.items())
    lines += [
        "",
        (
            f"In the whole path, on validation conversations ({shown}): mean SI-SDR in dB and capped WER in %, with 95"
            " % bootstrap"
        ),
    ]
    lines += ["intervals.", ""]
    columns, cells = ["engine", *(column for room in rooms for column in (f"{room}: SI-SDR", "WER"))], []
    for engine in dict.fromkeys(row["engine"] for row in rows):
        cells.append([engine])
        for room in rooms:
            figures = scores.summarise([row for row in rows if row["engine"] == engine and row["room"] == room])
            cells[-1] += [scores.figure(figures, "si_sdr_mean", 1), scores.figure(figures, "wer_capped", 0)]
    return "\n".join([*lines, *results_writer.table(columns, cells), "", f"![learning curves]({name}.png)", ""])


def plot(runs: list[Run], output: Path) -> None:
    """Validation loss and SI-SDR over the crops of 4 s that were seen."""
    figure, axes = picture.panels(1, 2, (11, 4))
    for run in runs:
        steps = [entry["step"] for entry in run.curve]
        for axis, key in zip(axes, ("si_sdr_db", "total")):
            axis.plot(steps, [entry[key] for entry in run.curve], marker=".", label=run.folder.name)
    axes[0].set(xlabel="step", ylabel="validation SI-SDR, dB")
    axes[1].set(xlabel="step", ylabel="validation loss", yscale="log")
    axes[0].legend()
    for axis in axes:
        axis.grid(alpha=0.3)
    picture.save(figure, output, dpi=110)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, nargs="+", required=True, metavar="RUN")
    parser.add_argument("--conversations", type=Path, nargs="+", required=True, metavar="DIR")
    parser.add_argument(
        "--every", type=int, default=1, metavar="N", help="take every N-th conversation of each folder (default: all)"
    )
    parser.add_argument("--whisper", type=Path, required=True, metavar="DIR")
    parser.add_argument("--output", type=Path, required=True, metavar="PATH")
    parser.add_argument("--cache", type=Path, default=Path.home() / ".cache" / "edgefilter-bench", metavar="DIR")
    options = parser.parse_args()
    torch.set_num_threads(1)
    try:
        recogniser = Recogniser(options.whisper, options.cache / "transcripts.jsonl")
        conversations = [
            conversation for _, conversation in every(find_conversations(options.conversations), options.every)
        ]
        runs = [Run(folder) for folder in options.runs]
        if missing := [str(run.folder) for run in runs if not (run.folder / "best.pt").exists()]:
            raise UsageError(f"{', '.join(missing)}: no best.pt, expected what export/train.py wrote")
        models = {"WHISPER": options.whisper, **{f"{run.folder.name}/best.pt": run.folder / "best.pt" for run in runs}}
        made_with = results_writer.stamp({"conversations": options.conversations}, models=models)
        facts = [run.facts() for run in runs]
        rows = [
            row
            for name in ("linear", "ss")
            for row in judge(name, lambda name=name: create(name), conversations, recogniser)
        ]
        for run in runs:
            rows += judge(run.folder.name, lambda run=run: Crnn(run.model), conversations, recogniser)
    except (EdgefilterError, OSError) as error:
        print(f"networks: {error}", file=sys.stderr)
        return 1
    plot(runs, options.output)
    content = {"runs": [fact | {"curve": run.curve} for fact, run in zip(facts, runs)], "utterances": rows}
    page = markdown(facts, rows, options.output.name)
    print(results_writer.write(options.output, made_with, "Networks", page, content))
    return 0


if __name__ == "__main__":
    sys.exit(main())
