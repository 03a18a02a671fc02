"""The weights of a training in a small file, from which it, or another one, can go on (export.train --start).

    python -m export.checkpoint RUN/last.pt --output weights.pt [--mean OTHER.pt ...] [--full]

Weights are kept as float16 (--full: float32), without the optimiser's state. The file says of its training what the
checkpoint says. --mean: the mean of its weights and others', which has to lie on one training's way to be any good
(Wortsman et al. 2022, "Model soups"); the file says of which steps.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from edgefilter.errors import EdgefilterError, ModelError
from export.onnx_export import load

MOST_BYTES = 16_000_000
"""Size of a file, bytes, that a git repository holds without large-file storage: by definition."""


def shrink(checkpoint: Path, output: Path, full: bool = False, others: Sequence[Path] = ()) -> int:
    """Write the averaged weights of a checkpoint to output, or the mean of these and others'; returns its size in bytes.

    Raises ModelError where a checkpoint holds no network, or one of other sizes, or the file is larger than MOST_BYTES.
    """
    found, *rest = (_read(path) for path in (checkpoint, *others))
    found.pop("resume", None)
    for path, other in zip(others, rest, strict=True):
        if other["config"] != found["config"]:
            raise ModelError(f"{path} holds a network of {other['config']}, expected {found['config']}")
    if rest:
        alike = [found["network"], *(other["network"] for other in rest)]
        found["network"] = {
            name: torch.stack([weights[name].float() for weights in alike]).mean(0) for name in found["network"]
        }
        found["mean_of"] = [each.get("step") for each in (found, *rest)]
    if not full:
        found["network"] = {n: v.half() if v.dtype == torch.float32 else v for n, v in found["network"].items()}
    torch.save(found, output)
    size = output.stat().st_size
    if size > MOST_BYTES:
        output.unlink()
        raise ModelError(f"{output} would take {size / 1e6:.1f} MB, expected at most {MOST_BYTES / 1e6:.0f} MB")
    return size


def _read(path: Path) -> dict:
    load(path)
    return torch.load(path, map_location="cpu", weights_only=True)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path, help="last.pt or best.pt of export/train.py")
    parser.add_argument("--output", type=Path, required=True, metavar="FILE.pt")
    parser.add_argument("--mean", type=Path, nargs="+", default=[], metavar="OTHER.pt", help="with these weights")
    parser.add_argument("--full", action="store_true", help="float32 instead of float16")
    options = parser.parse_args(argv)
    try:
        size = shrink(options.checkpoint, options.output, options.full, options.mean)
    except (EdgefilterError, OSError) as error:
        print(f"checkpoint: {error}", file=sys.stderr)
        return 1
    print(f"{options.output}: {size / 1e6:.1f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
