"""Commands in this process, as a user types them."""

from click.testing import Result
from typer.testing import CliRunner

from cosfly.cli import app


def invoke(*words: object) -> Result:
    """Run a command: texts are split at blanks, the words of a list stay as they are."""
    line: list[str] = []
    for word in words:
        line += word.split() if isinstance(word, str) else map(str, word if isinstance(word, list) else [word])
    return CliRunner().invoke(app, line)
