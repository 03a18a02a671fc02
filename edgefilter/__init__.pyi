"""The public names and where each is defined: read by type checkers, and by __init__.py when the program runs."""

from .calibration.calibrate import calibrate as calibrate
from .calibration.from_recording import self_calibrate as self_calibrate
from .calibration.multisine import calibrate_multisine as calibrate_multisine
from .calibration.multisine import generate_multisine as generate_multisine
from .calibration.sweep import generate_sweep as generate_sweep
from .diagnosis.compare import Comparison as Comparison
from .diagnosis.proof import Proof as Proof
from .diagnosis.recording import Added as Added
from .diagnosis.recording import Recording as Recording
from .diagnosis.recording import add as add
from .diagnosis.recording import compare as compare
from .diagnosis.recording import diagnose as diagnose
from .diagnosis.recording import prove as prove
from .diagnosis.result import Diagnosis as Diagnosis
from .diagnosis.result import Finding as Finding
from .diagnosis.result import Interval as Interval
from .echo.effect import Effect as Effect
from .echo.effect import Parameter as Parameter
from .echo.measurement import Measurement as Measurement
from .echo.model import EchoModel as EchoModel
from .echo.user_effects import load_effect as load_effect
from .engines import ENGINES as ENGINES
from .errors import AudioFileError as AudioFileError
from .errors import CalibrationError as CalibrationError
from .errors import DeviceError as DeviceError
from .errors import EdgefilterError as EdgefilterError
from .errors import ModelError as ModelError
from .errors import ProfileError as ProfileError
from .errors import SignalError as SignalError
from .errors import StftError as StftError
from .errors import UsageError as UsageError
from .filter.barge_in import BargeInSettings as BargeInSettings
from .filter.ego_filter import EgoFilter as EgoFilter
from .filter.ego_filter import enhance as enhance
from .integrations.duplex import Duplex as Duplex
from .integrations.echo_canceller import EchoCanceller as EchoCanceller
from .learning.background import BackgroundLearner as BackgroundLearner
from .learning.path_learner import PathLearner as PathLearner
from .profile.approximation import LinearApproximation as LinearApproximation
from .profile.data import Profile as Profile
from .types import SAMPLE_RATE as SAMPLE_RATE
from .types import Event as Event
from .types import Stats as Stats

__version__: str
