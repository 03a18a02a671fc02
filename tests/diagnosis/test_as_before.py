"""What diagnosis, passport, comparison and probe say of recordings, number by number: as it was before."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import soundfile

from edgefilter import Profile, diagnose
from edgefilter.diagnosis.passport import measure
from edgefilter.diagnosis.probe import Inquiry, menu
from edgefilter.diagnosis.result import Diagnosis
from edgefilter.echo.model import EchoModel
from edgefilter.filter.budget import DEMO
from tests.as_before import same_as_before
from tests.diagnosis.robot_scene import path, profile, record, voice


def read(folder: Path, name: str) -> np.ndarray:
    return soundfile.read(folder / f"{name}.flac", dtype="float32")[0]


def told(found: Diagnosis) -> dict:
    """All but intervals, p-values and what is drawn for experts: these depend on the last bits of a search."""
    known = found.to_dict()
    ranking = [
        {
            **{name: one[name] for name in ("effect", "excess_after_db", "share", "evidence")},
            "values": {name: interval["value"] for name, interval in one["parameters"].items()},
        }
        for one in known["ranking"]
    ]
    tried = [
        {name: one[name] for name in ("effect", "verdict", "why", "gain_db", "beside_db")} for one in known["tried"]
    ]
    curves = known["closer_look"] and known["closer_look"]["curves"]
    plain = ("verdict", "excess_db", "remaining_db", "evidence", "where", "advice", "law", "warnings")
    return {**{name: known[name] for name in plain}, "ranking": ranking, "tried": tried, "curves": curves}


@pytest.mark.parametrize("number", ["one", "two"])
def test_of_the_hidden_robots(number: str) -> None:
    folder = DEMO / "hidden" / number
    found = diagnose(Profile.load(folder / "profile.npz"), read(folder, "mic"), read(folder, "reference"))
    same_as_before(f"diagnosis_{number}", told(found), 0.1, 0.02)


def trembling(x: np.ndarray) -> np.ndarray:
    return record((x * (0.7 + 0.3 * np.cos(2 * np.pi * 5.0 * np.arange(x.size) / 16000))).astype(np.float32))


def bent(x: np.ndarray) -> np.ndarray:
    return record((np.tanh(4.0 * x + 0.3) / 4.0).astype(np.float32))


def with_effect(name: str, **values: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda x: record(x, EchoModel(path()).with_effect(name, values))


HAPPENED = {
    "trembling": trembling,
    "bent": bent,
    "turned_down": with_effect("playback_gain", gain_db=-4.0),
    "compressed": with_effect("compression", threshold_db=-35.0, ratio=3.0, attack_ms=5.0, release_ms=150.0),
    "elsewhere": lambda x: record(x, EchoModel(path(seed=2))),
    "clipped": lambda x: np.clip(record(x), -0.03, 0.03),
    "later": lambda x: record(x, lag=37.4),
    "expanded": lambda x: record((x * np.minimum(np.abs(x) / 0.1, 1.0) ** 0.5).astype(np.float32)),
}


@pytest.mark.parametrize("what", HAPPENED)
def test_of_a_small_robot(what: str) -> None:
    x = voice(8.0)
    same_as_before(f"diagnosis_{what}", told(diagnose(profile(), HAPPENED[what](x), x)), 0.1, 0.02)


@pytest.mark.parametrize("what", ["trembling", "elsewhere", "clipped"])
def test_of_an_unknown_device(what: str) -> None:
    x = voice(10.0)
    same_as_before(f"passport_{what}", measure(HAPPENED[what](x), x, voice(2.0, seed=5), engines=["linear"]).to_dict())


def test_of_two_explanations() -> None:
    x = voice(4.0)
    inquiry = Inquiry(profile(), [("playback_gain",), ("compression",)], HAPPENED["compressed"](x), x)
    sound = menu(x)["five steps of level, upwards"]
    heard = HAPPENED["compressed"](np.pad(sound, (0, 16000)))
    gains = inquiry.gains(sound)
    answer = inquiry.answer([inquiry.hear(heard, sound)], [gains], ("steps",))
    found = {"before": inquiry.before(), "gains": gains, "answer": answer.to_dict()}
    same_as_before("probe", found, 0.02, 0.02)
