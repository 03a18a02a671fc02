"""Every registered effect does what every effect must do."""

import pytest
from conformance import EFFECT_CHECKS

from edgefilter.echo import effect as effects


@pytest.mark.parametrize("check", EFFECT_CHECKS, ids=lambda check: check.__name__.removeprefix("effect_check_"))
@pytest.mark.parametrize("name", effects.names())
def test_conformance(name, check):
    check(name)
