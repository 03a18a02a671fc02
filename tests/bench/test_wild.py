"""The wild set: which programs, in which half, and that their sound comes back at its place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis.names import Outcome
from bench.simulate import wild
from bench.simulate.hidden_robot import Place, draw_scene
from bench.simulate.wild import Program
from edgefilter.echo.effects import catalogue

NAMES = {half: {program.name for program in programs} for half, programs in wild.HALVES.items()}
SUITES = [{name.split()[0].rstrip(",") for name in names} for half, names in NAMES.items() if half != "untried"]


def test_the_halves_are_of_other_programs() -> None:
    assert min(len(wild.TUNING), len(wild.REPORTING)) >= 25 and len(wild.UNSEEN) >= 15
    assert sum(map(len, SUITES)) == len(set.union(*SUITES))
    assert sum(map(len, NAMES.values())) == len(set.union(*NAMES.values()))


@pytest.mark.parametrize("half", sorted(wild.HALVES))
def test_every_right_name_is_one_that_the_diagnosis_may_say(half: str) -> None:
    right = {name for program in wild.HALVES[half] for name in program.right}
    assert right <= {*catalogue.names(), "unknown"}
    assert len(right) >= {"tuning": 12, "reporting": 12, "unseen": 9, "untried": 12}[half]


@pytest.mark.parametrize("half", sorted(wild.HALVES))
def test_programs_come_in_turn_with_a_control_for_every_ten(half: str) -> None:
    programs = wild.HALVES[half]
    drawn = [wild.programs_of(half, index) for index in range(2 * len(programs))]
    assert [program for of in drawn for program in of][: len(programs)] == list(programs)
    assert [index for index, of in enumerate(drawn) if not of] == list(range(9, len(drawn), 10))


def test_what_is_combined_has_one_right_name_each() -> None:
    drawn = [of for index in range(20) if (of := wild.programs_of("combined", index))]
    assert [tuple(program.name for program in of) for of in drawn[: len(wild.COMBINED)]] == list(wild.COMBINED)
    assert all(len({program.right for program in of}) == len(of) for of in drawn)
    assert all(len(program.right) == 1 for of in drawn for program in of)


@pytest.mark.parametrize("lag", [0, 37, 480, -20])
def test_a_program_that_is_late_is_put_back(lag: int) -> None:
    x = np.random.default_rng(0).standard_normal(4000)
    late = np.concatenate([np.zeros(lag), x]) if lag >= 0 else x[-lag:]
    y = wild.Command("late", lambda _: late)(x)
    assert y.size == x.size
    np.testing.assert_array_equal(y[100:-100], x[100:-100])


def test_a_program_that_is_not_there_says_which_packages_are_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(SystemExit, match=r"sox was not found; .*wild\.py says which packages"):
        wild.sox("gain", -3)(np.zeros(100))


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_a_program_that_gives_samples_that_are_no_numbers_is_refused(wrong: float) -> None:
    broken = wild.Command("sox reverb 50", lambda x: np.where(np.arange(x.size) < 3, wrong, x))
    with pytest.raises(
        SystemExit, match=r"sox reverb 50: 3 of 100 samples that came out are not finite, expected none"
    ):
        broken(np.ones(100))


@pytest.mark.parametrize(("name", "least", "most"), [("microphone moved", 0.01, 0.06), ("robot moved", 0.0, 1.2)])
def test_who_moves_stays_in_the_room(name: str, least: float, most: float) -> None:
    place = Place(np.array([4.0, 3.0, 2.6]), 0.4, 1, np.array([1.0, 1.0, 1.0]), np.array([1.2, 1.0, 0.9]))
    other, words = wild.moved(np.random.default_rng(1), place, Program(name, "room", ("early_path",), None))
    assert least <= np.linalg.norm(other.microphone - place.microphone) <= most + 1e-9
    assert ((other.microphone > 0) & (other.microphone < place.size)).all()
    assert words.startswith(name.split()[0])
    assert np.allclose(other.loudspeaker, place.loudspeaker) == (name == "microphone moved")


@pytest.mark.parametrize(("said", "hit"), [("limiter", True), ("compression", True), ("late_reverb", False)])
def test_other_right_names_count(said: str, hit: bool) -> None:
    outcome = Outcome("case", ("limiter",), ("program",), "clear", "missing", (said,), also=("compression",))
    assert outcome.hit is hit


def test_a_program_that_only_turns_the_volume_is_known_by_that_too() -> None:
    rng = np.random.default_rng(3)
    scene = draw_scene(rng, rng.standard_normal(96_000), 25.0)
    usual = scene.record(scene.usual)
    louder = replace(scene.usual, played=1.3 * scene.usual.played)
    bent = replace(scene.usual, played=np.clip(scene.usual.played, 0.0, None))
    assert wild.is_a_volume(scene, scene.record(louder) - usual)
    assert not wild.is_a_volume(scene, scene.record(bent) - usual)
