"""What `from edgefilter import ...` gives, and the types that it promises."""

import ast
from importlib import import_module
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import soundfile
import soxr

import edgefilter
from edgefilter import EgoFilter, calibrate, enhance, generate_sweep, types
from edgefilter.dsp.metrics import si_sdr
from edgefilter.errors import UsageError
from tests.program import DEMO, demo


def test_each_public_name_is_defined_where_the_stub_says():
    tree = ast.parse(Path(edgefilter.__file__).with_suffix(".pyi").read_text())
    homes = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    assert sum(len(node.names) for node in homes) == len(edgefilter.__all__) >= 30
    for node in homes:
        for alias in node.names:
            value = getattr(edgefilter, alias.name)
            assert alias.asname == alias.name and value is getattr(
                import_module(f"edgefilter.{node.module}"), alias.name
            )


def test_an_unknown_name_is_an_attribute_error_and_dir_lists_the_known():
    with pytest.raises(AttributeError, match="edgefilter attribute EgoFiltre"):
        edgefilter.EgoFiltre  # noqa: B018
    assert set(edgefilter.__all__) <= set(dir(edgefilter))


@pytest.mark.parametrize("engine", ["crnn", "ss", "bypass", "paper-ss"])
def test_stats_have_the_keys_of_their_type(engine):
    ego = EgoFilter(DEMO / "profile.npz", engine=engine)
    ego.process(np.zeros(4000, np.float32), np.zeros(4000, np.float32))
    found = ego.stats()
    assert set(found) == set(types.Stats.__annotations__)
    assert set(found["deadline"]) == set(types.DeadlineStats.__annotations__)
    assert (found["linear_stage"] is None) == (engine in ("bypass", "paper-ss"))
    if found["linear_stage"]:
        assert set(found["linear_stage"]) == set(types.LinearStageStats.__annotations__)
    tracking = set(types.AlignmentStats.__annotations__) - {"utterances_aligned"}
    paper = {"method", "delay_samples", "confidence", "utterances_aligned"}
    assert (
        set(found["alignment"] or ()) == {"crnn": tracking, "ss": tracking, "bypass": set(), "paper-ss": paper}[engine]
    )


@pytest.mark.slow
def test_events_are_of_the_kinds_of_their_type():
    mic, ref = demo("mic", "reference")
    ego = EgoFilter(DEMO / "profile.npz", engine="crnn")
    ego.process(mic, ref)
    kinds = {event.kind for event in ego.events()}
    assert {"realigned", "speech_started"} <= kinds <= set(get_args(types.EventKind))


def test_recordings_of_any_rate_are_taken_and_given_back_as_long():
    mic, ref = (soundfile.read(DEMO / f"{name}.flac", dtype="float32")[0][:80_000] for name in ("mic", "reference"))
    fast = [soxr.resample(sound, 16_000, 48_000) for sound in (mic, ref)]
    found = enhance(*fast, engine="linear", sample_rate=48_000)
    slow = enhance(*(soxr.resample(sound, 48_000, 16_000) for sound in fast), engine="linear")
    assert found.shape == fast[0].shape and si_sdr(soxr.resample(found, 48_000, 16_000), slow) > 30
    played = generate_sweep()
    heard, quiet = 0.5 * np.roll(played, 300), np.full(64_000, 1e-6, np.float32) * (-1) ** np.arange(64_000)
    three = [soxr.resample(sound.astype(np.float32), 16_000, 48_000) for sound in (played, heard, quiet)]
    assert abs(calibrate(*three, sample_rate=48_000).delay - 300) <= 1
    with pytest.raises(UsageError, match="sample_rate is 441, expected 1000 to 768000 Hz"):
        enhance(mic, ref, sample_rate=441)
