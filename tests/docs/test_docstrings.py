"""Docstrings of the public entry points have numpydoc's sections, for what their signatures have; none names its arguments wrongly."""

import ast
import inspect
import re
from pathlib import Path

import pytest

import edgefilter

FUNCTIONS = [name for name in edgefilter.__all__ if inspect.isfunction(getattr(edgefilter, name))]
CLASSES = ("EgoFilter", "Profile", "Recording")
METHODS = [
    f"{name}.{method}"
    for name in CLASSES
    for method, value in vars(getattr(edgefilter, name)).items()
    if not method.startswith("_") and (inspect.isfunction(value) or isinstance(value, classmethod))
]
SHORT = {
    "EgoFilter.reset",
    "Profile.with_echo",
    "Profile.noise_bins",
    "Profile.response_bins",
    *(f"Recording.{name}" for name in ("compare", "diagnose", "add", "prove")),
}
"""One sentence says all, or points to the function that it is for."""


def sections(text):
    """The text below each heading that is underlined."""
    found = re.split(r"^(\w+)\n-{3,}\n", inspect.cleandoc(text), flags=re.M)
    return dict(zip(found[1::2], found[2::2], strict=True))


def described(section):
    """Names at the margin of a section: `mic, ref : ndarray`, or `profile, engine, model`."""
    heads = [line.split(" : ")[0] for line in section.splitlines() if line and not line.startswith(" ")]
    return {name.strip() for head in heads for name in head.split(",")}


def test_entry_points_were_found():
    assert len(FUNCTIONS) >= 8 and len(METHODS) - len(SHORT) >= 8 and set(METHODS) >= SHORT


@pytest.mark.parametrize("name", [*FUNCTIONS, *CLASSES, *sorted(set(METHODS) - SHORT)])
def test_docstring_describes(name):
    thing = edgefilter
    for part in name.split("."):
        thing = getattr(thing, part)
    signature = inspect.signature(thing)
    parts = sections(thing.__doc__)
    parameters = set(signature.parameters) - {"self"}
    assert described(parts.get("Parameters", "")) == parameters
    gives = not inspect.isclass(thing) and signature.return_annotation not in (None, "None")
    assert ("Returns" in parts) == gives
    assert "." in name or ">>> " in parts["Examples"], "an example that tests/test_doctests.py runs"
    raised = re.findall(r"^(\w+Error(?:, \w+Error)*)$", parts.get("Raises", ""), re.M)
    assert all(hasattr(edgefilter, error) for line in raised for error in line.split(", "))
    assert raised or "Raises" not in parts


def test_no_docstring_begins_with_an_argument_that_got_a_capital():
    """Not "Mic (n,) and its reference", where the argument is called mic."""
    found, seen = [], 0
    for folder in ("edgefilter", "bench", "export"):
        for path in sorted((Path(__file__).parents[2] / folder).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and (text := ast.get_docstring(node)):
                    seen += 1
                    first = re.match(r"([A-Z]\w*)(?: \(|:)", text)
                    names = (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
                    if first and first[1].lower() in {name.arg.lower() for name in names}:
                        found.append(f"{path.name}, {node.name}: {text.splitlines()[0]}")
    assert seen > 1000 and not found
