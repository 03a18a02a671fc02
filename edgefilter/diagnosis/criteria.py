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

    # Forward: which effect is the next
    nested: float = 0.85
    """A simpler effect of the same family that explains this share of what the family's best one does is preferred: the
    richer model fits its noise as well."""
    same_db: float = 0.05
    """Two families that explain the same but for so much, or for same_share of it, are as good: the simpler is named. Where
    a simple effect leaves no more, no richer one is tried. Chosen on programs of SoX and swh: volume against compression."""
    same_share: float = 0.04
    """See same_db."""
    thorough: bool = False
    """Whether richer effects are tried also where a simple one leaves nothing."""
    long_filter: int = 4
    """Complexity of long filters: half a minute does not teach all their taps, so what they leave of the samples fitted
    to says little."""
    power_share: float = 0.6
    """Of the power over the fan, what an effect may leave at most that takes about half of it away; a narrow ring does,
    in few cells."""
    last_resort_share: float = 0.4
    """A last resort is tried where no other effect explains this share of the level above the silences: its fit is long
    and its noise flexible."""
    last_resort_db: float = 0.1
    """And where that level is no less: in less there are no knocks to be found."""
    second_share: float = 0.2
    """Of the excess level that is left, a further effect has to explain at least this share: less is how the first
    one's model errs."""
    most_effects: int = 3
    """A bound on the work: what the search is checked on holds two at once, and a third to be taken back."""
    voice_db: float = -6.0
    """Over the fan: where a model predicts less of a voice, no effect on it shows."""
    starts: int = 2
    """Further effects to begin with where the best one has not led to an explanation: of two at once the louder may
    hide the other."""
    start_share: float = 0.1
    """Of the level, what each of those must explain by itself, and no less than start_db."""
    start_db: float = 0.1
    """Less is not worth a search of its own."""
    half_share: float = 0.3
    """Of the level that one long filter explains, what a simple effect must explain to be taken for half of it."""
    nearly: float = 0.85
    """Share of the level that is explained where no other start is tried."""
    little_db: float = 2.0
    """Over the silences, and with no more than little_share of the power over the fan, neither: the model of the right
    effect leaves as much, and another start costs seconds. Nor is a last resort tried then."""
    little_share: float = 0.1
    """See little_db."""
    better: float = 0.05
    """Of the level explained, what another start must explain more to be preferred: less is chance, and it is the less
    simple."""

    # Refit: all effects beside each other
    rounds: int = 3
    """A bound on the work; fitting in turn ends earlier where the level no longer falls by worth_db."""
    worth_db: float = 0.02
    """Fall in level below which another round changes nothing that can be seen."""

    # Backward: what the later effects have made superfluous
    exchange_share: float = 0.85
    """Of what an effect explains beside the others, what its simpler exchange must explain: as nested."""
    simple: int = 1
    """Complexity up to which an effect is simple beside any flexible one."""
    passband_db: float = 0.4
    """A gain in a filter's passband that is more than an ordinary tolerance and the fit's error, and so a turned
    volume."""
    confirmed_share: float = 0.1
    """Of the level that a flexible effect leaves, what a simpler one beside it must explain, and no less than
    confirmed_db."""
    confirmed_db: float = 0.05
    """As the least that any effect must explain."""

    # Where a search ends
    silent_db: float = 0.2
    """Where the residual is no more than this above that of the robot's silences, nothing of the voice is in it, and
    none is begun."""
    heard_db: float = 0.6
    """Where it is no more than this above them, there is nothing beside the effects that were found, whose models err a
    little."""
    fan_db: float = 0.2
    """Nor where it is no more than this above the calibrated fan."""
    most_cost: int = 480
    """Sum of the costs of all fits, two minutes, after which no further one is made. Where that happens the diagnosis
    says so."""

    # The verdict
    false_rate: float = 0.01
    """Share of names that may be there by chance (significance.py)."""
    explained_db: float = 0.8
    """Excess up to which nothing is missing: what the fan of another day and a faint distortion leave."""
    explained_share: float = 0.45
    """Less of the excess level than this explained by all findings together is not what happened."""
    still_there: float = 0.6
    """Of the excess in dB, more than this left is not explained either."""
    part_share: float = 0.5
    """Share of the excess power that findings must explain to be named beside what none explains."""
    part_level: float = 0.3
    """And share of its level: power alone may be that of one loud passage."""
    noise_left: float = 0.4
    """Of the excess in dB, what noise that follows the voice may leave: how it follows is known to a decibel or two."""
    much_db: float = 3.0
    """Over the silences: what the model of an effect that is really there does not leave."""
    nearly_all: float = 0.99
    """Share of the excess power with which what is left may be the imprecision of the model itself."""

    # The fan
    fan_change_db: float = 1.0
    """By less than this a fan differs from day to day."""
    fan_steady_db: float = 1.5
    """Whitened by its own spectrum, the loud and the quiet tenth of a second of a fan differ by less, a talker's by
    much more."""
    fan_sparse_db: float = 0.7
    """And its mean is no more than this above its median; that of something that slams now and then is."""
    fan_coloured_db: float = 0.7
    """A gain behind the microphone changes the fan by less than this from frequency to frequency,"""
    fan_flat_db: float = 2.0
    """and by less than this over all while it is steady: what is neither may be a gain as well, and waits until the
    voice is explained."""

    # A band limit that shows in the power alone
    edge_gone: float = 0.25
    """Of the predicted power above an edge no more than this part is there."""
    edge_sure: float = 4.0
    """And what is missing is so many standard deviations: by chance at one edge in thirty thousand."""
    edge_passed: tuple[float, float] = (0.8, 1.2)
    """Between these times the predicted power is what lies well below the edge: the band is cut, not the volume
    turned."""
