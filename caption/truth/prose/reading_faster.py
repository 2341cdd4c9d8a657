"""Which of the two is faster, in set words, as statements: "half as fast as the walker", "比他慢", "thus slower".

They contradict in any wording (judging_strong.py) where the other one is faster at every moment that may be meant.
"""

from __future__ import annotations

import re

from caption.truth.prose.clause_words import ClauseWords
from caption.truth.prose.lexicon import Token
from caption.truth.prose.owners import Owners

_TIMES = r"(?:(?:twice|double|thrice|(?:two|three|four|five|six|seven|eight|nine|ten|several|many|#(?:\.#)?)(?: and a half)? times) (?:as (?:fast|quick|much)|(?:the )?(?:pace|speed|(?:walker|person|pedestrian|target|drone|runner|man)'s)|what|his|her|their|our|its))"
_PART = r"(?:(?:half|a third|a quarter|a fifth|a tenth|(?:only )?a fraction|(?:less|not even|barely|scarcely) (?:than )?half) (?:as (?:fast|quick|much)|(?:of )?(?:the |his |her |their |our |its )(?:pace|speed|walker's|person's|pedestrian's|target's|drone's)|(?:of )?what|of (?:the|his|her|their|our|its) (?:\w+ )?(?:pace|speed)))"
_BY_ZH = r"(?:得多|得明显|一些|一点|些|不少|很多|出?(?:了)?(?:一)?大?截|(?:了)?(?:将近|近)?[一两三几数]倍|出?(?:了)?(?:约|大约|近|差不多)?#|(?:了)?约?[一二三四五六七八九]成)"
_FASTER = {
    "en": re.compile(
        rf"\b(?:{_TIMES}|faster|quicker|more quickly|outpac(?:es|ing)|outruns|outrunning|outstrips|makes more ground speed|above the (?:pedestrian|walker|person|target|runner)'s (?:pace|speed))\b(?! the (?:nearer|closer))"
    ),
    "zh": re.compile(
        rf"[两三四五六七八九十几数]倍|#(?:\.#)?\s*倍|(?:比[^,;]{{1,14}}?|[更略稍])快(?!要|到|停|结束)|快(?:于|过|{_BY_ZH})|占优|占上风|超过(?:了)?(?:行人|目标|他|她|对方|人|无人机)"
    ),
}
_SLOWER = {
    "en": re.compile(
        rf"\b(?:{_PART}(?! again)|slower|more slowly|lags?(?: behind)?|trails|well short of|falls short of|far below the pace|(?:below|under) the (?:pedestrian|walker|person|target|runner)'s (?:pace|speed))\b"
    ),
    "zh": re.compile(
        rf"的?一半(?:都)?(?:不到|快)?|[三四五十]分之一|(?:比[^,;]{{1,14}}?|[更略稍])慢(?!慢|下|悠|性)|慢(?:于|过|{_BY_ZH})|不及|落后|赶不上|跟不上|不如(?:行人|目标|他|她|对方|人|无人机)"
    ),
}
_NO_SPEED = {
    "en": re.compile(
        r"\b(?:ever|each|every|before|earlier|than (?:before|at|in|it was|that)|getting|chang\w*|direction|grow\w*|did|was|were|distance|gap|range|height|altitude|high|tall|wide|width|box|turns?|turning|yaw\w*|climb\w*|descen\w*|degrees|metres|covered|as much ground|ground as|initially|at first|had|if|would|could|should|must|need\w*|not|n't|no|never|nor|neither|rather|let|first|needed|window|start|frame|step ago|second ago)\b|°|px"
    ),
    "zh": re.compile(
        r"[前上]一[步帧]|越|原来|前者|后者|比(?:刚才|之前|先前|最初|起初|上一|前一|t\d|开始|开头|第|半秒|一秒|窗口|原来|自己)|距离|高度|画面|框|宽|高|路|俯|角|度(?!不)|像素|时快时慢|不(?!及|到|如)|没|若|如果|应|要(?!慢|快)|需|可以|再|刚|曾|先(?!生)|起初|最|步比|帧比|变|加|减|放慢|得更|愈|忽|尽快|赶|走了|飞了|挪"
    ),
}
_AGAINST = re.compile(r"\b(?:against|versus|vs|than|to)\b|对|比")
_PIVOT = re.compile(r"是|有|为|近|足|连|于|不到")
_OTHER = {"drone": "target", "target": "drone"}


class FasterReader(ClauseWords):
    """Reads who is faster in one clause."""

    def read(self) -> None:
        if self.is_plan or self.in_scene or self.text.endswith("?") or self.clause.has("modality", "plan"):
            return
        start, end = self.clause.start, self.clause.end
        faster = _FASTER[self.language].search(self.text, start, end)
        slower = _SLOWER[self.language].search(self.text, start, end)
        match = faster or slower
        if match is None or (faster and slower) or self.clause.is_blocked(match.start()):
            return
        if _NO_SPEED[self.language].search(self.text, start, end):
            return
        subject = self._subject(match) if self._is_of_speeds(match) else ""
        if not subject:
            return
        token = Token("compare", match.group(), match.start(), match.end())
        side = (1 if faster else -1) * (1 if subject == "drone" else -1)
        self._add(token, kind="faster", side=side, frames=self._told_moment(token))

    def _is_of_speeds(self, match: re.Match[str]) -> bool:
        """Tell whether speeds are compared: by the word itself, or by a speed told in its clause or right before it."""
        if re.search(r"fast|quick|slow|pace|speed|outrun|outstrip|lag|trail|快|慢|落后", match.group()):
            return True
        at = self.sentence.clauses.index(self.clause)
        near = [i for c in self.sentence.clauses[max(0, at - 1) : at + 1] for i in c.numerals]
        units = [self.sentence.numerals[i].unit for i in near if self.sentence.numerals[i].start < match.end() + 30]
        return "mps" in units and set(units) <= {"mps", "times", "s", "", "frames"}

    def _subject(self, match: re.Match[str]) -> str:
        """Say who is the faster or slower: the one before the word, the one that the other is not, or the one of the clause before."""
        people = [
            t
            for t in self.clause.of("who", "drone", "target")
            if self.text[t.start : t.end] not in ("flying", "flies", "walking", "walks", "行走", "走", "飞行", "步行")
        ]
        pivot, begins = -1, match.start()
        if self.language == "zh":  # "无人机比人快", "是行人的两倍": the other one stands between
            pivot = self.text.find("比", self.clause.start, match.end())
            if pivot < 0 and (found := _PIVOT.search(self.text, self.clause.start, match.end())):
                pivot = found.start()
            begins = pivot if pivot >= 0 else match.end()
        before = [t for t in people if t.end <= (begins if self.language == "zh" and pivot >= 0 else match.start())]
        objects = [t for t in people if t.start >= begins]
        if objects and objects[0].start - match.end() == 1 and match.group().endswith("er"):
            return objects[0].value  # "a faster drone"
        if before and (not objects or objects[0].value != before[-1].value):
            return before[-1].value if len({t.value for t in before}) == 1 else ""
        if objects and not before:
            return _OTHER[objects[0].value]
        return "" if before or objects else self._alone_before()

    def _alone_before(self) -> str:
        """Give the only one whom the clause right before names, with a speed."""
        before = [c for c in self.sentence.clauses if c.end <= self.clause.start][-1:]
        if not any(self.sentence.numerals[i].unit == "mps" for c in before for i in c.numerals):
            return ""
        if _AGAINST.search(self.text, before[0].start, before[0].end):
            return ""
        return Owners(self.sentence, self.clause, self.context).named_alone_before()
