"""Options that several commands share, as arguments of `add_argument`, and what reads the numbers in them."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import Any, TypeAlias

from edgefilter.audio.channels import Channels
from edgefilter.engines import ENGINES
from edgefilter.filter.barge_in import USUAL_S, BargeInSettings

Option: TypeAlias = dict[str, Any]


def whole(least: int, most: int, expected: str) -> Callable[[str], int]:
    """A function that reads a whole number from least to most, else raises an error that says what was expected."""

    def read(text: str) -> int:
        if not text.strip().isdecimal() or not least <= int(text) <= most:
            raise argparse.ArgumentTypeError(f"'{text}' is not {expected}")
        return int(text)

    return read


def number(least: float, most: float, expected: str, closed: bool = False) -> Callable[[str], float]:
    """Argument type for a number between least and most; closed: the limits themselves are allowed too."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (least <= value <= most if closed else least < value < most):
            raise argparse.ArgumentTypeError(f"'{text}' is not {expected}")
        return value

    return read


positive = number(0.0, 1e6, "a number above 0")
_rate = number(0.0, 3600.0 / USUAL_S, f"a rate above 0 and below {3600.0 / USUAL_S:.0f} an hour")
channel = whole(0, 63, "the number of a channel, 0 to 63")
"""Of a device or a file, counted from 0: interfaces of studios have so many."""

ENGINE: Option = {
    "default": "auto",
    "metavar": "ENGINE",
    "help": f"auto, {', '.join(ENGINES)} (default: %(default)s); docs/cli.md says what each does",
}
MIC_CHANNELS: Option = {
    "type": Channels.parse,
    "metavar": "N,N,...|all",
    "help": "channels that are microphones, one to eight, from 0, or 'all' (docs/arrays.md); otherwise the mean is taken",
}
CONFIRM: Option = {
    "type": number(0.0, 10.0, "a time from 0 to 10 s", closed=True),
    "default": BargeInSettings.confirm_s,
    "metavar": "S",
    "help": "longest time, in seconds, from the suspicion that the human speaks to certainty; 0: the suspicion is enough (default: %(default)g)",
}
FALSE_STARTS: Option = {
    "dest": "threshold",
    "type": lambda text: BargeInSettings.at_rate(_rate(text)).threshold,
    "default": BargeInSettings.threshold,
    "metavar": "RATE",
    "help": "false starts in an hour of the robot's speech; the fewer, the more humans are missed (default: 16)",
}
ASK: Option = {
    "type": number(0.0, 40.0, "0 to 40 dB", closed=True),
    "default": BargeInSettings.ask_db,
    "metavar": "DB",
    "help": "lower the robot's voice by so much while the human may have begun to speak, to hear who it was (default: %(default)g)",
}
