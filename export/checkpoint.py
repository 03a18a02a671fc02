"""The weights of a training in a small file, from which it, or another one, can go on (export.train --start).

    python -m export.checkpoint RUN/last.pt --output weights.pt [--full]

Weights are kept as float16 (--full: float32), without the optimiser's state. The file says of its training what the
checkpoint says.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch

from edgefilter.errors import EdgefilterError, ModelError
from export.onnx_export import load

MOST_BYTES = 16_000_000
"""A repository without special storage takes no larger file gladly."""


def shrink(checkpoint: Path, output: Path, full: bool = False) -> int:
    """Write the averaged weights of a checkpoint to output; returns its size in bytes.

    Raises ModelError where the checkpoint holds no network, or the file is larger than MOST_BYTES.
    """
    load(checkpoint)
    found = torch.load(checkpoint, map_location="cpu", weights_only=True)
    found.pop("resume", None)
    if not full:
        found["network"] = {n: v.half() if v.dtype == torch.float32 else v for n, v in found["network"].items()}
    torch.save(found, output)
    size = output.stat().st_size
    if size > MOST_BYTES:
        output.unlink()
        raise ModelError(f"{output} would take {size / 1e6:.1f} MB, expected at most {MOST_BYTES / 1e6:.0f} MB")
    return size


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path, help="last.pt or best.pt of export/train.py")
    parser.add_argument("--output", type=Path, required=True, metavar="FILE.pt")
    parser.add_argument("--full", action="store_true", help="float32 instead of float16")
    options = parser.parse_args()
    try:
        size = shrink(options.checkpoint, options.output, options.full)
    except (EdgefilterError, OSError) as error:
        print(f"checkpoint: {error}", file=sys.stderr)
        return 1
    print(f"{options.output}: {size / 1e6:.1f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
