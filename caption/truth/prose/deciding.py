"""A decision against its own text: what the reasoning argues for, and which decisions that allows."""

from __future__ import annotations

import re

from caption.truth.prose.clauses import Clause, Sentence
from caption.truth.prose.cues import gap
from caption.truth.prose.lexicon import Token
from caption.truth.prose.statements import Force, Said
from cosfly.products.actions import kin_of

# What a text argues for -> decisions that agree with it; sides are put in where the text names one.
_SIDED = {"yaw": "yaw_{}_to_follow", "circle": "circle_{}", "strafe": "strafe_{}"}
_AGREE = {
    "ascend": ("ascend",), "descend": ("descend",), "forward": ("move_forward", "speed_up", "track_straight"),
    "backward": ("move_backward", "slow_down"), "slow": ("slow_down", "hover"), "fast": ("speed_up", "move_forward"),
    "search": ("search_to_reacquire_target",), "hover": ("hover", "slow_down"), "straight": ("track_straight", "move_forward"),
    "leave": ("break_off", "return_to_home"), "home": ("return_to_home", "break_off"),
}  # fmt: skip


# Decision -> what is asked for where it is not meant, sides aside. Who must search sees nobody to follow.
_OPPOSITE = {
    "ascend": ("descend",), "descend": ("ascend",), "speed_up": ("slow", "hover", "search"), "slow_down": ("fast", "search"),
    "move_forward": ("backward", "hover", "search"), "move_backward": ("forward", "fast", "search"), "hover": ("fast", "forward", "ascend", "descend"),
    "yaw_left_to_follow": ("straight", "search", "hover"), "yaw_right_to_follow": ("straight", "search", "hover"), "track_straight": ("search",),
    "search_to_reacquire_target": ("straight", "hover", "fast"), "circle_left": ("straight", "hover"), "circle_right": ("straight", "hover"),
    "strafe_left": ("hover",), "strafe_right": ("hover",),
}  # fmt: skip
_PLAIN_OPPOSITES = {
    ("ascend", "descend"), ("descend", "ascend"), ("fast", "slow_down"), ("slow", "speed_up"), ("forward", "move_backward"), ("backward", "move_forward"),
    *(("hover", one) for one in ("speed_up", "move_forward", "circle_left", "circle_right", "strafe_left", "strafe_right", "yaw_left_to_follow", "yaw_right_to_follow", "track_straight", "return_to_home")),
    *(("search", one) for one in ("track_straight", "move_forward", "hover", "ascend", "descend", "speed_up", "slow_down")),
    *(("straight", one) for one in ("search_to_reacquire_target", "break_off", "hover", "move_backward")),
    ("fast", "hover"), ("ascend", "hover"), ("descend", "hover"), ("backward", "speed_up"), ("backward", "hover"), ("forward", "hover"), ("backward", "track_straight"),
}  # fmt: skip
# "a search is not warranted": refused after it is named.
_REFUSED = {
    "en": re.compile(
        r"\bnot (?:be |yet |really |at all )?(?:needed|necessary|warranted|required|called|advisable|justified|worth|recommended|helpful|useful)"
        r"|n't (?:be )?(?:needed|necessary|warranted|required|help)|not (?:a|an|the) (?:problem|concern|issue|priority|option|matter)|no (?:problem|concern|issue|need)|unnecessary|pointless|useless|superfluous|premature|no sense|little sense|uncalled|optional|merely|only unsettle|by itself|would (?:not|only|break|lose|cost|merely)|(?:brings?|gains?|adds?|buys?|solves?|achieves?|does|changes) (?:us )?(?:nothing|little)|no use|little use|plays? (?:little|no) part|can (?:wait|end|stop)|has (?:done|ended)|is over|isn't the (?:answer|issue|problem)|is not the (?:answer|cure)|\bwrong (?:answer|move|choice|thing|idea)|\b(?:is|are|was|does|do) not\s*[.;]?\s*$"
    ),
    "zh": re.compile(
        r"(?:没有|并无|毫无)(?:必要|意义|需要)|不(?:是问题|成问题|构成问题|必要|需要|值得|合适|可取)|为时过早|多余|过头|可有可无|无济于事|本身|并不能|浪费|已有|照常|作用很小|作用不大|没用|无用|无益|没有用|用处|没有帮助|帮不上|可以结束|到此为止|制造误差|暂不"
    ),
}


# "rather than turn", "without any extra rotation", "no need to": refused before it is named.
_INSTEAD = {
    "en": re.compile(r"\b(?:rather than|instead of|without|no need|no reason|no case|no hurry|too small|nothing to)\b"),
    "zh": re.compile(r"比[^,]{0,8}$|而非|而不|无需|不必|不需|没有理由|没有必要|不用|何必|不值得|暂不"),
}
_LATER = {
    "en": re.compile(r"\b(?:before|until|till|after|once|later)\b"),
    "zh": re.compile(r"(?<!那就)(?<!因此)(?<!所以)(?<!不妨)(?<!可以)再(?![往向靠升降左右高低]|推|稍|略)|之后|以后"),
}


def actions_of(sentence: Sentence, clause: Clause, *, is_plan: bool) -> list[Said]:
    """Give the actions that a clause names and does not refuse."""
    found: list[Said] = []
    for token in clause.of("action"):
        if token.value == "fast" and _SHEDS.search(sentence.text, 0, token.start):
            continue  # "bleeds off yet more speed"
        if (
            token.value == "hover"
            and sentence.text[token.start : token.end] == "不动"
            and not clause.has("who", "drone")
        ):
            continue  # "航向不动": of what was named, not of the drone
        if _RULED_OUT[sentence.language].search(sentence.text, 0, token.start):
            continue
        if not _is_refused(sentence, clause, token) and not _IS_ATTRIBUTE.match(sentence.text, token.end):
            side = _side_of(sentence, clause, token) if token.value in _SIDED else 0
            force = _force(sentence, clause, token, is_plan=is_plan)
            found.append(Said(token.value, side, force, (clause.start, clause.end)))
    return found


def _force(sentence: Sentence, clause: Clause, token: Token, *, is_plan: bool) -> Force:
    text, language = sentence.text, sentence.language
    if clause.is_blocked(token.start, ("if", "may")) or _LATER[language].search(text, clause.start, token.start):
        return "option"
    named = [t for t in clause.of("who", "drone", "target") if t.end <= token.start]
    if language == "zh" and _BIDS.match(text, clause.start) and not _TOLD["zh"].search(text, clause.start, token.start):
        return "directive"
    if named and named[-1].value == "target" and not _is_asked(sentence, clause, named[-1].end, token.start):
        return "told"  # "the walker turns left"
    if _PERFECT[language].search(text, clause.start, token.start):
        return "told"
    if clause.is_blocked(token.start, ("goal",)):
        return "aim"
    if is_plan or _is_praised(text, clause, token, language):
        return "directive"
    return "told" if clause.numerals or _TOLD[language].search(text, clause.start, clause.end) else "open"


def _is_praised(text: str, clause: Clause, token: Token, language: str) -> bool:
    if language == "en":
        goes_on = _CONTINUING.fullmatch(text, clause.start, token.start)  # "continuing this orbit to the left"
        return goes_on is not None or _PRAISED["en"].match(text, token.end, clause.end) is not None
    return _PRAISED["zh"].search(text, clause.start, token.start) is not None


_RULED_OUT = {  # a list of what was not chosen
    "en": re.compile(r"\b(?:ruled out|excluded|discarded|rejected)\b(?!.*\b(?:left|remain\w*|instead)\b)"),
    "zh": re.compile(r"排除(?:方案|选项|的)?(?!.*(?:剩|余下|改))"),
}
_SHEDS = re.compile(r"\b(?:bleed|shed|scrub|los|drop|dump|wash|tak)\w* (?:off )?(?:\w+ )?$")
_IS_ATTRIBUTE = re.compile(
    r"\s*(?:offset|error|drift|deviation|component|angle|rate|偏移|误差|偏差|分量)"
)  # "sideways offset"
_CONTINUING = re.compile(
    r"\s*(?:and |so )?(?:continuing|carrying on|keeping on|going on)(?: with| to)?(?: (?:the|this|that|our|its|a|an|with|steady|gentle))*\s*"
)
_GOES_ON = frozenset(["continue", "keep", "go on", "carry on", "继续"])


def _is_asked(sentence: Sentence, clause: Clause, start: int, end: int) -> bool:
    """Tell whether a plan stands between two places: "with the target left, we should turn"."""
    plans = [t for t in clause.of("modality", "plan") if start <= t.start < end]
    return any(sentence.text[t.start : t.end] not in _GOES_ON for t in plans)


_TOLD = {
    "en": re.compile(r"\b(?:is|are|was|were|has|have|had|been|keeps|kept)\b|'s\b|'ve\b|'re\b"),
    "zh": re.compile(r"了|已|正|曾|刚|(?<!超|不|错)过(?!于|头|去|来)|(?<!接|顺|随|跟)着|一直"),
}
# What opens a clause that bids something in Chinese.
_BIDS = re.compile(r"[\s“”]*(?:那就|因此|所以)?(?:就|应当?|宜|接下来|接着|改为|转为|最干脆的是|立刻|直接)")
# "bleeding off speed is wiser than turning": recommended after it is named; in Chinese before.
_PRAISED = {
    "en": re.compile(
        r"[^,;:]{0,30}\b(?:is|would be|seems|looks|remains|stays) (?:the |by far |surely |still |a |an )*(?:wiser?|wisest|better|best|right|safer|safest|prudent|sensible|appropriate|fitting|in order"
        r"|(?:cheapest|simplest|easiest|natural|obvious|only|logical|cleanest|surest|sound|proper) (?:way|option|choice|move|step|answer|response|thing|course))\b(?! of)"
    ),
    "zh": re.compile(r"(?:正|最|更|很)适合"),
}  # fmt: skip
# "you have already let the nose go right": what was asked for once.
_PERFECT = {
    "en": re.compile(
        r"(?:'ve|\bhas|\bhave|\bhad|\bhaving) (?:already |just |now )?(?!to\b|got\b)\w+|\bhaving (?:already )?$"
    ),
    "zh": re.compile(r"已经?(?:让|使|把|将)"),
}


def _is_refused(sentence: Sentence, clause: Clause, token: Token) -> bool:
    text, language = sentence.text, sentence.language
    return (
        sentence.is_negated(clause, token)
        or _INSTEAD[language].search(text, clause.start, token.start) is not None
        or _REFUSED[language].search(text, token.end, clause.end) is not None
    )


def _side_of(sentence: Sentence, clause: Clause, token: Token) -> int:
    reach = 26 if sentence.language == "en" else 9
    sides = [t for t in clause.of("side", "left", "right", "cw", "ccw") if gap(t, token.start, token.end) <= reach]
    if not sides:
        return 0
    side = min(sides, key=lambda t: abs(gap(t, token.start, token.end)))
    return 1 if side.value in ("left", "ccw") else -1


def argues_against(decision: str, said: list[Said], last: list[Said]) -> list[Said]:
    """Give what a text asks for that is the opposite of its decision; nothing where it leaves room for the decision.

    Another action than the decision's is no contradiction: a text may ask for several, and may name the decision's own in words that
    are not known here. said: of the whole reasoning; last: of its last sentence, which is what it asks for where nothing is asked for
    plainly.
    """
    decision = kin_of(decision)
    final = _final(last)
    if final is not None and _is_plainly_opposite(decision, final) and decision not in _allowed(_beside(final, last)):
        return [final]
    asked = [one for one in said if one.force == "directive"] or [one for one in said if one.force == "aim"]
    asked = asked or [one for one in last if one.force == "open" and (one.side or one.action not in _SIDED)]
    named = {one.action for one in asked if one.side}  # "turning the nose to the left": one turn, not two
    asked = [one for one in asked if one.side or one.action not in named]
    opposites = [one for one in asked if _is_opposite(decision, one)]
    if decision in _allowed(asked):
        return []
    sided = {one.action for one in said if one.side}
    rest = [one for one in said if one.force in ("open", "option", "aim") and (one.side or one.action not in sided)]
    beside = [one for one in said if one.side or one.action not in named]
    rest += [one for one in beside if any(one.clause == other.clause and one != other for other in opposites)]
    return [] if decision in _allowed(rest) else opposites


def _final(last: list[Said]) -> Said | None:
    """Give what the last sentence asks for in the end, whatever was asked for before."""
    asked = [one for one in last if one.force == "directive" and (one.side or one.action not in _SIDED)]
    return asked[-1] if asked else None


def _beside(final: Said, last: list[Said]) -> list[Said]:
    """Give what else the sentence asks for, its own clause names or another leaves open with a side: "a small turn to the left keeps him centred; it can go on hovering"."""
    return [
        one
        for one in last
        if one != final
        and (one.clause == final.clause or one.force == "directive" or (one.side and one.force == "option"))
    ]


def _is_plainly_opposite(decision: str, said: Said) -> bool:
    return _is_to_other_side(decision, said) or (said.action, decision) in _PLAIN_OPPOSITES


def _is_to_other_side(decision: str, said: Said) -> bool:
    sided = _SIDED.get(said.action)
    return sided is not None and said.side != 0 and decision == sided.format("right" if said.side > 0 else "left")


def _is_opposite(decision: str, said: Said) -> bool:
    if said.action in ("leave", "home"):
        return decision not in ("break_off", "return_to_home")
    if said.action in _SIDED and decision == "track_straight":
        return said.side != 0 and said.force == "directive"
    return _is_to_other_side(decision, said) or said.action in _OPPOSITE.get(decision, ())


def _allowed(said: list[Said]) -> set[str]:
    allowed: set[str] = set()
    for action, side, *_ in said:
        if action in _SIDED:
            words = {1: ("left",), -1: ("right",), 0: ("left", "right")}[side]
            allowed |= {_SIDED[action].format(word) for word in words}
        else:
            allowed |= set(_AGREE[action])
    return allowed
