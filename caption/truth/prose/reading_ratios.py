"""How many times: the two speeds, or one series now against an earlier frame."""

from __future__ import annotations

import re

from caption.truth.prose.clauses import Clause, Sentence
from caption.truth.prose.cues import TREND_SERIES, Context, times_of
from caption.truth.prose.lexicon import Token
from caption.truth.prose.statements import NOW, Hedge, Statement

_SPEED = re.compile(r"fast|quick|slow|pace|speed|swift|rapid|velocit|速|快|慢")
_CHANGE = re.compile(r"(?:halv|doubl|tripl|trebl|quadrupl)(?:ed|es|ing)|翻|减半|加倍|只剩|剩下|降到|减到|增到")
_MORE_BY = re.compile(
    r"\s*(?:times )?(?:as much |again )?(?:faster|slower|quicker|more|less|bigger|larger|smaller|again|above|below|higher|lower|over|under|off|up|down)\b|\s*(?:多|左右|以上)?(?:快|慢|多|少)"
)


_INITIAL = re.compile(
    r"\s*(?:of )?(?:the |its |our )?(?:initial|original|first|starting|opening) (?:figure|value|one|speed|reading|pace)\b"
    r"|\s*of (?:what it was at first|where it started)"
)
# What a speed or a size is compared with is its own at another moment.
_EARLIER = re.compile(
    r"\b(?:initial|original|first|what it (?:was|did|had)|before|earlier|previous|ago|at the start|relative to its)\b|原来|原先|最初|起初|当初|开始|之前|此前|前一|上一|[降减增涨升]幅"
)
_AGAINST = re.compile(r"\b(?:against|versus|vs)\b|对(?!方)|比")
_OBJECT = re.compile(r"[比是为于及达到]")
_HALVES = re.compile(r"(?:halv|doubl|tripl|trebl)\w+|减半|翻[了一两]?[倍番]")  # seldom exact
_OF_OTHER = re.compile(r"的\s*(?:约|近|将近|大约|差不多)?\s*")  # "接近目标的五倍"


def ratio_statement(
    sentence: Sentence,
    clause: Clause,
    context: Context,
    start: int,
    end: int,
    numbers: tuple[int, ...],
    value: float = 0.0,
) -> Statement:
    """Read a ratio. names: of the series that it compares with itself; "speed_ratio": drone against target, the other way with side -1.

    mode "change": a share that was added or lost, "either": that or the ratio itself.
    """
    told = _Multiple(sentence, clause, context, start, end)
    names, side = told.names_and_side()
    signs = {1 if t.value.endswith("up") else -1 for t in told.trends} or told.signs_of_more()
    is_past = clause.has("time", "past", "start", "prev1", "prev2", "window", "mean") or context.has_past
    operands, is_ordered = _operands(sentence, start, end, numbers)
    return Statement(
        "ratio",
        (clause.start, clause.end),
        names,
        numbers,
        None if is_past else (NOW,),
        mode="change" if told.is_change() else "either" if told.may_be_change() else "value",
        hedge=_hedge(sentence, clause, start, end),
        side=side,
        trend=signs.pop() if len(signs) == 1 and "speed_ratio" not in names else 0,
        value=value,
        operands=operands,
        is_ordered=is_ordered,
        span=told.since(),
    )


_AS_HIGH = re.compile(r"\s*(?:as )?(?:high|far|long|wide|tall|deep)\b")  # of two lengths
_OF_TIME = re.compile(r"\s*(?:at|in|during|within|over)\b")  # "twice at 5 m/s"
_OF_THING = re.compile(
    r"\s*(?:a |an )?(?:met(?:re|er)|second|frame|step|of the (?:window|picture|frame|image)|way|visible|hidden|turn|the (?:window|picture|frame|image)|of an? )|\s*秒|侧|边|帧|步"
)


def ratio_word(
    sentence: Sentence, clause: Clause, context: Context, token: Token, *, in_scene: bool
) -> list[Statement]:
    """Read a word for a multiple or a part; nothing where it counts something else: "a second and a half", "half the frame"."""
    text, start, end = sentence.text, token.start, token.end
    if in_scene or _AS_HIGH.match(text, end) or text[:start].endswith("and a "):
        return []
    if _OF_TIME.match(text[: end + 12], end) or _OF_THING.match(text[: end + 12], end):
        return []
    return [ratio_statement(sentence, clause, context, start, end, (), float(token.value))]


class _Multiple:
    """A multiple or a percentage in its clause: who is named around it, and what its clause speaks of."""

    def __init__(self, sentence: Sentence, clause: Clause, context: Context, start: int, end: int) -> None:
        self.sentence, self.clause, self.context, self.start, self.end = sentence, clause, context, start, end
        self.text, self.part = sentence.text, sentence.text[clause.start : clause.end]
        self.people = clause.of("who", "drone", "target")
        self.before = [t for t in self.people if t.end <= start]
        self.after = [t for t in self.people if t.start >= end]
        self.owners = {t.value for t in self.people} | ({context.subject} if context.subject else set())
        self.trends = [
            t for t in clause.of("trend", "up", "down", "pace_up", "pace_down") if abs(t.start - start) <= 40
        ]
        self.is_earlier = (
            bool(_CHANGE.search(self.text[start:end]))
            or bool(_EARLIER.search(self.part))
            or any(t.value[0] == "t" or t.value in ("prev1", "prev2", "start") for t in clause.of("time") if t.value != "total")
        )  # fmt: skip

    def names_and_side(self) -> tuple[tuple[str, ...], int]:
        """Give what is compared, and for the two speeds whose is the multiple: +1 the drone's, 0 either's."""
        numerals, context = self.sentence.numerals, self.context
        speeds = bool(_SPEED.search(self.part)) or context.cue == "speed" or any(n.unit == "mps" for n in numerals)
        # "about that of the walker (1 m/s) times two"
        is_behind = not self.people and len(set(context.people)) == 2 and self.text[: self.clause.start].endswith(")")
        if speeds and not self.is_earlier and (is_behind or self._compares_two()):
            first = 1 if context.people and context.people[0] == "drone" else -1
            return ("speed_ratio",), first if is_behind else _direction(
                self.sentence, self.before, self.after, context, self.start, self.end
            )
        only_differs = all(t.value == "difference" for t in self.clause.of("quantity"))
        if speeds and self.people and len(self.owners) == 2 and only_differs:
            return ("speed_ratio", "speed", "target_speed"), 0  # "is a third faster": than it was, or than the other
        names = self._changing() if self._may_change() else ()
        if not names and speeds:
            if self.since() and len(set(context.people)) == 1:
                return ("speed",) if context.people[0] == "drone" else ("target_speed",), 0
            is_past = self.is_earlier or any(t.value != "now" for c in self.sentence.clauses for t in c.of("time"))
            names = ("speed_ratio", "speed", "target_speed") if is_past else ("speed_ratio",)
        return names, 0

    def _compares_two(self) -> bool:
        """Tell whether the drone and the target are named, or a word compares one with the other."""
        thans = self.clause.of("link", "than")
        return bool(
            len({t.value for t in self.people}) == 2
            or (self.people and len(self.owners) == 2 and not self.trends)
            or any(0 <= t.start - link.end <= 4 for t in self.before for link in thans)
            or _is_object(self.sentence, self.before, self.after)
            or self._is_versus()
            or (self.clause.has("compare", "faster", "slower") and not self.trends)
        )

    def _is_versus(self) -> bool:
        two = sum(n.unit == "mps" for n in self.sentence.numerals) == 2
        return two and not self.people and _AGAINST.search(self.text, 0, self.start) is not None

    def _may_change(self) -> bool:
        changes = _CHANGE.search(self.text[self.start : self.end]) or _CHANGE.search(self.part)
        return bool(self.trends or self.is_earlier or changes)

    def _changing(self) -> tuple[str, ...]:
        """Give the series that is compared with itself at another moment."""
        cues = [t for t in self.clause.of("quantity") if t.value in TREND_SERIES or t.value == "speed"]
        cue = min(cues, key=lambda t: abs(t.start - self.start)).value if cues else self.context.cue
        if cue in ("speed", "difference"):
            owners = {t.value for t in self.people}
            return (
                ("speed",)
                if owners == {"drone"}
                else ("target_speed",)
                if owners == {"target"}
                else ("speed", "target_speed")
            )
        if cue in ("altitude", "height") and self.context.cue in ("box", "tall", "width"):
            return ("altitude", "box_height")
        names = TREND_SERIES.get(cue, ())
        return ("box_width", "box_height", "box_area") if "box" in "".join(names) else names

    def signs_of_more(self) -> set[int]:
        """Give the way that a comparative says: "20 % less", "低了约三成"."""
        more = _MORE_BY.match(self.text, self.end)
        word = more.group().split()[-1] if more and self.text.isascii() else ""
        zh = _ZH_MORE_BY.search(self.text[self.clause.start : self.start]) if not self.text.isascii() else None
        word = zh.group()[0] if zh else word
        return {-1} if word in _LESS else {1} if word in _MORE else set()

    def since(self) -> tuple[int, int] | None:
        """Give the moment with which now is compared, where one is told: "和 t1 相比", "four times the initial figure"."""
        if _INITIAL.match(self.text, self.end):
            return (0, NOW)
        named = {frames for _, frames in times_of(self.clause) if frames != (NOW,)}
        if len(named) == 1 and len(next(iter(named))) == 1 and self.clause.has("link", "than"):
            return (next(iter(named))[0], NOW)
        return None

    def is_change(self) -> bool:
        """Tell whether it is what was added or lost, and not what is left: "30 % lower", "低了约三分之一"."""
        if self.sentence.language == "zh":
            return _ZH_MORE_BY.search(self.text[self.clause.start : self.start]) is not None
        more = _MORE_BY.match(self.text, self.end)
        return more is not None and more.group().split()[-1] in _LESS | _MORE and "as much" not in more.group()

    def may_be_change(self) -> bool:
        """Tell whether a share that was added or lost may be told, not the multiple itself."""
        zh = self.sentence.language == "zh" and _ZH_MORE_BY.search(self.text[self.clause.start : self.start])
        is_more = self.text[: self.clause.start].endswith("(") or _MORE_BY.match(self.text, self.end) or zh
        return bool(is_more or self.trends or _LOSS.search(self.part))


_LESS = frozenset(
    ["slower", "less", "smaller", "below", "lower", "under", "down", "慢", "低", "少", "小", "短", "矮", "窄", "近"]
)
_MORE = frozenset(
    [
        "faster",
        "quicker",
        "more",
        "bigger",
        "larger",
        "above",
        "higher",
        "over",
        "up",
        "快",
        "高",
        "多",
        "大",
        "长",
        "宽",
        "远",
    ]
)
_ZH_MORE_BY = re.compile(r"(?:快|慢|高|低|多|少|大|小|长|短|矮|宽|窄|远|近)(?:了|出)?(?:约|大约|近|将近|差不多)?\s*$")
_LOSS = re.compile(r"\b(?:drop|loss|gain|growth|rise|increase|decrease|reduction|deficit|cut|down|up)\b|幅")
# Between a number and the multiple that is told of it: "2.4 m/s 的三倍", "from 1.19 to 0.49 m/s (59 % less)".
_DIVISOR = re.compile(r"\s*\)?的\s*(?:约|大约|近)?\s*")
_AT_ONCE = re.compile(r"[\s,(]*(?:about |roughly |some |an? (?:drop|loss|gain|growth|rise) of )*|[\s,(]*约?\s*")
_PARTED = re.compile(r"[,;]")


def _operands(
    sentence: Sentence, start: int, end: int, numbers: tuple[int, ...]
) -> tuple[tuple[int, int] | None, bool]:
    """Give the two numbers of which a ratio is told, and whether it is the first one's of the second: "8.0 m/s, 3.4 times the walker's
    2.4 m/s", "8.0 米/秒,是行人 2.4 米/秒的三倍", but "8.0 m/s and 2.4 m/s, a ratio of 3.4".
    """
    text, since = sentence.text, sentence.text.rfind(";", 0, start) + 1
    told = [
        i
        for i, n in enumerate(sentence.numerals)
        if n.unit in ("m", "mps", "px") and i not in numbers and n.start >= since
    ]
    before = [i for i in told if sentence.numerals[i].end <= start]
    after = next((i for i in told if sentence.numerals[i].start >= end), None)
    if not before:
        return None, False
    last = sentence.numerals[before[-1]]
    if (
        sentence.language == "en"
        and after is not None
        and sentence.numerals[after].unit == last.unit
        and not _PARTED.search(text, end, sentence.numerals[after].start)
    ):
        return (before[-1], after), True
    pair = before[-2:]
    if len(pair) < 2 or sentence.numerals[pair[0]].unit != last.unit or last.joined in ("x", "*", "by", "乘"):
        return None, False
    if _DIVISOR.fullmatch(text, last.end, start):
        return (pair[0], pair[1]), True
    is_course = last.group == sentence.numerals[pair[0]].group and _AT_ONCE.fullmatch(text, last.end, start)
    if is_course or (len(before) == 2 and not _names_person(sentence, last.end, end)):
        return (pair[0], pair[1]), False
    return None, False


def _names_person(sentence: Sentence, start: int, end: int) -> bool:
    """Tell whether somebody is named between two places or in the rest of their clause."""
    return any(
        start <= t.start and (t.start < end or c.start < end <= c.end)
        for c in sentence.clauses
        for t in c.of("who", "drone", "target")
    )


def _is_object(sentence: Sentence, before: list, after: list) -> bool:
    if sentence.language == "zh":
        return bool(before and _OBJECT.search(sentence.text[max(0, before[-1].start - 2) : before[-1].start]))
    return bool(after)


_AS_FAST = re.compile(r"\s*(?:as (?:fast|quick|quickly)|(?:the|that) (?:speed|pace))\b(?! (?:of|as))")


def _direction(sentence: Sentence, before: list, after: list, context: Context, start: int, end: int) -> int:
    """Say whose speed is the multiple of the other's: +1 the drone's."""
    if sentence.language == "zh":
        if len(before) >= 2 and before[0].value != before[-1].value:
            return 1 if before[0].value == "drone" else -1
        is_object = before and (
            _OBJECT.search(sentence.text[max(0, before[-1].start - 4) : before[-1].start])
            or _OF_OTHER.fullmatch(sentence.text, before[-1].end, start)
        )
        if before and not is_object:
            return 1 if before[-1].value == "drone" else -1
        if before and not context.subject:
            return 1 if before[-1].value == "target" else -1
        if before and context.subject and context.subject != before[-1].value:
            return 1 if context.subject == "drone" else -1
        return 0
    if after and not before and not context.subject:
        return 1 if after[0].value == "target" else -1
    if before and after and before[0].value != after[0].value:
        return 1 if before[0].value == "drone" else -1
    if after and not before and context.subject and context.subject != after[0].value:
        return 1 if context.subject == "drone" else -1
    if before and not after and len({t.value for t in before}) == 1 and _AS_FAST.match(sentence.text, end):
        return 1 if before[0].value == "drone" else -1
    return 0


def _hedge(sentence: Sentence, clause: Clause, start: int, end: int) -> Hedge:
    text = sentence.text
    if sentence.language == "zh":
        if text.startswith(("多", "还多", "以上", "有余"), end) or text[start:end].endswith("多"):
            return "more"
        if re.search(r"不到|不足|少于", text[clause.start : start]):
            return "less"
    found: Hedge = ""
    for token in clause.of("hedge"):
        distance = start - token.end if token.end <= start else token.start - end
        if -1 <= distance <= (8 if sentence.language == "en" else 3) or (
            sentence.language == "zh" and -1 <= distance <= 12 and token.end <= start
        ):
            found = token.value  # type: ignore[assignment]
    return "about" if not found and _HALVES.match(text, start) else found
