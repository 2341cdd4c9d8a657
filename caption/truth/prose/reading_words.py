"""Sides, trends and comparisons of a clause as statements."""

from __future__ import annotations

import re

from caption.truth.prose.clause_words import ClauseWords
from caption.truth.prose.cues import OVERALL, TREND_SERIES, crossing, gap, times_of
from caption.truth.prose.lexicon import Token
from caption.truth.prose.reading_comparisons import compared_speeds
from caption.truth.prose.reading_ratios import ratio_word
from caption.truth.prose.statements import NOW

_HARDLY = re.compile(r"\b(?:hardly|barely|scarcely) (?:\w+ )?$|几乎(?:没有|没|不|未)?(?:怎么)?$")
_BEFOREHAND = re.compile(r"\b(?:after|before|following|despite) $")  # "has opened to 21.7 m after dipping"
_TAKES_OBJECT = re.compile(r"cut|reduc|shrink|shorten|widen")
_OBJECT = re.compile(r" (?:the |its |our |their |his |her )?")  # "cut the distance"
_SIGHT = ("line of sight", "sight line", "视线", "3d", "diagonal")  # lengths where a number follows; they do not grow
_BACK = re.compile(r"\b(?:is|are|keeps) (?:\w+ )?(?:back|return\w*|unwind\w*)|正[^#,]{0,5}回")
_MUCH = {
    "en": re.compile(r"\b(?:much|far|clearly|way|considerably|significantly|substantially|a lot|a good bit|a good deal|by a wide margin|easily|markedly|decidedly)\b"),
    "zh": re.compile(r"远|明显|得多|大大|显著|不少|很多|一大截|大幅|数倍"),
}  # fmt: skip
_VERTICAL = {"alt_up": 1, "alt_down": -1}
_PACE = {"pace_up": 1, "pace_down": -1}
_APART = {"dist_up": 1, "dist_down": -1}
_LEADS = ("", "from", "to", "by", "从", "到", "至", "由", "了")  # between a word of change and its number


_FURTHER = re.compile(r"(?:further|farther) (?:under|below|beneath|above|down|up|left|right|along|into|to the)\b")
_BESIDE = re.compile(r"[侧方]")
_NO_CHANGE = re.compile(
    r"cut(?:s|ting)? (?:across|through|in|into)\b|up (?:at|here|there)\b|gain per\b|slid(?:es?|ing)? (?:along|over|across|beside)\b|jump\w* (?:back )?from (?:\w+ )?#(?:\.#)? px|slow (?:pan|turn|climb|descent|yaw|sweep|drift|pass|approach|walk|pace|orbit|circle|arc)\b"
)
_GOES = re.compile(
    r"\b(?:walk|head|mov|mak|go|run|stroll)(?:s|es|ing)\b|走|远去|离去|行进|前行|横穿|穿过|移动|横过|跑去"
)
_AT_A_SPEED = re.compile(
    r"\s*at (?:(?:about|roughly|some|just|only) )?#"
)  # "he approaches at 1.2 m/s": the way that he goes
_THAT_WAY = re.compile(r"\b(?:down|up|left|right|round|over) $")  # "tips down further"
_PIXELS_OF = re.compile(r"\b(?:px|pixels?) (?:of|in) height\b")
_SIZE = re.compile(r"\b(?:bigger|larger|smaller)\b|[大小]$")


class WordReader(ClauseWords):
    """Reads the words of one clause."""

    def read(self, used_sides: set[Token]) -> None:
        self._comparisons()
        for token in self.clause.tokens:
            if token.kind in ("trend", "side") and self.clause.is_blocked(token.start):
                self.left_out = True
            elif token.kind == "trend":
                self._trend(token)
            elif token.kind == "side" and token not in used_sides:
                self._side(token)
            elif token.kind == "ratio" and not self.clause.is_blocked(token.start):
                self.statements += ratio_word(self.sentence, self.clause, self.context, token, in_scene=self.in_scene)

    def _is_hedge(self, token: Token) -> bool:
        """ "接近三倍", "down to about 3 m": the word belongs to the number after it."""
        same = any((t.start, t.end) == (token.start, token.end) for t in self.clause.of("hedge"))
        marks = [self.sentence.numerals[i].start for i in self.clause.numerals] + [
            t.start for t in self.clause.of("ratio")
        ]
        return same and any(0 <= mark - token.end <= 3 for mark in marks)

    # --- trends ------------------------------------------------------------------------------------------------------

    def _trend(self, token: Token) -> None:
        if self.is_plan or (self.in_scene and not self.clause.has("quantity")):
            self.left_out = self.left_out or not self.in_scene
            return
        names = () if self._is_hedge(token) else self._trend_names(token)
        if (
            not names
            or _NO_CHANGE.match(self.text, token.start)
            or (token.value in ("up", "down") and self._is_of_speeds(token, names))
        ):
            return
        if _HARDLY.search(self.text[: token.start]) or _BEFOREHAND.search(self.text, self.clause.start, token.start):
            self.left_out = True
            return
        negated = self.sentence.is_negated(self.clause, token)
        if token.value in ("steady", "mixed", "changing"):
            compared = any((t.start, t.end) == (token.start, token.end) for t in self.clause.of("compare"))
            if not negated and not (compared and (self.clause.has("link", "than") or len(self.clause.of("who")) > 1)):
                self._add(token, kind=token.value, names=names, frames=self._frames(token))
            return
        if self._compares(token) or re.search(r"\b(?:an?|any|some) $", self.text[: token.start]):
            return
        sign = 1 if token.value.endswith("up") else -1
        self._add(
            token,
            kind="trend",
            names=names,
            trend=sign,
            negated=negated,
            span=self._trend_span(),
            frames=self._trend_frames(token),
            is_named=self.clause.has("quantity"),
        )

    def _is_of_speeds(self, token: Token, names: tuple[str, ...]) -> bool:
        """Tell whether speeds stand right behind a word for another quantity's course: "jumped from 1 to 5 m/s and lost height"."""
        behind = [
            n
            for n in self.sentence.numerals
            if n.start >= token.end and self.text[token.end : n.start].strip(" ") in _LEADS
        ]
        return bool(behind) and behind[0].unit == "mps" and not any("speed" in name for name in names)

    def _compares(self, token: Token) -> bool:
        """ "lower than at t3" is a difference, "faster than the walker" a comparison: neither is a trend."""
        after = self.text[token.end : token.end + 8]
        if self.language == "en":
            return after.lstrip().startswith(("than", "now than")) or (
                self.text[token.start : token.end] in ("higher", "lower") and self.is_plan
            )
        return self.clause.has("link", "than") and token.end - token.start <= 2

    def _trend_names(self, token: Token) -> tuple[str, ...]:
        value = token.value
        nearest = self._cue(token)
        if (
            nearest == "altitude"
            and self.language == "zh"
            and not self.clause.has("who", "drone")
            and self._speaks_of_box()
        ):
            nearest = "height"
        if value in ("up", "down") and self._is_of_size(token):
            nearest = "box"
        if value in _PACE:
            return self._speed_names(token)
        same = [t for t in self.clause.of("trend") if t.start == token.start and t.end == token.end]
        if value in _VERTICAL:
            if nearest not in ("", "altitude", "height", "yaw", "turn", "centre") and (
                len(same) > 1 or nearest in ("over", "pitch")
            ):
                return ()
            if nearest == "speed" and self.clause.has("quantity", "speed"):
                return self._speed_names(token)  # "the drone's speed climbs"
            is_taller = _PIXELS_OF.search(self.text, token.end, self.clause.end)  # "loses just a few pixels of height"
            return () if is_taller or self._owner(token) == "target" else ("altitude",)
        if len(same) > 1 and any(t.value in _VERTICAL for t in same) and self._is_of_flier():
            return ()  # of nothing that its clause names: also a climb
        if value in _APART:
            if (
                _FURTHER.match(self.text, token.start)
                or _THAT_WAY.search(self.text, self.clause.start, token.start)
                or self.clause.has("quantity", "centre")
                or self.clause.has("who", "scene")
                or _AT_A_SPEED.match(self.text, token.end)
                or self._nears_something(token)
            ):
                return ()
            return ("distance", "slant")
        if nearest == "speed":
            return self._speed_names(token)
        if nearest == "height":
            return ("box_height",) if self._speaks_of_box() else ("altitude",)
        return TREND_SERIES.get(nearest, ())

    def _is_of_flier(self) -> bool:
        """Tell whether a clause names the drone and no quantity: "无人机却在抬高"."""
        return self.clause.has("who", "drone") and not self.clause.has("quantity")

    def _is_of_size(self, token: Token) -> bool:
        """ "the walker gets smaller", "她越来越小": of a person whose clause names no quantity, the size in the picture."""
        is_size = _SIZE.search(self.text, token.start, token.end) is not None
        return is_size and self.clause.has("who", "target") and not self.clause.has("quantity")

    def _nears_something(self, token: Token) -> bool:
        rest = self.text[token.end : self.clause.end].strip(" ，。,.")
        return self.language == "zh" and len(rest) > 2 and not self.clause.has("who", "target", "drone")

    def _speaks_of_box(self) -> bool:
        return self.clause.has("quantity", "box") or self.context.cue in ("box", "tall", "width")

    def _speed_names(self, token: Token) -> tuple[str, ...]:
        owner = self._owner(token)
        if self.context.is_carried and not self.clause.has("who", "drone", "target"):
            return ("speed", "target_speed")
        return ("speed",) if owner == "drone" else ("target_speed",) if owner == "target" else ()

    def _cue(self, token: Token) -> str:
        """Give the quantity that a trend word belongs to: the nearest one, before it rather than after."""
        ranked = []
        for cue in self.clause.of("quantity"):
            if (cue.start, cue.end) == (token.start, token.end) or self.text[cue.start : cue.end] in _SIGHT:
                continue
            if cue.value in TREND_SERIES or cue.value in (
                "speed",
                "height",
                "yaw",
                "turn",
                "centre",
                "yaw_rate",
                "heading",
                "target_heading",
            ):
                cost = gap(cue, token.start, token.end) + 10 * crossing(
                    self.sentence, self.clause, cue, token.start, token.end
                )
                if _TAKES_OBJECT.match(self.text, token.start) and _OBJECT.fullmatch(self.text, token.end, cue.start):
                    cost = 0
                ranked.append((cost, -(cue.end - cue.start), cue.value))
        if ranked:
            return min(ranked)[2]
        if any((t.start, t.end) != (token.start, token.end) for t in self.clause.of("quantity")):
            return ""  # of what its own clause names, not of what was spoken of before
        word = self.text[token.start : token.end]
        if (
            self.language == "en"
            and word.endswith("er")
            and not re.search(
                r"\b(?:is|are|gets?|getting|got|becomes?|became|become|appears?|looks?|grows?|grown|grew|now|even|ever)\b[^#]{0,20}$",
                self.text[self.clause.start : token.start],
            )
        ):
            return ""
        if token.start - self.clause.start > (30 if self.language == "en" else 10):
            return ""
        if self.context.told and token.value == ("down" if self.context.told_way > 0 else "up"):
            return ""  # "is gathering speed and dropping": goes the other way, so it is something else
        return self.context.told or self.context.cue

    def _trend_frames(self, token: Token) -> tuple[int, ...] | None:
        if self.clause.has("time", "now") or (
            self.language == "en" and re.search(r"\b(?:has|have|is|are)\b", self.text[self.clause.start : token.start])
        ):
            return (NOW,)
        is_past = (
            self.clause.has("time", "past", "until", "start", "prev1", "prev2", "max", "min")
            or self.context.has_past
            or (self.language == "zh" and self.context.has_frame)  # no tense tells that it is still that frame's
        )
        return None if is_past or times_of(self.clause) else (NOW,)

    # --- sides -------------------------------------------------------------------------------------------------------

    def _side(self, token: Token) -> None:
        if self.is_plan or token.value in ("above", "below"):
            self.left_out = self.left_out or self.is_plan
            return
        owner = self._owner(token)
        scene = [gap(t, token.start, token.end) for t in self.clause.of("who", "scene")]
        people = [gap(t, token.start, token.end) for t in self.clause.of("who", "target", "drone")]
        if scene and (not people or min(scene) <= min(people)):
            return
        if self.clause.has("move") or self.sentence.is_negated(self.clause, token):
            self.left_out = True
            return
        topic = self._topic(token, owner)
        sign = 1 if token.value in ("left", "ccw") else -1
        names = {
            "yaw": ("yaw",),
            "either": ("yaw", "target_turn"),
            "bend": ("target_turn", "target_heading"),
            "offset": ("offset_x",),
            "bearing": ("bearing",),
        }.get(topic)
        if names is None or self._is_of_way(token, topic):
            self.left_out = True
            return
        frames = self._frames(token)
        told = self.text[self.clause.start : token.start]
        if topic == "bend" and (
            re.search(r"\b(?:has|have|had)\b|已", told) or OVERALL.search(self.text, self.clause.start)
        ):
            frames = None  # the whole window's turn
        is_hedged = topic == "bend" and self.clause.has("modality", "likely")
        span = self._trend_span() if topic == "yaw" else None
        if topic == "yaw" and span is None and _BACK.search(self.text, self.clause.start, token.end + 6):
            span = (-2, NOW)  # "is coming back to the right"
        self._add(
            token,
            kind="side",
            names=names,
            side=sign,
            frames=frames,
            span=span,
            word="likely" if is_hedged else "",
        )

    def _is_of_way(self, token: Token, topic: str) -> bool:
        """Tell whether a side of the nose is where somebody goes or stands: "走向机头右侧", "walks off to the left of our heading"."""
        if topic == "yaw":
            return self.clause.has("who", "target") or _BESIDE.search(self.text, token.start, token.end + 1) is not None
        return (
            topic in ("bearing", "offset") and _GOES.search(self.text, self.clause.start, self.clause.end) is not None
        )

    def _topic(self, token: Token, owner: str) -> str:
        ranked = []
        for cue in self.clause.tokens:
            topic = self._topic_of(cue, owner)
            if topic:
                ranked.append((gap(cue, token.start, token.end), topic))
        if token.value in ("cw", "ccw") and not ranked:
            return "yaw"
        if any(topic == "yaw" for _, topic in ranked) and not any(
            topic in ("offset", "bearing") for _, topic in ranked
        ):
            return "yaw"
        if ranked:
            topics = {topic for cost, topic in ranked if cost <= min(ranked)[0] + 3}
            return min(ranked)[1] if len(topics) == 1 or token.value in ("left", "right") else ""
        text = self.text[token.start : token.end]
        if "转" in text or "旋" in text or "摆" in text or text.endswith(" turn"):
            if not self.clause.has("who", "drone", "target"):
                return "either"
            return "yaw" if owner == "drone" else "bend" if owner == "target" else ""
        if "拐" in text or "弯" in text or text.endswith(" bend"):
            return "bend" if owner != "drone" else ""
        if text.startswith("偏") or text.endswith("偏"):
            return "offset" if owner != "drone" else ""
        return ""

    def _topic_of(self, cue: Token, owner: str) -> str:
        match cue.kind, cue.value:
            case "quantity", "yaw":
                return "yaw"
            case "quantity", "turn" | "heading" | "yaw_rate":
                named = self.clause.has("who", "drone", "target")
                return "bend" if owner == "target" and named else "yaw" if owner == "drone" and named else "either"
            case "quantity", "target_heading":
                return "bend"
            case "quantity", "centre":
                return "offset"
            case "quantity", "bearing":
                return "bearing"
            case "bend", "bend":
                return "bend" if owner == "target" else ""
            case "position", "side" | "frame":
                return "offset" if owner == "target" else ""
        return ""

    # --- two speeds --------------------------------------------------------------------------------------------------

    def _comparisons(self) -> None:
        for token in self.clause.of("compare"):
            if self.clause.is_blocked(token.start) or self.is_plan:
                continue
            counted = any(self.sentence.numerals[i].unit == "times" for i in self.clause.numerals)
            if token.value == "matching" and (counted or self.clause.has("ratio")):
                continue  # "three times as fast as"
            sign = {"faster": 1, "slower": -1, "matching": 0}[token.value]
            pair = compared_speeds(self.sentence, self.clause, self.context, token, self._cue(token))
            if pair is None:
                self._pace_word(token, sign)
                continue
            word = {1: "faster", -1: "slower", 0: "matching"}[sign * pair]
            negated = self.sentence.is_negated(self.clause, token)
            self._add(
                token,
                kind="comparison",
                word=word,
                negated=negated,
                frames=self._frames_of_two(token),
                value=self._degree(token),
            )

    def _frames_of_two(self, token: Token) -> tuple[int, ...] | None:
        """Give the frames of a comparison: now where its clause names somebody and no other time."""
        own = self.clause.has("who", "drone", "target")
        if own and all(t.value in ("now", "last_step", "mean") for t in self.clause.of("time")):
            return (NOW,)
        return self._trend_frames(token)

    def _degree(self, token: Token) -> float:
        """Give 1 where somebody is much faster, not only faster."""
        return float(
            _MUCH[self.language].search(self.text, max(self.clause.start, token.start - 20), token.end + 6) is not None
        )

    def _pace_word(self, token: Token, sign: int) -> None:
        """ "steadily quicker", "ever more slowly": no second speed, so a trend of the one."""
        text = self.text[token.start : token.end]
        if not re.search(
            r"(?:ever|steadily|increasingly|getting|becoming|growing|gradually|progressively|and|still) (?:the )?$",
            self.text[: token.start],
        ):
            return
        if text in ("faster", "quicker", "slower", "more slowly", "more quickly") and not self.text[
            token.end :
        ].lstrip().startswith(("than", "by")):
            names = self._speed_names(token) or (
                ("speed",) if self.context.cue == "speed" or self._cue(token) == "speed" else ()
            )
            if names and not self.clause.of("time") and not self.clause.numerals and not self.clause.has("ratio"):
                self._add(token, kind="trend", names=names, trend=sign, frames=self._trend_frames(token))
