"""The effect of one's own that the documentation writes."""

import re
from pathlib import Path

DOCUMENT = Path(__file__).parents[2] / "docs/own_effect.md"


def documented_file(folder: Path) -> Path:
    """The example of the documentation, as a file of the name that it says."""
    (code,) = re.findall(r"```python\n(\"\"\"blade_chop.py.*?)```", DOCUMENT.read_text(), re.S)
    (folder / "blade_chop.py").write_text(code)
    return folder / "blade_chop.py"
