"""The embedded planner: reads a prompt by tables of words, without a model. English only; `trace` says what it read.

Source: stands in for the language model of app:simworld:step1 where no endpoint is given.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

from cosfly.runtime.config import read_yaml
from cosfly.runtime.errors import InputError
from cosfly.runtime.seeding import rng_for
from cosfly.worldgen.objects import OBJECTS
from cosfly.worldgen.plan import NamedObject, WorldPlan

WORDS = read_yaml(Path(__file__).with_name("words.yaml"))
NUMBERS = {word: number for number, word in enumerate(WORDS["numbers"], 1)}
ARTICLES = {"a", "an", "the", "its", "some", "several"}
_STOPS = re.compile(
    r"\b(?:and|or|with|of|on|in|at|by|along|around|round|near|beside|between|to|from|for|over|through|without|under|is|are|has|have"
    r"|it|there|where|that|which|them|stands?|surrounded|lined)\b|[,.;:()]"
)  # fmt: skip
_PHRASE = rf"(?:(?!{_STOPS.pattern}|\b(?:but|no)\b).)+"
_WITHOUT = re.compile(rf"\b(?:no|without(?: any)?)\s+({_PHRASE}(?:\b(?:or|nor)\b{_PHRASE})*)")  # "no fountain or well"
SEVERAL = 4  # of a plural without a number
MOST_CHARACTERS = 2000


def check_prompt(prompt: str) -> str:
    """Return a prompt on one line."""
    text = " ".join(prompt.split())
    if not re.search(r"\w", text) or len(text) > MOST_CHARACTERS:
        expected = f"1 to {MOST_CHARACTERS} characters, as in 'a small village with a church'"
        raise InputError(
            "a prompt that cannot be planned", where="PROMPT", got=f"{len(text)} characters", expected=expected
        )
    return text


def plan_by_rules(prompt: str, seed: int) -> tuple[WorldPlan, dict[str, Any]]:
    """Read a prompt; the seed varies what it leaves open, by up to a tenth.

    Returns:
        the plan, and the trace: which words were read as what.
    """
    text = prompt.lower().replace("’", "'")
    text = re.sub(
        r"\b(no|without(?: any)?|few|many|hardly any|lots of) (trees|vegetation|greenery)",
        lambda m: "no-trees" if m[1].startswith("without") else f"{m[1]}-trees".replace(" ", "-"),
        text,
    )
    text = re.sub(r"\bgarden city\b", "garden-city", text)
    without, text = " ".join(_WITHOUT.findall(text)), _WITHOUT.sub(" , ", text)
    objects, rest = _objects(text)
    words = re.findall(r"[a-z][a-z'-]*", rest)
    kind = next((name for name, one in WORDS["settlements"].items() if set(one["words"].split()) & set(words)), "town")
    values = {name: value for name, value in WORDS["settlements"][kind].items() if name != "words"}
    trace: dict[str, Any] = {"planner": "rules", "settlement": kind, "objects": {w.name: w.count for w in objects}}
    plan = WorldPlan().model_dump() | values
    for group, said in _said(rest, words).items():
        trace[group] = said
        for name, factor in WORDS["groups"][group][said].items():
            if name != "words":
                plan[name] = _times(plan[name], factor)
    for name, factor in (("blocks_along", 1), ("block_m", 1), ("gap_m", 1)):
        plan[name] = _times(plan[name], factor * rng_for(seed, "world", name).uniform(0.92, 1.08))
    plan |= _heights(prompt.lower(), plan)
    plan |= _open_and_water(words, objects, plan)
    if without:
        trace["without"] = without
        plan["parked_share"] *= not re.search(r"\b(?:cars?|vehicles?|traffic)\b", without)
    if "tower" in " ".join(words) and kind not in ("downtown", "high-rise city") and "heights_m" in values:
        plan["heights_m"] = (plan["heights_m"][0], max(plan["heights_m"][1], 48.0))
    if re.search(r"\b(?:towers|high-rises|skyscrapers) in the (?:cent|middle)", text):
        plan["high_center"], plan["heights_m"] = True, (min(plan["heights_m"][0], 8.0), plan["heights_m"][1])
    least = math.ceil(math.sqrt(2 * (plan["plazas"] + plan["greens"])))  # half of the blocks are built up
    plan["blocks_along"] = int(min(9, max(2, least, round(plan["blocks_along"]))))
    plan["gap_m"] = max(0.5, plan["gap_m"])
    plan |= {"objects": [one.model_dump() for one in objects], "not_in_table": _unknown(rest)}
    trace["not_in_table"] = plan["not_in_table"]
    spoken = re.findall(r"[a-z][a-z'-]+", " ".join(_STOPS.split(rest)))
    left = " ".join(plan["not_in_table"]).split()
    trace["not_read"] = sorted(
        {w for w in spoken if not {w, w.removesuffix("s")} & {*_known(), *ARTICLES, *NUMBERS, *left, "but"}}
    )
    if not (objects or plan["not_in_table"] or without or set(words) & _known()):
        raise InputError(
            "nothing that the rules can read",
            where="PROMPT",
            got=repr(prompt[:60]),
            expected="English, as in 'a small village with a church'",
            fix="say a kind of place, or ask a language model with --planner URL",
        )
    return WorldPlan.model_validate(plan), trace


def _times(value: Any, factor: float) -> Any:
    return (
        tuple(round(one * factor, 2) for one in value) if isinstance(value, (tuple, list)) else round(value * factor, 2)
    )


def _objects(text: str) -> tuple[list[NamedObject], str]:
    """Find the objects of the table, the longest names first; gives also what is left of the text."""
    found: list[NamedObject] = []
    names = {word: one.name for one in OBJECTS.values() for word in (one.name, *one.words)}
    for word in sorted(names, key=len, reverse=True):
        plural = f"{word[:-1]}ies" if word.endswith("y") else f"{word}(?:e?s)?"
        numbers = "|".join([*NUMBERS, *ARTICLES, r"\d+"])
        pattern = re.compile(rf"\b(?:({numbers})\s+(?:[a-z-]+\s+)??)?({word}|{plural})\b(?!-)")
        while match := pattern.search(text):
            said, is_plural = match[1], match[2] != word
            if names[word] == "hotel" and is_plural and not said:
                break  # hotels are buildings like others
            count = SEVERAL if is_plural else 1
            if said in NUMBERS or (said or "").isdigit():
                count = min(60, max(1, NUMBERS.get(said or "", 0) or int(said or 1)))
            found = [one for one in found if one.name != names[word]] + [NamedObject(name=names[word], count=count)]
            text = f"{text[: match.start()]} , {text[match.end() :]}"
    return sorted(found, key=lambda one: one.name), text


def _said(rest: str, words: list[str]) -> dict[str, str]:
    """Return which word of each group is said of the settlement."""
    said: dict[str, str] = {}
    for group, choices in WORDS["groups"].items():
        found: dict[str, str] = {}
        for chunk in _STOPS.split(rest):
            own = re.findall(r"[a-z][a-z'-]*", chunk)
            if group == "size" and not (set(WORDS["sized"]) & set(own) or any(word.endswith("-scale") for word in own)):
                continue
            found |= {choice: word for choice, one in choices.items() for word in own if word in one["words"].split()}
        if len(found) > 1:
            got = " and ".join(repr(word) for word in found.values())
            raise InputError(f"contradictory words of {group}", where="PROMPT", got=got, expected="one of them")
        if found:
            said[group] = next(iter(found))
    return said


def _heights(text: str, plan: dict[str, Any]) -> dict[str, Any]:
    """Read heights in metres: between A and B m, at least A m, up to B m."""
    unit = r"\s*(?:m|metres?|meters?)\b"
    between = re.search(rf"\b(?:between|from)\s+(\d+)(?:{unit})?\s+(?:and|to)\s+(\d+){unit}", text)
    least = re.search(rf"\b(?:at least|over|above|more than)\s+(\d+){unit}", text)
    most = re.search(rf"\b(?:at most|up to|below|under|less than)\s+(\d+){unit}", text)
    low, high = plan["heights_m"]
    if between or least or most:
        low = float(between[1] if between else least[1] if least else min(low, 0.5 * float(most[1])))  # type: ignore[index]
        high = float(between[2] if between else most[1] if most else max(high, 1.5 * low))
        if low > high or low < 3 or high > 450:
            got = f"{low:g} to {high:g} m"
            raise InputError(
                "contradictory heights", where="PROMPT", got=got, expected="lowest to highest, within 3 to 450 m"
            )
    return {"heights_m": (low, high)}


def _open_and_water(words: list[str], objects: list[NamedObject], plan: dict[str, Any]) -> dict[str, Any]:
    changes: dict[str, Any] = {}
    for word in words:
        singular = word[:-1] if word.endswith("s") else word
        if singular in WORDS["open"] and not (word == "park" and "industrial" in words):
            field = WORDS["open"][singular]
            changes[field] = max(plan[field], 1 if singular == word else 3)
        if word in WORDS["water"]:
            field, wide = WORDS["water"][word]
            changes[field] = wide
    counts = {one.name: one.count for one in objects}
    if "bridge" in counts:
        changes |= {"bridges": min(10, counts["bridge"]), "river_m": changes.get("river_m", 40.0)}
    if any(OBJECTS[name].where in ("quay", "water") for name in counts) and "river_m" not in changes:
        changes.setdefault("shore_m", 90.0)
    if "park" in words and "large" in words and "industrial" not in words:
        changes["greens"] = max(changes.get("greens", 0), 4)
    return changes


def _known() -> set[str]:
    """Return all words of the tables but the objects'."""
    known = {*WORDS["ordinary"], *WORDS["open"], *WORDS["water"], *WORDS["sized"]}
    for table in (WORDS["settlements"], *WORDS["groups"].values()):
        known |= {word for one in table.values() for word in one["words"].split()}
    return known


def _unknown(rest: str) -> list[str]:
    """Return what the text names and no table has: the last word of a phrase that begins with an article or a
    number."""
    known, found = _known(), []
    for chunk in _STOPS.split(rest):
        words = re.findall(r"[a-z0-9][a-z0-9'-]*", chunk)
        if len(words) < 2 or not (words[0] in ARTICLES or words[0] in NUMBERS or words[0].isdigit()):
            continue
        last = words[-1]
        if (
            len(last) > 2
            and not {last, last.removesuffix("s")} & known
            and not any(word in known for word in words[1:-1])
        ):
            found.append(" ".join(words[1:]))
    return found
