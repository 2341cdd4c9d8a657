"""The embedded planner: reads a prompt by tables of words, without a model. English only.

Source: an alternative to the language model of app:simworld:step1 where no endpoint is given.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

from cosfly.runtime.config import read_yaml
from cosfly.runtime.errors import InputError
from cosfly.runtime.seeding import rng_for
from cosfly.worldgen.plan import OBJECTS, NamedObject, WorldPlan

WORDS = read_yaml(Path(__file__).with_name("words.yaml"))
KNOWN = {
    *(word for name in ("ordinary", "open", "water", "sized") for word in WORDS[name]),
    *(word for table in (WORDS["settlements"], *WORDS["groups"].values())
      for entry in table.values() for word in entry["words"].split()),
}  # fmt: skip
NUMBERS = {word: number for number, word in enumerate(WORDS["numbers"], 1)}
ARTICLES = {"a", "an", "the", "its", "some", "several"}
_STOPS = re.compile(
    r"\b(?:and|or|with|of|on|in|at|by|along|around|round|near|beside|between|to|from|for|over|through|without|under|is|are|has|have"
    r"|it|there|where|that|which|them|stands?|surrounded|lined)\b|[,.;:()]"
)  # fmt: skip
_PHRASE = rf"(?:(?!{_STOPS.pattern}|\b(?:but|no)\b).)+"
_WITHOUT = re.compile(rf"\b(?:no|without(?: any)?)\s+({_PHRASE}(?:\b(?:or|nor)\b{_PHRASE})*)")  # "no fountain or well"
_HEIGHTS = re.compile(r"\b(?:between|from)\s+(\d+)\s*(?:m\b)?\s*(?:and|to)\s+(\d+)\s*(?:m|metres?|meters?)\b")
SEVERAL = 4  # objects of a plural without a number


def plan_by_rules(prompt: str, seed: int) -> tuple[WorldPlan, dict[str, Any]]:
    """Read a prompt; return the plan, and the trace: the choice for each property.

    The seed varies unspecified sizes, by up to a tenth.
    """
    text = prompt.lower().replace("’", "'")
    trees = r"\b(no|without(?: any)?|few|many|hardly any|lots of) (trees|vegetation|greenery)"
    text = re.sub(trees, lambda m: f"{re.sub('^without.*', 'no', m[1])}-trees".replace(" ", "-"), text)
    text = re.sub(r"\bgarden city\b", "garden-city", text)
    without = " ".join(_WITHOUT.findall(text))
    text = _WITHOUT.sub(" , ", text)
    objects, remaining_text = _find_objects(text)
    words = re.findall(r"[a-z][a-z'-]*", remaining_text)
    not_in_table = _find_unknown(remaining_text)
    if not (objects or not_in_table or without or set(words) & KNOWN):
        raise InputError(
            "the rule-based planner recognises no word of this prompt", where="PROMPT", got=repr(prompt[:60]),
            expected="an English description, such as 'a small village with a church'",
            fix="name a kind of place, or use a language model with --planner URL",
        )  # fmt: skip
    settlements = WORDS["settlements"]
    kind = next((name for name, entry in settlements.items() if set(entry["words"].split()) & set(words)), "town")
    trace: dict[str, Any] = {"planner": "rules", "settlement": kind, "objects": {w.name: w.count for w in objects}}
    plan = WorldPlan().model_dump() | {name: value for name, value in settlements[kind].items() if name != "words"}
    for group, choice in _choices(remaining_text).items():
        trace[group] = choice
        for name, factor in WORDS["groups"][group][choice].items():
            if name != "words":
                plan[name] = _scaled(plan[name], factor)
    for name in ("blocks_along", "block_m", "gap_m"):
        plan[name] = _scaled(plan[name], rng_for(seed, "world", name).uniform(0.92, 1.08))
    if heights := _HEIGHTS.search(prompt.lower()):
        plan["heights_m"] = float(heights[1]), float(heights[2])
        if not 3 <= plan["heights_m"][0] <= plan["heights_m"][1] <= 450:
            expected = "a lowest and a highest height, within 3 to 450 m"
            what = "the range of building heights is impossible"
            raise InputError(what, where="PROMPT", got=heights[0], expected=expected)
    plan |= _open_and_water(words, objects, plan)
    if without:
        trace["without"] = without
        if re.search(r"\b(?:cars?|vehicles?|traffic)\b", without):
            plan["parked_share"] = 0.0
    if "tower" in " ".join(words) and kind not in ("downtown", "high-rise city"):
        plan["heights_m"] = (plan["heights_m"][0], max(plan["heights_m"][1], 48.0))
    if re.search(r"\b(?:towers|high-rises|skyscrapers) in the (?:cent|middle)", text):
        plan["high_center"] = True
        plan["heights_m"] = (min(plan["heights_m"][0], 8.0), plan["heights_m"][1])
    least = math.ceil(math.sqrt(2 * (plan["plazas"] + plan["greens"])))  # half of the blocks are built on
    plan["blocks_along"] = int(min(9, max(2, least, round(plan["blocks_along"]))))
    plan["gap_m"] = max(0.5, plan["gap_m"])
    plan |= {"objects": [named.model_dump() for named in objects], "not_in_table": not_in_table}
    return WorldPlan.model_validate(plan), trace | {"not_in_table": not_in_table}


def _scaled(value: Any, factor: float) -> Any:
    return tuple(round(v * factor, 2) for v in value) if isinstance(value, tuple | list) else round(value * factor, 2)


def _find_objects(text: str) -> tuple[list[NamedObject], str]:
    """Find the objects of the table, the longest names first; return also the rest of the text."""
    objects: dict[str, NamedObject] = {}
    names = {word: thing.name for thing in OBJECTS.values() for word in (thing.name, *thing.words)}
    numbers = "|".join([*NUMBERS, *ARTICLES, r"\d+"])
    for word in sorted(names, key=len, reverse=True):
        plural = f"{word[:-1]}ies" if word.endswith("y") else f"{word}(?:e?s)?"
        pattern = re.compile(rf"\b(?:({numbers})\s+(?:[a-z-]+\s+)??)?({word}|{plural})\b(?!-)")
        while match := pattern.search(text):
            number = match[1] or ""
            is_plural = match[2] != word
            if names[word] == "hotel" and is_plural and not number:
                break  # hotels are ordinary buildings
            count = SEVERAL if is_plural else 1
            if number in NUMBERS or number.isdigit():
                count = min(60, max(1, NUMBERS.get(number, 0) or int(number)))
            objects[names[word]] = NamedObject(name=names[word], count=count)
            text = f"{text[: match.start()]} , {text[match.end() :]}"
    return [objects[name] for name in sorted(objects)], text


def _choices(text: str) -> dict[str, str]:
    """Return the choice of the text in each group; words of size count only in phrases about the settlement."""
    chosen: dict[str, str] = {}
    phrases = [re.findall(r"[a-z][a-z'-]*", phrase) for phrase in _STOPS.split(text)]
    of_settlement = [
        words for words in phrases if set(WORDS["sized"]) & set(words) or any(w.endswith("-scale") for w in words)
    ]
    for group, choices in WORDS["groups"].items():
        words = [word for phrase in (of_settlement if group == "size" else phrases) for word in phrase]
        found = {choice: word for word in words for choice, entry in choices.items() if word in entry["words"].split()}
        if len(found) > 1:
            got = " and ".join(repr(word) for word in found.values())
            what = f"two words about {group} contradict each other"
            raise InputError(what, where="PROMPT", got=got, fix="use only one of these words")
        if found:
            chosen[group] = next(iter(found))
    return chosen


def _open_and_water(words: list[str], objects: list[NamedObject], plan: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a plan that change by the objects and by words for open blocks and water."""
    changes: dict[str, Any] = {}
    for word in words:
        singular = word.removesuffix("s")
        if singular in WORDS["open"] and not (word == "park" and "industrial" in words):
            field = WORDS["open"][singular]
            changes[field] = max(plan[field], 1 if singular == word else 3)
        if word in WORDS["water"]:
            field, wide = WORDS["water"][word]
            changes[field] = wide
    counts = {named.name: named.count for named in objects}
    if "bridge" in counts:
        changes |= {"bridges": min(10, counts["bridge"]), "river_m": changes.get("river_m", 40.0)}
    if any(OBJECTS[name].where in ("quay", "water") for name in counts) and "river_m" not in changes:
        changes.setdefault("shore_m", 90.0)
    if "park" in words and "large" in words and "industrial" not in words:
        changes["greens"] = max(changes.get("greens", 0), 4)
    return changes


def _find_unknown(text: str) -> list[str]:
    """Return the phrases that begin with an article or a number, and of which no table has a word."""
    unknown = []
    for phrase in _STOPS.split(text):
        first, *words = re.findall(r"[a-z0-9][a-z0-9'-]*", phrase) or [""]
        is_counted = first in ARTICLES or first in NUMBERS or first.isdigit()
        if is_counted and words and len(words[-1]) > 2 and not {*words, words[-1].removesuffix("s")} & KNOWN:
            unknown.append(" ".join(words))
    return unknown
