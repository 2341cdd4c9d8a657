"""The words of a prompt that the rules know, and its phrases: which adjective belongs to which noun.

Source: an alternative to the language model of app:simworld:step1 where no endpoint is given.
"""

import re
from collections.abc import Iterable
from pathlib import Path

from cosfly.runtime.config import read_yaml
from cosfly.worldgen.plan import OBJECTS


def words_of(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


def longest_first(words: Iterable[str]) -> list[str]:
    return sorted(words, key=len, reverse=True)  # "office tower" before "tower"


WORDS = read_yaml(Path(__file__).with_name("words.yaml"))
POSITIONS = set(words_of(WORDS["positions"]))
STOPS = set(words_of(WORDS["stops"])) | POSITIONS
ORDINARY = set(words_of(WORDS["ordinary"]))
ADJECTIVES = {
    word: (group, choice)
    for group, rows in WORDS["groups"].items() for choice, row in rows.items() for word in words_of(row["words"])
}  # fmt: skip
SETTLEMENTS = {name: {*words_of(row["words"])} for name, row in WORDS["settlements"].items()}
SETTLEMENT_NOUNS = {*words_of(WORDS["sized"])}.union(*SETTLEMENTS.values())
# Nouns by target; later ones of a word replace earlier ones.
NOUNS = {
    **dict.fromkeys([*ORDINARY, *WORDS["open"], *words_of(WORDS["lacking"])], "other"),
    **dict.fromkeys(WORDS["water"], "water"),
    **dict.fromkeys(words_of(WORDS["streets"]), "street"),
    **dict.fromkeys(words_of(WORDS["avenues"]), "avenue"),
    **{word: name for name, row in WORDS["buildings"].items() for word in (*words_of(row["words"]), name)},
    **{word: "other" for obj in OBJECTS.values() for word in (obj.name, *obj.words)},
    **dict.fromkeys(SETTLEMENT_NOUNS, "town"),
}
_TOKEN = re.compile(
    rf"#(?P<measure>\d+)#|(?P<end>[.,;:()]|(?<![\w-])(?:{'|'.join(words_of(WORDS['ends']))})(?![\w-]))"
    rf"|(?<![\w-])(?:(?P<known>{'|'.join(longest_first([*ADJECTIVES, *NOUNS]))})(?:e?s)?|(?P<word>[\w-]+))(?![\w-])"
)


def holds(text: str, word: str) -> bool:
    return re.search(rf"(?<![\w-]){re.escape(word)}s?(?![\w-])", text) is not None


class Phrase:
    """The adjectives and nouns between two prepositions or punctuation marks."""

    def __init__(self, end: str) -> None:
        self.ends = [end]  # what is before it
        self.text = ""
        self.adjectives = list[tuple[int, str]]()  # with their places in the text
        self.measures = list[int]()  # their numbers
        self.nouns = list[str]()
        self.words = set[str]()  # all others

    @property
    def head(self) -> str:
        """The noun that the adjectives describe; empty if the phrase has none, "?" if it has an unknown one."""
        return self.nouns[-1] if self.nouns else "" if self.words <= STOPS else "?"


def phrases_of(text: str) -> list[Phrase]:
    """Split a text into phrases."""
    phrases = [Phrase(".")]
    for match in _TOKEN.finditer(text):
        phrase = phrases[-1]
        phrase.text += " " + (match[0] if not match["end"] else "")
        if match["measure"]:
            phrase.measures.append(int(match["measure"]))
        elif match["end"] and not (phrase.adjectives or phrase.nouns or phrase.words or phrase.measures):
            phrase.ends.append(match["end"])
        elif match["end"]:
            phrases.append(Phrase(match["end"]))
        elif match["known"] in ADJECTIVES:
            phrase.adjectives.append((match.start(), match["known"]))
        elif match["known"]:
            phrase.nouns.append(match["known"])
        else:
            phrase.words.add(match["word"])
    return phrases


def nearby_noun(phrases: list[Phrase], number: int) -> str:
    """Return the noun for a phrase without one: "a small, dense | town", "houses are low | and narrow"."""
    for after in phrases[number + 1 : number + 2]:
        if after.nouns and {",", "and"}.issuperset(after.ends) and not {"a", "an", "the"} & after.words:
            return after.head
    return noun_before(phrases, number)


def noun_before(phrases: list[Phrase], number: int) -> str:
    return next((phrase.head for phrase in reversed(phrases[:number]) if phrase.nouns), "")
