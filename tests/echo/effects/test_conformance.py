"""Every registered effect does what every effect must do."""

import pytest

from edgefilter.echo.effects import catalogue
from tests.conformance import EFFECT_CHECKS


@pytest.mark.slow
@pytest.mark.parametrize("check", EFFECT_CHECKS, ids=lambda check: check.__name__.removeprefix("effect_check_"))
@pytest.mark.parametrize("name", catalogue.names())
def test_conformance(name, check):
    check(name)
