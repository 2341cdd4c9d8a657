"""A caption's text cut into its sentences: what the states of `captions.jsonl` and of a release are counted along."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import lru_cache

from cosfly.formats.captions import Coc

# A point after these ends no sentence, nor does one inside a number.
_ABBREVIATIONS = ("approx", "ca", "vs", "deg", "i\\.e", "e\\.g", "resp", "max", "min", "avg", "horiz")
_POINT = r"(?<=\.)(?=\s|$)" + "".join(rf"(?<!\b(?i:{word})\.)" for word in _ABBREVIATIONS)
# Begins with one class of characters, for which the engine looks by itself: twice as fast as with alternatives.
_MARKS = ".。！？!?\n"
END = re.compile(rf"[{_MARKS}](?:(?<=[。！？!?])[。！？!?]*|(?<=\n)|{_POINT})\s*")


def sentences_of(coc: Coc) -> Iterator[tuple[str, str]]:
    """Yield (name, text) of the sentences of both texts of an answer, in order."""
    for letter, text in (("C", coc.critical_components), ("R", coc.reasoning_trace)):
        for number, part in enumerate(cut_sentences(text), 1):
            yield f"{letter}{number}", part.strip()


@lru_cache(maxsize=256)  # an English text is cut again when its mirror is held against it
def cut_sentences(text: str) -> tuple[str, ...]:
    """Cut a text at the ends of its sentences; together the pieces are the text."""
    pieces: list[str] = []
    start = 0
    for end in [*[match.end() for match in END.finditer(text)], len(text)]:
        piece = text[start:end]
        if piece and not piece.isspace():
            pieces.append(piece)
        elif pieces:
            pieces[-1] += piece
        start = end
    return tuple(pieces)
