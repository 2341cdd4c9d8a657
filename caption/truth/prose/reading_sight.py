"""How much of the target is seen, in set words, as statements: covered, unseen or clear, now or in the frames that are told.

They contradict in any wording (judging_strong.py) where no frame that may be meant bears them out.
"""

from __future__ import annotations

import re

from caption.truth.prose.clause_words import ClauseWords
from caption.truth.prose.cues import times_of
from caption.truth.prose.lexicon import Token
from caption.truth.prose.statements import NOW

_HID = r"(?:hidden|covered|occluded|obscured|screened|masked|blocked|concealed|obstructed|shielded)"
_SIGHT: dict[str, dict[str, re.Pattern[str]]] = {
    "en": {
        "covered": re.compile(
            rf"\b(?:half|partly|partially|mostly|largely|badly|heavily) {_HID}\b|\b{_HID} (?:in|behind|by|since|all|throughout|now)\b|\b(?:is|are|been|remains?|stays?|now|keeps) {_HID}\b(?! (?:#|about|roughly|some|a |the |ground|more|less))"
            rf"|\bwith (?:half|part|most|much) of (?:it|him|her|them|the \w+) {_HID}\b|\b(?:plenty of|heavy|partial|strong) occlusion\b|\b(?:covers?|hides?|blocks?|screens?) (?:half|part|most|much|some|(?:any )?parts?) of (?:it|him|her|them|the (?:person|walker|target|pedestrian|figure|subject|box))\b"
            r"|\b(?:wall|tree|foliage|hedge|van|something) (?:now )?(?:stands|is) in the (?:line of sight|way|sight line)\b|\bcut(?:s)? across the line of sight\b"
        ),
        "unseen": re.compile(
            rf"\b(?:completely|fully|entirely|wholly|totally) {_HID}\b|\bout of (?:sight|view|the picture|the frame|frame|the image)\b|\bno longer (?:visible|in (?:view|sight|frame|the picture)|sees?|seen)\b|\b(?:is|are|been|was) (?:lost|gone)\b(?! (?:#|about|height|speed|altitude|from (?:#|about)))"
            r"|\bgone from (?:view|sight|the picture)\b|\b(?:cannot|can't|could not) (?:be )?seen?\b|\binvisible\b|\bnowhere to be seen\b|\bunseen\b|\bnot (?:visible|in view|in sight|seen)\b|\b(?:has|have) (?:disappeared|vanished)\b|\bvisibility (?:is |has been |was )?(?:poor|lost|gone|bad)\b"
        ),
        "clear": re.compile(
            r"\b(?:in|back in|into) (?:full|plain|clear|open|good) (?:view|sight)\b|\b(?:fully|clearly|plainly|perfectly|completely|entirely|well) (?:visible|in view|in sight|exposed|restored|seen)\b|\b(?:unobstructed|unoccluded)\b|\bback in(?:to)? the (?:picture|frame|image)\b"
            r"|\b(?:is|are|remains?|stays?|been|still) (?:visible|in view|in sight|seen)\b|\bvisible in (?:every|each|all)\b|\bshows? the (?:person|walker|target|pedestrian)\b|\bappears? in (?:every|each|all)\b"
        ),
    },
    "zh": {
        "covered": re.compile(
            r"(?:被|遭|给)[^,;]{0,6}(?:遮|挡)(?:住|着|了|掉|去|没)?|(?:遮|挡)(?:住|了|去|着)(?:了)?(?:大半|一半|一部分|部分)|(?:部分|局部|一半|大半|大片|严重)(?:被)?(?:遮|挡)|时隐时现|若隐若现|半遮|有(?:大片|严重|明显)?遮挡|遮挡严重"
        ),
        "unseen": re.compile(
            r"看不[见到]|不可见|(?:出|离开|移出|跑出|走出|脱离)了?(?:画面?|画框|视野|镜头)(?!中|左|右|上|下|侧|内|里|正)|消失|(?:完全|彻底|全)(?:被)?(?:遮|挡)|跟丢|不在(?:画面|视野|镜头)|(?:画面|视野|镜头)之?外|没(?:了)?踪影|丢了"
        ),
        "clear": re.compile(
            r"清晰可见|完全可见|清楚可见|清清楚楚|一清二楚|看得(?:很|非常|十分)?(?:清|见|到)|(?:完整|完全|整个)(?:地)?(?:露|出现|可见|看)|重新看清|(?:回到|在)(?:画面|视野|镜头)之?[里内中]|无遮挡|没有遮挡|毫无遮挡|(?<!不)可见"
        ),
    },
}
_DENIED = {
    "en": re.compile(
        r"\b(?:not|no|never|nothing|none|nobody|neither|nor|without|if|unless|would|could|might|may|should|avoid|before|until|till|lest|risk|danger|hardly|barely|whoever|whatever|what|cannot|to (?:keep|stay|get|bring|have|be)|where|when|while|once|help\w*|let\w*|last|keep|keeping|puts?|after|still has|soon|longer|anything|something like|which|likely|probably)\b|n't\b"
    ),
    "zh": re.compile(
        r"不|没|无(?!人机)|未|若|如果|免|防|风险|可能|会(?!儿)|将|一旦|怕|尚|非|除|前(?![两三一四])|后(?![两三])|曾|先(?!生)|谁|时|让|使|能|等|保持|要|恢复|找|避|便于|为了|哪|从|直到|再|多半|大概|应|最后一次|刚|一度|途中|除了"
    ),
}
_EVER_SINCE = re.compile(r"\bsince\b|此后|从此|之后[两三]?帧?|(?<=帧)起|t\d ?起|以来")
_SOME_FRAME = re.compile(r"第|次帧|首帧|\b(?:first|second|third|fourth|frames?|step)\b")
_SOME_FRAMES = re.compile(r"[一两三四几]帧|\b(?:one|two|three|four|#) (?:of\b|frames?\b)")
_EVERY = {
    "en": re.compile(
        r"\b(?:throughout|always|all along|all the time|(?:all|each of the|every one of the) (?:the )?(?:five|#|frames)|(?:in )?(?:every|each) (?:single )?(?:frame|one|picture|image)|the (?:whole|entire) (?:time|window|clip))\b"
    ),
    "zh": re.compile(r"一直|始终|全程|五帧|每一?帧|各帧|整段"),
}


class SightReader(ClauseWords):
    """Reads the set words for being seen of one clause."""

    def read(self) -> None:
        if self.is_plan or self.text.endswith("?"):
            return
        found = [
            (word, match)
            for word, pattern in _SIGHT[self.language].items()
            if (match := pattern.search(self.text, self.clause.start, self.clause.end))
        ]
        if (
            not found
            or {word for word, _ in found} >= {"clear", "covered"}
            or {word for word, _ in found} >= {"clear", "unseen"}
        ):
            return
        word, match = found[-1]
        if self.clause.is_blocked(match.start()) or _DENIED[self.language].search(
            self.text, self.clause.start, match.start()
        ):
            return
        people = {t.value for t in self.clause.of("who", "drone", "target")}
        if self.clause.has("who", "scene") and "target" not in people and word != "covered":
            return
        if people == {"drone"} and not _OF_SIGHT.search(match.group()):
            return
        if any(self.sentence.numerals[i].unit in ("m", "percent") for i in self.clause.numerals):
            return  # "3 m covered"
        token = Token("sight", match.group(), match.start(), match.end())
        frames = self._seen_frames(token)
        if self._is_one_of_many() and not (
            frames
            and len(frames) == 1
            and (times_of(self.clause) or _EVER_SINCE.search(self.text, self.clause.start, self.clause.end))
        ):
            return
        self._add(token, kind="sight", word=word, frames=frames)

    def _is_one_of_many(self) -> bool:
        """Tell whether a sentence tells of several moments what is seen there."""
        return (
            sum(c.has("visibility") for c in self.sentence.clauses) > 1
            or _SOME_FRAME.search(self.text, 0, self.clause.start) is not None
        )

    def _seen_frames(self, token: Token) -> tuple[int, ...] | None:
        part = self.text[self.clause.start : self.clause.end]
        if _EVERY[self.language].search(part) or _SOME_FRAMES.search(part):
            return None
        if any(not (t.value == "now" or t.value in ("since", "last_step")) for t in self.clause.of("time")):
            return (NOW,) if _EVER_SINCE.search(part) and not self.clause.has("time", "past", "until") else None
        return self._told_moment(token)


_OF_SIGHT = re.compile(r"view|sight|视野|画")
