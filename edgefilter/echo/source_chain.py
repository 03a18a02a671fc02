"""The reference, hop by hop, as the loudspeaker's linear part gets it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from edgefilter.echo.effects.catalogue import chain
from edgefilter.echo.measurement import Values
from edgefilter.types import SAMPLE_RATE, Samples


class SourceChain:
    """Applies the source effects of a model to successive blocks.

    Those with a memory also see what came before a block.

    effects: (name, values). Left out is what needs more of the past than a filter can look back at every hop, as a
    compressor with its release does, and what acts behind the path.
    """

    def __init__(self, effects: Sequence[tuple[str, Values]] = ()) -> None:
        self._chain = [
            (effect, values)
            for effect, values in chain(effects)
            if effect.stage == "source" and effect.memory is not None
        ]
        self._memory = sum(effect.memory or 0 for effect, _ in self._chain)
        self._past = np.zeros(self._memory, np.float32)

    def __call__(self, block: Samples) -> Samples:
        """Block (n,) after the effects, (n,); it follows the last one."""
        if not self._chain:
            return block
        x = np.concatenate((self._past, block)) if self._memory else block
        self._past = x[x.size - self._memory :]
        for effect, values in self._chain:
            x = effect.apply(x, values, SAMPLE_RATE)
        return x[self._memory :]

    def rewritten(self, history: Samples, hop: int) -> Samples:
        """History (n,) after the effects, (n,), when the past is another than it was.

        Its last hop will come again as a block.
        """
        self._past = np.zeros(self._memory, np.float32)
        driven = self(history)
        before = np.concatenate((np.zeros(self._memory, np.float32), history[: history.size - hop]))
        self._past = before[before.size - self._memory :]
        return driven
