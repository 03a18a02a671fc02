"""Correcting a model's metadata leaves its graph as it is."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import onnx
import pytest

from edgefilter.engines.onnx_session import open_model
from export import rewrite_metadata

TINY = Path(__file__).parents[1] / "data" / "crnn.onnx"


def test_training_is_replaced_and_all_else_stays(tmp_path: Path) -> None:
    path = Path(shutil.copy(TINY, tmp_path))
    assert rewrite_metadata.main([str(path), "--training", '{"step": 5, "seed": [1, 7]}']) == 0
    before, after = onnx.load(str(TINY)), onnx.load(str(path))
    assert before.graph.SerializeToString(deterministic=True) == after.graph.SerializeToString(deterministic=True)
    assert len(after.graph.initializer) > 5
    said, was = ({entry.key: entry.value for entry in model.metadata_props} for model in (after, before))
    assert json.loads(said.pop("training")) == {"step": 5, "seed": [1, 7]} != json.loads(was.pop("training"))
    assert said == was
    assert dict(open_model(path, "edgefilter-crnn", 2).training) == {"step": 5, "seed": [1, 7]}
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize(
    ("content", "says"), [(b"no model", "cannot be read as an ONNX model"), (None, "no metadata about its training")]
)
def test_what_is_no_exported_model_is_one_line_and_stays(
    content: bytes | None, says: str, tmp_path: Path, capsys
) -> None:
    path = tmp_path / "m.onnx"
    if content is None:
        model = onnx.load(str(TINY))
        onnx.helper.set_model_props(model, {})
        onnx.save(model, str(path))
    else:
        path.write_bytes(content)
    before = path.read_bytes()
    assert rewrite_metadata.main([str(path), "--training", "{}"]) == 1
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1 and path.read_bytes() == before


def test_training_that_is_no_json_is_one_line(tmp_path: Path, capsys) -> None:
    path = Path(shutil.copy(TINY, tmp_path))
    assert rewrite_metadata.main([str(path), "--training", "step 5"]) == 1
    assert capsys.readouterr().err.startswith("rewrite_metadata: ") and path.read_bytes() == TINY.read_bytes()
