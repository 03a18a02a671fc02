"""Benchmarks: scenarios x systems x metrics, behind ``python -m bench SCENARIO``.

A scenario is a module (or a package) with a docstring for ``--help`` and two functions::

    def add_arguments(parser):                    # its own options; the common ones are in bench/__main__.py:
        parser.add_argument("recordings", type=Path)  # output, every, limit, seed, jobs, scheduler, cache, whisper

    def run(options) -> str:                      # returns the page; raises EdgefilterError for what a user can mend
        made_with = provenance.stamp({"RECORDINGS": [options.recordings]}, systems=["crnn"], models={"WHISPER": options.whisper})
        rows = [...]                              # figures, one dict each
        tables = [results.table("headline", "What it says", ["system", ("SI-SDR, dB", 1)], [["crnn", mean(rows, "si_sdr")]])]
        plots = [results.plot("curve", [results.panel("ERLE", "s", "dB", {"crnn": (x, y)})])]
        return results.write(options.output, "NAME", "Title", made_with, tables, plots, rows=rows)

Pages and pictures are made from the JSON file by bench/results.py. A scenario of several programs gives each a NAME of
its own: all of them stand in the one file of --output, and a program that runs again replaces its own part only.
"""
