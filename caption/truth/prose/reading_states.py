"""What the target and the drone do, whether the target is seen, and where it stands in the picture, as statements."""

from __future__ import annotations

import re

from caption.truth.prose.clause_words import ClauseWords
from caption.truth.prose.cues import times_of
from caption.truth.prose.lexicon import Token

_UNSURE = {
    "en": re.compile(
        r"\b(?:after|following|brief|briefly|once|until|till|since|again|had|before|momentar\w+|temporar\w+|dropout|earlier)\b"
    ),
    "zh": re.compile(r"后|短暂|曾|直到|自|起|一度|之前|此前|先|又"),
}
_RUNNING = re.compile(r"\b(?:run|running|jog|jogs|jogging|sprint|sprinting|sprints|sprinted|rushing)\b|跑|奔")
_NONE_OF = re.compile(
    r"\b(?:none|not one) of the\b|\bnothing in the (?:picture|frame|image|view) (?:is|has|calls|needs|moves|changes)\b"
)
_FRAMES_OF = re.compile(
    r"\b(?:one|two|three|four|#) frames? of (?!the\b)\w+, "
)  # "two frames of occlusion, one of partial cover"
_OF_A_THING = re.compile(r"(?:方向|高度|航向|机头|距离|位置|角度)[^,;]{0,3}$")  # "方向也没动"
_AFTER_A_MOMENT = re.compile(
    r"\band then (?:stop|stood|halt|paus|rest)\w*|\bafter (?:the |that )?(?:first|second|third|fourth|t\d)\b"
)
_IDIOM = re.compile(
    r"\s+(?:out of|out|low|late|short|high|hot|parallel|in parallel|smoothly)\b"
)  # "running out of room"
_COMPARED = re.compile(r"\b(?:\w+er|more|less) $")
_STILL = ("standing still", "motionless", "stationary", "standstill", "immobile", "站着", "站立", "站定", "原地不动")
_EVERY = tuple(range(32))  # frame of the longest window
_ALWAYS = {
    "en": re.compile(r"\b(?:throughout|always|all along|all the time|(?:in |for )?(?:all|each of the) five|(?:in )?every (?:single )?frame|the (?:whole|entire) (?:time|window))\b"),
    "zh": re.compile(r"一直|始终|全程|五帧(?:里|中|内|都|均|全)|每一?帧都?"),
}  # fmt: skip
_WHILE = {
    "en": re.compile(r"\b(?:while|when|where|whilst|if) (?=visible|in view|in sight|seen|hidden)"),
    "zh": re.compile(r"(?:可见|看得见|看得到)(?:时|的时候|期间|之时)"),
}
_CENTRED = {
    "en": re.compile(r"\b(?:centred|centered|dead cent(?:re|er)|middle|in the cent(?:re|er)|at the cent(?:re|er)|mid frame|on cent(?:re|er)|on the cross ?hairs?|crosshairs?|midpoint|near the (?:image |frame |picture )?cent(?:re|er)|close to the (?:image |frame |picture )?cent(?:re|er))\b"),
    "zh": re.compile(r"居中|正中|中央|中间|中心"),
}  # fmt: skip
_FAR_OFF = {
    "en": re.compile(r"\b(?:off[ -]cent(?:re|er)|(?:well|far|way|clearly|badly) off (?:to one side|the (?:axis|crosshairs?|cent(?:re|er)|middle))|far from the (?:cent(?:re|er)|middle|crosshairs?))\b"),
    "zh": re.compile(r"(?:远离|偏离|偏出|明显离开|不在)(?:了)?(?:画面|图像)?(?:中心|中央|正中|十字线|准星)"),
}  # fmt: skip
_OFF = {
    "en": re.compile(r"\b(?:off|from|of|away from|left|right|above|below|to) (?:the )?(?:image |frame |picture |screen )?(?:cent(?:re|er)|middle)|re ?cent"),
    "zh": re.compile(r"(?:偏离|离开|远离|距|偏出|脱离|离|回到|回|向|自|从|相对)[^,]{0,4}(?:中心|中央|正中|中间)|(?:中心|中央|正中|中线|正中央)(?:点|线|的)?(?:附近)?(?:稍|略|偏|的|以|约|之)*(?:左|右|上|下|偏)|重新居中|再居中|中间的|中间帧"),
}  # fmt: skip


class StateReader(ClauseWords):
    """Reads visibility, states, bends and centring of one clause."""

    def read(self) -> None:
        for token in self.clause.tokens:
            if token.kind not in ("visibility", "state"):
                continue
            if self.clause.is_blocked(token.start):
                self.left_out = True
            elif token.kind == "visibility":
                self._visibility(token)
            elif token.value in ("turning", "straight"):
                self._bend(token)
            else:
                self._state(token)
        self._centre()

    def _visibility(self, token: Token) -> None:
        word = token.value
        text = self.text[token.start : token.end]
        after = self.text[token.end : token.end + 14]
        if text in ("lost", "covered", "lose") and re.match(
            r"\s*(?:about |roughly |some |a |only |just |another )?[#\d]|\s*(?:height|altitude|speed|two|three|four|more|less|twice|half|as much|the (?:first|second|third|fourth|last)|ground|the ground|the distance|some|a (?:distance|way|lot|bit|little|few))\b",
            after,
        ):
            return
        if (
            text in ("partial", "partially", "partly", "部分", "局部", "一部分", "fully", "完整", "畅通")
            and not self._is_sight()
        ):
            return
        if text == "可见" and token.start == self.clause.start and self.clause.end - token.end >= 4:
            return  # "it can be seen that"
        if _NONE_OF.search(self.text, self.clause.start, self.clause.end):
            self.left_out = True
            return
        if self.is_plan or ((self.in_scene and not self.clause.has("who", "target")) and not self._is_sight()):
            self.left_out = self.left_out or self.is_plan
            return
        if _WHILE[self.language].search(self.text[max(0, token.start - 6) : token.end + 4]):
            return  # "while visible"
        if re.search(r"\b(?:one|you) (?:can|could|sees?)|what one\b", self.text[self.clause.start : self.clause.end]):
            return  # of anybody
        if self._owner(token) == "drone" and not self._is_sight():
            return
        measured = self.clause.has(
            "quantity", "yaw", "turn", "speed", "distance", "slant", "altitude", "height", "over", "yaw_rate", "heading"
        )
        if measured and re.search(r"vanish|disappear|lost|missing|blind|gone|fade|消失|丢|covered|screened", text):
            return
        if word == "hidden" and (self.clause.has("visibility", "partly") or self._hides_nothing(token)):
            return
        if text in ("covered", "missing") and not self.clause.has("who", "target"):
            return
        negated = self.sentence.is_negated(self.clause, token)
        if negated and word == "partly":
            self.left_out = True
            return
        if negated and word in ("visible", "full") and (before := self._negation_before(token)) is not None:
            token = Token(token.kind, "hidden", before.start, token.end)  # "not visible", "nothing in sight"
            word, negated = "hidden" if word == "visible" else word, word != "visible"
        if negated and text.startswith(("no ", "not ", "without", "无", "没", "未", "毫", "nothing", "不")):
            negated = False
        numerals = [self.sentence.numerals[i] for i in self.clause.numerals]
        named = [t for t, _ in times_of(self.clause)]  # "第二帧" is no count
        counted = any(n.unit == "frames" and not any(t.start <= n.start < t.end for t in named) for n in numerals)
        counted = (
            counted
            or _FRAMES_OF.search(self.text) is not None
            or "连续第" in self.text[self.clause.start : self.clause.end]
        )
        spans = [t for t in self.clause.of("time") if t.value.startswith(("last:", "first:"))]
        part = self.text[self.clause.start : self.clause.end]
        spans += [t for t in self.clause.of("time", "since") if times_of(self.clause)]
        is_one = {t.value for t in self.clause.of("visibility")} == {"hidden", "partly"}  # "partly", "hidden"
        many = len({t.start for t in self.clause.of("visibility")}) > 1 and bool(times_of(self.clause)) and not is_one
        loose = many or (not spans and (counted or _UNSURE[self.language].search(part) is not None))
        frames = None if loose else self._frames(token)
        if frames is None and not negated and _ALWAYS[self.language].search(part):
            frames = _EVERY
        self._add(token, kind="visibility", word=word, negated=negated, frames=frames)

    def _negation_before(self, token: Token) -> Token | None:
        """Give the negation that stands right before a word."""
        for one in self.clause.of("negation", "turn"):
            if one.end <= token.start and self.text[one.end : token.start].strip() in ("", "to be", "be", "in"):
                return one
        return None

    def _hides_nothing(self, token: Token) -> bool:
        return re.match(r"\s*(?:nothing|none|no\b|neither)", self.text[token.end :]) is not None

    def _is_sight(self) -> bool:
        if self.clause.has("who", "target") or self.context.subject == "target":
            return True
        return bool(
            re.search(
                r"\b(?:view|sight|visual|contact|seen|visibility|track|visible|cover)\b|视线|可见|视野|遮",
                self.text[self.clause.start : self.clause.end],
            )
        )

    def _state(self, token: Token) -> None:
        owner = self._doer(token)
        is_target = token.value in ("standing", "walking")
        told = any(
            self.sentence.numerals[i].unit in ("m", "mps") for i in self.clause.numerals
        )  # the number says it better
        if token.value == "walking" and self.clause.has("trend", "pace_down"):
            return  # "slower and slower", until he stands
        if self.is_plan or owner != ("target" if is_target else "drone") or self.in_scene:
            return
        if (
            told
            and token.value in ("walking", "hovering", "flying")
            and not _RUNNING.search(self.text, token.start, token.end)
        ):
            return
        text = self.text[token.start : token.end]
        if text == "still" and _COMPARED.search(self.text, 0, token.start):
            return  # "slower still"
        if text in ("still", "stand", "stands", "static", "flat") and not re.match(
            r"\s*(?:$|[,.;])", self.text[token.end : token.end + 10]
        ):
            return
        if (
            self.clause.has("quantity", "pitch", "yaw", "altitude", "distance", "box")
            and token.value == "standing"
            and text not in _STILL
        ):
            return
        barely = (
            re.search(r"(?:hardly|barely|scarcely) $|几乎(?:不|没)?(?:怎么)?$", self.text[: token.start]) is not None
        )
        if barely:
            return
        if _IDIOM.match(self.text, token.end) or _OF_A_THING.search(self.text, self.clause.start, token.start):
            return
        running = _RUNNING.search(text) is not None
        is_after = _AFTER_A_MOMENT.search(self.text, self.clause.start, self.clause.end)
        frames = None if is_after or (told and token.value == "standing") else self._frames(token)
        word = "running" if running else token.value
        self._add(token, kind="state", word=word, negated=self.sentence.is_negated(self.clause, token), frames=frames)

    def _doer(self, token: Token) -> str:
        """Say who does something: the one named last before it in its clause, else of whom the sentence speaks."""
        named = [
            t
            for t in self.clause.of("who", "drone", "target")
            if t.end <= token.start and self.text[t.start : t.end] not in ("them", "him", "us", "me")
        ]
        if named:
            return named[-1].value
        return self._owner(token)

    def _bend(self, token: Token) -> None:
        """ "keeps turning", "walks dead straight": of the target, where no side and no angle says it better."""
        if self.is_plan or self.in_scene or self._owner(token) != "target" or self.clause.has("side"):
            return
        if any(self.sentence.numerals[i].unit == "deg" for i in self.clause.numerals) or self.clause.has(
            "quantity", "yaw"
        ):
            return
        self._add(
            token, kind="state", word=token.value, negated=self.sentence.is_negated(self.clause, token), frames=None
        )

    def _centre(self) -> None:
        part = self.text[self.clause.start : self.clause.end]
        match = _CENTRED[self.language].search(part) or _FAR_OFF[self.language].search(part)
        if match is None or self.is_plan or (self.in_scene and not self.clause.has("who", "target")):
            return
        off = _FAR_OFF[self.language].search(part)
        if (
            off is not None
            and not self.clause.has("side", "left", "right")
            and not self.clause.has("negation", "turn")
            and not self.clause.numerals
        ):
            token = Token("quantity", "centre", self.clause.start + off.start(), self.clause.start + off.end())
            if self.clause.has("who", "target") or self.context.subject == "target":
                self._add(token, kind="centre", word="off", frames=self._frames(token))
            return
        if _OFF[self.language].search(part) or self.clause.is_blocked(self.clause.start + match.start()):
            return
        if self.clause.has("side") or any(self.sentence.numerals[i].unit == "px" for i in self.clause.numerals):
            return
        token = Token("quantity", "centre", self.clause.start + match.start(), self.clause.start + match.end())
        if not self.sentence.is_negated(self.clause, token):
            self._add(token, kind="centre", frames=self._frames(token))
