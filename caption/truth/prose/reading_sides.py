"""Sides in set words as statements: which way the nose turned, on which side the box stands, where the target is or goes.

They contradict in any wording (judging_strong.py): what the side is of stands beside it, and the window has to be on the other side at
every moment that may be meant.
"""

from __future__ import annotations

import re

from caption.truth.prose.clause_words import ClauseWords
from caption.truth.prose.lexicon import Token

_SIDES_EN = "left|right|port|starboard|clockwise|anticlockwise|counterclockwise"
_OTHERS = r"(?!\b(?:of|from|target|walker|person|pedestrian|subject|runner|man|woman|box|he|she|him|her|they|them|course|figure)\b)"
_SPIN = r"(?:swung|swing|swings|swinging|turn(?:s|ed|ing)?|rotat\w+|pann\w+|yaw\w*|slew\w*|swivel\w*|spun|pivot\w*)"
_TO = r" (?:(?!\b(?:and|but|while|of|from|then|back|target|walker|person)\b)[\w#.°]+ ){0,8}?(?:to the |round to the |to |about )?"
_ENDS = r"(?:wards?)?\b(?! of| side| half| hand|-)"
_NOSE = {
    "en": re.compile(
        rf"\b(?:nose|yaw)\b(?! of)(?:{_OTHERS}[^;:()]){{0,60}}?"
        rf"\b(?:{_SPIN}|came|come|comes|gone|goes|going|went|drift(?:s|ed|ing)?|wander(?:s|ed|ing)?|flick\w*|crept|creep\w*|edg\w+|mov\w+|nudg\w+|slid|giv\w+|gave|work\w+|follow\w*|pull\w+|thrown|kick\w+){_TO}(?P<side>{_SIDES_EN}){_ENDS}"
        rf"|\b(?:drone|aircraft|machine|camera|we|i)\b(?:{_OTHERS}(?!\bnose\b)[^;:()]){{0,60}}?\b{_SPIN}{_TO}(?P<spin>{_SIDES_EN}){_ENDS}"
        rf"|\bswing of the nose(?: went)?{_TO}(?P<swing>{_SIDES_EN}){_ENDS}|\b(?P<adj>left|right)(?:ward)? (?:yaw|pan|rotation|slew)\b(?! rate)|\b(?P<turn>left|right)(?:ward)? (?:turn|swing) of #"
    ),
    "zh": re.compile(
        r"(?:机头|机首|机身|镜头|无人机)(?:(?!行人|目标|人|他|她|方位|[左右侧边在偏;:()]).){0,40}?(?:[向往朝]?(?P<side>[左右])(?:转|偏(?!航)|摆|甩|扫|拧|旋|偏航|带|打)|偏(?P<off>[左右])(?!侧|边|方|前|后))"
    ),
}
# Where the box stands in the picture.
_MIDDLE = r"(?:the |its )?(?:(?:image|frame|picture|vertical|exact|optical|screen) )*(?:cent(?:re|er)(?: line)?|middle|midline|axis|cross ?hairs?|crosshair|mid ?frame)"
_IN_PICTURE = {
    "en": re.compile(
        rf"#(?:\.#)? ?(?:px|pixels) (?:\w+ )?(?:(?:to the|off to the|on the|over to the) )?(?P<px>left|right)\b(?! of (?:our|the (?:nose|drone|heading)))|\b(?P<off>left|right) of (?:and (?:above|below|under) )?{_MIDDLE}\b|\b(?:upper|lower|top|bottom) (?P<part>left|right)\b"
        r"|\b(?:on|in) the (?P<half>left|right)(?: hand)? (?:half|side|part|third|edge) of the (?:picture|frame|image|view|screen)\b"
    ),
    "zh": re.compile(
        r"(?:画面|中心|中线|图像|正中|中央|准星)(?:的|偏|靠|正|略|稍|之)?(?P<side>[左右])(?:侧|边|方|上|下|半|移|#)?|偏(?P<off>[左右])(?:上|下|方)?(?:了|约|仅)?#(?:\.#)? ?(?:个)?(?:像素|px)|偏到了?(?:画面)?的?(?P<to>[左右])|略?偏(?P<part>[左右])(?:上|下)"
    ),
}
# Where the target is or goes, as the drone looks.
_ABOUT_US = {
    "en": re.compile(
        r"\b(?P<side>left|right) of (?:where )?(?:the |our |its |my )?(?:drone's own |drone's |own |aircraft's )*(?:nose|heading|drone|course|aircraft|machine|camera|track|us\b|ours\b|my (?:-?#|nose))"
        r"|\b(?:behind|over|off|at|by|beyond|past|abeam|on|to) (?:the |our |its |my )?(?:aircraft's |drone's )?(?P<shoulder>left|right|port|starboard) (?:shoulder|rear|flank|quarter|wing|hand side)"
        r"|\b(?:behind|aft|astern|abeam|off)(?: and)?(?: on| to| over to)? (?:the|our|its) (?P<behind>left|right)\b(?! of)|\b(?P<abeam>left|right)(?: and)? (?:behind|abeam|rear|astern)"
        r"|\b(?:points?|runs|running|heads?|headed|walk\w*|goes|mov(?:es|ing)|leads?|course|sets?|cross\w*)\b(?: (?!and|then|but|nose|turn)[\w#°.-]+){0,6}? (?:to|towards?|into|over to|off to|from) (?:the |our |its |my |their |his |her )?(?P<goes>left|right)\b(?! of| turn)"
    ),
    "zh": re.compile(
        r"(?<!起始)(?:机头|机首|无人机|镜头|我机|机身)(?:指向|方向|朝向)?的?(?:正|偏)?(?P<side>[左右])(?:手边|侧|边|前方|后方|前|后|方)|(?P<behind>[左右])后(?:方|侧)|(?:相对机头|朝|往|向)(?:[^,;]{0,4}?)(?P<goes>[左右])(?:前方|侧|边|手)?(?:横穿|横走|走|跑|横着走|移动)|偏(?P<off>[左右])前方|(?:在|位于)(?:正)?(?P<at>[左右])(?:侧|边)(?:约|略|偏|#)"
    ),
}
_TURNED = {  # the target's way
    "en": re.compile(
        r"\b(?:turn\w*|veer\w*|bent|bends?|swung|swing\w*|wheel\w*|borne off|bear\w*|curv\w*|hook\w*|broke\w*|sheer\w*|cut)\b(?: (?!and|but|while|of|from|then|nose|drone)[\w#.°]+){0,8}? (?:to the |to |about )?(?P<side>left|right)(?:wards?)?\b(?! of| side| hand)|#(?:\.#)?(?:°| degrees) (?:to the )?(?P<by>left|right)\b"
    ),
    "zh": re.compile(
        r"(?:行人|目标|他|她|方向|对方|人)(?:(?!机头|无人机|[;:()]).){0,40}?[向往朝]?(?P<side>[左右])(?:转|拐|偏|弯|折)(?!航)"
    ),
}
_MOVES_BACK = re.compile(
    r"\b(?:back|return\w*|from|until|instead|would|could|should|if|not|no|n't|never|either|both|or|neither|than)\b|n't\b|回|从|不(?!断)|没|若|如果|先(?!生)|再|左右|右左|或"
)
_NOBODY = re.compile(r"\b(?:nothing|nobody|no one)\b|什么|没有")
_SENSE = {"left": 1, "port": 1, "anticlockwise": 1, "counterclockwise": 1, "leftward": 1, "左": 1}


class SideReader(ClauseWords):
    """Reads the sides of one clause."""

    def read(self) -> None:
        if self.is_plan or self.text.endswith("?") or self.clause.has("modality", "plan"):
            return
        if self.in_scene or self.clause.has("who", "scene"):
            return
        self._find(_NOSE, "nose")
        self._find(_IN_PICTURE, "box")
        if not self.clause.has("quantity", "centre", "box"):
            self._find(_ABOUT_US, "about")
        people = {t.value for t in self.clause.of("who", "drone", "target")} or {self.context.subject}
        if people == {"target"} and not self.clause.has("quantity", "yaw", "bearing", "centre"):
            self._find(_TURNED, "bend")

    def _find(self, table: dict[str, re.Pattern[str]], word: str) -> None:
        for match in table[self.language].finditer(self.text, self.clause.start, self.clause.end):
            side = next((v for v in match.groupdict().values() if v), "")
            if not side or self.clause.is_blocked(match.start()) or self.clause.is_blocked(match.end() - 1):
                continue
            if _MOVES_BACK.search(self.text, self.clause.start, match.end()) or _NOBODY.search(
                self.text, self.clause.start, self.clause.end
            ):
                continue
            if word == "box" and self.text.endswith(("向", "往", "朝"), 0, match.start()):
                continue  # "向画面左边横穿过去"
            if (
                word == "about"
                and match.groupdict().get("goes")
                and _OF_OURS.search(self.text, self.clause.start, match.start())
            ):
                continue  # "the nose has been moving to the right"
            if word == "bend" and self.text.endswith(("the ", "this ", "a "), 0, match.start()):
                continue  # "the swing to the left must not stop": whose is not told
            is_noun = match.groupdict().get("adj")  # "1.4° of left yaw": asked for or done
            if is_noun and not _SO_FAR.search(self.text, self.clause.start, self.clause.end):
                continue
            if (word == "nose" and not self._is_done(match)) or (word == "about" and not self._is_of_target(match)):
                continue
            token = Token("side", side, match.start(), match.end())
            is_one = word == "box" and len(list(table[self.language].finditer(self.text))) == 1
            frames = self._told_moment(token) if is_one else None
            self._add(token, kind="lies", word=word, side=_SENSE.get(side, -1), frames=frames)

    def _is_of_target(self, match: re.Match[str]) -> bool:
        """Tell whether it is the target that goes or stands there: whoever was named last."""
        named = [t for t in self.clause.of("who", "drone", "target") if t.start < match.start()]
        return (named[-1].value if named else self.context.latest or self.context.subject) != "drone"

    def _is_done(self, match: re.Match[str]) -> bool:
        """Tell whether a turn is told and not asked for: in the reasoning, by its verb or its degrees."""
        if not self.is_reasoning:
            return True
        degrees = any(self.sentence.numerals[i].unit == "deg" for i in self.clause.numerals)
        return degrees or _DONE[self.language].search(self.text, self.clause.start, match.end()) is not None


_OF_OURS = re.compile(r"\b(?:nose|heading|camera|view|box)\b")
_SO_FAR = re.compile(r"\b(?:has|have|had|so far|in (?:two|the|one|total)|each|every|was|were|is running)\b")
_DONE = {
    "en": re.compile(
        r"\b(?:has|have|had|was|were|is|are|came|went|swung|crept|turned|rotated|drifted|gives|follows|so far)\b|'s\b|'ve\b"
    ),
    "zh": re.compile(r"了|已|正|过|一直|累计|趋势"),
}
