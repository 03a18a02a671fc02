"""What was measured on this machine before: a small JSON file in the user's cache folder."""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import platformdirs

PACKAGES = ("edgefilter", "numpy", "scipy", "onnxruntime")
FILE = "timings.json"


def folder() -> Path:
    """The user's cache folder by the platform's rules: XDG_CACHE_HOME or ~/.cache, ~/Library/Caches, LOCALAPPDATA."""
    return platformdirs.user_cache_path("edgefilter", appauthor=False, opinion=False)


def describe(path: Mapping[str, object]) -> dict[str, object]:
    """What timings depend on: machine, versions, and what the caller says of the path."""
    found: dict[str, object] = {"machine": platform.node(), "processor": processor(), "cores": os.cpu_count()}
    return {**found, **versions(PACKAGES), **path}


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Of Python and of each package, "none" where it is not installed."""
    found = {"python": platform.python_version()}
    for package in packages:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "none"
    return found


def processor() -> str:
    """Name of the processor as the system knows it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.lower().startswith("model name")]
    return names[0] if names else platform.processor()


def recall(
    about: Mapping[str, object], kinds: Mapping[str, type], say: Callable[[str], None] = lambda text: None
) -> dict[str, dict]:
    """Engine -> figures as kept by `keep` for exactly this description.

    kinds: name and type of every figure. An engine whose figures are others is left out, and a damaged file holds
    nothing; say is told why.
    """
    everything, trouble = _read()
    kept = everything.get(_key(about), {})
    listed = kept.get("engines") if isinstance(kept, dict) else None
    if not trouble and kept and not isinstance(listed, dict):
        trouble = "its entry for this machine holds no engines"
    found = {}
    for name, figures in (listed if isinstance(listed, dict) else {}).items():
        wrong = _unlike(figures, kinds)
        if wrong:
            trouble = f"{name}: {wrong}"
        else:
            found[name] = figures
    if trouble:
        say(f"the measurements kept in {folder() / FILE} are not used: {trouble}")
    return found


def keep(about: Mapping[str, object], engines: Mapping[str, dict]) -> str | None:
    """Write figures, atomically; returns why that was impossible, None when it was done."""
    everything = _read()[0] | {_key(about): {"about": dict(about), "engines": dict(engines)}}
    draft = folder() / f"{FILE}.{os.getpid()}"
    try:
        folder().mkdir(parents=True, exist_ok=True)
        draft.write_text(json.dumps(everything, indent=1) + "\n", encoding="utf-8")
        draft.replace(folder() / FILE)
    except OSError as error:
        with suppress(OSError):
            draft.unlink()
        return f"{folder()}: {error.strerror}"
    return None


def forget() -> None:
    """Remove all that was measured."""
    (folder() / FILE).unlink(missing_ok=True)


def _read() -> tuple[dict, str]:
    """What is kept, and what is wrong with it; a file that is not there is an empty one."""
    try:
        found = json.loads((folder() / FILE).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}, ""
    except OSError as error:
        return {}, f"it cannot be read ({error.strerror})"
    except (ValueError, RecursionError):
        return {}, "it is not JSON"
    if not isinstance(found, dict):
        return {}, f"it holds a JSON {type(found).__name__}, expected an object"
    return found, ""


def _unlike(figures: object, kinds: Mapping[str, type]) -> str:
    """What of figures is not of the kinds; empty where all is."""
    if not isinstance(figures, dict) or figures.keys() != kinds.keys():
        return f"expected {', '.join(kinds)}"
    for name, kind in kinds.items():
        value = figures[name]
        good = type(value) in ((int, float) if kind is float else (kind,))
        if not good or (kind in (int, float) and not 0 <= value < float("inf")):
            return f"{name} is {str(value)[:40]!r}, expected type {kind.__name__}"
    return ""


def _key(about: Mapping[str, object]) -> str:
    return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:16]
