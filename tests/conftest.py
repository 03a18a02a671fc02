"""Which tests share a process where several run at once (pytest -n 3), and which begin; a catalogue that any test can add to."""

import fcntl
import gc
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

# of each process, before numpy asks for it; three share two cores, since tests that play sound wait most of the time
os.environ.setdefault("OMP_NUM_THREADS", "1")
HERE = Path(__file__).parent
LONGEST = (
    "live",
    "diagnosis/test_hidden_recordings.py",
    "diagnosis/test_probe.py",
    "learning/test_path_learner.py",
    "bench/test_evaluate.py",
    "export/test_gpu.py",
    "filter/test_hostile_inputs.py",
    "export/test_training.py",
    "diagnosis/test_diagnose.py",
    "diagnosis/test_apply.py",
    "diagnosis/test_linear_changes.py",
    "bench/test_live.py",
    "commands/test_passport.py",
    "commands/test_apply_commands.py",
    "bench/test_arrays.py",
    "export/test_voicefilter.py",
    "test_wheel.py",
    "docs/test_examples.py",
    "diagnosis/test_defects.py",
    "diagnosis/test_codec.py",
    "integrations/test_sic.py",
)
"""From some 25 seconds up: begun last, one of them would be waited for by the other process alone."""


def group_of(file: str) -> str:
    """Of a file's path from tests/ on: it stays together, so that its fixtures are made once; so do all that play sound."""
    return "live" if file.startswith("live/") else file


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object:
    """By group, in the order below.

    pytest-xdist 3.8 does not see the marks by which it has groups of its own where pytest is 9.2, and without
    loadscopereorder off it would begin with the files that hold most tests.
    """
    from xdist.scheduler import LoadScopeScheduling

    class ByGroup(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return group_of(nodeid.split("::")[0].removeprefix("tests/"))

    config.option.loadscopereorder = False
    return ByGroup(config, log)


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Iterator[None]:
    """The first of several processes imports alone: side by side on a fresh machine each would compile every module, 26 s of CPU.

    What was imported stays: to look through it for garbage takes a third of the time to import it, and half a second of a test
    each time.
    """
    gc.disable()
    try:
        if "PYTEST_XDIST_WORKER" not in os.environ:
            return (yield)
        with open(Path(session.config.option.basetemp).parent / "imported", "a") as lock:  # the folder of all of them
            fcntl.flock(lock, fcntl.LOCK_EX)
            if os.fstat(lock.fileno()).st_size:
                fcntl.flock(lock, fcntl.LOCK_UN)
            found = yield
            lock.write("all")
        return found
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest groups first."""
    groups = {item: group_of(item.path.relative_to(HERE).as_posix()) for item in items}
    items.sort(key=lambda item: LONGEST.index(groups[item]) if groups[item] in LONGEST else len(LONGEST))


@pytest.fixture(autouse=True)
def own_catalogue(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test registers or loads is forgotten when it is over: the effect and the file that it came from."""
    from edgefilter.echo import user_effects
    from edgefilter.echo.effects import catalogue

    monkeypatch.setattr(catalogue, "_known", dict(catalogue._known))
    monkeypatch.setattr(user_effects, "_loaded", dict(user_effects._loaded))
