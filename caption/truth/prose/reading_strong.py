"""Strong words of a clause as statements: standing or racing, changing or not, off the centre. No shade of meaning makes them true of the opposite.

They contradict in any wording, so little is taken for one: who or what is meant stands in the clause or is whom the sentence speaks of,
nothing denies, supposes or plans it, and the window must say the opposite by far (judging_strong.py).
"""

from __future__ import annotations

import re

from caption.truth.prose.clause_words import ClauseWords
from caption.truth.prose.cues import TREND_SERIES
from caption.truth.prose.lexicon import Token

_REST = {
    "en": re.compile(
        r"\b(?:standing|stands?|stood|stay(?:s|ing|ed)?|remain(?:s|ing|ed)?|sit(?:s|ting)?|hang(?:s|ing)?|hover(?:s|ing)?|wait(?:s|ing)?|is|are|was|now|practically|completely)"
        r" (?:(?:dead|quite|perfectly|stock|absolutely|completely|totally|put|there|rooted|now|about|entirely|parked|all but|practically|almost)\s+)*"
        r"(?:still(?! [\w#])|motionless|stationary|immobile|idle|waiting|in place|on the spot|to the spot|like a post|rooted|parked|at rest|quietly)\b"
        r"|\b(?:stand(?:s|ing)|sit(?:s|ting)) (?:\w+ )?still(?! (?:\w+er|more|less|#|left|right|to)\b)|\b(?:stock still|stands? (?:waiting|idle)|standing (?:idle|figure)|stays put|(?:come|came|comes) to a (?:complete|full|dead) (?:stop|halt)|sitting on an? )\b"
    ),
    "zh": re.compile(
        r"(?:站着|站住|站在原地|停在原地|悬在原地|原地|一动|一步)(?:没动|没有动|不动|未动|不走)|一动不动|静止不动|悬停不动|完全站定|忽然站定|静静?立|坐在|坐着|停在原地|站着没动|站住不动|停下来不走"
    ),
}
_RACE = {
    "en": re.compile(
        r"\b(?:racing|tearing along|tears along|dash(?:es|ing)|rushing|charging|hurtling|bolting|sprint(?:s|ing|ed|er)?|flat out|(?:at|in) full (?:speed|sprint|stretch|tilt|power|throttle|gallop)|hard run"
        r"|(?:at|with) (?:top|great|high|breakneck) speed|(?:breaks?|broken|breaking|broke) into a (?:hard |full )?(?:run|sprint)|on the run)\b"
    ),
    "zh": re.compile(
        r"狂奔|飞奔|疾奔|疾跑|猛跑|猛冲|冲刺|飞驰|疾驰|疾行|疾走|疾步|疾飞|全速|全力奔?跑|高速(?:前冲|飞行|前进|移动|奔跑)|大步(?:奔跑|快走|流星)|跑个不停|越跑越快"
    ),
}
_RUN = {
    "en": re.compile(
        r"\b(?:running|runs|ran|jogg(?:ing|ed)|jogs|trotting|trots)\b(?! out\b| low\b| short\b| high\b| at\b| down\b| parallel\b)"
    ),
    "zh": re.compile(r"奔跑|在跑|跑着|跑步前|小跑|慢跑|跑起来|跑了起来"),
}
_WALK = {
    "en": re.compile(
        r"\b(?:walk|strid|stroll|march|ambl|hurr|head|push)(?:s|es|ing|ies|ying) (?:\w+ ){0,2}?(?:on|off|away|along|ahead|past|briskly|quickly|fast|brisk)\b|\bbrisk (?:walk|pace)\b|\bon the move\b"
        r"|\b(?:has|have) (?:\w+ )?(?:moved (?:on|away|off|quite|a (?:good|long|fair)|several|many|some|considerably)|walked|covered)\b"
    ),
    "zh": re.compile(r"快走|快步|大步|匆匆|走个不停|往前走|向前走|继续(?:往前|向前)?走|一直在走|走动着|走远"),
}
# Who alone can do it.
_DOERS = {
    "en": (("target", re.compile(r"\b(?:stand|stood|sit|walk|run|jog|sprint|rooted|strid|stroll|trot)")), ("drone", re.compile(r"\b(?:hover|hang|throttle)"))),
    "zh": (("target", re.compile(r"站|坐|走|跑|步|奔|静立")), ("drone", re.compile(r"悬|飞"))),
}  # fmt: skip
_MUCH = r"(?:a lot|a great deal|a good deal|considerably|sharply|markedly|wildly|dramatically|substantially|strongly|by dozens|far|noticeably|constantly|all the time|enormously|greatly|hugely|plenty)"
# A change that nothing in its clause makes small.
_CHANGES_MUCH = {
    "en": re.compile(
        rf"\b(?:chang|var|shift|fluctuat|mov|deviat|turn|veer|swing|differ)\w* (?:\w+ ){{0,3}}?{_MUCH}\b|\bnever (?:once )?the same\b"
        r"|\bnever stops? \w+ing\b|\bkeeps? (?:on )?(?:changing|turning|shifting|moving|swinging)\b|\b(?:does not|never) stays?\b(?! (?:with|behind))"
        r"|\b(?:strong|brisk|marked|sharp|large|big|great|considerable) (?:change|changes|rotation|swing|shift)s?\b|\bnowhere near\b"
    ),
    "zh": re.compile(
        r"变化(?:很|极|非常|相当|十分|颇)?(?:大|剧烈|明显)|[变动转]得(?:很|相当|极|非常)?(?:厉害|快)|(?:不断|频频|接连|一直在?|始终在|没有一刻不在|每帧都在)(?:改变|变化|转动|转|晃|变|扭)|[变转晃动]个不停"
        r"|改了(?:不少|好几次|很多)|变了(?:很多|不少|一大截)|变过[一好两几]|一变再变|没有一[刻样帧][^,]{0,4}不变|大有变化|有很大变化|猛转|大幅(?:摆动|转动|变化)|没有一刻停"
    ),
}
# Any change at all.
_CHANGES = {
    "en": re.compile(
        r"\b(?:chang(?:e|es|ed|ing)|var(?:ies|ied)|fluctuates?|fluctuated|deviat(?:es|ed))\b(?! (?:to|into|the|a) )|\b(?:does|has|have|did) (?:moved?|turned?|shift(?:ed)?|budged?)\b"
        r"|\b(?:never|not|nor|n't|no longer)(?: \w+){0,2}? (?:the same|fixed|constant|steady|unchanged|at rest|unvarying|frozen|stable)\b|\b(?:does|do|did)(?: not|n't) (?:hold|keep|remain)\b|\bhas not (?:stayed|remained|come to rest)\b"
    ),
    "zh": re.compile(
        r"变化|改变|变了|变过|改了|改过|在变|并不(?:固定|恒定|稳定|平稳|一致)|不(?:固定|恒定|再是)|早已不是|(?:一直|始终)在(?:转|动)|转动过|动过"
    ),
}
_SMALL = {  # what makes a change small, or denies it
    "en": re.compile(
        r"\b(?:slight\w*|little|tiny|small|minor|hardly|barely|scarcely|minimal\w*|almost|nearly|practically|virtually|touch|bit|marginal\w*|negligible|tenths?|within|fraction|trace|hair|only|just|mere\w*|modest|degree|pixel|any|anything|nothing|none|gentl\w+|slow\w*|gradual\w*|no|less|few|without|neither|nor|zero)\b|#"
    ),
    "zh": re.compile(
        r"[微略稍]|小(?!时)|几乎|不大|很少|轻|一点|不到|以内|不足|仅|只|不超|缓|慢|渐|#|没有?(?!一[刻样帧])|无(?!人机)|零|未(?!能)|毫|大致|基本|尚"
    ),
}
_TURNS = {
    "en": re.compile(
        r"\b(?:turns?|turned|turning|veer(?:s|ed|ing)|deviat(?:es|ed)) (?:very )?(?:sharply|abruptly|hard)\b|\bdoes not (?:keep to|walk in|follow|hold) a straight\b|\b(?:zig ?zags?|chang(?:ed|es|ing) direction|changed course)\b"
    ),
    "zh": re.compile(
        r"拐了个?(?:急|大|弯)|接连(?:转弯|拐弯)|频频(?:转向|转弯)|不断(?:转弯|拐弯|变向)|走的(?:并)?不是直线|并非(?:笔直|直线)|急转弯"
    ),
}
_OFF_CENTRE = {
    "en": re.compile(
        r"\b(?:not|never|nowhere|no longer|isn't|anything but) (?:(?:yet|really|at all|quite|always|kept|keep|held|hold|sit|sits|stay|stayed|stays|lie|lies|be|is|been|remain|remained|the|its|box|once|anywhere|anything like|ever|properly|exactly|well|perfectly|near to) ){0,4}"
        r"(?:centred|centered|(?:in|on|at|near|close to) (?:the )?(?:(?:image|frame|picture|vertical|optical|very|dead|exact) )*(?:middle|cent(?:re|er)(?: line)?|midline|axis|cross ?hairs?)\b)"
        r"|\b(?:left|strayed from|wandered off|moved off|moved away from|drifted off|drifted from|slipped from|slipped off|away from|out of|far from) (?:the )?(?:image |frame |picture |vertical )*(?:middle|cent(?:re|er)(?: line)?|midline|axis)\b"
        r"|\b(?:far|well|way|clearly|badly|dozens of pixels|always|long|plainly|much) off (?:the )?(?:image |frame |picture )*(?:middle|cent(?:re|er)(?: line)?|axis)\b"
        r"|\b(?:large|big|marked|clear|considerable|strong) (?:lateral|sideways|horizontal) (?:offset|error|deviation)\b"
    ),
    "zh": re.compile(
        r"(?:并?不|没有|没|从未|没能|未能|早已不|已不|不再|远没有|未)(?:再|能)?(?:保持|始终|一直)?(?:居中|对准|对正|(?:在|处于|位于|落在)(?:画面|图像)?(?:的)?(?:正)?(?:中央|中心|中间))|(?:离开|挪出|偏出|移出|跑出|脱离|远离)了?(?:画面|图像)?的?(?:正)?(?:中心|中央|中线)"
        r"|偏离(?:了)?(?:画面|图像)?(?:正)?(?:中心|中央)?(?:很远|很多|不少)|(?:有|存在|出现)(?:了)?(?:很大|明显|较大|不小)的?(?:横向)?(?:偏差|偏移)"
    ),
}
_CHANGING = {
    "yaw": ("yaw",), "height": ("altitude", "box_height"), "centre": ("offset_x", "offset_y"), "speed": ("speed", "target_speed"), "bearing": ("bearing",),
    "pitch": ("pitch", "depression"), "depression": ("pitch", "depression"), "box": ("box_height", "box_width", "offset_x", "offset_y"),
}  # fmt: skip
_WAY = {"en": re.compile(r"\b(?:direction|course|path|line|way)\b"), "zh": re.compile(r"方向|走向|路线|去向")}
_DENIES = {
    "en": re.compile(
        r"\b(?:not|no|never|n't|without|neither|nor|hardly|barely|nothing|if|unless|should|would|could|might|may|than|instead|rather|as if|anything but|enough|nearly|almost|stops?|stopped|to (?:keep|avoid|stop))\b|n't\b"
    ),
    "zh": re.compile(
        r"不(?!断)|没|无(?!人机)|未|别|若|如果|先(?!生)|此前|之前|曾|几乎|似|像|再|免|而非|反而|后再|差点|接近|将|要"
    ),
}
_DONE = {
    "en": re.compile(r"\b(?:is|are|has|have|was|were|keeps|kept|hangs|hovers|now|still|remains)\b|'s\b|'re\b"),
    "zh": re.compile(r"正|还在|仍|已|却|着|了|在"),
}


class StrongReader(ClauseWords):
    """Reads the strong words of one clause."""

    def read(self) -> None:
        if self.is_plan or self.in_scene or self.text.endswith("?"):
            return
        self._motion(_REST, "rest")
        self._motion(_RACE, "race")
        self._motion(_RUN, "run")
        self._motion(_WALK, "walk")
        self._extent()
        self._off_centre()

    def _match(self, table: dict[str, re.Pattern[str]]) -> Token | None:
        """Find words that nothing before them in their clause denies or supposes."""
        match = table[self.language].search(self.text, self.clause.start, self.clause.end)
        if match is None or self.clause.is_blocked(match.start()):
            return None
        token = Token("strong", match.group(), match.start(), match.end())
        if self.sentence.is_negated(self.clause, token):
            return None
        denied = _DENIES[self.language].search(self.text, self.clause.start, match.start())
        return None if denied else token

    # --- who stands and who races ------------------------------------------------------------------------------------

    def _motion(self, table: dict[str, re.Pattern[str]], word: str) -> None:
        token = self._match(table)
        if token is None:
            return
        owner = self._mover(token)
        if not owner or (self.is_reasoning and owner == "drone" and not self._is_told(token)):
            return
        if self.clause.has("who", "scene") and owner != next(
            (t.value for t in self.clause.of("who") if t.end <= token.start), ""
        ):
            return
        names = ("speed",) if owner == "drone" else ("target_speed",)
        self._add(token, kind="motion", names=names, word=word, frames=self._told_moment(token))

    def _mover(self, token: Token) -> str:
        """Say who moves: whom the verb allows of those whom the clause names before it, or the one of the clauses before it."""
        word = self.text[token.start : token.end]
        alone = next((who for who, verbs in _DOERS[self.language] if verbs.search(word)), "")
        named = [t for t in self.clause.of("who", "drone", "target") if not token.start <= t.start < token.end]
        before = [t.value for t in named if t.end <= token.start]
        if alone and named:
            return alone if alone in before or (named[0].start - token.end <= 3 and named[0].value == alone) else ""
        if before:
            return before[-1]
        if named:
            return named[0].value if named[0].start - token.end <= 3 else ""  # "the running figure"
        if self.context.is_carried and self.context.subject != alone:
            return ""
        earlier = set(self.context.people) or {self.context.subject}
        if alone:
            return alone if alone in earlier else ""
        return earlier.pop() if len(earlier) == 1 else ""

    def _is_told(self, token: Token) -> bool:
        return _DONE[self.language].search(self.text, self.clause.start, token.end) is not None and not self.clause.has(
            "modality", "thus"
        )

    # --- what changes ------------------------------------------------------------------------------------------------

    def _extent(self) -> None:
        token = self._match(_TURNS)
        if token is not None and self._mover(token) == "target":
            self._add(token, kind="extent", names=("target_heading",), frames=None)
            return
        token = self._match(_CHANGES_MUCH)
        if token is None:
            match = _CHANGES[self.language].search(self.text, self.clause.start, self.clause.end)
            if match is None or self.clause.is_blocked(match.start()) or self._is_small(match):
                return
            token = Token("strong", match.group(), match.start(), match.end())
        names = self._changing(token)
        if names:
            self._add(token, kind="extent", names=names, frames=None)

    def _is_small(self, match: re.Match[str]) -> bool:
        """Tell whether something in its clause makes a change small or denies it, the word itself aside."""
        text, clause, pattern = self.text, self.clause, _SMALL[self.language]
        if pattern.search(text, clause.start, match.start()) or pattern.search(text, match.end(), clause.end):
            return True
        token = Token("strong", match.group(), match.start(), match.end())
        return (
            self.sentence.is_negated(clause, token)
            or _DENIES[self.language].search(text, clause.start, match.start()) is not None
        )

    def _changing(self, token: Token) -> tuple[str, ...]:
        """Give what may be said to change: what the clause names before the word."""
        cues = [t for t in self.clause.of("quantity") if t.start < token.start]
        if self.clause.has("compare"):
            return ()
        if not cues:
            way = _WAY[self.language].search(self.text, self.clause.start, token.start)
            return ("target_heading",) if way and self._mover(token) == "target" else ()
        cue = cues[-1].value
        people = {t.value for t in self.clause.of("who", "drone", "target")}
        if cue in ("heading", "target_heading", "turn"):
            return {"target": ("target_heading",), "drone": ("yaw",)}.get("".join(people), ("target_heading", "yaw"))
        return _CHANGING.get(cue) or TREND_SERIES.get(cue, ())

    # --- the picture -------------------------------------------------------------------------------------------------

    def _off_centre(self) -> None:
        match = _OFF_CENTRE[self.language].search(self.text, self.clause.start, self.clause.end)
        if match is None or self.clause.is_blocked(match.start()):
            return
        if _DENIES[self.language].search(self.text, self.clause.start, match.start()):
            return
        if self.clause.has("who", "scene") or any(self.sentence.numerals[i].unit == "px" for i in self.clause.numerals):
            return
        token = Token("strong", match.group(), match.start(), match.end())
        self._add(token, kind="framing", frames=self._told_moment(token))
