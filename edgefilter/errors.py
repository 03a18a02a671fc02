"""The error tree. Each message says what is wrong, what was found, what was expected and what to do, in one line."""

from __future__ import annotations


def printable(text: object, most: int | None = None) -> str:
    r"""Make text from outside (a file, a client, a library) safe to print: one line, without codes that control a terminal.

    White space becomes single blanks, other control characters are escaped. most: characters that are kept.

    >>> printable("\x1b[2J\n a name", 12)
    '\\x1b[2J a na'
    """
    line = " ".join(str(text).split())
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)[:most]


class EdgefilterError(Exception):
    """Base of every error that this package raises on purpose; as text one line, whatever names and values it quotes.

    The command line turns it into one line and exit code 1.
    """

    def __str__(self) -> str:
        return printable(super().__str__())


class UsageError(EdgefilterError):
    """The request itself cannot be met (an unknown engine or device, options that exclude each other); exit code 2."""


class AudioFileError(EdgefilterError):
    """An audio file cannot be read or written, or what it holds is not usable audio."""


class DeviceError(EdgefilterError):
    """A sound device or the audio system failed or vanished."""


class ProfileError(EdgefilterError):
    """A profile file is damaged, of another version, or holds values that no robot has."""


class CalibrationError(EdgefilterError):
    """The calibration recordings do not allow a measurement."""


class StftError(EdgefilterError):
    """A window, hop and FFT size that cannot be inverted."""


class SignalError(EdgefilterError):
    """Samples handed to the library have the wrong shape, type or are not finite."""


class ModelError(EdgefilterError):
    """A network's model file is missing, damaged or not the one that the engine needs, or what runs it is broken."""
