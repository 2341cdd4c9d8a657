"""`cosfly view`: one self-contained page of a release or run, for a browser without a network.

The page holds its data as JSON; its one script (`viewer.js`) writes every foreign text as text, never as markup, and
the page's policy lets no other script run.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cosfly.escaping import for_terminal
from cosfly.look.page import page, scripts
from cosfly.reading.files import read_text
from cosfly.work.store import write_bytes
from release.viewer.content import ViewerConfig, ViewerPage
from release.viewer.of_release import show_release
from release.viewer.of_run import show_run

PICTURES = "pictures"


def run(folder: Path, out: Path, cfg: ViewerConfig, captions: Path | None = None) -> Path:
    """Reads a release (or the folder round it), a run folder or a playback tree; writes one page and gives its path.

    Args:
        captions: `captions.jsonl` of a playback tree; a run has its own.
    Raises:
        InputError: the folder is none of these, or something in it cannot be read.
    """
    dataset = next((place for place in (folder, folder / "dataset") if (place / "release.json").exists()), None)
    shown = show_run(folder, cfg, captions) if dataset is None else show_release(dataset, cfg)
    write_bytes(out, page_html(shown).encode())
    return out


def page_html(shown: ViewerPage) -> str:
    """Give the page's text."""
    style, script = (read_text(Path(__file__).with_name(name)) for name in ("viewer.css", "viewer.js"))
    script = scripts("tools.js", "canvas.js") + script
    data = _printable(shown.model_dump(mode="json", exclude_defaults=False))
    return page(
        "release/viewer/viewer.html", title=shown.title, style=style, script=script, notes=shown.notes, data=data
    )


def _printable(value: Any) -> Any:
    """Give a value whose texts are cut and free of control characters; pictures, which are ours, stay."""
    if isinstance(value, str):
        return for_terminal(value)
    if isinstance(value, list):
        return [_printable(one) for one in value]
    if isinstance(value, dict):
        return {_printable(key): one if key == PICTURES else _printable(one) for key, one in value.items()}
    return value
