"""Do the tests notice a change in the code? Mutants by cosmic-ray, a sample of them, and the tests beside each module.

    python -m bench mutate --count 200 --output bench/results/mutate      (hours; --jobs 2)

A mutant is a module of edgefilter/FOLDER with one operator, number, condition, decorator or the like replaced. Places
are drawn at random, each as often as any other, then one of cosmic-ray's replacements there; annotations, which do
nothing while a program runs, are left out. The tests of a mutant are those of tests/FOLDER, and of files outside
tests/bench that have the name of one of its modules, that reach the line, measured once without a mutant; all of them
where none reaches it, as on import or in a child process. It is killed where one fails, or where they take longer
than three times what all of them take; slow tests come last. Everything happens in copies of the checkout. Outcomes
are kept in --cache by code and tests. `--numbers` doubles and halves numbers that have a name instead: one that no test
tells from either decides nothing that is tested. The same seed draws the same mutants as long as the code is the same: `--again`
tries those alone that survived in OUTPUT.json, after tests were added.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import os
import queue
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeAlias

from bench import provenance, results
from bench.cache import Cache, key_of
from bench.count import holds_number, named_numbers
from bench.metrics import counted
from bench.recordings import progress
from edgefilter.errors import UsageError

Places: TypeAlias = dict[tuple[int, int], list[tuple[str, int]]]
FOLDERS = ("alignment", "filter", "engines", "learning", "diagnosis", "integrations")
LEFT_OUT = ("results", "__pycache__", "*.egg-info", ".*")
PATIENCE, LEAST_S = 3.0, 60.0
"""A mutant is killed by the clock after so many times what the tests take without one, but not before LEAST_S."""
PASSED, FAILED, NONE_CHOSEN = 0, 1, 5
"""Exit codes of pytest."""
SCALED = {"double": "({} * 2)", "halve": "(lambda x: type(x)(x / 2))({})"}
"""What stands in place of a number that has a name; half of an integer is one."""


@dataclass(frozen=True)
class Mutant:
    """A replacement in a module: which of an operator's occurrences, and the line before and after it."""

    folder: str
    module: str
    operator: str
    occurrence: int
    line: int
    before: str
    after: str


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--modules", default=",".join(FOLDERS), metavar="A,B,...", help="folders (default: %(default)s)")
    add("--count", type=int, default=200, help="mutants (default: %(default)s)")
    add("--numbers", action="store_true", help="double and halve numbers that have a name")
    add("--again", action="store_true", help="only those that survived in OUTPUT.json")


def run(options: argparse.Namespace) -> str:
    folders = options.modules.split(",")
    for folder in folders:
        for place in (results.ROOT / "edgefilter" / folder, results.ROOT / "tests" / folder):
            if not place.is_dir():
                raise UsageError(f"there is no {place}, expected folders of edgefilter/ that tests/ has as well")
    made_with = provenance.stamp()
    drawn = sample(folders, options.count, options.seed, numbers if options.numbers else places)
    outcomes = _survived(options.output, drawn) if options.again else {}
    missing = [mutant for mutant in drawn if outcomes.get(mutant, "survived") == "survived"]
    cache, code = Cache(options.cache, "mutants"), {folder: code_of(folder) for folder in folders}

    def reach_of(folder: str) -> dict:
        return cache.get(lambda: measured(free, folder), "reach", code[folder])

    def outcome_of(mutant: Mutant) -> str:
        return cache.get(lambda: attempt(free, mutant, reach[mutant.folder]), "outcome", code[mutant.folder], mutant)

    with copies(options.jobs) as free, ThreadPoolExecutor(options.jobs) as pool:
        reach = dict(zip(folders, pool.map(reach_of, folders), strict=True))
        tried = pool.map(outcome_of, missing)
        outcomes |= {mutant: next(tried) for mutant in progress(missing, "mutant")}
    rows = [{**asdict(mutant), "outcome": outcomes[mutant]} for mutant in drawn]
    survivors = [row for row in rows if row["outcome"] == "survived"]
    tables = [
        results.table("mutation", "By folder", ["folder", "mutants", "killed", "survived", "survived, % [95 %]"],
                      [_counts(name, rows) for name in (*folders, "all")]),
        results.table("survivors", "What no test noticed", ["where", "before", "after"],
                      [[f"{row['module']}:{row['line']}", f"`{row['before']}`", f"`{row['after']}`"] for row in survivors]),
    ]  # fmt: skip
    return results.write(options.output, "mutate", "Mutations of the code", made_with, tables, mutants=rows)


def _counts(name: str, rows: Sequence[Mapping]) -> list:
    found = counted(row["outcome"] == "survived" for row in rows if name in ("all", row["folder"]))
    share = {key: round(found[key]) for key in ("mean", "low", "high")}
    return [name, found["n"], found["n"] - found["hits"], found["hits"], share]


def _survived(output: Path | None, drawn: Sequence[Mutant]) -> dict[Mutant, str]:
    """Outcomes of an earlier run over the same mutants."""
    path = output and output.with_name(f"{output.name}.json")
    part = results.read(path)["parts"].get("mutate") if path and path.exists() else None
    known = {Mutant(**row): outcome for row in part["mutants"] if (outcome := row.pop("outcome"))} if part else {}
    if list(known) != list(drawn):
        remedy = "run without --again, or with its --count and --seed"
        raise UsageError(f"{path} is not of these {len(drawn)} mutants: {remedy}")
    return known


def sample(
    folders: Sequence[str], count: int, seed: int, places_of: Callable[[str], Places] | None = None
) -> list[Mutant]:
    """So many different places of the folders' modules, each with a replacement drawn at random. places_of: `places` or `numbers`."""
    found: dict[tuple, list[tuple[str, int]]] = {}
    for folder in folders:
        for path in sorted((results.ROOT / "edgefilter" / folder).rglob("*.py")):
            for place, replacements in (places_of or places)(path.read_text(encoding="utf-8")).items():
                found[(folder, path, *place)] = replacements
    rng = random.Random(seed)
    mutants = []
    for folder, path, line, column in rng.sample(list(found), len(found)):
        if len(mutants) == count:
            break
        operator, occurrence = rng.choice(found[folder, path, line, column])
        source = path.read_text(encoding="utf-8")
        lines = source.splitlines()
        try:
            changed = mutated(source, operator, occurrence).splitlines()
        except AttributeError:  # cosmic-ray 8.7 cannot replace every exception that it lists
            continue
        after = next((b for a, b in zip(lines, changed) if a != b), "")
        module = path.relative_to(results.ROOT).as_posix()
        mutants.append(Mutant(folder, module, operator, occurrence, line, lines[line - 1].strip(), after.strip()))
    return mutants


def places(source: str) -> Places:
    """Every (line, column) of the source that can be mutated, with the operators and occurrences there."""
    cosmic = _cosmic_ray()
    nodes, skipped = list(cosmic.ast.ast_nodes(cosmic.ast.get_ast(source))), list(annotations(source))
    found: Places = {}
    for name in cosmic.plugins.operator_names():
        operator = cosmic.plugins.get_operator(name)
        if operator.arguments():  # those that replace one named variable
            continue
        positions = (start for node in nodes for start, _ in operator().mutation_positions(node))
        for occurrence, at in enumerate(positions):
            if not any(first <= at < last for first, last in skipped):
                found.setdefault(at, []).append((name, occurrence))
    return dict(sorted(found.items()))


def numbers(source: str) -> Places:
    r"""Every (line, column) at which a number that has a name stands; of several in one tuple each, of one that is worked out the whole.

    >>> list(numbers("A, B = 1, 0.5 * 16000\nC = 'no number'"))
    [(1, 7), (1, 10)]
    """
    return {
        (at.lineno, at.col_offset): [(name, i) for name in SCALED]
        for i, at in enumerate(_numbers(ast.parse(source).body))
    }


def _numbers(body: Sequence[ast.stmt]) -> Iterator[ast.expr]:
    plain = (ast.Constant, ast.BinOp, ast.UnaryOp, ast.Name, ast.operator, ast.unaryop, ast.expr_context)
    for statement in body:
        if isinstance(statement, ast.ClassDef):
            yield from _numbers(statement.body)
        elif named_numbers([statement], field=True):
            value = statement.value
            for one in value.elts if isinstance(value, ast.Tuple) else [value]:
                if holds_number(one) and all(isinstance(node, plain) for node in ast.walk(one)):
                    yield one


def annotations(source: str) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    for node in ast.walk(ast.parse(source)):
        for part in (getattr(node, "annotation", None), getattr(node, "returns", None)):
            if part is not None:
                yield (part.lineno, part.col_offset), (part.end_lineno, part.end_col_offset)


def mutated(source: str, operator: str, occurrence: int) -> str:
    if operator in SCALED:
        at = list(_numbers(ast.parse(source).body))[occurrence]
        lines = source.splitlines(keepends=True)
        before, after = lines[at.lineno - 1], lines[at.end_lineno - 1]
        number = SCALED[operator].format(ast.get_source_segment(source, at))
        rest = before[: at.col_offset] + number + after[at.end_col_offset :]
        return "".join([*lines[: at.lineno - 1], rest, *lines[at.end_lineno :]])
    cosmic = _cosmic_ray()
    return cosmic.mutating.mutate_code(source, cosmic.plugins.get_operator(operator)(), occurrence)


def _cosmic_ray() -> object:
    # parso first: cosmic-ray's plugins otherwise find it half imported
    for name in ("parso.python.tree", "cosmic_ray.ast", "cosmic_ray.mutating", "cosmic_ray.plugins"):
        _library(name)
    return _library("cosmic_ray")


def _library(name: str) -> object:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        remedy = "pip install cosmic-ray pytest-cov"
        raise UsageError(f"mutants need cosmic-ray and pytest-cov ({error}): {remedy}") from None


@contextmanager
def copies(count: int) -> Iterator[queue.Queue[Path]]:
    free: queue.Queue[Path] = queue.Queue()
    with tempfile.TemporaryDirectory() as folder:
        for number in range(count):
            copy = Path(folder) / str(number)
            shutil.copytree(results.ROOT, copy, ignore=shutil.ignore_patterns(*LEFT_OUT), symlinks=True)
            free.put(copy)
        yield free


def code_of(folder: str) -> str:
    """What an outcome depends on: the package and the folder's tests."""
    tests = [results.ROOT / name for name in files_of(results.ROOT, folder)]
    return key_of(*(path.read_bytes() for path in [*sorted((results.ROOT / "edgefilter").rglob("*.py")), *tests]))


def files_of(root: Path, folder: str) -> list[str]:
    """Tests of a folder, and those elsewhere that have the name of one of its modules; the benchmarks' own read results, which copies lack."""
    modules = {f"test_{path.stem}" for path in (root / "edgefilter" / folder).rglob("*.py")}
    tests = root / "tests"
    named = (path for path in tests.rglob("test_*.py") if path.stem in modules and tests / "bench" not in path.parents)
    return [path.relative_to(root).as_posix() for path in sorted({*(tests / folder).rglob("test_*.py"), *named})]


def measured(free: queue.Queue[Path], folder: str) -> dict:
    """Which tests reach which lines, and the seconds that a mutant's may take; UsageError where they fail anyway."""
    copy = free.get()
    began, kept = time.monotonic(), copy / ".coverage"
    kept.unlink(missing_ok=True)
    try:
        options = (f"--cov=edgefilter/{folder}", "--cov-context=test", "--cov-report=", "--cov-append")
        if tests(copy, files_of(copy, folder), None, *options) != PASSED:
            raise UsageError(f"tests of {folder} fail without a mutant: mend that first")
        limit_s = max(LEAST_S, PATIENCE * (time.monotonic() - began))
        data = _library("coverage").CoverageData(str(kept))
        data.read()
        numbers: dict[str, int] = {"": 0}  # on import, for no test
        lines: dict[str, dict[str, list[int]]] = {}
        for path in sorted(data.measured_files()):
            lines[Path(path).relative_to(copy).as_posix()] = {
                str(line): sorted({numbers.setdefault(name, len(numbers)) for name in names} - {0})
                for line, names in data.contexts_by_lineno(path).items()
            }
    finally:
        free.put(copy)
    return {"limit_s": limit_s, "tests": list(numbers), "lines": lines}


def targets(copy: Path, mutant: Mutant, reach: Mapping) -> list[str]:
    """What pytest is to run: the tests that reach the statement; whole files where their preparation does."""
    by_line = reach["lines"].get(mutant.module, {})
    first, last = statement((copy / mutant.module).read_text(encoding="utf-8"), mutant.line)
    contexts = {reach["tests"][i] for line in range(first, last + 1) for i in by_line.get(str(line), ())}
    whole = {name.partition("::")[0] for name in contexts if not name.endswith("|run")}
    single = {name.removesuffix("|run").partition("[")[0] for name in contexts}
    chosen = whole | {name for name in single if name.partition("::")[0] not in whole}
    stem = Path(mutant.module).stem
    chosen = chosen or set(files_of(copy, mutant.folder))
    return sorted(chosen, key=lambda name: (stem not in name.partition("::")[0], "::" not in name, name))


def statement(source: str, line: int) -> tuple[int, int]:
    """First and last line of the innermost statement there, without the statements inside it; a decorator belongs to what it decorates."""
    spans = {}
    for node in (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.stmt)):
        start = min([node.lineno, *(one.lineno for one in getattr(node, "decorator_list", ()))])
        spans[start, node.end_lineno] = node
    first, last = min((span for span in spans if span[0] <= line <= span[1]), key=lambda span: span[1] - span[0])
    body = getattr(spans[first, last], "body", None)
    return first, body[0].lineno - 1 if body else last


def attempt(free: queue.Queue[Path], mutant: Mutant, reach: Mapping) -> str:
    """What became of a mutant: killed, timeout or survived."""
    copy = free.get()
    path = copy / mutant.module
    source = path.read_text(encoding="utf-8")
    try:
        chosen = targets(copy, mutant, reach)
        path.write_text(mutated(source, mutant.operator, mutant.occurrence), encoding="utf-8")
        code = tests(copy, chosen, reach["limit_s"])
    except subprocess.TimeoutExpired:
        return "timeout"
    finally:
        path.write_text(source, encoding="utf-8")
        free.put(copy)
    return "survived" if code == PASSED else "killed"


def tests(copy: Path, chosen: Sequence[str], limit_s: float | None, *options: str) -> int:
    """The exit code of the first chosen tests that fail, or of all; slow ones last."""
    began = time.monotonic()
    environment = os.environ | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    # the tests need no plugin, hypothesis works without its own; to load them takes a processor up to 2 s at each start
    environment["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    plugins = "-p pytest_cov" if options else ""
    for which in ("not slow", "slow"):
        pytest = f"-m pytest --rootdir=. -x -q -p no:cacheprovider {plugins} -m".split()
        left = None if limit_s is None else max(limit_s - (time.monotonic() - began), 1.0)
        command, quiet = [sys.executable, *pytest, which, *options, *chosen], subprocess.DEVNULL
        process = subprocess.Popen(
            command, cwd=copy, env=environment, stdout=quiet, stderr=quiet, start_new_session=True
        )
        try:
            code = process.wait(left)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, 9)  # with whatever the tests have started
            process.wait()
            raise
        if code not in (PASSED, NONE_CHOSEN):
            return code
    return PASSED
