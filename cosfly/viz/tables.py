"""A table of text, for the terminal and for a page of Markdown."""

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class TextTable:
    """A table of text; the first column is words, the others are numbers."""

    title: str
    columns: list[str]
    rows: list[list[str]]

    def markdown(self) -> str:
        """Return the table in Markdown, without its title."""
        lines = [self.columns, ["---", *["---:"] * (len(self.columns) - 1)], *self.rows]
        return "".join(f"| {' | '.join(line)} |\n" for line in lines).replace("*", "\\*")


def cells(values: Iterable[float | None], digits: int = 3) -> list[str]:
    """Return numbers as text, "-" for None."""
    return ["-" if value is None else f"{value:.{digits}f}" for value in values]
