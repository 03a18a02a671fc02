"""What was measured on this machine before: a small JSON file in the user's cache folder."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = ("edgefilter", "numpy", "scipy", "onnxruntime")
FILE = "timings.json"


def folder() -> Path:
    """The user's cache folder by the platform's rules: XDG_CACHE_HOME or ~/.cache, ~/Library/Caches, LOCALAPPDATA."""
    if sys.platform == "darwin":
        base = Path.home() / "Library/Caches"
    elif sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData/Local"))
    else:
        named = os.environ.get("XDG_CACHE_HOME", "")
        base = Path(named) if Path(named).is_absolute() else Path.home() / ".cache"  # a relative one is to be ignored, says the rule
    return base / "edgefilter"


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


def recall(about: Mapping[str, object]) -> dict[str, dict]:
    """Engine -> figures as kept by `keep` for exactly this description; empty where there are none or the file is damaged."""
    kept = _read().get(_key(about), {})
    return kept.get("engines", {}) if isinstance(kept, dict) else {}


def keep(about: Mapping[str, object], engines: Mapping[str, dict]) -> str | None:
    """Write figures, atomically; returns why that was impossible, None when it was done."""
    everything = _read() | {_key(about): {"about": dict(about), "engines": dict(engines)}}
    draft = folder() / f"{FILE}.{os.getpid()}"
    try:
        folder().mkdir(parents=True, exist_ok=True)
        draft.write_text(json.dumps(everything, indent=1) + "\n")
        draft.replace(folder() / FILE)
    except OSError as error:
        with suppress(OSError):
            draft.unlink()
        return f"{folder()}: {error.strerror}"
    return None


def forget() -> None:
    """Remove all that was measured."""
    (folder() / FILE).unlink(missing_ok=True)


def _read() -> dict:
    try:
        found = json.loads((folder() / FILE).read_text())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _key(about: Mapping[str, object]) -> str:
    return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:16]
