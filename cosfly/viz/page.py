"""Self-contained HTML pages from templates with a common base page and style, and Markdown pages.

Texts that a template prints are cut and escaped, except the markup of templates, style and script.
"""

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

ROOT = Path(cosfly.__file__).parents[1]  # the parent of cosfly, caption, distill and release


def page(template: str, *, title: str, style: str = "", script: str = "", asks: bool = False, **values: Any) -> str:
    """Return a page.

    Args:
        template: Path relative to the folder of the packages. style, script: Added to those of the base page. asks: The
            page may send requests to its server.
    """
    style = scripts("page.css") + style
    return _environment().get_template(template).render(
        title=title, style=Markup(style), script=Markup(script), policy=Markup(_policy(script, asks)), **values
    )  # fmt: skip


def scripts(*names: str) -> str:
    """Return shared files of templates, joined: `tools.js`, `canvas.js` (a map), `space.js` (WebGL)."""
    return "".join(read_text(Path(__file__).with_name("templates") / name) for name in names)


def markdown(template: str, **values: Any) -> str:
    """Return a page of Markdown from a template, by its path relative to the folder of the packages."""
    return _environment(is_markdown=True).get_template(template).render(**values)


def run_name(folder: Path) -> str:
    """Return the name of the run that a stage's folder belongs to, or of the folder itself."""
    folder = folder.resolve()
    return folder.parent.name if (folder.parent / "run.yaml").is_file() else folder.name


def _policy(script: str, asks: bool) -> str:
    """Return a content policy that allows only the page's own script, by its hash: no other script, request or form."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    allowed = f"script-src 'sha256-{digest}'; " if script else ""
    if asks:
        allowed += "connect-src 'self'; "
    return f"default-src 'none'; {allowed}img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"


@lru_cache(maxsize=2)
def _environment(is_markdown: bool = False) -> Environment:
    environment = Environment(
        autoescape=not is_markdown, undefined=StrictUndefined, finalize=_in_markdown if is_markdown else _printed,
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=is_markdown,
        loader=FunctionLoader(lambda name: read_text(ROOT / name)),
    )  # fmt: skip
    environment.filters["thousands"] = "{:,}".format
    environment.filters["share"] = lambda count, total: f"{100.0 * count / total:.1f} %" if total else "-"
    if is_markdown:
        environment.filters |= {
            "code": lambda text: Markup(markdown_code(text)),
            "codes": lambda names: Markup(", ".join(map(markdown_code, names))),
            "safe": Markup,
        }
    else:
        environment.filters["words"] = lambda name: str(name).replace("_", " ")
        environment.policies["json.dumps_function"] = lambda value, **_: dump_json(value)
    return environment


def _printed(value: Any) -> Any:
    """Cut texts and remove control characters before they are escaped; None is a dash."""
    if isinstance(value, str) and not isinstance(value, Markup):
        return for_terminal(value)
    return "–" if value is None else value


def _in_markdown(value: Any) -> Any:
    """Escape texts, unless they are Markup; keep a space at either end."""
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    return " " * value.startswith(" ") + for_markdown(value) + " " * (value.endswith(" ") and len(value) > 1)
