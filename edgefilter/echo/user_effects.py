"""Effects of the user's own: a Python file with one class that has the hooks of Effect, known beside the others."""

from __future__ import annotations

import functools
import importlib.util
import sys
import traceback
from collections.abc import Callable, Mapping
from importlib.abc import Loader
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import cast

import numpy as np

from edgefilter.dsp.psd import GRID_BINS
from edgefilter.echo.effect import FAMILIES, STAGES, Effect, Parameter, Shift, complete, neutral
from edgefilter.echo.effects.catalogue import names, register
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.types import SAMPLE_RATE

REQUIRED = ("name", "stage", "parameters", "fit")
"""What no effect can do without; the rest has the defaults of Effect."""
HOOKS = [name for name, hook in {**vars(Effect), **vars(Shift)}.items() if callable(hook) and not name.startswith("_")]
_loaded: dict[Path, str] = {}


def load_effect(path: str | Path) -> str:
    """Run the Python file at path and make the effect that its one class defines known.

    The file is code and runs with the caller's rights. A file that was loaded before is not run again.
    A class that does not derive from Effect gets its defaults all the same.

    Parameters
    ----------
    path : str or Path
        A Python file with one class that is an effect (docs/own_effect.md).

    Returns
    -------
    str
        The effect's name.

    Raises
    ------
    UsageError
        In one line, where there is no such file, it does not run, holds no such class or more than one, the class lacks
        a part of an effect, its name is taken, or its neutral values are not the identity.

    Examples
    --------
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
    mine = _guarded(path, _effect_class(path, _run(path)))
    try:
        effect = mine()
    except Exception as error:
        told = f"{path}: {mine.__name__}() stops with {_told(error)}; an effect is made without arguments"
        raise UsageError(told) from error
    if wrong := _wrong(effect):
        raise UsageError(f"{path}: {wrong}")
    register(effect)
    _loaded[path.resolve()] = effect.name
    return effect.name


def loaded_files() -> tuple[Path, ...]:
    """The files of all effects of the user's own that are known, for another process to load."""
    return tuple(_loaded)


def _guarded(path: Path, mine: type[Effect]) -> type[Effect]:
    """A subclass of the user's class: what its hooks raise becomes one line that names the file and the line in it, what they give is checked."""
    own = [name for name in HOOKS if getattr(mine, name, None) is not getattr(Effect, name, None)]
    checks: dict[str, Callable] = {**_RESULTS, "run": functools.partial(_runner, path)}
    return type(
        mine.__name__, (mine,), {name: _in_one_line(path, getattr(mine, name), checks.get(name)) for name in own}
    )


def _in_one_line(path: Path, hook: Callable, check: Callable | None) -> Callable:
    """The hook, guarded. check(effect, result, first argument) raises UsageError for a result that would fail later."""

    @functools.wraps(hook)
    def call(effect: Effect, *arguments: object, **named: object) -> object:
        try:
            result = hook(effect, *arguments, **named)
        except EdgefilterError:
            raise
        except Exception as error:
            frames = traceback.extract_tb(error.__traceback__)
            lines = [frame.lineno for frame in frames if frame.filename == str(path.resolve())]
            where = f" at line {lines[-1]}" if lines else ""
            raise UsageError(f"{path}: {hook.__name__} stops{where} with {_told(error)}") from error
        if check is None:
            return result
        try:
            return check(effect, result, arguments[0])
        except UsageError as error:
            raise UsageError(f"{path}: {hook.__name__} {error}") from None

    return call


def _like_input(effect: Effect, result: object, x: np.ndarray) -> object:
    if not _finite(result, x.shape) or getattr(result, "dtype", None) != np.float32:
        raise UsageError(f"gives {_kind(result)}, expected finite float32 of shape {x.shape}, the shape of its input")
    return result


def _values(effect: Effect, result: object, *_: object) -> Mapping[str, object]:
    if not isinstance(result, Mapping):
        raise UsageError(f"gives {type(result).__name__}, expected a dict from parameter names to values")
    try:
        return complete(effect, result)
    except UsageError as error:
        raise UsageError(f"gives a wrong value: {error}") from None


def _power(effect: Effect, result: object, x: np.ndarray) -> object:
    if not _finite(result, x.shape) or np.any(cast(np.ndarray, result) < 0):
        raise UsageError(f"gives {_kind(result)}, expected finite numbers of shape {x.shape}, none below 0")
    return result


def _density(effect: Effect, result: object, *_: object) -> object:
    return _power(effect, result, np.empty(GRID_BINS))


def _finite(result: object, shape: tuple[int, ...]) -> bool:
    return isinstance(result, np.ndarray) and result.shape == shape and bool(np.isfinite(result).all())


_RESULTS: dict[str, Callable] = {
    "apply": _like_input,
    "fit": _values,
    "variance": _power,
    "noise_psd": _density,
    "colour": _density,
}


def _runner(path: Path, effect: Effect, result: object, *_: object) -> Callable | None:
    """What run() gave, its calls guarded as the hooks are."""
    if result is None:
        return None
    if not callable(result):
        raise UsageError(f"gives {type(result).__name__}, expected a callable (x, heard) -> samples, or None")
    return functools.partial(_in_one_line(path, type(result).__call__, _like_input), result)


def _kind(result: object) -> str:
    return f"{result.dtype} of shape {result.shape}" if isinstance(result, np.ndarray) else type(result).__name__


def _run(path: Path) -> ModuleType:
    """The module of the file, executed under a name of its own."""
    if path.suffix != ".py":
        raise UsageError(f"{path}: effects are read from Python files, expected a name that ends in .py")
    if not path.is_file():
        raise UsageError(f"{path}: no such file; --effects takes the Python file that defines your effect")
    name = f"edgefilter_user_effect_{len(_loaded)}_{path.stem}"
    # None only where no loader goes with the suffix: .py has one
    spec = cast(ModuleSpec, importlib.util.spec_from_file_location(name, path.resolve()))
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        cast(Loader, spec.loader).exec_module(module)
    except SyntaxError as error:
        raise UsageError(f"{path}: line {error.lineno} is not Python ({error.msg})") from None
    except (Exception, SystemExit) as error:
        raise UsageError(f"{path}: stops with {_told(error)}; the file must run without an error by itself") from error
    return module


def _effect_class(path: Path, module: ModuleType) -> type[Effect]:
    """The one effect that the module defines, with the defaults of Effect."""
    own = [value for value in vars(module).values() if isinstance(value, type) and value.__module__ == module.__name__]
    classes = [value for value in own if issubclass(value, Effect) or "apply" in vars(value)]
    if len(classes) != 1:
        found = ", ".join(value.__name__ for value in classes) or "none"
        raise UsageError(
            f"{path}: expected one class with apply and fit, found {found}; keep each effect in a file of its own"
        )
    (mine,) = classes
    given = {part for base in mine.__mro__ if base not in (Effect, object) for part in vars(base)}
    missing = [part for part in REQUIRED if part not in given]
    if missing:
        raise UsageError(
            f"{path}: class {mine.__name__} lacks {', '.join(missing)}; an effect has {', '.join(REQUIRED)}"
        )
    return mine if issubclass(mine, Effect) else type(mine.__name__, (mine, Effect), {})


def _wrong(effect: Effect) -> str:
    """What would fail later, in the middle of a diagnosis; empty where nothing would."""
    if not isinstance(effect.name, str) or not effect.name.isidentifier():
        return f"name is {effect.name!r}, expected one word of letters, digits and underscores"
    if effect.name in names():
        return f"effect '{effect.name}' exists already: choose another name than {', '.join(sorted(names()))}"
    if effect.stage not in STAGES:
        return f"stage is {effect.stage!r}, expected one of {', '.join(STAGES)}"
    if effect.family not in FAMILIES:
        return f"family is {effect.family!r}, expected one of {', '.join(FAMILIES)}"
    if not effect.parameters or not all(isinstance(p, Parameter) for p in effect.parameters):
        return "parameters is not a tuple of Parameter(name, unit, neutral, low, high)"
    for p in effect.parameters:
        if not p.low <= p.neutral <= p.high:
            return f"neutral {p.name}={p.neutral:g} is outside {p.low:g} to {p.high:g}"
    probe = np.random.default_rng(0).standard_normal(SAMPLE_RATE // 4).astype(np.float32) * np.float32(0.1)
    probe.flags.writeable = False
    if float(np.max(np.abs(effect.apply(probe, neutral(effect), SAMPLE_RATE) - probe))) > 1e-5:
        return f"apply changes the signal at the neutral values of effect '{effect.name}', expected the identity there"
    return ""


def _told(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:120]}"
