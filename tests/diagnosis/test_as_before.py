"""What diagnosis, passport, comparison and probe say of recordings, number by number: as it was before."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import soundfile
from scipy import signal

from edgefilter import Profile, compare, diagnose
from edgefilter.diagnosis.joint import fit_straight
from edgefilter.diagnosis.passport import measure
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.probe import Inquiry, menu
from edgefilter.diagnosis.proof import prove
from edgefilter.diagnosis.result import Diagnosis
from edgefilter.echo.model import EchoModel
from edgefilter.filter.budget import DEMO
from tests.as_before import levels_db, same_as_before
from tests.diagnosis.robot_scene import livelier, path, profile, record, voice
from tests.diagnosis.test_laws import HIDDEN, lawful


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
    zones = known["independence"]["of_findings"]["zones"] if known["independence"]["of_findings"] else []
    depends = [(zone["meaning"], zone["share"]) for zone in zones]
    return {
        **{name: known[name] for name in plain},
        "ranking": ranking,
        "tried": tried,
        "curves": curves,
        "depends": depends,
    }


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


def drifting_band(x: np.ndarray) -> np.ndarray:
    effects = {"clock_drift": {"ppm": 80.0}, "bandlimit": {"cutoff_hz": 3300.0}}
    return record(x, EchoModel(path(), tuple(effects.items())))


def scrambled(x: np.ndarray) -> np.ndarray:
    """Only the magnitudes of the voice are heard, 40 ms late, as behind a microphone that makes sound anew."""
    _, _, spectra = signal.stft(np.pad(x, (640, 0))[: x.size], 16000, nperseg=512)
    turned = np.exp(2j * np.pi * np.random.default_rng(9).uniform(size=spectra.shape))
    return record(signal.istft(spectra * turned, 16000, nperseg=512)[1][: x.size].astype(np.float32))


RING = {"frequency_hz": 900.0, "q": 15.0, "gain_db": 6.0}
HAPPENED = {
    "trembling": trembling,
    "bent": bent,
    "turned_down": with_effect("playback_gain", gain_db=-4.0),
    "compressed": with_effect("compression", threshold_db=-35.0, ratio=3.0, attack_ms=5.0, release_ms=150.0),
    "elsewhere": lambda x: record(x, EchoModel(path(seed=2))),
    "clipped": lambda x: np.clip(record(x), -0.03, 0.03),
    "later": lambda x: record(x, lag=37.4),
    "scrambled": scrambled,
    "turned_down_elsewhere": lambda x: record(0.7 * x, EchoModel(livelier())),
    "clipped_behind_a_ring": lambda x: np.clip(
        record(x, EchoModel(path()).with_effect("chassis_resonance", RING)), -0.04, 0.04
    ),
    "drifting_band": drifting_band,
    "expanded": lambda x: record((x * np.minimum(np.abs(x) / 0.1, 1.0) ** 0.5).astype(np.float32)),
}


@pytest.mark.parametrize("what", [what for what in HAPPENED if what != "scrambled"])
def test_of_a_small_robot(what: str) -> None:
    x = voice(8.0)
    same_as_before(f"diagnosis_{what}", told(diagnose(profile(), HAPPENED[what](x), x)), 0.1, 0.02)


@pytest.mark.parametrize("what", ["trembling", "elsewhere", "clipped", "scrambled"])
def test_of_an_unknown_device(what: str) -> None:
    x = voice(10.0)
    same_as_before(f"passport_{what}", measure(HAPPENED[what](x), x, voice(2.0, seed=5), engines=["linear"]).to_dict())


@pytest.mark.parametrize("family", HIDDEN)
def test_of_a_free_law(family: str) -> None:
    """Its lines of Python hold every number of it."""
    law = lawful(family)
    found = {"code": law.code, "words": law.words, "gain_db": law.gain_db, "curve": law.curve.to_dict()}
    same_as_before(f"law_{family.replace(' ', '_')}", found, 0.02, 0.02)


def interrupted(x: np.ndarray) -> np.ndarray:
    """A human in a pause, twice; what the robot says behind the second one comes 90 samples later."""
    early, late = (
        record(part) for part in (x * (np.arange(x.size) < x.size // 2), x * (np.arange(x.size) >= x.size // 2))
    )
    y = 0.5 * (early + np.roll(late, 90))
    for start in (20_000, 68_000):
        y[start : start + 8000] += 0.02 * np.random.default_rng(8).standard_normal(8000).astype(np.float32)
    return y


@pytest.mark.parametrize("what", ["bent", "elsewhere", "later", "turned_down", "interrupted"])
def test_of_a_comparison(what: str) -> None:
    """What is heard and said before the first and behind the last whole word is cut off from some."""
    x = voice(9.0, seed=4)
    at = np.arange(x.size) % 48_000
    x[(at > 16_000) & (at < 36_000)] = 0.0
    y = interrupted(x) if what == "interrupted" else HAPPENED[what](x)
    if what in ("later", "bent"):
        x = np.where((np.arange(x.size) > 9000) & (np.arange(x.size) < 120_000), x, 0.0).astype(np.float32)
    prepared = prepare(profile(), y, x)
    masks = {"usable": prepared.usable, "active": prepared.active, "fit": prepared.measurement.fit}
    found = compare(profile(), y, x).to_dict()
    turns = {name: np.flatnonzero(np.diff(mask.astype(int))) for name, mask in masks.items()}
    same_as_before(f"comparison_{what}", {**found, **turns, "prediction": levels_db(prepared.prediction)})


@pytest.mark.parametrize("names", [("late_reverb",), ("playback_gain", "speaker_nonlinearity")])
def test_of_effects_that_are_added(names: tuple[str, ...]) -> None:
    """The path's filter, in energy of forty parts, each value, and what the running filter gains by them."""
    x = voice(10.0, seed=6)
    y = record((np.tanh(6.0 * x) / 9.0).astype(np.float32), EchoModel(path(seed=4)))
    model, straightened = fit_straight(prepare(profile(), y, x), names)
    values = {
        f"{name}.{key}": value if np.size(value) < 9 else [float(np.sum(part**2)) for part in np.array_split(value, 40)]
        for name, known in model.effects
        for key, value in known.items()
    }
    proof = prove(profile(), names, y, x)
    found = {"values": values, "straightened": straightened, "proof": proof.to_dict(), "without": proof.without}
    same_as_before(f"added_{names[-1]}", found, 0.01, 0.01)


def test_of_sounds_that_are_played() -> None:
    """Their level in steps of 50 ms, and that of their differences, which tells the spectrum."""
    sounds = menu(voice(6.0))
    found = {what: [levels_db(part, 0.05) for part in (x, np.diff(x))] for what, x in sounds.items()}
    same_as_before("sounds", found)


def test_of_two_explanations() -> None:
    x = voice(4.0)
    inquiry = Inquiry(profile(), [("playback_gain",), ("compression",)], HAPPENED["compressed"](x), x)
    sound = menu(x)["five steps of level, upwards"]
    heard = HAPPENED["compressed"](np.pad(sound, (0, 16000)))
    gains = inquiry.gains(sound)
    answer = inquiry.answer([inquiry.hear(heard, sound)], [gains], ("steps",))
    found = {"before": inquiry.before(), "gains": gains, "answer": answer.to_dict()}
    same_as_before("probe", found, 0.02, 0.02)
