"""Write the tables of README.md, docs/index.md and bench/README.md anew from bench/results.

A page quotes a table between two comments, ``<!-- table: devices/headline -->`` and ``<!-- end -->``: of the file
devices.json the table named headline.
"""

from __future__ import annotations

import argparse

from bench import results


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """None of its own."""


def run(options: argparse.Namespace) -> str:
    changed = []
    for page in results.PAGES:
        old = page.read_text(encoding="utf-8")
        if (new := results.quote(old)) != old:
            page.write_text(new, encoding="utf-8")
            changed.append(page.relative_to(results.ROOT).as_posix())
    return f"written: {', '.join(changed)}" if changed else "all tables are up to date"
