"""Hear the human while the robot talks: removal of a robot's own voice and fan from its microphone, in real time.

Everything public can be had from here (docs/api.md). Names are loaded when they are first asked for, so that `import
edgefilter` costs nothing and a program pays for what it uses.

>>> import numpy as np
>>> from edgefilter import enhance
>>> silence = np.zeros(1000, np.float32)
>>> enhance(silence, silence, engine="linear").shape
(1000,)
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
