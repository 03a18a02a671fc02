r"""Which checkpoint keeps the words: networks against 'ss' on validation conversations, by what a recogniser makes of them.

    python -m bench.measure.words_validation --checkpoints RUN/last.pt [...] --conversations DIR [DIR ...] --cold \
        --real RECORDINGS --humans HUMAN/val --whisper WHISPER --output bench/results/words_validation

Loss and SI-SDR did not predict word errors, so networks are chosen by these. Every network is heard alone, and mixed
with the Wiener mask of 'ss', with the linear stage's error, and with both (--wiener, --error: shares of the answer),
beside the package's own `ss` and `crnn`, which are mixed with the error as well. --cold: each conversation once more
without its profile. --real: humans of --humans laid on the tuning half of the recordings of real loudspeakers
(bench.measure.real), without a profile. --learning: the filter learns while it runs. Give validation conversations,
never test ones. Differences are paired: each utterance against its own answer by 'ss'. All systems get the very same
frames: what stands before the engine runs once. --known: earlier results by the same code; what they hold is not run
again.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from bench import results_writer
from bench.measure.conversation import Conversation, every, find_conversations, progress
from bench.measure.intervals import interval
from bench.measure.real_streams import ECHO_ONLY, ROBOT_ALONE, Cells, Laid, chosen, find_recordings, lay
from bench.measure.recogniser import Recogniser, word_errors
from edgefilter import PathLearner
from edgefilter.dsp.metrics import si_sdr
from edgefilter.dsp.stft import StftConfig, Synthesiser
from edgefilter.engines import create
from edgefilter.engines.base import Engine, EngineState, FrontEndKind
from edgefilter.engines.crnn import Crnn
from edgefilter.engines.linear import Linear
from edgefilter.engines.spectral_subtraction import SpectralSubtraction
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.filter.stream import Stream
from edgefilter.profile.data import Profile
from edgefilter.types import Frame, Output, Samples
from export import onnx_export

REAL = Cells(sers=(-10.0, -20.0), befores=(0.0, 10.0))
"""Of humans laid on real loudspeakers."""
BASE = "ss"
COLD, LAID = " cold", "real loudspeaker"
"""How the kind of a conversation without its profile ends, and the kind of humans laid on real loudspeakers."""


@dataclass(frozen=True)
class Mixed:
    """An engine with a share of another's answer in its own: what one deletes the other may have kept."""

    engine: Engine
    other: Engine
    share: float
    name: str = "mixed"
    front: FrontEndKind = "full"

    @property
    def stft(self) -> StftConfig:
        return self.engine.stft

    @property
    def lookahead(self) -> int:
        return self.engine.lookahead

    def initial_state(self) -> EngineState:
        return self.engine.initial_state(), self.other.initial_state()

    def step(self, frame: Frame, state: EngineState) -> tuple[Output, EngineState]:
        (ours, mine), (theirs, its) = (
            engine.step(frame, each) for engine, each in zip((self.engine, self.other), state, strict=True)
        )
        spectrum = (1 - self.share) * ours.spectrum + self.share * theirs.spectrum
        return Output(spectrum.astype(np.complex64), ours.speech_probability), (mine, its)


@dataclass(frozen=True)
class Case:
    """One utterance to be understood: mic, ref (n,); clean (m,) is the human in span. kind: whose table it stands in."""

    kind: str
    name: str
    mic: Samples
    ref: Samples
    clean: Samples
    span: slice
    text: str
    profile: Profile | None = None


def cases(name: str, conversation: Conversation, cold: bool) -> Iterator[Case]:
    """A conversation with its profile, and with `cold` once more without."""
    mic, ref, clean = (conversation.read(each) for each in ("mic", "ref", "clean"))
    kind, text, span = f"{name} {conversation.meta['room']}", conversation.meta["text"], conversation.span
    yield Case(kind, conversation.folder.name, mic, ref, clean[span], span, text, conversation.profile)
    if cold:
        yield Case(f"{kind}{COLD}", conversation.folder.name, mic, ref, clean[span], span, text)


def laid_case(laid: Laid) -> Case:
    """A human on a real loudspeaker."""
    signals = laid.signals()
    if signals.human is None:
        raise UsageError(f"{laid.name} holds no human")
    name = f"{laid.name}, {laid.ser:g} dB after {laid.before:g} s"
    return Case(LAID, name, signals.mic, signals.ref, signals.human[signals.span], signals.span, laid.text)


@dataclass(frozen=True)
class Listener:
    """An engine that keeps the frames it is given."""

    stft: StftConfig
    frames: list[Frame]
    name: str = "listener"
    front: FrontEndKind = "full"
    lookahead: int = 0

    def initial_state(self) -> EngineState:
        return ()

    def step(self, frame: Frame, state: EngineState) -> tuple[Output, EngineState]:
        self.frames.append(Frame(*(part.copy() for part in frame[:-1]), frame.idle))
        return Output(frame.error), state


def frames(case: Case, stft: StftConfig, learning: bool) -> list[Frame]:
    """What every engine of that transform is given."""
    listener = Listener(stft, [])
    stream = Stream(listener, case.profile, learner=PathLearner(case.profile) if learning else None)
    stream.process(case.mic, case.ref)
    stream.flush()
    return listener.frames


def answer(engine: Engine, heard: list[Frame], samples: int) -> Samples:
    """(samples,) that a stream with this engine gives out."""
    state, voice, hops = engine.initial_state(), Synthesiser(engine.stft), []
    for frame in heard:
        output, state = engine.step(frame, state)
        hops.append(voice.push(output.spectrum))
    return np.concatenate(hops)[engine.stft.window_length - engine.stft.hop :][:samples]


Make = Callable[[Profile | None], Engine]
"""Of the profile that the filter runs with."""


def systems(checkpoints: list[Path], wiener: list[float], error: list[float], folder: Path) -> dict[str, Make]:
    """What is compared, by name: linear, ss and crnn as they ship, each checkpoint's averaged weights, alone and mixed.

    crnn has the share of ss that ships; a checkpoint is alone with and without a calibration, or mixed with both.
    """
    found: dict[str, Make] = {"linear": lambda profile: create("linear", profile)}
    for name in (BASE, "crnn"):
        found |= with_shares(name, lambda profile, name=name: create(name, profile), error)
    folder.mkdir(parents=True, exist_ok=True)
    for path in checkpoints:
        trained = onnx_export.load(path)
        name = f"{path.parent.name}/{path.stem}, step {trained.training.get('step', '?')}"
        model = folder / f"{path.parent.name}_{path.stem}.onnx"
        onnx_export.export(trained, model)
        found |= with_shares(name, lambda _, model=model: Crnn(model), error)
        for share in wiener:
            found |= with_shares(
                f"{name}, {share:g} {BASE}",
                lambda _, model=model, share=share: mix(Crnn(model), SpectralSubtraction, share),
                error,
            )
    return found


def with_shares(name: str, make: Make, shares: list[float]) -> dict[str, Make]:
    """An engine as it is, and with each share of the error."""
    mixed = {
        f"{name}, {share:g} error": lambda profile, share=share: mix(make(profile), Linear, share) for share in shares
    }
    return {name: make, **mixed}


def mix(engine: Engine, other: Callable[[StftConfig], Engine], share: float) -> Mixed:
    """An engine with a share of another's answer, at its own transform."""
    return Mixed(engine, other(engine.stft), share)


Row = tuple[str, str, str]
"""Of a result: kind, conversation, system."""


def read_known(paths: list[Path], made_with: dict) -> dict[Row, dict]:
    """Rows of earlier results.

    Raises UsageError where one is no such result, or was made by other code, on other data of the same name, or with
    other models.
    """
    known: dict[Row, dict] = {}
    ours = hashes(made_with)
    for path in paths:
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
            theirs, rows = hashes(found["stamp"]), found["utterances"]
        except (ValueError, TypeError, KeyError):
            raise UsageError(f"{path} is no result of words_validation: give the JSON file of one") from None
        if other := [name for name in theirs.keys() & ours.keys() if theirs[name] != ours[name]]:
            raise UsageError(f"{path} was made with another {', another '.join(sorted(other))}: measure it again")
        known |= {(row["kind"], row["conversation"], row["system"]): row for row in rows}
    return known


def hashes(stamp: dict) -> dict[str, str]:
    """Of the code, data and models of a stamp, by name."""
    data = {entry["folder"]: entry["sha256"] for entry in stamp["data"]}
    return {"code": stamp["code"]} | data | {name: model["sha256"] for name, model in stamp["models"].items()}


def judge(
    case: Case, making: dict[str, Make], learning: bool, recogniser: Recogniser, known: dict[Row, dict]
) -> Iterator[dict]:
    """SI-SDR and word errors of every system."""
    heard: dict[StftConfig, list[Frame]] = {}
    for name, make in making.items():
        if row := known.get((case.kind, case.name, name)):
            yield row
            continue
        engine = make(case.profile)
        if engine.stft not in heard:
            heard[engine.stft] = frames(case, engine.stft, learning)
        out = answer(engine, heard[engine.stft], case.mic.size)[case.span]
        errors = word_errors(case.text, recogniser.transcribe(out))
        yield {
            "system": name,
            "kind": case.kind,
            "conversation": case.name,
            "si_sdr": si_sdr(out, case.clean),
            "words": errors.words,
            "errors": errors.errors,
            "deletions": errors.deletions,
            "insertions": errors.insertions,
            "capped": errors.capped,
        }


def compared(rows: list[dict], system: str) -> dict[str, float]:
    """Figures of one system, and its capped WER less that of 'ss' on the same utterances with a 95 % interval."""
    ours = [row for row in rows if row["system"] == system]
    base = {(row["kind"], row["conversation"]): row for row in rows if row["system"] == BASE}
    words = sum(row["words"] for row in ours)
    less = [row["capped"] - base[row["kind"], row["conversation"]]["capped"] for row in ours]
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
    """A table per kind, one of the conversations with their profile, one of those without, and one of all."""
    kinds = {kind: [row for row in rows if row["kind"] == kind] for kind in dict.fromkeys(row["kind"] for row in rows)}
    cold = [kind for kind in kinds if kind.endswith(COLD)]
    warm = [kind for kind in kinds if kind not in (*cold, LAID)]
    groups = {"with a calibration": warm, "without": cold, "all": list(kinds)}
    together = {
        name: [row for kind in group for row in kinds[kind]] for name, group in groups.items() if len(group) > 1
    }
    lines = []
    for kind, of_kind in (kinds | together).items():
        cells = []
        for system in dict.fromkeys(row["system"] for row in of_kind):
            found = compared(of_kind, system)
            percent = [f"{100 * found[key]:.0f}" for key in ("capped", "deletions", "insertions")]
            less = "{:+.1f} [{:+.1f}, {:+.1f}]".format(*(100 * found[key] for key in ("less", "less_low", "less_high")))
            cells.append([system, *percent, less, f"{found['si_sdr']:.1f}"])
        base = [row for row in of_kind if row["system"] == BASE]
        head = ["system", "capped WER, %", "deleted", "inserted", "WER less that of ss, points", "SI-SDR, dB"]
        said = f"{kind}, {len(base)} utterances of {sum(row['words'] for row in base)} words:"
        lines += [said, "", *results_writer.table(head, cells), ""]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoints", type=Path, nargs="*", default=[], metavar="FILE.pt")
    parser.add_argument("--conversations", type=Path, nargs="+", required=True, metavar="DIR")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="take every N-th conversation of each folder")
    parser.add_argument("--cold", action="store_true", help="each once more without its profile")
    parser.add_argument("--real", type=Path, metavar="DIR", help="recordings of real loudspeakers")
    parser.add_argument("--humans", type=Path, metavar="DIR", help="speech that is laid on them")
    parser.add_argument("--real-cases", type=int, default=8, help="humans that are laid on them, each four times")
    parser.add_argument("--learning", action="store_true", help="the filter learns while it runs")
    parser.add_argument("--wiener", type=float, nargs="*", default=[0.5], help="shares of 'ss' in the answer")
    parser.add_argument("--error", type=float, nargs="*", default=[0.2], help="shares of the linear stage's error")
    parser.add_argument("--known", type=Path, nargs="*", default=[], metavar="FILE.json", help="earlier results")
    parser.add_argument("--whisper", type=Path, required=True, metavar="DIR")
    parser.add_argument("--output", type=Path, required=True, metavar="PATH")
    parser.add_argument("--cache", type=Path, default=Path.home() / ".cache" / "edgefilter-bench", metavar="DIR")
    options = parser.parse_args()
    torch.set_num_threads(1)
    try:
        if options.real and not options.humans:
            raise UsageError("--real lays humans on recordings: give --humans with a transcripts.tsv")
        recogniser = Recogniser(options.whisper, options.cache / "transcripts.jsonl")
        models = {
            "WHISPER": options.whisper,
            **{f"{path.parent.name}/{path.name}": path for path in options.checkpoints},
        }
        real = {"real": [options.real]} if options.real else {}
        made_with = results_writer.stamp({"conversations": options.conversations, **real}, models=models)
        known = read_known(options.known, made_with)
        making = systems(options.checkpoints, options.wiener, options.error, options.cache / "checkpoints")
        found = every(find_conversations(options.conversations), options.every)
        laid: list[Laid] = []
        if options.real:
            recordings = chosen(find_recordings(options.real, ROBOT_ALONE), "tune", "*")
            recordings = [recording for recording in recordings if recording.kind == ECHO_ONLY]
            laid = lay(recordings, options.humans, None, REAL, options.real_cases, seed=1)
        rows = []
        for item in progress([*found, *laid], name="conversations"):
            each = [laid_case(item)] if isinstance(item, Laid) else cases(*item, options.cold)
            for case in each:
                rows += judge(case, making, options.learning, recogniser, known)
    except (EdgefilterError, OSError) as error:
        print(f"words_validation: {error}", file=sys.stderr)
        return 1
    print(results_writer.write(options.output, made_with, "Words on validation", markdown(rows), {"utterances": rows}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
