# SPDX-License-Identifier: GPL-3.0-or-later
"""Pages whose tables come from a run: what lies between a pair of marks is replaced."""
from __future__ import annotations

import re
from pathlib import Path


def fill(path: Path, texts: dict[str, str]) -> None:
    """Put each text between `<!-- its name -->` and `<!-- end -->`. ValueError where a page has no such place."""
    page = path.read_text(encoding="utf-8")
    for name, text in texts.items():
        place = re.compile(rf"(<!-- {re.escape(name)} -->\n).*?(<!-- end -->)", re.DOTALL)
        page, count = place.subn(lambda found, text=text: f"{found[1]}{text}\n{found[2]}", page)
        if count != 1:
            raise ValueError(f"'{path}' has {count} places for '{name}'")
    path.write_text(page, encoding="utf-8")
