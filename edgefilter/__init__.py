"""Hear the human while the robot talks: removal of a robot's own voice and fan from its microphone, in real time.

Everything public can be had from here (docs/api.md). Names are loaded when they are first asked for, so that `import
edgefilter` costs nothing and a program pays for what it uses.

>>> import numpy as np
>>> from edgefilter import enhance
>>> silence = np.zeros(1000, np.float32)
>>> enhance(silence, silence, engine="linear").shape
(1000,)
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from edgefilter.calibration.calibrate import calibrate as calibrate
    from edgefilter.calibration.from_recording import self_calibrate as self_calibrate
    from edgefilter.calibration.multisine import calibrate_multisine as calibrate_multisine
    from edgefilter.calibration.multisine import generate_multisine as generate_multisine
    from edgefilter.calibration.sweep import generate_sweep as generate_sweep
    from edgefilter.diagnosis.compare import Comparison as Comparison
    from edgefilter.diagnosis.compare import compare as compare
    from edgefilter.diagnosis.diagnose import add as add
    from edgefilter.diagnosis.diagnose import diagnose as diagnose
    from edgefilter.diagnosis.proof import Proof as Proof
    from edgefilter.diagnosis.proof import prove as prove
    from edgefilter.diagnosis.proven import diagnose_proven as diagnose_proven
    from edgefilter.diagnosis.result import Diagnosis as Diagnosis
    from edgefilter.diagnosis.result import Finding as Finding
    from edgefilter.diagnosis.result import Interval as Interval
    from edgefilter.echo.effect import Effect as Effect
    from edgefilter.echo.effect import Parameter as Parameter
    from edgefilter.echo.measurement import Measurement as Measurement
    from edgefilter.echo.model import EchoModel as EchoModel
    from edgefilter.echo.user_effects import load_effect as load_effect
    from edgefilter.engines import ENGINES as ENGINES
    from edgefilter.errors import AudioFileError as AudioFileError
    from edgefilter.errors import CalibrationError as CalibrationError
    from edgefilter.errors import DeviceError as DeviceError
    from edgefilter.errors import EdgefilterError as EdgefilterError
    from edgefilter.errors import ModelError as ModelError
    from edgefilter.errors import ProfileError as ProfileError
    from edgefilter.errors import SignalError as SignalError
    from edgefilter.errors import StftError as StftError
    from edgefilter.errors import UsageError as UsageError
    from edgefilter.filter.barge_in import BargeInSettings as BargeInSettings
    from edgefilter.filter.ego_filter import EgoFilter as EgoFilter
    from edgefilter.filter.ego_filter import enhance as enhance
    from edgefilter.integrations.echo_canceller import EchoCanceller as EchoCanceller
    from edgefilter.learning.background import BackgroundLearner as BackgroundLearner
    from edgefilter.learning.path_learner import PathLearner as PathLearner
    from edgefilter.profile.approximation import LinearApproximation as LinearApproximation
    from edgefilter.profile.data import Profile as Profile
    from edgefilter.types import SAMPLE_RATE as SAMPLE_RATE
    from edgefilter.types import Event as Event
    from edgefilter.types import Stats as Stats

__version__ = "0.1.0"

_HOMES = {
    "calibration.calibrate": ("calibrate",),
    "calibration.from_recording": ("self_calibrate",),
    "calibration.multisine": ("calibrate_multisine", "generate_multisine"),
    "calibration.sweep": ("generate_sweep",),
    "diagnosis.compare": ("Comparison", "compare"),
    "diagnosis.diagnose": ("add", "diagnose"),
    "diagnosis.proof": ("Proof", "prove"),
    "diagnosis.proven": ("diagnose_proven",),
    "diagnosis.result": ("Diagnosis", "Finding", "Interval"),
    "echo.effect": ("Effect", "Parameter"),
    "echo.measurement": ("Measurement",),
    "echo.model": ("EchoModel",),
    "echo.user_effects": ("load_effect",),
    "engines": ("ENGINES",),
    "errors": (
        "AudioFileError",
        "CalibrationError",
        "DeviceError",
        "EdgefilterError",
        "ModelError",
        "ProfileError",
        "SignalError",
        "StftError",
        "UsageError",
    ),
    "filter.barge_in": ("BargeInSettings",),
    "filter.ego_filter": ("EgoFilter", "enhance"),
    "integrations.echo_canceller": ("EchoCanceller",),
    "learning.background": ("BackgroundLearner",),
    "learning.path_learner": ("PathLearner",),
    "profile.approximation": ("LinearApproximation",),
    "profile.data": ("Profile",),
    "types": ("SAMPLE_RATE", "Event", "Stats"),
}
"""Where each public name is defined."""
_HOME = {name: home for home, names in _HOMES.items() for name in names}
__all__ = [*sorted(_HOME), "__version__"]  # noqa: PLE0604 - all of them are texts


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'edgefilter' has no attribute '{name}'")
    value = getattr(importlib.import_module(f"edgefilter.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
