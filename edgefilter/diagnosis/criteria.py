"""Every threshold of the selection in one place, each with its reason.

What one effect must show stands in its own file.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Criteria:
    """When an effect is named, when a search goes on, and what is said in the end.

    A level is Score.level_db, the mean of dB over all cells; excess is in power.
    """

    false_rate: float = 0.01
    """Of ordinary recordings, the share in which an effect may be named by chance (diagnosis/ordinary.py)."""

    # Shares of what there is to explain. With fifteen numbers, one for each question, 78 recordings of one or two hidden effects were named
    # no better than with four; with those four, 80 recordings of up to three effects no better than with these (training and validation voices)
    nearly: float = 0.85
    """A simpler effect that explains this share of what a flexible one explains is preferred, since a flexible one fits a part of any residual.
    An effect that explains the same share of everything may be the right one already: no richer one is tried."""
    half: float = 0.5
    """What all findings together explain at least of the excess, in level and in power: less is not what happened."""
    part: float = 0.2
    """What a further effect explains at least of what is left: less is how the first one's model errs. Where a waveform explains so
    much, noise is not tried yet: it fits whatever is left. And the share of the excess level that findings, besides half of its power,
    explain at least to be named beside what none explains: power alone may be that of one loud passage."""

    # Forward: which effect is the next
    most_effects: int = 3
    """Most effects that a search adds, a bound on its time: the recordings it was tested on have two, and it may add one that it drops again."""
    little_db: float = 2.0
    """Over the silences, and with next to nothing of the power over the fan, no last resort is tried: the model of the right
    effect leaves as much."""

    # Refit: all effects beside each other
    rounds: int = 3
    """A bound on the work; fitting in turn ends earlier where the level no longer falls by worth_db."""
    worth_db: float = 0.02
    """Fall in level below which another round changes nothing that can be seen."""

    # Where a search ends
    silent_db: float = 0.2
    """Where the residual is no more than this above that of the robot's silences, nothing of the voice is in it, and
    none is begun."""
    heard_db: float = 0.6
    """Where it is no more than this above them, there is nothing beside the effects that were found, whose models err a
    little."""
    most_fits: int = 80
    """A bound on the work: after four times the whole catalogue no further fit is made. Where that happens the diagnosis says so."""

    # The verdict
    explained_db: float = 0.8
    """Residual over what the profile expects, dB, up to which nothing is missing: the fan of another day and a faint distortion leave as much."""
    much_db: float = 3.0
    """Over the silences: what the model of an effect that is really there does not leave."""
    nearly_all: float = 0.99
    """Share of the excess power with which what is left may be the imprecision of the model itself."""
