"""A sentence to its form: clause by clause, with what earlier clauses leave to later ones."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import lru_cache

from caption.truth.prose.clauses import Clause, parse
from caption.truth.prose.cues import Context, times_of
from caption.truth.prose.deciding import actions_of
from caption.truth.prose.reading_faster import FasterReader
from caption.truth.prose.reading_numbers import NumberReader
from caption.truth.prose.reading_plain import PlainReader
from caption.truth.prose.reading_sides import SideReader
from caption.truth.prose.reading_sight import SightReader
from caption.truth.prose.reading_states import StateReader
from caption.truth.prose.reading_strong import StrongReader
from caption.truth.prose.reading_words import WordReader
from caption.truth.prose.statements import NOW, Form, Said, Statement
from cosfly.products.captions import Language

_READERS = (StateReader, PlainReader, StrongReader, SideReader, SightReader, FasterReader)


@lru_cache(maxsize=65536)  # by the sentence without its digits: neighbouring windows share most
def read_form(masked: str, language: Language, subject: str, is_reasoning: bool) -> Form:
    """Read a sentence in which runs of digits are written as `#`. subject: whom the sentence before it spoke of."""
    sentence = parse(masked, language)
    if masked.endswith(("?", "？")):  # a question states nothing
        of_past = any(frames != (NOW,) for clause in sentence.clauses for _, frames in times_of(clause))
        return Form(masked, tuple(sentence.numerals), (), True, subject, asks_of_past=of_past)
    context = Context(subject=subject)
    statements: list[Statement] = []
    actions: list[Said] = []
    left_out = any_plan = False
    for clause in sentence.clauses:
        is_plan = _is_plan(masked, clause, is_reasoning, any_plan)
        any_plan = any_plan or is_plan or (is_reasoning and clause.has("modality", "future") and clause.has("action"))
        in_scene = clause.has("who", "scene") and not clause.has("who", "drone", "target")
        numbers = NumberReader(sentence, clause, context, in_scene)
        numbers.read()
        plain = {"in_scene": in_scene, "is_plan": is_plan, "is_reasoning": is_reasoning}
        words = WordReader(sentence, clause, context, **plain)
        words.read(numbers.beside.used_sides)
        statements += numbers.statements + words.statements
        for reader in _READERS:
            one = reader(sentence, clause, context, **plain)
            one.read()
            statements += one.statements
            left_out = left_out or one.left_out
        left_out = left_out or numbers.left_out or words.left_out
        if is_reasoning or is_plan:
            actions += actions_of(sentence, clause, is_plan=is_plan)
        _carry(masked, clause, context)
    statements = _per_frame(statements)
    return Form(
        masked,
        tuple(sentence.numerals),
        tuple(statements),
        left_out,
        context.subject,
        tuple(actions),
    )


def _per_frame(statements: list[Statement]) -> list[Statement]:
    """Read "seen: fully, fully, partly, not at all, not at all" as one word for each frame; drop a row that is not one a frame."""
    row = [s for s in statements if s.kind == "visibility" and s.frames == (-1,) and s.clause[1] - s.clause[0] <= 22]
    if len(row) < 4:
        return statements
    others = [s for s in statements if s.kind != "visibility"]
    return others + [replace(s, frames=(i,)) for i, s in enumerate(row[-5:])] if len(row) >= 5 else others


def _is_plan(masked: str, clause: Clause, is_reasoning: bool, any_plan: bool) -> bool:
    has_owner = clause.has("who", "drone", "target")
    if clause.has("modality", "plan"):
        return True
    if clause.has("modality", "thus") and (clause.has("action") or not has_owner):
        is_told = not is_reasoning and _SO_DOING.search(masked, clause.start, clause.end)
        return not (is_told or _UNDER_WAY.search(masked, clause.start, clause.end))
    if any_plan and not has_owner and not clause.numerals:
        return True
    return is_reasoning and not clause.numerals and _opens_with_action(masked, clause, has_owner)


_UNDER_WAY = re.compile(
    r"\b(?:is|are) (?:(?:\w+ )?(?!being)\w+ing\b|(?:well|already) )|正在?[^,]{0,4}(?:转|摆)"
)  # "so the nose is coming back"
_SO_DOING = re.compile(r"\b(?:so|thus|hence) \w+ing\b")  # among the components: "4.0 m/s, 5.0 m/s at t1, so slowing"
_IS_WHAT = re.compile(r"\b(?:is|was) (?:what|how|why)\b")  # "turning while sliding is what a circle looks like"
_BEFORE_ACTION = re.compile(
    r"(?:so|then|hence|now|and|just|simply|[-:.])*\s*(?:an?|another|some|more)?\s*(?:(?:gentle|slight|further|small|moderate|continued|continuing"
    r"|left|right|leftward|rightward|clockwise|counterclockwise|anticlockwise|short|slow|quick|gradual|mild|soft|careful|little|bit|modest|firm|brief|tight|wide|level|steady|smooth) ?)*"
    r"|(?:那就|就|先|再|请|立即|马上|接着|然后|随后|随即|现在|此时|这时|目前|于是|还是|不如|只管|尽快|迅速|缓缓|慢慢|稍微|略微|略|稍|轻轻|小幅|大幅|适当|适度|进一步|向[左右上下前后]|往[左右上下前后]|朝[左右]|[,、\s])*"
)


def _opens_with_action(masked: str, clause: Clause, has_owner: bool) -> bool:
    """Tell whether a clause opens with what to do: "yaw right", "a gentle left turn", "rotating the nose left"."""
    token = next((t for t in clause.tokens if t.kind == "action"), None)
    if token is None or masked[token.start : token.end] in ("nose", "机头", "rotation", "heading change"):
        return False
    if _IS_WHAT.search(masked, token.end):
        return False
    if re.match(r"\s+(?:is|are|was|has|had|rate|of|works|helps|continues)\b", masked[token.end :]):
        return False
    before = masked[clause.start : token.start].strip(" ,;:")
    if not _BEFORE_ACTION.fullmatch(before + " ") and before:
        return False
    if masked.isascii():
        word = masked[token.start : token.end].split()[0]
        return word.endswith("ing") or not has_owner or (bool(before) and not word.endswith("s"))
    return not has_owner and not re.search(r"了|正在|正|已|仍", masked[clause.start : clause.end])


_TOLD_BY = {
    "alt_up": "altitude", "alt_down": "altitude", "pace_up": "speed", "pace_down": "speed", "dist_up": "distance", "dist_down": "distance",
}  # fmt: skip


def _carry(text: str, clause: Clause, context: Context) -> None:
    people = clause.of("who", "drone", "target")
    if people:
        context.people += tuple(t.value for t in people)
        context.subject, context.latest, context.is_carried = people[0].value, people[-1].value, False
    cues = list(clause.of("quantity"))
    if cues:
        context.told = ""
        context.cue = cues[-1].value if clause.numerals or len(cues) == 1 else cues[0].value
    else:
        trends = [t.value for t in clause.of("trend") if t.value in _TOLD_BY]
        if trends:
            context.told, context.told_way = _TOLD_BY[trends[0]], 1 if trends[0].endswith("up") else -1
    if context.cue == "height" and clause.has("quantity", "box"):
        context.cue = "tall"
    context.has_past = context.has_past or clause.has("time", "past", "start", "prev1", "prev2")
    if any(frames != (NOW,) for _, frames in times_of(clause)):
        context.has_frame = True
        context.has_past = context.has_past or text.startswith(":", clause.end)  # "t0 and t1: target partly hidden"
