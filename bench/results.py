"""The one writer of results: a JSON file, from which the Markdown page and its pictures are generated.

A file has parts, one for each program that wrote to it: {"schema", "parts": {NAME: {"title", "stamp", "notes", "tables",
"plots", ...}}}. The stamp is that of bench/provenance.py.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import re
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from edgefilter import engines
from edgefilter.errors import UsageError
from edgefilter.filter.budget import processor, versions

SCHEMA = 3
"""Of every JSON file: 3 has parts with tables and plots, and digests of the behaviour that was measured."""
PACKAGES = ("numpy", "scipy", "onnxruntime", "faster-whisper", "ctranslate2", "jiwer", "pywebrtc-audio", "soundfile")
ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).parent / "results"
PAGES = (ROOT / "README.md", ROOT / "docs" / "index.md", ROOT / "bench" / "README.md")
"""Pages that quote tables: <!-- table: FILE/TABLE --> ... <!-- end -->."""
QUOTED = re.compile(r"(<!-- table: (\w+)/([\w-]+) -->\n).*?(<!-- end -->)", re.DOTALL)


# ---------------------------------------------------------------- what code, data and machine are


def digest(path: Path) -> dict:
    """Number of files, bytes and sha256 of a folder (names and contents) or a file; raises UsageError for nothing."""
    if path.is_file():
        return {"files": 1, "bytes": path.stat().st_size, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    files = sorted((p for p in path.rglob("*") if p.is_file()), key=lambda p: p.relative_to(path).as_posix())
    if not files:
        raise UsageError(f"{path} holds no file, expected the data that this result is made from: check the path")
    whole, size = hashlib.sha256(), 0
    for file in files:
        content = file.read_bytes()
        name = f"{file.relative_to(path).as_posix()}\0{len(content)}\0".encode()
        whole.update(name + hashlib.sha256(content).digest())
        size += len(content)
    return {"files": len(files), "bytes": size, "sha256": whole.hexdigest()}


def code_digest(files: Iterable[Path] | None = None) -> str:
    """sha256 over the package's Python files, or over these files."""
    package = Path(engines.__file__).parents[1]
    chosen = sorted(package.rglob("*.py")) if files is None else list(files)
    return hashlib.sha256(b"".join(hashlib.sha256(path.read_bytes()).digest() for path in chosen)).hexdigest()


def revision() -> tuple[str, bool]:
    """The commit that is checked out, and whether a file other than a result differs from it; "unknown" without git."""

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=True)
        return done.stdout.strip()

    try:
        return git("rev-parse", "HEAD"), bool(git("status", "--porcelain", "--", ".", ":(exclude)bench/results"))
    except (OSError, subprocess.CalledProcessError):
        return "unknown", True


def machine() -> dict[str, str]:
    """Processor, threads, system, Python and package versions."""
    threads = os.environ.get("OMP_NUM_THREADS") or f"not limited, {os.cpu_count()} cores"
    return {"processor": processor(), "threads": threads, "system": platform.system(), **versions(PACKAGES)}


# ---------------------------------------------------------------- what a result holds


def table(name: str, title: str, columns: Sequence, rows: Iterable[Sequence], text: str = "") -> dict:
    """A table, ready for JSON.

    columns: a heading each, or (heading, digits) for numbers. A cell is a text, a number, None for nothing, or a mean
    with its interval: {"mean", "low", "high"}, as bench/metrics.py gives it. text stands above the table.

    >>> print(markdown_table(table("one", "Rooms", ["room", ("dB", 1)], [["lab", 3], ["office", None]])))
    | room | dB |
    | --- | --- |
    | lab | 3.0 |
    | office |  |
    """
    heads, digits = map(list, zip(*(column if isinstance(column, tuple) else (column, None) for column in columns)))
    return {"name": name, "title": title, "text": text, "columns": heads, "digits": digits, "rows": list(rows)}


def absent(reasons: Mapping[str, str]) -> dict:
    return table("absent", "Rows that cannot be had here", ["system", "why"], list(reasons.items()))


def panel(title: str, x: str, y: str, lines: Mapping[str, tuple], marks: str = ".-", **axes: object) -> dict:
    """One panel of a plot: its lines by name, each (x values, y values); axes as matplotlib's Axes.set has them."""
    return {"title": title, "marks": marks, "axes": {"xlabel": x, "ylabel": y, **axes}, "lines": dict(lines)}


def plot(name: str, panels: Sequence[dict]) -> dict:
    return {"name": name, "panels": list(panels)}


def write(
    output: Path | None,
    name: str,
    title: str,
    made_with: Mapping,
    tables: Sequence[dict] = (),
    plots: Sequence[dict] = (),
    notes: str = "",
    **data: object,
) -> str:
    """Write the part NAME of OUTPUT.json, then OUTPUT.md and its pictures from the whole file; return the part's page.

    output: without suffix; None: nothing is written. Parts of other names that the file holds already stay. made_with:
    from `provenance.stamp`. tables, plots: from `table` and `plot`, all that the page shows besides the notes, in Markdown. data:
    whatever else the JSON file is to hold; numbers that are not finite become null.
    """
    part = plain({"title": title, "stamp": made_with, "notes": notes, "tables": tables, "plots": plots, **data})
    if output:
        path = output.parent / f"{output.name}.json"
        old = read(path)["parts"] if path.exists() else {}
        output.parent.mkdir(parents=True, exist_ok=True)
        save(output, {"schema": SCHEMA, "parts": {**old, name: part}})
    return markdown_part(part, output)


def read(path: Path) -> dict:
    """A JSON file of results; one of an earlier schema has no parts."""
    found = json.loads(path.read_text(encoding="utf-8"))
    return found if found.get("schema") == SCHEMA else {"schema": SCHEMA, "parts": {}}


def save(output: Path, whole: Mapping) -> None:
    (output.parent / f"{output.name}.json").write_text(to_json(whole), encoding="utf-8")
    pages = [f"# {output.name.replace('_', ' ').capitalize()}"]
    pages += [markdown_part(part, output) for part in whole["parts"].values()]
    (output.parent / f"{output.name}.md").write_text("\n\n".join(pages) + "\n", encoding="utf-8")
    for part in whole["parts"].values():
        for one in part["plots"]:
            (output.parent / picture_name(output, one)).write_bytes(picture(one))


def to_json(content: Mapping) -> str:
    """JSON as the results folder holds it: what holds no further list or object stands in one line."""
    text = json.dumps(plain(content), indent=1, allow_nan=False) + "\n"
    return re.sub(r"[\[{][^\[\]{}]*[\]}]", lambda found: re.sub(r"\s*\n\s*", " ", found[0]), text)


def columns(rows: Sequence[Mapping], digits: int = 5) -> dict:
    """Many rows with the same keys as {"columns", "values"}, numbers rounded to so many digits; a row that lacks a key has None.

    >>> columns([{"a": 1, "b": 0.123456}, {"a": 2}])
    {'columns': ['a', 'b'], 'values': [[1, 0.12346], [2, None]]}
    """
    keys = list(dict.fromkeys(key for row in rows for key in row))

    def short(value: Any) -> Any:
        return float(f"{value:.{digits}g}") if isinstance(value, float) and math.isfinite(value) else value

    return {"columns": keys, "values": [[short(row.get(key)) for key in keys] for row in rows]}


def plain(value: Any) -> Any:
    """As JSON can hold it: numpy's numbers and arrays as plain ones, numbers that are not finite as None."""
    if isinstance(value, Mapping):
        return {str(key): plain(part) for key, part in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(part) for part in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


# ---------------------------------------------------------------- Markdown, pictures


def cell(value: Any, digits: int | None = None) -> str:
    """A cell of a table as text.

    An interval that shows no width, of a single recording or of figures that are all alike, says nothing and is left out.

    >>> cell({"mean": 31.2, "low": 25.04, "high": 37.1}, 0), cell({"mean": 9.24, "low": 9.22, "high": 9.24}, 1), cell(None)
    ('31 [25, 37]', '9.2', '')
    """
    if value is None:
        return ""
    if isinstance(value, Mapping):
        mean = cell(value["mean"], digits)
        bounds = [cell(value.get(key), digits) for key in ("low", "high")]
        return f"{mean} [{bounds[0]}, {bounds[1]}]" if all(bounds) and bounds[0] != bounds[1] else mean
    if isinstance(value, float) and digits is None:
        return f"{value:g}"
    return f"{value:.{digits}f}" if isinstance(value, (int, float)) and digits is not None else str(value)


def markdown_table(one: Mapping) -> str:
    lines = ["| " + " | ".join(one["columns"]) + " |", "|" + " --- |" * len(one["columns"])]
    for row in one["rows"]:
        cells = (cell(value, digits).replace("|", "/") for value, digits in zip(row, one["digits"], strict=True))
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def markdown_part(part: Mapping, output: Path | None = None) -> str:
    blocks = [f"## {part['title']}", head(part["stamp"]), part["notes"]]
    for one in part["tables"]:
        blocks += [f"### {one['title']}", one["text"], markdown_table(one)]
    blocks += [f"![{one['name']}]({picture_name(output, one)})" for one in part["plots"] if output]
    return "\n\n".join(block.strip("\n") for block in blocks if block)


def head(made_with: Mapping) -> str:
    """The stamp in Markdown: command, code, data, models, machine."""
    changed = " with changes that are not committed" if made_with["dirty"] else ""
    read = [f"{one['what']}/{one['folder']} ({one['files']} files, {one['sha256'][:12]})" for one in made_with["data"]]
    read += [f"{name} ({one['sha256'][:12]})" for name, one in made_with["models"].items()]
    sources = [f"Data and models (sha256): {', '.join(read)}."] if read else []
    code = f"Code {made_with['commit'][:12]}{changed}, {made_with['date']}."
    machine_ = ", ".join(f"{key} {value}" for key, value in made_with["machine"].items())
    return "\n".join([f"`{made_with['command']}`", "", code, *sources, f"{machine_}."])


def picture_name(output: Path | None, one: Mapping) -> str:
    return f"{output.name if output else 'result'}_{one['name']}.png"


def picture(one: Mapping) -> bytes:
    """A plot of `plot` as PNG, by matplotlib's object interface, which needs no display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2 * len(one["panels"]), 4), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, panel_ in zip(figure.subplots(1, len(one["panels"]), squeeze=False).flat, one["panels"], strict=True):
        for name, (x, y) in panel_["lines"].items():
            heights = [np.nan if value is None else value for value in y]
            axes.plot(x, heights, panel_["marks"], label=name, linewidth=1.2)
        axes.set(title=panel_["title"], **panel_["axes"])
        axes.grid(alpha=0.3)
        if len(panel_["lines"]) > 1:
            axes.legend(fontsize=8)
    out = BytesIO()
    figure.savefig(out, dpi=100)
    return out.getvalue()


# ---------------------------------------------------------------- tables that other pages quote


def quote(text: str, folder: Path = RESULTS) -> str:
    """The text with each quoted table as the results have it now; raises UsageError for one that no result has."""

    def made(found: re.Match) -> str:
        path = folder / f"{found[2]}.json"
        parts = read(path)["parts"].values() if path.exists() else ()
        for one in (one for part in parts for one in part["tables"]):
            if one["name"] == found[3]:
                return f"{found[1]}{markdown_table(one)}\n{found[4]}"
        raise UsageError(f"no table '{found[3]}' in bench/results/{found[2]}.json: check the page that quotes it")

    return QUOTED.sub(made, text)
