"""Effects of the user's own: a Python file with one class that follows the Effect protocol, registered beside the others."""

from __future__ import annotations

import importlib.util
import sys
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from edgefilter.echo.effect import STAGES, Effect, Measurement, Parameter, Values, complete, names, neutral, register
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.types import SAMPLE_RATE, Samples

if TYPE_CHECKING:
    from edgefilter.echo.model import EchoModel

REQUIRED = ("name", "stage", "memoryless", "parameters", "apply", "fit")
PROBE_SAMPLES = 4000
_loaded: dict[Path, str] = {}


def load_effect(path: str | Path) -> str:
    """Run the Python file at path, register the effect that its one class defines, and return the effect's name.

    The file is code and runs with the caller's rights. A file that was loaded before is not run again.
    Raises UsageError, in one line, where there is no such file, it does not run, holds no such class or more than one, the class lacks
    a part of the Effect protocol, its name is taken, or its neutral values are not the identity.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "broken.py"
    >>> _ = file.write_text("def f(:")
    >>> load_effect(file)  # doctest: +ELLIPSIS
    Traceback (most recent call last):
        ...
    edgefilter.errors.UsageError: ...broken.py: line 1 is not Python (...)
    """
    path = Path(path)
    if path.resolve() in _loaded:
        return _loaded[path.resolve()]
    effect = _Guarded(path, _instance(path, _run(path)))
    _check(path, effect)
    register(effect)
    _loaded[path.resolve()] = effect.name
    return effect.name


class _Guarded:
    """The user's effect; what its methods raise becomes one line that names the file and the line in it."""

    def __init__(self, path: Path, effect: Effect) -> None:
        self._path, self._effect = path, effect
        self.name, self.stage, self.memoryless, self.parameters = effect.name, effect.stage, effect.memoryless, effect.parameters
        if hasattr(effect, "noise_psd"):
            self.noise_psd = effect.noise_psd
        if hasattr(effect, "variance"):
            self.variance = effect.variance
        if hasattr(effect, "memory"):
            self.memory = effect.memory

    def apply(self, x: Samples, values: Values, sample_rate: int) -> Samples:
        """The user's apply, its result checked for shape, type and finite values."""
        out = self._call(self._effect.apply, x, values, sample_rate)
        if not isinstance(out, np.ndarray) or out.shape != x.shape or out.dtype != np.float32 or not np.isfinite(out).all():
            what = f"{out.dtype} of shape {out.shape}" if isinstance(out, np.ndarray) else type(out).__name__
            raise UsageError(f"{self._path}: apply gives {what}, expected finite float32 of shape {x.shape}, the shape of its input")
        return out

    def fit(self, measurement: Measurement, model: EchoModel) -> Values:
        """The user's fit, its result checked for names and bounds."""
        values = self._call(self._effect.fit, measurement, model)
        if not isinstance(values, Mapping):
            raise UsageError(f"{self._path}: fit gives {type(values).__name__}, expected a dict from parameter names to values")
        return complete(self._effect, values)

    def _call(self, method: Callable[..., object], *arguments: object) -> object:
        try:
            return method(*arguments)
        except EdgefilterError:
            raise
        except Exception as error:
            lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(self._path.resolve())]
            where = f" at line {lines[-1]}" if lines else ""
            raise UsageError(f"{self._path}: {method.__name__} stops{where} with {_told(error)}") from error


def _run(path: Path) -> ModuleType:
    """The module of the file, executed under a name of its own."""
    if path.suffix != ".py":
        raise UsageError(f"{path}: effects are read from Python files, expected a name that ends in .py")
    if not path.is_file():
        raise UsageError(f"{path}: no such file; --effects takes the Python file that defines your effect")
    name = f"edgefilter_user_effect_{len(_loaded)}_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path.resolve())
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except SyntaxError as error:
        raise UsageError(f"{path}: line {error.lineno} is not Python ({error.msg})") from None
    except (Exception, SystemExit) as error:
        raise UsageError(f"{path}: stops with {_told(error)}; it must run on its own before it can be used") from error
    return module


def _instance(path: Path, module: ModuleType) -> Effect:
    """The one effect that the module defines."""
    classes = [
        value for value in vars(module).values() if isinstance(value, type) and value.__module__ == module.__name__ and hasattr(value, "apply")
    ]
    if len(classes) != 1:
        found = ", ".join(value.__name__ for value in classes) or "none"
        raise UsageError(f"{path}: expected one class with apply and fit, found {found}; keep each effect in a file of its own")
    missing = [part for part in REQUIRED if not hasattr(classes[0], part)]
    if missing:
        raise UsageError(f"{path}: class {classes[0].__name__} lacks {', '.join(missing)}; an effect has {', '.join(REQUIRED)}")
    try:
        return classes[0]()
    except Exception as error:
        raise UsageError(f"{path}: {classes[0].__name__}() stops with {_told(error)}; an effect is made without arguments") from error


def _check(path: Path, effect: Effect) -> None:
    """Raise UsageError for what would fail later, in the middle of a diagnosis."""
    if not isinstance(effect.name, str) or not effect.name.isidentifier():
        raise UsageError(f"{path}: name is {effect.name!r}, expected one word of letters, digits and underscores")
    if effect.name in names():
        raise UsageError(f"{path}: effect '{effect.name}' exists already: choose another name than {', '.join(sorted(names()))}")
    if effect.stage not in STAGES:
        raise UsageError(f"{path}: stage is {effect.stage!r}, expected one of {', '.join(STAGES)}")
    if not effect.parameters or not all(isinstance(p, Parameter) for p in effect.parameters):
        raise UsageError(f"{path}: parameters is not a tuple of Parameter(name, unit, neutral, low, high)")
    for p in effect.parameters:
        if not p.low <= p.neutral <= p.high:
            raise UsageError(f"{path}: neutral {p.name}={p.neutral:g} is outside {p.low:g} to {p.high:g}")
    probe = np.random.default_rng(0).standard_normal(PROBE_SAMPLES).astype(np.float32) * np.float32(0.1)
    probe.flags.writeable = False
    found = effect.apply(probe, neutral(effect), SAMPLE_RATE)
    if float(np.max(np.abs(found - probe))) > 1e-5:
        raise UsageError(f"{path}: apply changes the signal at the neutral values of effect '{effect.name}', expected the identity there")


def _told(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:120]}"
