"""edgefilter: hear the human while the robot talks."""

__version__ = "0.1.0"
