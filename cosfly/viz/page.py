"""HTML pages: templates of the rooms that write them, all on one base page with one style; they stand alone, without a
network.

Every text that a template prints is cut and escaped (autoescape); only markup of templates themselves, the style and
the script are not.
"""

from __future__ import annotations

import base64
import hashlib
from functools import lru_cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup

import cosfly
from cosfly.runtime.escaping import for_markdown, for_terminal, markdown_code
from cosfly.runtime.io import read_text
from cosfly.runtime.json_io import dump_json

ROOT = Path(cosfly.__file__).parents[1]  # cosfly, caption, distill and release stand side by side


def page(template: str, *, title: str, style: str = "", script: str = "", asks: bool = False, **values: Any) -> str:
    """Return a page.

    Args:
        template: its path from the folder of the packages. title: the name of what it shows. style, script: our own,
            beside the base page's. asks: it may ask the server that it came from.
    """
    style = scripts("page.css") + style
    return _environment().get_template(template).render(
        title=title, style=Markup(style), script=Markup(script), policy=Markup(_policy(script, asks)), **values
    )  # fmt: skip


def scripts(*names: str) -> str:
    """Return what several pages share, one after the other: `tools.js`, `canvas.js` (a map), `space.js` (WebGL)."""
    return "".join(read_text(Path(__file__).with_name("templates") / name) for name in names)


def fragment(template: str, **values: Any) -> str:
    """Return a part of a page, which another template prints as it is."""
    return Markup(_environment().get_template(template).render(**values))


def markdown(template: str, **values: Any) -> str:
    """Return a page of Markdown, of a template by its path from the folder of the packages."""
    return _markdown_environment().get_template(template).render(**values)


def run_name(folder: Path) -> str:
    """Return the name that a person knows a stage's folder by: the run's, where it stands in one."""
    folder = folder.resolve()
    return folder.parent.name if (folder.parent / "run.yaml").is_file() else folder.name


def _policy(script: str, asks: bool) -> str:
    """Let a page show itself and run the one script of ours, named by its hash: no other script, request or form, even
    where an escape fails."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    allowed = (f"script-src 'sha256-{digest}'; " if script else "") + ("connect-src 'self'; " if asks else "")
    return f"default-src 'none'; {allowed}img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"


@lru_cache(maxsize=1)
def _environment() -> Environment:
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, finalize=_printed, trim_blocks=True, lstrip_blocks=True,
        loader=FunctionLoader(lambda name: read_text(ROOT / name)),
    )  # fmt: skip
    environment.filters["words"] = lambda name: str(name).replace("_", " ")
    environment.filters["thousands"] = "{:,}".format
    environment.policies["json.dumps_function"] = lambda value, **_: dump_json(value)
    return environment


def _printed(value: Any) -> Any:
    """Cut texts and take control characters out before they are escaped; an unknown value is a dash."""
    if isinstance(value, str) and not isinstance(value, Markup):
        return for_terminal(value)
    return "–" if value is None else value


@lru_cache(maxsize=1)
def _markdown_environment() -> Environment:
    environment = Environment(
        undefined=StrictUndefined, finalize=_in_markdown, trim_blocks=True, lstrip_blocks=True,
        keep_trailing_newline=True, loader=FunctionLoader(lambda name: read_text(ROOT / name)),
    )  # fmt: skip
    environment.filters |= {
        "code": lambda text: Markup(markdown_code(text)),
        "codes": lambda names: Markup(", ".join(map(markdown_code, names))),
        "thousands": "{:,}".format,
        "g": "{:g}".format,
        "share": lambda count, total: f"{100.0 * count / total:.1f} %" if total else "-",
        "safe": Markup,
    }
    return environment


def _in_markdown(value: Any) -> Any:
    """Escape texts, unless they are marked as ours; a space at an end stays."""
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    return " " * value.startswith(" ") + for_markdown(value) + " " * (value.endswith(" ") and len(value) > 1)
