"""The one writer of results: every JSON file and Markdown page says from which code, data, models and machine it comes.

A program of bench/measure calls `stamp` before it measures, so that the stamp is of what ran and not of what was edited
meanwhile, and `write` at its end. docs: bench/README.md, "What a stamp says".
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path, PurePath

import numpy as np

from edgefilter import engines
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.filter.budget import processor, versions

SCHEMA = 2
"""Of every JSON file: 2 has a stamp, 1 had the machine alone."""
PACKAGES = ("numpy", "scipy", "onnxruntime", "faster-whisper", "ctranslate2", "jiwer", "pywebrtc-audio", "soundfile")
ROOT = Path(__file__).parents[1]
CHUNK = 1 << 20


def stamp(
    data: Mapping[str, Sequence[Path]] | None = None,
    engine_names: Iterable[str] = (),
    models: Mapping[str, Path | None] | None = None,
) -> dict:
    """What a result is made with and from, ready for JSON; take it before measuring.

    Parameters
    ----------
    data
        Folders (or files) that are read, by what they are: ``{"HUMAN": [Path("human/val")]}``. Of a folder its last
        part is written down, with the number and size of its files and their `digest`.
    engine_names
        Engines that run; the model files that the package would load for them are hashed.
    models
        Further models by name, a file or a folder each: ``{"WHISPER": folder}``; None where none is used.

    Returns
    -------
    dict
        command, commit, dirty, code (sha256 of the package's Python files: two results with the same one are of the
        same filter and diagnosis, whatever was committed in between), data (what, folder, files, bytes, sha256),
        models (by name: files, bytes, sha256; of a single file that of its content), machine, date (UTC).

    Raises
    ------
    UsageError
        For a folder or file that is not there.
    """
    data = dict(data or {})
    files = models_of(engine_names) | {name: path for name, path in (models or {}).items() if path is not None}
    commit, dirty = revision()
    return {
        "command": command(data, files),
        "commit": commit,
        "dirty": dirty,
        "code": code_digest(),
        "data": [
            {"what": what, "folder": path.resolve().name, **digest(path)}
            for what, paths in data.items()
            for path in paths
        ],
        "models": {name: _of_model(path) for name, path in files.items()},
        "machine": machine(),
        "date": datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
    }


def write(output: Path | None, made_with: Mapping, title: str, page: str, content: Mapping) -> str:
    """Write OUTPUT.json and OUTPUT.md and return the page; without an output only return it.

    Parameters
    ----------
    output
        Where to, without suffix; its folder is made where it is missing.
    made_with
        From `stamp`; the JSON file holds it under "stamp", the page in a short head.
    title
        First heading of the page.
    page
        What follows the head, Markdown.
    content
        The figures; numbers that are not finite become null.
    """
    text = "\n".join([f"# {title}", "", *head(made_with), "", page.strip("\n"), ""])
    if output:
        output.parent.mkdir(parents=True, exist_ok=True)
        whole = {"schema": SCHEMA, "title": title, "stamp": made_with, **content}
        _beside(output, ".json").write_text(to_json(whole), encoding="utf-8")
        _beside(output, ".md").write_text(text, encoding="utf-8")
    return text


def to_json(content: Mapping) -> str:
    """JSON as the results folder holds it.

    Numbers that are not finite become null, numpy's numbers and arrays plain ones.
    """
    return json.dumps(_plain(content), indent=1, allow_nan=False) + "\n"


def table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """Lines of a Markdown table.

    >>> table(["room", "dB"], [["lab", 3]])
    ['| room | dB |', '| --- | --- |', '| lab | 3 |']
    """
    lines = ["| " + " | ".join(columns) + " |", "|" + " --- |" * len(columns)]
    return lines + ["| " + " | ".join(str(cell).replace("|", "/") for cell in row) + " |" for row in rows]


def head(made_with: Mapping) -> list[str]:
    """The stamp as the lines under a page's title: command, code, data, models, machine."""
    changed = " with changes that are not committed" if made_with["dirty"] else ""
    code = f"Code {made_with['commit'][:12]}{changed}, {made_with['date']}."
    lines = [f"`{made_with['command']}`", "", code]
    read = [
        f"{entry['what']}/{entry['folder']} ({entry['files']} files, {entry['sha256'][:12]})"
        for entry in made_with["data"]
    ]
    read += [f"{name} ({entry['sha256'][:12]})" for name, entry in made_with["models"].items()]
    lines += [f"Data and models (sha256): {', '.join(read)}."] if read else []
    return [*lines, ", ".join(f"{key} {value}" for key, value in made_with["machine"].items()) + "."]


def digest(path: Path) -> dict:
    """files, bytes and sha256 of a folder (or of one file).

    Over name, size and content of each file, in the order of their names.

    Names are relative to the folder with "/" between the parts, so that a copy elsewhere has the same digest. Raises
    UsageError where there is nothing.
    """
    files = (
        [path]
        if path.is_file()
        else sorted((p for p in path.rglob("*") if p.is_file()), key=lambda p: p.relative_to(path).as_posix())
    )
    if not files:
        raise UsageError(f"{path} holds no file, expected the data that this result is made from: check the path")
    whole, size = hashlib.sha256(), 0
    for file in files:
        name = file.name if file == path else file.relative_to(path).as_posix()
        whole.update(f"{name}\0{file.stat().st_size}\0".encode())
        whole.update(_sha256(file).digest())
        size += file.stat().st_size
    return {"files": len(files), "bytes": size, "sha256": whole.hexdigest()}


def models_of(engine_names: Iterable[str]) -> dict[str, Path]:
    """The model files that the engines of these names load, by file name.

    Engines without a network, and programs that are none, have none.

    "auto" may choose any, so it counts as each of them; one whose model is missing has none.
    """
    found = {}
    for name in dict.fromkeys(
        engine for asked in engine_names for engine in (engines.HAVE_MODEL if asked == "auto" else (asked,))
    ):
        if name in engines.HAVE_MODEL:
            try:
                path = engines.create(name).model.path
            except EdgefilterError:
                continue
            found[path.name] = path
    return found


def code_digest() -> str:
    """sha256 over names and contents of the package's Python files."""
    package, whole = Path(engines.__file__).parents[1], hashlib.sha256()
    for path in sorted(package.rglob("*.py"), key=lambda p: p.relative_to(package).as_posix()):
        whole.update(path.relative_to(package).as_posix().encode() + b"\0" + _sha256(path).digest())
    return whole.hexdigest()


def revision() -> tuple[str, bool]:
    """The commit that is checked out, and whether a file other than a result differs from it.

    ("unknown", True) where this is no git checkout, or git is missing.
    """
    try:
        commit = _git("rev-parse", "HEAD").strip()
        return commit, bool(_git("status", "--porcelain", "--", ".", ":(exclude)bench/results").strip())
    except (OSError, subprocess.CalledProcessError):
        return "unknown", True


def machine() -> dict[str, str]:
    """Processor, threads, system, Python and package versions."""
    limit = os.environ.get("OMP_NUM_THREADS")
    threads = limit or f"not limited, {os.cpu_count()} cores"
    return {"processor": processor(), "threads": threads, "system": platform.system(), **versions(PACKAGES)}


def command(data: Mapping[str, Sequence[Path]], models: Mapping[str, Path]) -> str:
    """The command line that runs now, without the folders of this machine.

    Data and models by what they are, other paths by their last part.
    """
    known = {path.resolve(): f"{what}/{path.resolve().name}" for what, paths in data.items() for path in paths}
    known |= {path.resolve(): name for name, path in models.items()}
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    program = spec.name.removesuffix(".__main__") if spec and spec.name.startswith("bench.") else Path(sys.argv[0]).stem
    return " ".join(["python", "-m", program, *(_without_folders(argument, known) for argument in sys.argv[1:])])


def _without_folders(argument: str, known: Mapping[Path, str]) -> str:
    if argument.startswith("-") and "=" in argument:
        option, value = argument.split("=", 1)
        return f"{option}={_without_folders(value, known)}"
    path = PurePath(argument)
    if not argument.startswith("-") and (named := known.get(Path(argument).resolve())):
        return named
    return path.name if path.is_absolute() or ".." in path.parts else argument


def _beside(output: Path, suffix: str) -> Path:
    """OUTPUT with a suffix; a dot that its name holds already stays."""
    return output.parent / (output.name + suffix)


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=True)
    return done.stdout


def _of_model(path: Path) -> dict:
    if path.is_file():
        return {"files": 1, "bytes": path.stat().st_size, "sha256": _sha256(path).hexdigest()}
    return digest(path)


def _sha256(path: Path) -> hashlib._Hash:
    found = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(CHUNK):
            found.update(chunk)
    return found


def _plain(value: object) -> object:
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
