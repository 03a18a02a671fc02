"""Recordings that the benchmark's tests have too."""

from tests.bench.conftest import clips, live  # noqa: F401
