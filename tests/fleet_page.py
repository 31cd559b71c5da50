"""The example of docs/fleet.md, file by file, as tests run it."""

from __future__ import annotations

import re
from pathlib import Path

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "fleet.md").read_text(encoding="utf-8")
SECTION = PAGE.partition("## An example")[2].partition("\n## ")[0]
#: Text of each file by its name.
EXAMPLE: dict[str, str] = dict(
    re.findall(r"`([\w-]+\.\w+)`[^`\n]*:\n\n```\w+\n(.*?)^```$", SECTION, re.MULTILINE | re.DOTALL)
)
#: The command, and what it prints.
COMMAND: str = re.findall(r"^```sh\n(.*)\n```$", SECTION, re.MULTILINE)[-1]
PRINTED: str = re.findall(r"^```text\n(.*?)^```$", SECTION, re.MULTILINE | re.DOTALL)[-1]


def write_example(folder: Path) -> None:
    """Write the example's files into a folder."""
    for name, text in EXAMPLE.items():
        (folder / name).write_text(text, encoding="utf-8")
