"""The catalogue is the one place that lists effects: no other module spells a name, the order is its own."""

from __future__ import annotations

import ast
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from edgefilter.echo.effect import STAGES, Effect, neutral
from edgefilter.echo.effects.catalogue import EFFECTS, chain, register
from edgefilter.echo.running import SourceChain
from tests.conformance import EFFECT_CASES, robot_model, robot_speech

PACKAGE = Path(__file__).parents[2] / "edgefilter"
HOME = PACKAGE / "echo" / "effects"
OUTSIDE = [path for path in sorted(PACKAGE.rglob("*.py")) if HOME not in path.parents]


def spelled(tree: ast.AST) -> set[str]:
    """Every text, name and attribute in the code, docstrings and comments left out."""
    documents = {
        node.body[0].value
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in documents:
            found.add(node.value)
        elif isinstance(node, ast.Name):
            found.add(node.id)
        elif isinstance(node, ast.Attribute):
            found.add(node.attr)
        elif isinstance(node, ast.alias):
            found |= set(node.name.split("."))
    return found


def test_files_were_found() -> None:
    assert len(OUTSIDE) > 40 and len(EFFECTS) >= 13
    assert spelled(ast.parse("x = find('rattle')")) & {effect.name for effect in EFFECTS}


@pytest.mark.parametrize("path", OUTSIDE, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_module_outside_the_folder_spells_an_effect(path: Path) -> None:
    own = {effect.name for effect in EFFECTS} | {type(effect).__name__ for effect in EFFECTS}
    if path.parent.name == "integrations":
        own.discard("codec")  # there the word means the coding of a stream
    assert not spelled(ast.parse(path.read_text(encoding="utf-8"))) & own


def test_an_effect_is_asked_and_not_searched_for_attributes() -> None:
    asking = [path for folder in ("echo", "diagnosis", "report") for path in sorted((PACKAGE / folder).rglob("*.py"))]
    assert len(asking) > 40
    assert [path.name for path in asking if "hasattr(" in path.read_text(encoding="utf-8")] == []


def test_the_list_follows_the_sound() -> None:
    stages = [STAGES.index(effect.stage) for effect in EFFECTS]
    assert stages == sorted(stages)
    assert all(isinstance(effect, Effect) and effect.sentence(neutral(effect)) for effect in EFFECTS)


def test_the_order_in_which_effects_were_found_changes_no_prediction() -> None:
    x, names = robot_speech()[:16_000], ("compression", "playback_gain", "speaker_nonlinearity")
    predictions = []
    for order in permutations(names):
        model = robot_model()
        for name in order:
            model = model.with_effect(name, EFFECT_CASES[name])
        assert [name for name, _ in model.effects] == list(order)
        assert [effect.name for effect, _ in chain(model.effects)] == [
            "playback_gain",
            "compression",
            "speaker_nonlinearity",
        ]
        predictions.append(model.predict(x))
        # transforms of another length than with the past in front: rounding of float32
        expected = x
        for effect, values in chain(model.effects):
            expected = effect.apply(expected, values, 16_000)
        np.testing.assert_allclose(SourceChain(model.effects)(x), expected, atol=1e-6)
    assert all(np.array_equal(found, predictions[0]) for found in predictions)


def test_a_users_effect_comes_after_those_of_its_stage() -> None:
    class Late(Effect):
        name, stage, parameters = "aaa", "source", ()

    register(Late())
    named = [effect.name for effect, _ in chain((("aaa", {}), ("rattle", {}), ("clock_drift", {})))]
    assert named == ["rattle", "aaa", "clock_drift"]
