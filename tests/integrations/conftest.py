"""The simulated room of the examples, and a filter whose reference can be looked at."""

import asyncio
import importlib
import inspect
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edgefilter import EgoFilter, Profile
from edgefilter.calibration.calibrate import cross_density
from edgefilter.integrations import duplex
from edgefilter.profile.array import ArrayCalibration

collect_ignore = [] if sys.version_info >= (3, 11) else ["test_pipecat.py"]  # for which Pipecat is not made
EXAMPLES = Path(__file__).parents[2] / "docs/examples"


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem):
    """A test that is a coroutine has a loop of its own, and two minutes."""
    if inspect.iscoroutinefunction(pyfuncitem.obj):
        words = {name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}
        asyncio.run(asyncio.wait_for(pyfuncitem.obj(**words), 120))
        return True


class Watched(EgoFilter):
    """Keeps the reference that it got, and the time at which speech began."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.references, self.began_s = [], None

    def process(self, mic_block, ref_block):
        self.references.append(ref_block)
        human = super().process(mic_block, ref_block)
        if self.human_speaks and self.began_s is None:
            self.began_s = self.stats()["samples"] / 16_000
        return human


@pytest.fixture(scope="session")
def example():
    """Imports a program of docs/examples as a module."""
    if str(EXAMPLES) not in sys.path:
        sys.path.append(str(EXAMPLES))
    return importlib.import_module


@pytest.fixture(scope="session")
def room_of(example):
    return example("room")


@pytest.fixture(scope="session")
def pair(room_of):
    """A profile of two microphones, and what a device of three channels hears (n, 3) in 3.7 s: first another one, then
    these two, while a human speaks from 1 s to 2.5 s."""
    robot = Profile.load(room_of.PROFILE)
    rng = np.random.default_rng(3)

    def both(first):
        own = 0.1 * np.std(room_of.Room().fan) * rng.standard_normal((2, first.size))
        return (np.stack((first, np.roll(first, 3))) + own).astype(np.float32)

    further = np.roll(robot.echo.impulse_response, 3)[None]
    fan = both(np.tile(room_of.Room().fan, 20))
    room = room_of.Room()
    heard = [room.hear(room_of.RATE)]
    room.speak()
    heard.append(room.hear(24_000))
    room.human_from = None
    heard.append(room.hear(19_200))
    mics = both(np.concatenate(heard))
    sound = np.stack((0.3 * np.roll(mics[0], 50), *mics), axis=1)
    return replace(robot, array=ArrayCalibration(further, cross_density(fan))), sound


@pytest.fixture(scope="session")
def talking(room_of, pair):
    """The same two microphones behind a loopback of what is played (n, 3): 3.5 s of a robot, a human from 2.5 s on."""
    room = room_of.Room()
    room.play(room_of.ROBOT[:56_000])
    heard = [room.hear(40_000)]
    room.speak()
    heard.append(room.hear(16_000))
    first = np.concatenate(heard)
    own = 0.1 * np.std(room.fan) * np.random.default_rng(4).standard_normal((2, first.size))
    mics = np.stack((first, np.roll(first, 3))) + own
    return pair[0], np.stack((np.concatenate(room.played), *mics), axis=1).astype(np.float32)


@pytest.fixture
def patient(monkeypatch):
    """The room's time is not the machine's: a slow machine is no microphone that was off."""
    monkeypatch.setattr(duplex, "WAITED_S", 1e9)


@pytest.fixture
def ego(room_of, patient):
    return Watched(room_of.PROFILE)


@pytest.fixture
def check_conversation(room_of):
    """What each example must show: the human is noticed, the robot stops, the reference is what was played."""

    def check(room, ego, human_at_s):
        assert human_at_s < ego.began_s < human_at_s + 0.5  # 0.2 s were seen
        played, said = (sounding(parts) for parts in (room.played, ego.references))
        assert human_at_s * 16_000 * 0.8 < played.size < 0.95 * sounding([room_of.ROBOT]).size, "cut off in mid-word"
        both = min(played.size, said.size)
        np.testing.assert_array_equal(played[:both], said[:both])
        assert abs(played.size - said.size) < 0.5 * 16_000  # what the loudspeaker's buffer holds, and a frame

    return check


def sounding(parts):
    """All samples that are not zero: a machine that is too slow makes pauses, in the one or in the other."""
    samples = np.concatenate(parts)
    samples = np.rint(samples * 32768)
    return samples[samples != 0]
