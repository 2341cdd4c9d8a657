"""Which words may contradict: those of a plain sentence about what is seen now, whose subject stands in the same clause.

What a reader of patterns misunderstands is a plan, an idiom, a relation to something else, another moment. There a word that does not
fit is left unread; one that fits still counts as read.
"""

from __future__ import annotations

import re

from caption.truth.prose.clauses import Clause, Sentence
from caption.truth.prose.lexicon import Token
from caption.truth.prose.statements import Statement

# A second thing, another moment, a supposition, or a set phrase that only looks like a statement.
_BLOCKED = {
    "en": re.compile(
        r"\b(?:instead|rather|same|as if|lost and found|further|let|if|unless|should|would|could|might|than|without|instead of|apart from"
        r"|except|despite|although|though|even|neither|nor|not|no|never|nothing|nobody|hardly|barely|anything|too|enough|almost|nearly|lack\w*|missing is)\b|n't\b|\?"
    ),
    "zh": re.compile(r"不(?!断)|没|无(?!人机)|未|别|若|如果|刚|先(?!生)|此前|之前|曾|谁|近乎|几乎|同样|一样|相同|似|像是|虽|尽管|再|免|而非|反而|身后|旁|用(?=上升|下降|爬升|加速|减速|后退|前进)"),
}  # fmt: skip
# The same without what only concedes: "though half hidden" tells that it is.
_DENIED = {
    "en": re.compile(r"\b(?:instead|rather|same|as if|lost and found|let|if|unless|should|would|could|might|than|without|instead of|apart from|except|neither|nor|not|no|never|nothing|nobody|hardly|barely|anything|too|enough|almost|nearly)\b|n't\b|\?"),
    "zh": re.compile(r"不(?!断)|没|无(?!人机)|未|别|若|如果|刚|先(?!生)|此前|之前|曾|谁|近乎|几乎|同样|一样|相同|似|像是|再|免|而非|反而|身后|旁"),
}  # fmt: skip
_ADVERB = re.compile(
    r"\s*(?:in|on|at|now|away|after|before|here|there|behind|through|along|up|down|where|as|about|then|once)\b"
)
_RELATED = {
    "en": re.compile(r"\s*(?:-?hand side)?\s*of (?:our|its|his|hers?|him|them|us|it|their|that|this|where|what|the (?!image|frame|picture|cent|middle|cross|screen))"),
    "zh": re.compile(r"\s*(?:的)?一侧"),
}  # fmt: skip
_STANDS_AT = re.compile(
    r"(?:stood|stands?|rests?|waits?)\b(?! still| there| motionless| idle| on the spot| in place|[.,;]|$)"
)  # "stood 10 px right"
_DONE = re.compile(r"了|着|已|正|在|中|持续|不断|逐")
_TURNS = re.compile(
    r"\b(?:is|are|has|have|keeps?|comes?|turns?|turned|turning|rotates?|rotating|swings?|in progress|bend(?:s|ing)|curv(?:es|ing)|veer(?:s|ing))\b|在|正|已|了|着|转过|持续|每秒"
)


_CROSSES = re.compile(r"\bacross the (?:view|picture|frame|image|screen)|横穿|穿过|横过")
_UNSEEN = re.compile(r"occlu|\bhidden|out of (?:view|sight|frame)|outside|遮挡|视野外|看不[见到]")  # whenever that was
_ORDINALS = re.compile(  # several frames that are told one by one: "in the second and third frames"
    r"\b(?:first|second|third|fourth|#) (?:and|to|through|or) (?:the )?(?:second|third|fourth|fifth|last|final|#)\b"
)
_BACK = {"en": re.compile(r"\bback (?:at|to|up|down|on)\b"), "zh": re.compile(r"回到|又回|复又")}


def is_plain(found: Statement, token: Token, sentence: Sentence, clause: Clause, is_reasoning: bool) -> bool:
    """Tell whether a word that the window does not bear out is a contradiction."""
    text, language = sentence.text, sentence.language
    part = text[clause.start : clause.end]
    if found.negated or found.kind in ("steady", "mixed") or _is_blocked(found, token, sentence, clause):
        return False
    if is_reasoning and clause.has("action") and not _is_told(part, clause, language):
        return False  # what to do
    if found.kind == "trend" and _BACK[language].search(text, clause.start):
        return False  # "went from 10.7 m down to 9.8 m and is back at 10.8 m"
    match found.kind:
        case "state":
            return (
                found.word in ("walking", "standing", "running")  # others are rarely met
                and not _STANDS_AT.match(text, token.start)
                and not clause.has("who", "scene")
                and _has_subject(token, clause, language, found)
            )
        case "visibility":
            return (
                (
                    _is_of_frame(clause)
                    or (found.frames is None and _UNSEEN.search(text, token.start, token.end) is not None)
                )
                and found.word != "visible"  # "to keep him in the picture", "last seen": never of what is hidden now
                and not _is_measured(sentence, clause)
                and not _ORDINALS.search(text, clause.start, clause.end)
            )
        case "trend":
            allowed = (
                ("m", "s", "frames")
                if found.names == ("altitude",) and not clause.has("quantity")
                else ("m", "mps", "s", "frames", "px", "percent", "times")
            )
            if found.names == ("altitude",) and not _is_of_drone(text[clause.start : token.start], clause):
                return False
            if not clause.has("quantity") and _LOOKS[language].search(part):
                return False  # "he looks smaller": his image, not what was spoken of before
            return all(sentence.numerals[i].unit in allowed for i in clause.numerals)
        case "side":
            return _is_side(found, token, part, sentence, clause)
    return True


def is_asserted(found: Statement, token: Token, sentence: Sentence, clause: Clause, is_reasoning: bool) -> bool:
    """Tell whether a word is said of some moment: nothing before it denies or supposes it, and it is nothing to do."""
    text, language = sentence.text, sentence.language
    if found.kind == "visibility":
        has_subject = text[token.start : token.end] != "lost" and not _is_measured(sentence, clause)
    else:
        people = [t.start - token.end for t in clause.of("who", "target")]
        has_subject = any(gap < 0 or gap == 1 for gap in people)  # "the motionless walker"
        has_subject = has_subject or (language == "zh" and not clause.has("quantity"))
        has_subject = has_subject and not _STANDS_AT.match(text, token.start)
    blocked = _DENIED[language].search(text, clause.start, token.start) or "?" in text
    part = text[clause.start : clause.end]
    is_to_do = is_reasoning and clause.has("action") and not _is_told(part, clause, language)
    return has_subject and not (found.negated or blocked or is_to_do or clause.has("who", "scene"))


def _is_measured(sentence: Sentence, clause: Clause) -> bool:
    """Tell whether a clause gives a number that is not told of being seen."""
    return any(sentence.numerals[i].unit in ("m", "percent", "px") for i in clause.numerals)


def _is_blocked(found: Statement, token: Token, sentence: Sentence, clause: Clause) -> bool:
    text = sentence.text
    if found.kind == "comparison":
        return False
    own = text[token.start : token.end]
    return any(
        not (token.start <= match.start() and match.end() <= token.end) and match.group() not in own
        for match in _BLOCKED[sentence.language].finditer(text, clause.start, clause.end)
    )


def _is_told(part: str, clause: Clause, language: str) -> bool:
    """Tell whether a clause with a manoeuvre says that it is under way."""
    if language == "zh":
        return bool(_DONE.search(part)) and clause.has("who", "drone", "target")
    has_subject = clause.has("who", "drone", "target") or clause.has("quantity", "altitude", "distance", "speed", "yaw")
    return (has_subject or re.search(r"\bit\b", part) is not None) and bool(_TURNS.search(part))


_LOOKS = {"en": re.compile(r"\b(?:looks?|looking|appears?|appearing)\b"), "zh": re.compile(r"看着|看上去|看起来|显得")}
_ADVERBS = re.compile(
    r"(?:[\s,]|and|it|is|has|been|still|now|steadily|slowly|again|then|正|在|仍|还|已|也|又|继续|不断|持续|缓缓|逐渐|一直|一路|略|稍|微|有所|随后|先|最后|末|步|半秒|\d|strong|steep|rapid|quick|slow|gentle|marked|slight|clear|sharp|the|a|却|并|且|但|急速|快速|强烈|缓慢|明显|大幅|迅速|稳步|平缓|轻微|[一二两三四五]|帧|秒|里|内|都|间)*"
)


def _is_of_drone(before: str, clause: Clause) -> bool:
    """Tell whether a climb is the drone's: it or its height is named, or nobody."""
    return (
        clause.has("who", "drone")
        or clause.has("quantity", "altitude", "height", "climb_rate")
        or _ADVERBS.fullmatch(before) is not None
    )


def _has_subject(token: Token, clause: Clause, language: str, found: Statement) -> bool:
    whose = "drone" if found.word in ("hovering", "flying") else "target"
    people = [t for t in clause.of("who", "drone", "target") if (t.start, t.end) != (token.start, token.end)]
    if not people or any(t.value != whose for t in people):
        return False
    return people[0].start < token.start or 0 <= people[0].start - token.end <= 1  # "the motionless walker"


def _is_of_frame(clause: Clause) -> bool:
    """Tell whether a clause speaks of the current frame, of named ones, of the first or last few, or of all."""
    times = clause.of("time")
    few = [t for t in times if t.value.startswith(("last:", "first:"))]
    times = [t for t in times if not any(t.end > one.start - 7 and t.start < one.end for one in few)]  # "first three"
    return all(t.value in ("now", "window", "mean", "since") or t.value[1:].isdigit() for t in times)


def _is_side(found: Statement, token: Token, part: str, sentence: Sentence, clause: Clause) -> bool:
    text, language = sentence.text, sentence.language
    after = _ADVERB.match(text, token.end) if language == "en" else None
    if _RELATED[language].match(text, token.end) or (after and not re.match(r"\s*#", text[after.end() :])):
        return False
    if len(found.names) == 2 and found.names[0] == "yaw":
        return True  # of nobody's turn
    if language == "zh" and any(
        t.end == token.start and text[: t.start].endswith("在") for t in clause.of("who", "target")
    ):
        return False  # "中心在他右边"
    if found.names[0] == "offset_x" and _CROSSES.search(part):
        return False  # which way it goes, not where it is
    if found.names[0] == "offset_x":
        return (
            clause.has("quantity", "centre") or clause.has("position", "frame") or (language == "en" and "edge" in part)
        )
    return bool(_TURNS.search(part)) or clause.has("who", "drone", "target")
