"""Values that people type after an option, checked, and the options that many commands share."""

from __future__ import annotations

import argparse


def effects_option(command: argparse.ArgumentParser) -> None:
    """--effects, of every command that reads a profile."""
    command.add_argument(
        "--effects",
        action="append",
        default=[],
        metavar="FILE.py",
        help="an effect of your own (see docs/own_effect.md); repeatable",
    )


def command(text: str) -> str:
    """Words for a shell, not none."""
    if not text.strip():
        raise argparse.ArgumentTypeError(f"'{text}' is not a command")
    return text


def positive(text: str) -> float:
    """A number above 0."""
    return number(text, 0.0, 1e6, "a number above 0")


def level(text: str) -> float:
    """Of a peak: at most full scale, and above what 16 bit can hold."""
    return number(text, -90.0, 0.0, "a level from -90 to 0 dB of full scale", closed=True)


def number(text: str, low: float, high: float, expected: str, closed: bool = False) -> float:
    """A number between low and high, closed: or one of them; else an error that says what was expected."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not (low <= value <= high if closed else low < value < high):
        raise argparse.ArgumentTypeError(f"'{text}' is not {expected}")
    return value
