"""Whether a number is a value or a change of one, and which way."""

from __future__ import annotations

import re

from caption.truth.prose.clauses import Clause, Sentence
from caption.truth.prose.cues import Context, crossing, times_of
from caption.truth.prose.lexicon import Token
from caption.truth.prose.numerals import Numeral
from caption.truth.prose.statements import NOW, Mode

MORE_THAN = re.compile(
    r"\s*(?:of )?(?P<word>more|less|higher|lower|above|below|farther|further|closer|nearer|wider|narrower|taller|shorter|larger|smaller|bigger|faster|slower|quicker|longer|up|down|greater|fewer)\b(?P<than> (?:than|on|from|since|over|against))?"
)
ZH_MORE = re.compile(
    r"(?<![接将靠附最])(?:高|低|远|近|宽|窄|快|慢|多|少|大|小|长|短)(?:出|了)?(?:约|大约|近|将近)?\s*$"
)
MORE_BY = re.compile(r"[多少]出(?:了)?(?:约|大约|近|将近)?\s*$")  # "最后半秒就多出 3.2 米"
_UP_TO = {  # a word of change with what leads to its number
    "en": re.compile(
        r"(?:(?!amount|equal|com(?:es?|ing) to|add)[a-z]+ ){1,3}?to (?:(?:about|around|roughly|some|almost|nearly|only|just|a mere|now) )*"
    ),
    "zh": re.compile(r"[^#,]{1,4}[到至](?:了)?(?:约|大约|近|将近)?\s*"),
}
EITHER_WAY = 2
_GOES_TO = {  # other words that end at their number
    "en": re.compile(r"\b(?:jump|leap|leapt|burst|shot|surge|spr[iau]ng|dash|rush|swing|swung|went|gone|move|ease|settle|relax|brake|dawdle|c[ao]me)(?:s|ed|d|ped|ing)? (?:(?:back|up|down|away|out) )*to (?:(?:about|around|roughly|some|almost|nearly|only|just|a mere|now) )*$"),
    "zh": re.compile(r"[跳窜冲蹿飙走跑飞慢快提涨缩拉退追落回弹变开收减加](?:高|低|近|远|大|小|慢|快|速)?[到至](?:了)?(?:约|大约|近|将近)?\s*$"),
}  # fmt: skip
_ASIDE_OF = re.compile(
    r"\s*(?:to the )?(?:left|right|above|below) (?:of )?(?:the )?(?:\w+ )?(?:cent(?:re|er)|middle|axis)\b"
)
_SLID = re.compile(r"\b(?:slid|slipped|jumped|swung|drifted|wandered) (?:(?:about|some|roughly) )?$")
AFTERWARDS = re.compile(r"\bafter\b")  # "back to 8.9 m after a brief excursion to 14 m"
_AFTER = re.compile(r"\s*,?\s*after (?:the |an? |some )?")
_IN_LAST_STEP = {
    "en": re.compile(r"\s*(?:to the )?(?:left|right|anticlockwise|counterclockwise|clockwise)?\s*(?:in|during|over|within) (?:the |this )?(?:last|final|latest|most recent)\b"),
    "zh": re.compile(r"(?:转|偏|摆|扭|拨)(?:过|动)?了?\s*$"),
}  # fmt: skip
_COMES_BY = re.compile(r"\bby (?:(?:about|around|roughly|some|almost|nearly|only|just|another) )*$")
_PER_STEP = {  # before a number, and after it
    "en": (
        re.compile(r"\b(?:each|every) (?:half second|step|frame) (?:(?!at |in |of |is |was |to |on )\w+ ){1,3}?(?:(?:about|roughly|around|some|almost|nearly|by) )*$"),
        re.compile(r"\s*(?:to the )?(?:left |right |clockwise )?(?:(?:in each(?= interval)|per|each|every|a|with every|with each) (?:single )?(?:half second |frame |0\.5 s )?(?:frame|step|interval|half second)\b(?! (?:ago|earlier|before|back|later))|from (?:one )?(?:frame|step) to (?:the next|frame|step)\b)"),
    ),
    "zh": (re.compile(r"(?:每帧|每步|每一步|每一帧|逐帧|每半秒|每0\.5\s?秒|每隔半秒|步[^#,;]{0,4}各)[^#,;是为在]{0,8}$"), None),
}  # fmt: skip
_FROM_TO = {  # what stands before the first number and between the two
    "en": (
        re.compile(r"\bfrom (?:(?:about|around|roughly|some|almost|nearly|only|just|over|under|a mere|an initial) )*$"),
        re.compile(r"\s*(?:(?:up|down|back) )?to (?:(?:about|around|roughly|some|almost|nearly|only|just|over|under|a mere|now) )*"),
    ),
    "zh": (
        re.compile(r"[从由](?:约|大约|近|将近|不到)?\s*$"),
        re.compile(r"\s*(?:一路|逐步|逐渐|迅速|陡然|缓缓|慢慢|略微?|稍微?|又|再)*[增减升降提加缩涨跌拉扩收落掉冲放变拓猛骤骤陡飙窜回抬压大]{0,3}[到至成为](?:了)?(?:约|大约|近|将近)?\s*"),
    ),
}  # fmt: skip
_DOWN_WORDS = frozenset(
    ["less", "lower", "below", "closer", "nearer", "narrower", "shorter", "smaller", "slower", "down", "fewer"]
)


class Changing:
    """The changes of one clause."""

    def __init__(self, sentence: Sentence, clause: Clause, context: Context) -> None:
        self.sentence, self.clause, self.context = sentence, clause, context
        self.text, self.language = sentence.text, sentence.language

    def change(self, numeral: Numeral) -> tuple[Mode, int]:
        """Say whether a number is a change, and which way."""
        if numeral.unit == "px" and _ASIDE_OF.match(self.text, numeral.end):
            return "value", 0  # "had jumped 26 px to the right of the centre"
        if numeral.unit == "px" and _SLID.search(self.text, self.clause.start, numeral.start):
            return "either", 0
        before = [t for t in self.clause.tokens if t.kind in ("trend", "link") and t.end <= numeral.start]
        before = [t for t in before if not crossing(self.sentence, self.clause, t, numeral.start, numeral.end)]
        ratios = {t.start for t in self.clause.of("ratio")}
        trends = [
            t for t in before if t.kind == "trend" and t.value not in ("steady", "mixed") and t.start not in ratios
        ]
        sign = 0
        if trends:
            sign = 1 if trends[-1].value.endswith("up") else -1
        after = MORE_THAN.match(self.text, numeral.end) if self.language == "en" else None
        if after and (after["than"] or after["word"] not in ("above", "below", "up", "down")):
            return "change", -1 if after["word"] in _DOWN_WORDS else 1
        if (
            self.language == "zh"
            and (more := ZH_MORE.search(self.text[: numeral.start]))
            and self.clause.has("link", "than")
            and not (numeral.unit == "px" and self.clause.has("quantity", "centre"))  # "比中心低 49 像素"
        ):
            return "change", -1 if more.group()[0] in "低近窄慢少小短" else 1
        if self.language == "zh" and numeral.unit == "m" and (more := MORE_BY.search(self.text, 0, numeral.start)):
            return "change", -1 if more.group()[0] == "少" else 1
        if self._is_done(numeral):
            return "either", sign if numeral.unit != "deg" else 0
        links = [t for t in before if t.kind == "link" and numeral.start - t.end <= 14]
        if (
            links
            and links[-1].value in ("to", "from", "than")
            and not (self.language == "zh" and self._is_against_time())
        ):
            return "value", 0
        if (trends and self.text[trends[-1].end - 1] in "到至回") or (
            trends and self.text[: trends[-1].end].endswith(" from")
        ):
            return "value", 0
        if self._is_against_time() and self.clause.has("link", "than"):
            return "either", sign if numeral.unit != "deg" else 0
        if numeral.sign > 0 and numeral.unit in ("m", "mps"):
            return ("change", 1) if numeral.unit == "m" else ("either", 0)
        if self.is_per_step(numeral):
            return "change", sign if numeral.unit != "deg" else 0
        if numeral.unit == "mps" and trends and self.clause.has("quantity", "distance", "slant", "altitude", "height"):
            return "value", 0  # "the gap grows by 1 m every second"
        if self.turns(numeral):
            parts = [
                t for t in self.clause.of("time") if t.value not in ("now", "t0", "window", "since", "until", "mean")
            ]
            return ("either" if parts else "value"), 0
        if links and links[-1].value == "by" and self.language == "en":
            return ("change", sign) if trends else ("either", 0)
        reach = 22 if self.language == "en" else 7
        if trends and numeral.start - trends[-1].end <= reach and not self._is_placed(trends[-1], numeral):
            slopes = numeral.unit == "deg" and self.clause.has("quantity", "pitch", "depression")
            return ("either", 0) if slopes else ("change", sign)
        if self.clause.has("time", "last_step", "last_second") or self._is_done(numeral):
            return "either", 0
        return "value", 0

    def reached(self, numeral: Numeral) -> int:
        """Say which way a value was reached: "slowed to 1.2 m/s", "提速到 2.4 米/秒", EITHER_WAY for "leapt to"; 0 where that is not told."""
        if numeral.unit not in ("m", "mps", "px"):
            return 0
        trends = [t for t in self.clause.of("trend") if t.value.endswith(("up", "down")) and t.end <= numeral.start]
        if not trends or self.sentence.is_negated(self.clause, trends[-1]):
            return EITHER_WAY if _GOES_TO[self.language].search(self.text, self.clause.start, numeral.start) else 0
        last = trends[-1]
        ends = _UP_TO[self.language].fullmatch(self.text, last.start, numeral.start)
        return 0 if ends is None else 1 if last.value.endswith("up") else -1

    def is_from_to(self, a: Numeral, b: Numeral) -> bool:
        """Tell whether two numbers stand as the ends of one way, whatever else their clause holds: "从 0.7 米/秒增到 1.1 米/秒"."""
        return self.goes_from(a) and _FROM_TO[self.language][1].fullmatch(self.text, a.end, b.start) is not None

    def comes_by(self, numeral: Numeral) -> bool:
        """Tell whether a number is the change that leads to the next: "by 1.6 m to 17.7 m"."""
        return _COMES_BY.search(self.text, self.clause.start, numeral.start) is not None

    def goes_from(self, numeral: Numeral) -> bool:
        return _FROM_TO[self.language][0].search(self.text, self.clause.start, numeral.start) is not None

    def comes_after(self, now: Numeral, before: Numeral) -> bool:
        """ "1.1 m/s after the 6.4 m/s burst", but not "21 m after 2 m of climb"."""
        return _AFTER.fullmatch(self.text, now.end, before.start) is not None and not self.text.startswith(
            " of", before.end
        )

    def turned_by(self, numeral: Numeral) -> bool:
        """Tell whether an angle is how far something turned in the last step: "1.9 degrees in the final step"."""
        pattern = _IN_LAST_STEP[self.language]
        if self.language == "en":
            return pattern.match(self.text, numeral.end) is not None
        return pattern.search(self.text, self.clause.start, numeral.start) is not None

    def is_per_step(self, numeral: Numeral) -> bool:
        """Tell whether a number is told of each step: "0.5 m per step", "每半秒多 0.5 米", "every half second adds 1.8 m"."""
        if numeral.unit == "mps" or (self.language == "zh" and self.reached(numeral)):
            return False  # "1.1 m/s in every step", "逐帧回升到 21.6 米"
        before, after = _PER_STEP[self.language]
        if after is not None and after.match(self.text, numeral.end):
            return True
        return before.search(self.text, self.clause.start, numeral.start) is not None

    def _is_done(self, numeral: Numeral) -> bool:
        """ "掉了 5 米", "varies by no more than 0.3 m": a change, whatever the verb."""
        if self.language == "zh" and re.search(
            r"(?<![到至])了(?:约|大约|近|将近|差不多|整整|仅|有)?\s*$", self.text[: numeral.start]
        ):
            return numeral.unit in ("m", "px", "mps") or self.clause.has("quantity", "pitch")
        return bool(
            re.search(
                r"\b(?:chang|vari|within|spread|deviat|stray|wander)|变化|变动|波动|浮动|起伏|差异|相差",
                self.text[self.clause.start : numeral.start],
            )
        )

    def _is_against_time(self) -> bool:
        """ "lower than at t3", "比 t0 时偏右": a difference from another frame."""
        thans = self.clause.of("link", "than")
        return any(0 <= time.start - than.end <= 8 or 0 <= than.start - time.end <= 4 for than in thans for time, frames in times_of(self.clause) if frames != (NOW,))  # fmt: skip

    def _is_placed(self, trend: Token, numeral: Numeral) -> bool:
        """A change is not told by "rising at 2 m/s", "降低，约 20 米"."""
        between = self.text[trend.end : numeral.start]
        if self.language == "en":
            return bool(
                re.search(r"\b(?:at|to|from|near|with|is|of|than|and|around a|now|through|past|on|after)\b|=", between)
            )
        return bool(re.search(r"[到至为在是,从由于]|=", between)) or (
            numeral.unit == "mps" and trend.value.startswith("alt")
        )

    def turns(self, numeral: Numeral) -> bool:
        if numeral.unit != "deg":
            return False
        return self.clause.has("quantity", "yaw", "turn", "heading", "target_heading", "yaw_rate") or self.clause.has(
            "bend", "bend"
        )

    def is_partial(self) -> bool:
        """Tell whether a part of the window is named: a way is told from its start otherwise."""
        return self.clause.has("time", "last_step", "last_second", "last", "last_s") or any(
            frames not in ((0,), (0, 1), (NOW,)) for _, frames in times_of(self.clause)
        )
