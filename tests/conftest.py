"""Which tests share a process where several run at once (pytest -n 2 --dist loadgroup)."""

from pathlib import Path

import pytest

LIVE = Path(__file__).parent / "live"


def pytest_collection_modifyitems(items):
    """A file stays together, so that its fixtures are made once; all that play sound come one after the other."""
    for item in items:
        group = "live" if item.path.is_relative_to(LIVE) else str(item.path)
        item.add_marker(pytest.mark.xdist_group(group))
