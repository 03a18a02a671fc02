"""Size of the source: lines, and numbers that have a name, by folder.

    python -m bench count

Named are names in capitals at the level of a module or a class whose value holds a number, and the fields of a dataclass
whose default does: a number that moves from the one to the other counts as before.
"""

from __future__ import annotations

import argparse
import ast
from collections.abc import Sequence
from pathlib import Path

from bench import results

FOLDERS = ("edgefilter", "bench", "export", "tests")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folders", nargs="*", type=Path, metavar="FOLDER", help="default: those of this checkout")


def run(options: argparse.Namespace) -> str:
    lines = ["  lines  named numbers"]
    for folder in options.folders or [results.ROOT / name for name in FOLDERS]:
        parts = sorted({path.parent for path in folder.rglob("*.py")} - {folder}) if folder.name == "edgefilter" else []
        for part, files in [(folder, folder.rglob("*.py")), *((part, part.glob("*.py")) for part in parts)]:
            sources = [path.read_text(encoding="utf-8") for path in files]
            named = sum(named_numbers(ast.parse(source).body) for source in sources)
            told = part.relative_to(folder.parent)
            lines.append(f"{sum(source.count(chr(10)) for source in sources):7} {named:7}  {told}")
    return "\n".join(lines)


def named_numbers(body: Sequence[ast.stmt], field: bool = False) -> int:
    r"""How many names in capitals statements give to a value that holds a number, those of classes in them too.

    field: whether the statements are a class's, in which annotated names count whatever their case.

    >>> named_numbers(ast.parse("A, B = 1, 2; C = 'one'; D: float = 0.5; e = 3").body)
    3
    >>> named_numbers(ast.parse("class Settings:\n    wait_s: float = 0.5\n    name: str = 'one'").body)
    1
    """
    count = 0
    for statement in body:
        if isinstance(statement, ast.ClassDef):
            count += named_numbers(statement.body, True)
        elif isinstance(statement, (ast.Assign, ast.AnnAssign)) and statement.value and holds_number(statement.value):
            targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
            names = (node.id for target in targets for node in ast.walk(target) if isinstance(node, ast.Name))
            count += sum(name.isupper() or (field and isinstance(statement, ast.AnnAssign)) for name in names)
    return count


def holds_number(value: ast.expr) -> bool:
    """Whether a value is a number, or has one in it."""
    constants = (node.value for node in ast.walk(value) if isinstance(node, ast.Constant))
    return any(isinstance(constant, (int, float)) and not isinstance(constant, bool) for constant in constants)
