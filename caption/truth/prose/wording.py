"""Whether a clause is worded as captions are that were read rightly; where it is not, nothing in it contradicts a window.

Reading by patterns goes wrong where words are known one by one and mean something else together ("when the clip opened", "height lost
so far"). A clause is therefore compared, three neighbouring words at a time, with all that was met in captions whose truth was known:
`en_wordings.txt` and `zh_wordings.txt` hold their sentences as `written` gives them. `tests/wordings.py` writes them anew, which is
due where a lexicon or this module changes.
"""

from __future__ import annotations

import re
from functools import cache, lru_cache
from itertools import chain, pairwise
from pathlib import Path

from caption.truth.prose.clauses import Clause, Sentence, parse
from caption.truth.prose.lexicon import Token
from cosfly.products.captions import Language
from cosfly.reading.files import read_text

TRIPLE, PAIR = 3, 2  # neighbouring words that must have been met together
_SHORT = 6  # words
# Of a phrase with several meanings the first of these stands for it.
_KINDS = (
    "quantity", "who", "side", "trend", "visibility", "state", "compare", "time", "negation", "modality", "hedge",
    "link", "ratio", "action", "position", "bend", "move",
)  # fmt: skip
# Small words that stand for each other, by the one that is written.
_ALIKE = {
    "is": "is are was were be been being am", "has": "has have had having", "do": "do does did", "and": "and but or",
    "of": "of in on at by with for over across along during within", "it": "it they we i he she you one",
}  # fmt: skip
_SMALL = {word: written for written, words in _ALIKE.items() for word in words.split()}
# What says nothing of how a clause is built, as most adverbs do not.
_SILENT: dict[Language, re.Pattern[str]] = {
    "en": re.compile(
        r"s|an?|the|this|that|these|those|its|itself|own|only|just|mere|merely|even|still|now|already|also|yet|(?!hardly|barely|scarcely)[a-z]+ly"
    ),
    "zh": re.compile(r"[仅只才就还已仍都也的了却着地很]"),
}
_WORD: dict[Language, re.Pattern[str]] = {
    "en": re.compile(r"[a-z]+"),
    "zh": re.compile(r"[\u4e00-\u9fff]|[a-z]+"),
}
# Of what a rule or another text says: its numbers need not be those of the window.
_CITES = re.compile(
    r"《|§|第\s?#\s?条|\b(?:article|section|paragraph|clause|rule|manual|regulation|handbook|guideline)s?\b"
)
_START, _END, _NEXT = "^", "$", ";"


@lru_cache(maxsize=4096)
def is_met(text: str, language: Language, span: tuple[int, int], loosely: bool = False, alone: bool = False) -> bool:
    """Tell whether the neighbouring words of a clause of a masked sentence were met together.

    span: of the clause. Wanted are all groups of three, of two for a short clause without a word that the lexicon does not hold. loosely: all
    groups of two but one. A clause that names neither a quantity nor anybody goes on about the one before it, and is looked at with it.
    """
    if cites(text):
        return False
    sentence = parse(text, language)
    at = next(i for i, clause in enumerate(sentence.clauses) if (clause.start, clause.end) == span)
    words = words_of(sentence, sentence.clauses[at])
    is_short = len(words) <= _SHORT and all(word[0] in "<#" or word in _ALIKE for word in words)
    if at and not alone and not sentence.clauses[at].has("quantity") and not sentence.clauses[at].has("who"):
        words = [*words_of(sentence, sentence.clauses[at - 1]), _NEXT, *words]
    unmet = _neighbours([_START, *words, _END], PAIR if loosely or is_short else TRIPLE) - met(language)
    return len(unmet) <= loosely


def cites(text: str) -> bool:
    """Tell whether a sentence says what a rule or another text says."""
    return _CITES.search(text) is not None


def words_of(sentence: Sentence, clause: Clause) -> list[str]:
    """Give a clause as words: kinds of the lexicon in angle brackets, numbers by their unit, others as they are written."""
    text, written, silent = sentence.text, _WORD[sentence.language], _SILENT[sentence.language].fullmatch
    kinds: dict[tuple[int, int], str] = {}
    for token in sorted(clause.tokens, key=_rank):
        kinds.setdefault((token.start, token.end), "" if token.kind == "hedge" else f"<{token.kind}>")
    places = [(start, end, kind) for (start, end), kind in kinds.items()]
    numerals = [sentence.numerals[i] for i in clause.numerals]
    places += [(n.start, n.end, f"#{n.unit}") for n in numerals]
    words: list[str] = []
    at = clause.start
    for start, end, kind in sorted(places, key=lambda place: (place[0], -place[1])):
        words += written.findall(text, at, max(at, start))
        words += [kind] if kind and end > at else []
        at = max(at, end)
    words += written.findall(text, at, max(at, clause.end))
    return [_SMALL.get(word, word) for word in words if not silent(word)]


def _rank(token: Token) -> int:
    return _KINDS.index(token.kind)


def written(sentence: Sentence) -> str:
    """Give a sentence as a line of a wordings file: its clauses in their order."""
    return f" {_NEXT} ".join(" ".join(words_of(sentence, clause)) for clause in sentence.clauses)


def groups_of(line: str) -> set[tuple[str, ...]]:
    """Give the groups of neighbouring words of a line, three at a time and two: within its clauses, and from each to the next."""
    clauses = [part.split(" ") if part else [] for part in line.split(f" {_NEXT} ")]
    runs = [[_START, *words, _END] for words in clauses]
    runs += [[_START, *before, _NEXT, *after, _END] for before, after in pairwise(clauses)]
    return {group for words in runs for size in (TRIPLE, PAIR) for group in _neighbours(words, size)}


def _neighbours(words: list[str], size: int) -> set[tuple[str, ...]]:
    return {tuple(words[i : i + size]) for i in range(len(words) - size + 1)}


def wordings_file(language: Language) -> Path:
    return Path(__file__).with_name(f"{language}_wordings.txt")


@cache
def met(language: Language) -> frozenset[tuple[str, ...]]:
    """Give all groups of neighbouring words that were met."""
    lines = read_text(wordings_file(language), what="wordings").splitlines()
    return frozenset(chain.from_iterable(map(groups_of, lines)))
