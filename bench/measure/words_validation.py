r"""Which checkpoint keeps the words: networks against 'ss' on validation conversations, by what a recogniser makes of them.

    python -m bench.measure.words_validation --checkpoints RUN/last.pt [...] --conversations DIR [DIR ...] --cold \
        --whisper WHISPER --output bench/results/words_validation

Loss and SI-SDR did not predict word errors, so networks are chosen by these. Every network is heard alone, and mixed
with the Wiener mask of 'ss' and with the linear stage's error (--wiener, --error: shares of the answer). --cold: each
conversation once more without its profile. Give validation conversations, never test ones. Differences are paired: each
utterance against its own answer by 'ss'. Real loudspeakers: `bench.measure.real` with EDGEFILTER_CRNN.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from bench import results_writer
from bench.measure.conversation import Conversation, every, find_conversations, progress
from bench.measure.intervals import interval
from bench.measure.recogniser import Recogniser, word_errors
from edgefilter.dsp.metrics import si_sdr
from edgefilter.dsp.stft import StftConfig
from edgefilter.engines import create
from edgefilter.engines.base import Engine, EngineState, FrontEndKind
from edgefilter.engines.crnn import Crnn
from edgefilter.errors import EdgefilterError
from edgefilter.filter.stream import Stream
from edgefilter.types import Frame, Output
from export import onnx_export

BASE = "ss"


@dataclass(frozen=True)
class WithError:
    """An engine with a share of the linear stage's error in its answer, which brings words back that were deleted."""

    engine: Engine
    share: float
    name: str = "with error"
    front: FrontEndKind = "full"

    @property
    def stft(self) -> StftConfig:
        return self.engine.stft

    @property
    def lookahead(self) -> int:
        return self.engine.lookahead

    def initial_state(self) -> EngineState:
        return self.engine.initial_state()

    def step(self, frame: Frame, state: EngineState) -> tuple[Output, EngineState]:
        output, state = self.engine.step(frame, state)
        spectrum = (1 - self.share) * output.spectrum + self.share * frame.error
        return Output(spectrum.astype(np.complex64), output.speech_probability), state


Make = Callable[[], Engine]


def systems(checkpoints: list[Path], wiener: list[float], error: list[float], folder: Path) -> dict[str, Make]:
    """What is compared, by name: linear, ss, and each checkpoint's averaged weights alone and mixed."""
    found: dict[str, Make] = {"linear": lambda: create("linear"), BASE: lambda: create("ss")}
    folder.mkdir(parents=True, exist_ok=True)
    for path in checkpoints:
        trained = onnx_export.load(path)
        name = f"{path.parent.name}/{path.stem}, step {trained.training.get('step', '?')}"
        model = folder / f"{path.parent.name}_{path.stem}.onnx"
        onnx_export.export(trained, model)
        found[name] = lambda model=model: Crnn(model, 0.0)
        for share in wiener:
            found[f"{name}, {share:g} ss"] = lambda model=model, share=share: Crnn(model, share)
        for share in error:
            found[f"{name}, {share:g} error"] = lambda model=model, share=share: WithError(Crnn(model, 0.0), share)
    return found


def judge(name: str, make: Make, kind: str, conversation: Conversation, recogniser: Recogniser) -> dict:
    """One utterance: SI-SDR and word errors. kind: "... cold" without the profile."""
    stream = Stream(make(), None if kind.endswith("cold") else conversation.profile)
    out = np.concatenate((stream.process(conversation.read("mic"), conversation.read("ref")), stream.flush()))
    out = out[conversation.span]
    errors = word_errors(conversation.meta["text"], recogniser.transcribe(out))
    return {
        "system": name,
        "kind": kind,
        "conversation": conversation.folder.name,
        "si_sdr": si_sdr(out, conversation.read("clean")[conversation.span]),
        "words": errors.words,
        "errors": errors.errors,
        "deletions": errors.deletions,
        "insertions": errors.insertions,
        "capped": errors.capped,
    }


def compared(rows: list[dict], kind: str, system: str) -> dict[str, float]:
    """Figures of one system on one kind, and its capped WER less that of 'ss' on the same utterances with a 95 % interval."""
    ours = [row for row in rows if (row["kind"], row["system"]) == (kind, system)]
    base = {row["conversation"]: row for row in rows if (row["kind"], row["system"]) == (kind, BASE)}
    words = sum(row["words"] for row in ours)
    less = [row["capped"] - base[row["conversation"]]["capped"] for row in ours]
    low, high = interval(lambda x: x.mean(axis=-1), less)
    return {
        "capped": float(np.mean([row["capped"] for row in ours])),
        "deletions": sum(row["deletions"] for row in ours) / words,
        "insertions": sum(row["insertions"] for row in ours) / words,
        "si_sdr": float(np.mean([row["si_sdr"] for row in ours])),
        "less": float(np.mean(less)),
        "less_low": low,
        "less_high": high,
    }


def markdown(rows: list[dict]) -> str:
    """A table per kind."""
    lines = []
    for kind in dict.fromkeys(row["kind"] for row in rows):
        cells = []
        for system in dict.fromkeys(row["system"] for row in rows):
            found = compared(rows, kind, system)
            percent = [f"{100 * found[key]:.0f}" for key in ("capped", "deletions", "insertions")]
            less = "{:+.1f} [{:+.1f}, {:+.1f}]".format(*(100 * found[key] for key in ("less", "less_low", "less_high")))
            cells.append([system, *percent, less, f"{found['si_sdr']:.1f}"])
        count = len({row["conversation"] for row in rows if row["kind"] == kind})
        head = ["system", "capped WER, %", "deleted", "inserted", "WER less that of ss, points", "SI-SDR, dB"]
        lines += [f"{kind}, {count} utterances:", "", *results_writer.table(head, cells), ""]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoints", type=Path, nargs="*", default=[], metavar="FILE.pt")
    parser.add_argument("--conversations", type=Path, nargs="+", required=True, metavar="DIR")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="take every N-th conversation of each folder")
    parser.add_argument("--cold", action="store_true", help="each once more without its profile")
    parser.add_argument("--wiener", type=float, nargs="*", default=[0.5], help="shares of 'ss' in the answer")
    parser.add_argument("--error", type=float, nargs="*", default=[0.2], help="shares of the linear stage's error")
    parser.add_argument("--whisper", type=Path, required=True, metavar="DIR")
    parser.add_argument("--output", type=Path, required=True, metavar="PATH")
    parser.add_argument("--cache", type=Path, default=Path.home() / ".cache" / "edgefilter-bench", metavar="DIR")
    options = parser.parse_args()
    torch.set_num_threads(1)
    try:
        recogniser = Recogniser(options.whisper, options.cache / "transcripts.jsonl")
        models = {
            "WHISPER": options.whisper,
            **{f"{path.parent.name}/{path.name}": path for path in options.checkpoints},
        }
        made_with = results_writer.stamp({"conversations": options.conversations}, models=models)
        making = systems(options.checkpoints, options.wiener, options.error, options.cache / "checkpoints")
        found = every(find_conversations(options.conversations), options.every)
        rows = []
        for name, conversation in progress(found, name="conversations"):
            room = f"{name} {conversation.meta['room']}"
            for kind in (room, f"{room} cold") if options.cold else (room,):
                rows += [judge(system, make, kind, conversation, recogniser) for system, make in making.items()]
    except (EdgefilterError, OSError) as error:
        print(f"words_validation: {error}", file=sys.stderr)
        return 1
    print(results_writer.write(options.output, made_with, "Words on validation", markdown(rows), {"utterances": rows}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
