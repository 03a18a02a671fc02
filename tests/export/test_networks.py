"""The comparison of trained networks, on a network of four steps."""

import json

import numpy as np
import pytest
import soundfile as sf

from bench.measure import networks
from export import train


class Deaf:
    """A recogniser that hears one word right."""

    def __init__(self, *_):
        pass

    def transcribe(self, samples):
        return "one" if samples.any() else ""


@pytest.fixture
def conversation(tmp_path):
    folder = tmp_path / "conversations" / "lab_00"
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    robot, human = 0.1 * rng.standard_normal((2, 2 * 16000))
    human[:16000] = 0
    click = np.zeros(16000)
    click[800] = 0.5
    for name, samples in {
        "mic": robot + 0.1 * human,
        "ref": robot,
        "clean": 0.1 * human,
        "sweep_ref": click,
        "sweep_mic": click,
    }.items():
        sf.write(folder / f"{name}.flac", samples, 16000)
    sf.write(folder / "fan_only.flac", 1e-3 * rng.standard_normal(32000), 16000)
    (folder / "meta.json").write_text(json.dumps({"room": "lab", "text": "one two", "start": 16000, "end": 32000}))
    return folder.parent


def test_networks_are_compared(tmp_path, conversation, monkeypatch):
    run = tmp_path / "tiny"
    small = ["--channels", "2", "2", "2", "2", "--hidden", "4", "--smoke"]
    monkeypatch.setattr(
        "sys.argv",
        ["train", "--data", str(tmp_path / "d"), "--validation", str(tmp_path / "v"), "--output", str(run), *small],
    )
    assert train.main() == 0
    monkeypatch.setattr(networks, "Recogniser", Deaf)
    monkeypatch.setattr(networks, "HOPS", 3)
    monkeypatch.setattr(networks.Conversation, "profile", None)
    out = tmp_path / "results" / "networks"
    arguments = [
        "--runs",
        str(run),
        "--conversations",
        str(conversation),
        "--whisper",
        str(tmp_path),
        "--output",
        str(out),
    ]
    monkeypatch.setattr("sys.argv", ["networks", *arguments])
    assert networks.main() == 0
    found = json.loads(out.with_suffix(".json").read_text())
    assert [row["engine"] for row in found["utterances"]] == ["linear", "ss", "tiny, 0 Wiener", "tiny, 0.5 Wiener"]
    assert all(row["errors"] == 1 and row["words"] == 2 and np.isfinite(row["si_sdr"]) for row in found["utterances"])
    assert found["runs"][0]["steps"] == 4 and found["runs"][0]["hot_ms"]["p50"] > 0
    assert "| tiny | 512/256" in out.with_suffix(".md").read_text() and out.with_suffix(".png").stat().st_size > 1000


def test_a_folder_without_a_network_is_one_line(tmp_path, conversation, monkeypatch, capsys):
    monkeypatch.setattr(networks, "Recogniser", Deaf)
    arguments = [
        "--runs",
        str(tmp_path),
        "--conversations",
        str(conversation),
        "--whisper",
        str(tmp_path),
        "--output",
        str(tmp_path / "o"),
    ]
    monkeypatch.setattr("sys.argv", ["networks", *arguments])
    assert networks.main() == 1
    assert "no best.pt" in capsys.readouterr().err
