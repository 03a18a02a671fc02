"""Every registered effect does what every effect must do."""

import pytest

from edgefilter.echo import effect as effects
from tests.conformance import EFFECT_CHECKS


@pytest.mark.parametrize("check", EFFECT_CHECKS, ids=lambda check: check.__name__.removeprefix("effect_check_"))
@pytest.mark.parametrize("name", effects.names())
def test_conformance(name, check):
    check(name)
