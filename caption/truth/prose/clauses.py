"""A masked sentence as clauses of tokens: what is near what, what is negated, what is not stated as observed."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import cache

from caption.truth.prose.lexicon import Token, load_lexicon
from caption.truth.prose.numerals import Numeral, numerals
from cosfly.products.captions import Language

_BREAKS = {
    "en": r"[;:()\[\]]|→(?=\s*[a-z])|(?<!approx)(?<!\bca)(?<!\bvs)(?<!resp)(?<!max)(?<!min)(?<!avg)\.(?=\s)|\s-\s|,(?!\s*(?:and |or )?[-+]?[#\d])|(?<![#\d]),|(?<=t\d),(?=\s*[-+]?#)|\b(?:given|considering|(?<!all )but|while|whilst|whereas|although|though|yet|because|(?<!in )which|who|since(?= the| it| they| we| our| he| she| neither)|(?<=, )as(?= the| it| they| we| he| she)|so(?! far| that))\b"
    r"|\band(?= (?:the|its|it|they|their|our|we|i|he|she|has|have|is|are|was|keeps|bears|lies|now|so|then|both|that|not)\b)|\"|\||•",
    "zh": r"[;:()\[\]。]|→(?=\s*[^\d#\s+-])|、(?!\s*[-+]?[#\d])|(?<![#\d])、|,(?!\s*[-+]?[#\d])|(?<![#\d]),|(?<=t\d),(?=\s*[-+]?#)|考虑到|鉴于|而(?!且)|(?<=米)却|(?<=秒)却|(?<=度)却(?!在)|但是|但|不过|并且|且|因为|由于|同时|\||•",
}
_FRAME = re.compile(r"(?<![a-z])t(\d{1,2})(?!\d)")
_AGO = {"en": re.compile(r"\s*(?:ago|earlier|before|back|prior)\b"), "zh": re.compile(r"\s*(?:钟)?(?:之前|以前|前)")}
_LAST = {
    "en": re.compile(r"(?:last|latest|newest|most recent|recent|final|past|preceding)\s*(?:of )?(?:the )?$"),
    "zh": re.compile(r"(?:最近|最后|最新|末|(?<![随之此])后|近|过去)的?\s*$"),
}
_FIRST = {
    "en": re.compile(r"(?:first|earliest|oldest|opening|initial)\s*$"),
    "zh": re.compile(r"(?:前|最初|起初|最早|头)的?\s*$"),
}
_BLOCKING = ("if", "may", "future", "goal")


@dataclass
class Clause:
    """A part of a sentence. blocked: spans in which nothing is stated as observed, with the reason."""

    start: int
    end: int
    tokens: list[Token]
    numerals: list[int] = field(default_factory=list)
    blocked: list[tuple[int, int, str]] = field(default_factory=list)

    def of(self, kind: str, *values: str) -> list[Token]:
        return [t for t in self.tokens if t.kind == kind and (not values or t.value in values)]

    def has(self, kind: str, *values: str) -> bool:
        return any(t.kind == kind and (not values or t.value in values) for t in self.tokens)

    def is_blocked(self, at: int, reasons: tuple[str, ...] = _BLOCKING) -> bool:
        return any(start <= at < end and reason in reasons for start, end, reason in self.blocked)


_FAR = (  # negations of the whole clause
    "at no point", "at no time", "in no frame", "in no step", "there was no step", "there is no step", "no step in which", "no frame in which", "never", "nowhere",
)  # fmt: skip


@dataclass
class Sentence:
    text: str
    language: Language
    numerals: list[Numeral]
    clauses: list[Clause]

    def is_negated(self, clause: Clause, token: Token) -> bool:
        """Tell whether a negation stands before a token, near enough to mean it."""
        if self.language == "en" and _NEITHER_NOR.search(self.text, 0, token.start):
            return True
        between = [self.numerals[i] for i in clause.numerals]
        for negation in clause.of("negation", "turn"):
            words = self.text.count(" ", negation.end, token.start)
            is_far = self.text[negation.start : negation.end] in _FAR
            if not 0 <= token.start - negation.end <= (6 if self.language == "zh" else 60 if is_far else 28):
                continue
            if any(negation.end <= n.start and n.end <= token.start for n in between):
                continue
            if self.language == "zh" or words <= (10 if is_far else 4):
                return True
        return False


_NEITHER_NOR = re.compile(
    r"^neither\b[^;:.]*\bnor\b[^;:.]*$"
)  # as the sentence's subject: "neither the height nor the distance is"


@cache
def _breaks(language: Language) -> re.Pattern[str]:
    return re.compile(_BREAKS[language])


def parse(text: str, language: Language) -> Sentence:
    """Cut a masked sentence."""
    found = numerals(text, language)
    tokens = load_lexicon(language).scan(text)
    tokens += [Token("time", "t" + match[1], match.start(), match.end()) for match in _FRAME.finditer(text)]
    tokens += _spans(text, found, language)
    tokens += _unknown_moments(text, tokens, language)
    if language == "en":
        tokens += _particles(text, tokens)
        if _GROUND.search(text):
            tokens = [_may_be_slant(t, text) for t in tokens]
        tokens = [t for t in tokens if not _is_particle(t, text, tokens)]
    ratios = [t for t in tokens if t.kind == "ratio"]
    kept = [
        n
        for n in found
        if not any(t.start <= n.start < t.end and (t.end >= n.end or n.unit == "times") for t in ratios)
    ]
    tokens = [
        t
        for t in tokens
        if t.kind != "ratio"
        or not any(((n.start <= t.start and n.end > t.end) or (n.start < t.start and n.end >= t.end)) for n in kept)
    ]
    tokens.sort(key=lambda t: t.start)
    clauses = _cut(text, tokens, kept, language)
    _block(clauses, text)
    return Sentence(text, language, kept, clauses)


_AT_SOME_TIME = {
    "en": re.compile(r"(?<![a-z])(?:frame|step|image|photo) #(?![.#])"),
    "zh": re.compile(
        r"第#[帧步]|(?<=[\u4e00-\u9fff])(?<![同及随小此适届暂临准一当按定实平有这那])时(?![刻候间长段常])"
    ),
}


def _unknown_moments(text: str, tokens: list[Token], language: Language) -> list[Token]:
    """Read "入院时" and "frame 4", which may count from 0 or 1, as moments of which nothing more is known."""
    ends = {t.end for t in tokens if t.kind == "time"}
    found = _AT_SOME_TIME[language].finditer(text)
    return [Token("time", "some", match.start(), match.end()) for match in found if match.start() not in ends]


_REASON = re.compile(
    r"since (?:the (?!start|beginning|first|last|previous|window|opening)|its?\b|we\b|they\b|he\b|she\b|our\b|both\b)"
)


_READING = re.compile(r"\b(?:initial|original|first|starting|earlier|previous|same|present|latest|current|final) $")


def _is_particle(token: Token, text: str, tokens: list[Token]) -> bool:
    """Tell whether a word means nothing here: the "own" of "his own pace", the "figure" that is a number, the "since" that gives a reason."""
    if token.kind == "who" and text[token.start : token.end] == "own":
        return any(t.kind == "who" and t.end == token.start - 1 for t in tokens)
    if token.kind == "who" and text[token.start : token.end] == "figure":
        return _READING.search(text, 0, token.start) is not None
    return token.kind in ("time", "link") and _REASON.match(text, token.start) is not None


_GROUND = re.compile(r"\bground (?:distance|range)\b|\bhorizontal")


def _may_be_slant(token: Token, text: str) -> Token:
    """A bare "range" beside a distance over the ground may be that along the line of sight."""
    is_bare = token.kind == "quantity" and token.value == "distance" and text[token.start : token.end] == "range"
    return Token("quantity", "range", token.start, token.end) if is_bare else token


_PARTICLE = re.compile(
    r"\b(?!look|eat|ate|use|point|pitch|tilt|camera|angl|view|px|pixel|m\b|met|deg|straight|further|slow|pick|catch|caught|keep|end|set|show|upside|sum|line|well|nose|face|facing|bear|gaz|see|head|pan|turn|follow|close|clos|open|back|make|made|take|speed|sped|brought|bring|cover|hold|held|lock|give|gave|brow|slope|high|half|so|and|or|is|are|it|the|#)"
    r"[a-z]+ (up|down)\b(?! to t\d| with| front)"
    r"|(?:^|[,;(:]|\b(?:is|are|was|now|currently|and)) ?(up|down) (?=(?:by |from |to )?(?:about |roughly |almost |nearly |some |an? )*(?:[#\d]|(?:one|two|three|four|five|six|seven|eight|nine|ten|half)\b))"
)


def _particles(text: str, tokens: list[Token]) -> list[Token]:
    """Read the up and down of a verb that the lexicon does not hold: "creeps up", "has edged down"."""
    taken = [(t.start, t.end) for t in tokens if t.kind in ("trend", "side", "modality", "action", "time", "link")]
    found = []
    for match in _PARTICLE.finditer(text):
        at = match.start(1 if match[1] else 2)
        if not any(start < match.end() and at < end for start, end in taken):
            found.append(Token("trend", match[1] or match[2], at, match.end()))
    return found


def _spans(text: str, found: list[Numeral], language: Language) -> list[Token]:
    """Read counts of seconds and frames as times: `2 s ago`, `the last two frames`."""
    tokens = []
    for n in found:
        if n.unit not in ("s", "frames"):
            continue
        before = text[max(0, n.start - 18) : n.start]
        if n.unit == "s" and _AGO[language].match(text, n.end):
            tokens.append(Token("time", f"ago:{n.value * n.factor}", n.start, n.end))
        elif n.unit == "frames" and _AGO[language].match(text, n.end):
            tokens.append(Token("time", f"back:{n.value:.0f}", n.start, n.end))
        elif _LAST[language].search(before):
            tokens.append(Token("time", f"last{'' if n.unit == 'frames' else '_s'}:{n.value}", n.start, n.end))
        elif n.unit == "frames" and _FIRST[language].search(before) and not (n.value == 1 and before.endswith("前")):
            tokens.append(Token("time", f"first:{n.value:.0f}", n.start, n.end))
        elif n.unit == "s":
            tokens.append(Token("time", "window", n.start, n.end))
    return tokens


def _is_in_list(at: int, found: list[Numeral]) -> bool:
    """Tell whether a comma stands inside a row of three numbers or more."""
    before = next((n for n in reversed(found) if n.end <= at), None)
    after = next((n for n in found if n.start >= at), None)
    if before is None or after is None or before.group != after.group:
        return False
    return sum(n.group == before.group for n in found) >= 3


_OF_TIME = re.compile(
    r"(?:\W|\b(?:at|in|by|on|the|then|and|from|during|over|for|of|so|now|but|only|just|as|already|still|here|this|that|very|first|last)\b)*"
)


def _is_time_alone(text: str, start: int, end: int, tokens: list[Token], found: list[Numeral]) -> bool:
    inside = [t for t in tokens if start <= t.start < end]
    is_time = any(t.kind == "time" and t.value != "past" for t in inside) and all(
        t.kind in ("time", "link", "position") for t in inside
    )
    is_free = not any(start <= n.start < end and n.unit not in ("s", "frames") for n in found)
    part, at = "", start
    for t in sorted(tokens, key=lambda t: t.start):
        if at <= t.start and t.end <= end:
            part, at = part + text[at : t.start], t.end
    is_alone = not text.isascii() or _OF_TIME.fullmatch(part + text[at:end]) is not None
    return is_time and is_free and is_alone and end - start <= (28 if text.isascii() else 9)


def _cut(text: str, tokens: list[Token], found: list[Numeral], language: Language) -> list[Clause]:
    clauses, start = [], 0
    for match in (*_breaks(language).finditer(text), None):
        at = len(text) if match is None else match.start()
        if match is not None and match.group() in ",、|" and _is_in_list(match.start(), found):
            continue  # "18.0 m, 18.3 m, 18.9 m"
        if match is not None and match.group() in ",，" and _is_time_alone(text, start, at, tokens, found):
            continue  # "At t3, the roof hid the walker"
        inside = [t for t in tokens if start <= t.start < at]
        numbers = [i for i, n in enumerate(found) if start <= n.start < at]
        if inside or numbers:
            clauses.append(Clause(start, at, inside, numbers))
        if match is not None:
            start = match.start() if match.group()[0].isalpha() and language == "en" else match.end()
    return clauses


_GIVEN = re.compile(r"\s*(?:given|considering|since|because|as)\b|\s*(?:因为|由于)")


# Before a number they aim at nothing: "makes about twice", "1.2 against 4.3 m/s", "又回到 20 米".
_STATING = frozenset(["make", "makes", "made", "making", "against", "回到"])
_A_NUMBER = re.compile(
    r"(?: (?:about|roughly|some|only|just|a mere|that|the|our|its|present|current|\w+'s))* #|(?:了|约|大约)?\s*#"
)


_LOOKS_AS = re.compile(r"\b(?:looks|seems|appears) as $")


# "had their path bent left, ...": a condition.
_INVERTED = re.compile(r"(?:^|(?<=[;.:]))\s*(?:had|should|were) (?:the|it|he|she|they|their|his|her|its|we|our|this)\b")


def _block(clauses: list[Clause], text: str) -> None:
    """Mark where a sentence speaks of what is not observed: conditions up to a semicolon or a reason, goals to the clause's end."""
    conditional = False
    for clause in clauses:
        given = _GIVEN.match(text, clause.start) or text[: clause.start].endswith(("考虑到", "鉴于", "因为", "由于"))
        conditional = (
            conditional and text[max(0, clause.start - 1)] != ";" and not given and not clause.has("modality", "thus")
        )
        conditional = conditional or _INVERTED.match(text, clause.start) is not None
        if conditional:
            clause.blocked.append((clause.start, clause.end, "if"))
        if clauses[0] is not clause and text.startswith("and ", clause.start):
            before = clauses[clauses.index(clause) - 1]
            clause.blocked += [
                (clause.start, clause.end, why) for _, end, why in before.blocked if end >= before.end and why != "if"
            ]
        for token in clause.of("modality"):
            if token.value == "if" and (text.startswith("的", token.end) or _LOOKS_AS.search(text, 0, token.start)):
                continue  # "只有他的一半", "it looks as if"
            if token.value == "if":
                conditional = True
                clause.blocked.append((clause.start, clause.end, "if"))
            elif token.value == "may" and not text.startswith("#", token.end + 1):  # "perhaps 7 px"
                clause.blocked.append((clause.start, clause.end, "may"))
            elif token.value in ("future", "goal"):
                if text[token.start : token.end] == "把" and clause.has("visibility"):
                    continue  # "屋顶把他挡住"
                if text[token.start : token.end] in _STATING and _A_NUMBER.match(text, token.end):
                    continue
                whole = token.value == "future" and not clause.numerals
                clause.blocked.append((clause.start if whole else token.start, clause.end, token.value))
