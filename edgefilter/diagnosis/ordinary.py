"""By chance: in how many ordinary recordings, of which nothing is missing, some effect explains as much.

No robot is exactly as it was calibrated: its path has moved a little, its fan is yesterday's, its loudspeaker distorts
faintly. So an effect is held against what it explains in recordings with such tolerances and nothing else, which
`python -m bench diagnosis ordinary --learn` has measured (ordinary.json).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from math import log10, prod
from typing import NamedTuple

from scipy.special import ndtr

LEAST_DB = -80.0
"""Down to so much it is told what an effect explains: a likelihood of some thousand cells is not known better."""


class Chance(NamedTuple):
    """What an effect explains in ordinary recordings; share: of these, the ones in which its fit helps at all.

    The upper quarter of explained_db() there is that of a normal distribution with this mean and standard deviation, dB.
    """

    share: float
    middle_db: float
    spread_db: float

    def of(self, explained: float) -> float:
        """Share of ordinary recordings in which the effect explains more than that."""
        return self.share * float(ndtr((self.middle_db - explained) / self.spread_db))


def explained_db(gain_db: float) -> float:
    """Power that a fall of the held-out level by gain_db takes away, over what is left, dB; LEAST_DB where none does."""
    return 10.0 * log10(max(10.0 ** (gain_db / 10.0) - 1.0, 10.0 ** (LEAST_DB / 10.0)))


@dataclass(frozen=True)
class Ordinary:
    """What ordinary recordings show by chance, by effect; independent: the part of their number that counts as such."""

    effects: Mapping[str, Chance]
    independent: float = 1.0

    def p_value(self, name: str, gain_db: float) -> float:
        """Share of recordings with no missing effect in which the fit of any effect surprises as much as this one, which lowers the error by gain_db.

        By Sidak's rule (1967) for independent effects: the p-value of each is uniform from 0 to the share of recordings in which
        its fit helps at all. Since they are not independent, fewer effects are counted than there are.
        """
        own = self.of(name, gain_db)
        others = prod(1.0 - min(own, chance.share) for chance in self.effects.values())
        return own if own == 1.0 else 1.0 - others**self.independent

    def of(self, name: str, gain_db: float) -> float:
        """Share of ordinary recordings in which that effect does so; of one of the user's own, that which explains most by chance."""
        explained, known = explained_db(gain_db), self.effects
        chances = (known[name],) if name in known else known.values()
        return 1.0 if explained <= LEAST_DB else max(chance.of(explained) for chance in chances)


def p_value(name: str, gain_db: float) -> float:
    """`Ordinary.p_value` by the table that comes with the package."""
    return _table().p_value(name, gain_db)


def own_p_value(name: str, gain_db: float) -> float:
    """`Ordinary.of` by the table that comes with the package: of one effect that was not chosen from many."""
    return _table().of(name, gain_db)


def percent(p: float) -> str:
    """A p-value as people read it: 'less than 0.01 %', '0.3 %'."""
    if p < 1e-4:
        return "less than 0.01 %"
    return f"{100 * p:.0f} %" if p > 0.1 else f"{100 * p:.2g} %"


@cache
def _table() -> Ordinary:
    table = json.loads(files("edgefilter.diagnosis").joinpath("ordinary.json").read_text(encoding="utf-8"))
    return Ordinary({name: Chance(**of) for name, of in table["effects"].items()}, table["independent"])
