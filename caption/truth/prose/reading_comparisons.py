"""Two speeds: whether a word compares them, and which one with which."""

from __future__ import annotations

import re

from caption.truth.prose.clauses import Clause, Sentence
from caption.truth.prose.cues import Context
from caption.truth.prose.lexicon import Token

_SPEED = re.compile(
    r"fast|ahead|ground|edge|quick|slow|pace|speed|rapid|swift|outpac|outrun|outstrip|overtak|lag|trail|behind|keep|catch|caught"
    r"|快|慢|落后|赶|追|甩|同速|跟不上|跟得上"
)
_VERBS = re.compile(
    r"fl(?:y|ies|ying|own|ew)|walk(?:s|ed|ing)?|stroll(?:s|ed|ing)?|march\w*|ambl\w+|saunter\w*|trudg\w+|行走|走|步行|飞行"
)
_COMPARATIVE = re.compile(
    r"faster|slower|quicker|higher|lower|greater|swifter|larger|smaller|more|less|more quickly|more slowly|speedier|more rapidly"
)
_THAN = re.compile(r"\b(?:than|as)\b")
_ALONE = re.compile(
    r"fall|fell|behind|lag|catch|caught|keep|kept|outpac|outrun|left|match|step|ahead|ground|edge"
)  # "keeps pace": with the other one


_WITH_ITSELF = re.compile(r"same|pace|equal|identical|一样|相同|一致")
_BARE = (
    "更快",
    "更慢",
    "快",
    "慢",
    "略快",
    "略慢",
    "稍快",
    "稍慢",
    "快些",
    "慢些",
    "快一些",
    "慢一些",
    "快一点",
    "慢一点",
)
_DEGREE = re.compile(
    r"(?:略|稍|稍微|偏|明显|更|较)(?:偏)?(?:快|慢)(?!了|下|起|慢|快|速|步|走|飞)"
)  # "行人明显更快": than the other one
_THE = re.compile(r"\bthe (?:clearly |much |far |slightly |marginally )?$")  # "is the quicker of the two"


def _of_subject(subjects: list[Token], context: Context) -> int | None:
    subject = subjects[-1].value if subjects else context.subject
    return {"drone": 1, "target": -1}.get(subject)


def compared_speeds(sentence: Sentence, clause: Clause, context: Context, token: Token, cue: str) -> int | None:
    """Say which speed a word compares with which: +1 the drone's with the target's, -1 the other way; None where it does not.

    cue: the quantity nearest to the word.
    """
    text = sentence.text[token.start : token.end]
    if sentence.text[: token.start].endswith(("或", "或者", " or ")):
        return None  # "3 m/s or faster"
    near = any(
        sentence.numerals[i].unit == "mps" and abs(sentence.numerals[i].start - token.end) < 30 for i in clause.numerals
    )
    if not (_SPEED.search(text) or cue == "speed" or near):
        return None
    people = [t for t in clause.of("who", "drone", "target") if not _VERBS.fullmatch(sentence.text[t.start : t.end])]
    subjects, objects = [t for t in people if t.end <= token.start], [t for t in people if t.start >= token.end]
    thans = [t for t in clause.of("link", "than") if t.end != token.start]  # "较慢" names nobody
    if sentence.language == "zh" and text in _BARE and not objects and not thans:
        both = {"drone", "target"} <= {*context.people, *(t.value for t in subjects)}
        is_of_two = _DEGREE.search(sentence.text, clause.start, token.end) or (both and text.endswith(("些", "一点")))
        return _of_subject(subjects, context) if is_of_two else None
    if (
        sentence.language == "en"
        and token.value != "matching"
        and _THE.search(sentence.text[: token.start])
        and not clause.has("time", "past", "since")
    ):
        return _of_subject(subjects, context)
    if (
        sentence.language == "en"
        and _COMPARATIVE.fullmatch(text)
        and not _THAN.search(sentence.text, token.end, clause.end)
    ):
        return None
    if sentence.language == "zh":
        than = [t for t in clause.of("link", "than") if t.end <= token.start + 2]
        if text in ("快", "慢", "高", "低") and not than:
            return None
        if than:  # "无人机比行人快": the one after 比 is the object
            objects = [t for t in people if than[-1].end <= t.start <= token.start]
            subjects = [t for t in people if t.end <= than[-1].start]
    if not objects and clause.has("time", "window", "since") and _WITH_ITSELF.search(text):
        return None  # "has kept the same pace all along"
    if not objects and _ALONE.search(text):
        subject = subjects[0].value if subjects else context.subject
        return {"drone": 1, "target": -1}.get(subject)
    if not objects:
        return None
    subject = subjects[0].value if subjects else context.subject
    other = {"drone": "target", "target": "drone"}[objects[0].value]
    return 1 if (subject if subject and subject != objects[0].value else other) == "drone" else -1
