"""edgefilter: hear the human while the robot talks.

EgoFilter goes in front of a recogniser, enhance() filters whole arrays, Profile is the calibrated robot.
"""

from edgefilter.filter.ego_filter import EgoFilter, enhance
from edgefilter.profile.data import Profile
from edgefilter.types import Event

__version__ = "0.1.0"
__all__ = ["EgoFilter", "Event", "Profile", "enhance"]
