"""The command line in this process: one of its own takes half a second to begin."""

import io
import subprocess
from contextlib import redirect_stderr, redirect_stdout

from edgefilter.cli import main


def here(*words):
    """What subprocess.run would give."""
    out, error = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(error):
        code = main([str(word) for word in words])
    return subprocess.CompletedProcess(words, code, out.getvalue(), error.getvalue())
