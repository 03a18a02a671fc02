"""Train the edge network, or the paper's, on simulated conversations.

    python -m export.train --data DIR --validation DIR --output RUN [--network edge|paper] [--steps 6000] [--seed 1]
        [--filters 64 8 --lstm 400 --hidden 600] [--start WEIGHTS.pt] [--smoke]
    torchrun --nproc-per-node 2 -m export.train ...                             the same on several processes

The paper's network has its own sizes unless --filters, --lstm and --hidden make it narrower. What goes on, by a second
call or by --start, keeps the sizes that it has.

--start takes the weights of a trained network of the same sizes (one of --erb bands may have had another --hop), to go
on with other data: with --data made by
export/dataset.py --profile, an effect that was found in the field is learned. Every --every steps RUN/last.pt is
written (a second call goes on from there; more --steps prolong it), RUN/best.pt where the averaged weights have the best
validation loss so far; TensorBoard reads RUN, and RUN/log.jsonl has the same figures. With several processes --batch is
that of each.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.types import SAMPLE_RATE
from export.crops import Batches, Shape
from export.items import Items
from export.losses import LossWeights
from export.network import EdgeConfig
from export.onnx_export import load
from export.paper_network import PaperCrnn
from export.step_times import table
from export.tasks import TASKS, EdgeTask, PaperTask
from export.trainer import HALF, Plan, Trainer


def smoke(options: argparse.Namespace) -> None:
    """A few items of coloured noise instead of speech in --data, so that the whole of train() runs within seconds."""
    rng = np.random.default_rng(0)
    for folder in (options.data, options.validation):
        folder.mkdir(parents=True, exist_ok=True)
        for index in range(2):
            human, robot = (rng.standard_normal(3 * SAMPLE_RATE // 2).cumsum() % 7 - 3 for _ in range(2))
            signals = {"mic": human + 9 * robot, "error": human + robot, "reference": 9 * robot, "clean": human}
            signals["fan"] = 0 * human
            packed = {name: np.round(1000 * samples).astype(np.int16) for name, samples in signals.items()}
            shape = human.size // options.hop, options.hop + 1
            powers = {name: np.full(shape, level, np.uint8) for name, level in (("noise", 60), ("residual", 90))}
            scales = {name: np.float32(0.9) for name in ("scale", "reference_scale")}
            np.savez(folder / f"{index:05d}.npz", **packed, **powers, **scales)
    options.steps, options.every, options.batch, options.seconds = 4, 2, 2, 0.35


def arguments(argv: list[str] | None = None) -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, metavar="DIR")
    parser.add_argument("--validation", type=Path, required=True, metavar="DIR")
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--network", choices=tuple(TASKS), default="edge")
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument("--minutes", type=float, help="end by then; the rate falls over the last fifth of them")
    parser.add_argument("--every", type=int, default=500, help="steps between validations")
    parser.add_argument("--patience", type=int, default=0, help="validations without a better score to stop after")
    parser.add_argument("--batch", type=int, default=Shape.batch)
    parser.add_argument("--seconds", type=float, default=Shape.seconds, help="of a crop")
    parser.add_argument(
        "--long-every",
        type=int,
        default=Shape.long_every,
        help="each so many batches a quarter of crops, 4 times as long",
    )
    parser.add_argument("--newest", type=int, help="use the last so many items alone (default: all)")
    parser.add_argument(
        "--rate", type=float, default=1.5e-3, help="learning rate; it stays, and falls over the last fifth"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--hop", type=int, default=256)
    parser.add_argument("--channels", type=int, nargs=4, help=f"of the edge network (default: {EdgeConfig.channels})")
    parser.add_argument(
        "--filters",
        type=int,
        nargs="+",
        metavar="N",
        help="of the paper's network: filters of its first seven convolutions and of the last (default: 64 8; one number: the last has an eighth)",
    )
    parser.add_argument("--lstm", type=int, help="units in each direction of the paper's network (default: 400)")
    parser.add_argument("--hidden", type=int, help=f"units (default: {EdgeConfig.hidden}; of the paper's network 600)")
    parser.add_argument(
        "--norm", choices=("layer", "batch", "none"), help="(default: layer; of the paper's network none)"
    )
    parser.add_argument("--erb", type=int, help="bands as wide as the ear's, 64 say, in place of all frequencies")
    parser.add_argument(
        "--recogniser",
        type=Path,
        metavar="WHISPER",
        help="folder of the recogniser whose encoder compares the second sound with the human alone",
    )
    parser.add_argument("--recogniser-weight", type=float, default=0.1)
    parser.add_argument(
        "--fan-kept",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="share of the fan's amplitude that the sound to listen to should keep, 0 to 1",
    )
    parser.add_argument(
        "--fan-recognised", type=float, default=1.0, metavar="SHARE", help="the same of the sound for a recogniser"
    )
    parser.add_argument(
        "--second-alone", action="store_true", help="train the head of the sound for a recogniser, and nothing else"
    )
    told = "train the speech head by all layers, and keep both sounds as this network makes them"
    parser.add_argument("--like", type=Path, metavar="CHECKPOINT", help=told)
    parser.add_argument("--suppression", type=float, default=LossWeights.suppression)
    parser.add_argument("--si-sdr", type=float, default=LossWeights.si_sdr)
    parser.add_argument("--start", type=Path, metavar="CHECKPOINT", help="weights to begin with")
    parser.add_argument("--times", action="store_true", help="say where the time of a step goes, and train nothing")
    parser.add_argument("--threads", type=int, default=1)
    told = "float32 instead of bfloat16 in the forward pass; always where only that is computed in hardware"
    parser.add_argument("--full-precision", action="store_true", default=not HALF, help=told)
    parser.add_argument(
        "--smoke", action="store_true", help="make a few seconds of data in --data and --validation and take four steps"
    )
    return parser.parse_args(argv)


def sizes_before(kind: str, *checkpoints: Path | None) -> dict[str, object]:
    """Configuration of the network in the first of these files that is there, empty without any.

    Raises UsageError where that is a network of another kind, and ModelError where it is no checkpoint.
    """
    for path in checkpoints:
        if path and path.exists():
            network = load(path).network
            found = PaperTask.kind if isinstance(network, PaperCrnn) else EdgeTask.kind
            if found != kind:
                raise UsageError(f"{path} holds a network of kind {found}, expected {kind}: give --network {found}")
            return asdict(network.config)
    return {}


def main(argv: list[str] | None = None) -> int:
    options = arguments(argv)
    try:
        if options.smoke:
            smoke(options)
        torch.set_num_threads(options.threads)
        plan = Plan(options.steps, options.rate, options.seed, options.every, options.patience, options.minutes)
        shape = Shape(options.batch, options.seconds, options.long_every)
        before = sizes_before(options.network, options.output / "last.pt", options.start)
        task = TASKS[options.network](options, before)
        if options.times:
            print(table(task, Batches(Items(options.data), task.stft, shape, options.seed)))
            return 0
        options.output.mkdir(parents=True, exist_ok=True)
        trainer = Trainer(task, plan, shape, options.output, options.start)
        trainer.run(options.data, options.validation, options.newest)
        trainer.processes.leave()
    except (EdgefilterError, OSError) as error:
        print(f"train: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
