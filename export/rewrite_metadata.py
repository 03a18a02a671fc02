r"""Correct what an ONNX file says of its training; its graph, weights and operators, stays as it is to the byte.

    python -m export.rewrite_metadata models/crnn.onnx models/crnn_int8.onnx \
        --training '{"step": 16400, "seed": [1, 7], "items": 7129}'

For a file whose checkpoint is gone, or whose export would not give the same bytes again. Everything else in the
metadata stays. Say the same in models/MODELS.md; a test compares the two.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path

import onnx

from edgefilter.errors import ModelError


def rewrite(path: Path, training: Mapping[str, object]) -> None:
    """Replace the "training" entry of the file's metadata.

    Parameters
    ----------
    path
        An ONNX file that export/onnx_export.py wrote.
    training
        step (of all stages together), seed (of the only stage, or a list of the stages' seeds), items, and whatever
        else is known.

    Raises
    ------
    ModelError
        For a file that is no ONNX model, has no such entry, or whose graph would not be the same afterwards.
    """
    try:
        model = onnx.load(str(path))
    except Exception as error:  # protobuf's exceptions share no base with onnx's
        raise ModelError(f"{path} cannot be read as an ONNX model ({error}): give a file that export wrote") from None
    graph = model.graph.SerializeToString(deterministic=True)
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    if "training" not in metadata:
        raise ModelError(f"{path} has no metadata about its training, expected an entry 'training': export it again")
    onnx.helper.set_model_props(model, {**metadata, "training": json.dumps(training)})
    draft = path.with_name(f".{path.name}.draft")
    try:
        onnx.save(model, str(draft))
        if onnx.load(str(draft)).graph.SerializeToString(deterministic=True) != graph:
            raise ModelError(f"{path}: its graph would change, which must not be: the file is left as it is")
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path, nargs="+", metavar="FILE.onnx")
    parser.add_argument("--training", required=True, metavar="JSON", help="what the entry 'training' is to say")
    options = parser.parse_args(argv)
    try:
        training = json.loads(options.training)
        for path in options.models:
            rewrite(path, training)
    except (ModelError, OSError, ValueError) as error:
        print(f"rewrite_metadata: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
