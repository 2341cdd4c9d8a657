"""The embedded planner: reads an English prompt by tables of words, without a model.

What is read is taken out of the text, so that the rest are the words that were not used.

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
from cosfly.worldgen.plan import OBJECTS, WorldPlan


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


WORDS = read_yaml(Path(__file__).with_name("words.yaml"))
STOPS, ORDINARY = set(_words(WORDS["stops"])), set(_words(WORDS["ordinary"]))
LIMITS = (
    ("blocks_along", 2.0, 9.0), ("block_m", 30.0, 180.0), ("gap_m", 0.5, 40.0), ("street_m", 5.0, 40.0),
    ("avenue_m", 5.0, 60.0), ("parked_share", 0.0, 0.9),
)  # fmt: skip
AMOUNTS = {
    "no": "no", "without": "no", "without any": "no", "few": "few", "almost no": "few", "hardly any": "few",
    "many": "many", "lots of": "many", "plenty of": "many",
}  # fmt: skip
SEVERAL = 4  # objects of a plural without a number
STOREY_M = 3.2
LOW_TOWN_M = 16.0  # highest building of a town without high-rises
DEEP = 2.4  # depth of a linear town of a given length, in blocks
_NUMBER, _LENGTH = r"(\d+(?:\.\d+)?)", r"(km|kilomet(?:er|re)s?|m|metres?|meters?)\b"
_HEIGHT = rf"{_NUMBER}[ -]?(m|metres?|meters?|floors?|storeys?|stor(?:y|ies)|levels?)\b(?! (?:wide|long|x|by))"
_HIGH = r"(?: high| tall| in height)?"
_STREET = r"\b(street|road|lane|alley|avenue)s?"
_LIMITS = {  # of the heights of buildings
    "most": r"(?:(?:no|none|not|nothing)(?: \w+)?(?: is| are)? (?:higher|taller|more|over|above)(?: than)?|under|below"
            rf"|at most|up to|max(?:imum)?\.?(?: height)?(?: of)?|limited to) {_HEIGHT}{_HIGH}",
    "most_too": rf"{_HEIGHT}{_HIGH},? (?:at most|or less|or lower|maximum|at the most)",
    "between": rf"(?:\b(?:between|from) )?\b{_NUMBER} ?(?:m|metres?|meters?)? ?(?:and|to|-) {_HEIGHT}{_HIGH}",
    "least": rf"(?:at least|more than|over|above|minimum) {_HEIGHT}{_HIGH}",
    "exactly": rf"{_HEIGHT}{_HIGH}",
}  # fmt: skip
_SIZES = {
    "sides": rf"{_NUMBER} ?(?:{_LENGTH})? ?(?:x|×|by|times) ?{_NUMBER} ?{_LENGTH}",
    "square": rf"{_NUMBER} ?{_LENGTH} (?:square\b|across|on (?:a|each) side)",
    "area": rf"{_NUMBER} ?(km2|km²|square kilomet(?:er|re)s?|sq\.? ?km|hectares?|ha|m2|m²|square met(?:er|re)s)(?!\w)",
    "length": rf"{_NUMBER} ?{_LENGTH} long\b",
}
_CHINESE = re.compile(r"[\u4e00-\u9fff]")


def plan_by_rules(prompt: str, seed: int) -> tuple[WorldPlan, dict[str, Any]]:
    """Read a prompt; return the plan, and the trace: what was read as what, and what was not respected.

    The seed chooses the street pattern and sizes that the prompt does not name.
    """
    return _Reader(prompt).read(seed)


class _Reader:
    """Reads one prompt. text: what is not read yet; plan: fields of the plan, found so far."""

    def __init__(self, prompt: str) -> None:
        self.prompt = prompt
        self.plan: dict[str, Any] = WorldPlan().model_dump()
        self.not_used: list[str] = []
        self.not_respected: list[str] = []
        text = prompt.lower().replace("’", "'")
        if _CHINESE.search(text):
            what, expected = "内置规则只读英文描述", "英文描述, 例如 'a small village with a church'"
            fix = "用英文写这段描述, 或用 --planner URL 指定语言模型"
            raise InputError(what, where="PROMPT", got=repr(prompt[:60]), expected=expected, fix=fix)
        for word in sorted(WORDS["numbers"], key=len, reverse=True):
            text = re.sub(rf"\b{word}\b", str(WORDS["numbers"][word]), text)
        for plain, pattern in (("1-stor", r"\bsingle[- ]stor"), ("hotel-buildings", r"(?<!\d )\bhotels\b")):
            text = re.sub(pattern, plain, text)
        text = re.sub(r"\b([2-9]0)[- ]([1-9])\b", lambda match: str(int(match[1]) + int(match[2])), text)
        amounts = "|".join(sorted(AMOUNTS, key=len, reverse=True))
        pattern = rf"\b({amounts}) (trees|vegetation|greenery|cars)\b"
        self.text = " " + re.sub(pattern, self._amount, text) + " "

    @staticmethod
    def _amount(match: re.Match[str]) -> str:
        word = "cars" if match[2] == "cars" else "trees"
        return f"{AMOUNTS[match[1]]}-{word}"

    # --- what is taken from the text ---

    def _take(self, pattern: str, keep: str = ",") -> re.Match[str] | None:
        """Return the first match of a pattern, and put `keep` in its place."""
        if match := re.search(pattern, self.text):
            self.text = f"{self.text[: match.start()]} {match.expand(keep)} {self.text[match.end() :]}"
        return match

    def _take_words(self, words: str) -> None:
        """Take all of some words, singular or plural."""
        for word in sorted(_words(words), key=len, reverse=True):
            while self._take(rf"(?<![\w-]){re.escape(word)}s?(?![\w-])"):
                pass

    def _take_counted(self, word: str, *, needs_number: bool = False) -> tuple[int | None, bool] | None:
        """Take a noun with its number; return the number, and whether it is a plural. Adjectives between them stay."""
        plural = f"{word[:-1]}ies" if re.search("[^aeiou]y$", word) else f"{word}(?:e?s)?"
        stops = "|".join(sorted(STOPS, key=len, reverse=True))
        number = rf"(?:\b(\d+) ((?:(?!(?:{stops}) )[a-z-]+ ){{0,3}}?)){'' if needs_number else '?'}"
        match = self._take(rf"{number}\b({word}|{plural})\b(?!-)", keep=r", \2 ,")
        return match and (int(match[1]) if match[1] else None, match[3] != word)

    def read(self, seed: int) -> tuple[WorldPlan, dict[str, Any]]:
        """Return the plan and the trace."""
        before = self.text
        sizes = {name: match for name, pattern in _SIZES.items() if (match := self._take(pattern))}
        widths = [match for pattern in (
            rf"{_STREET}(?: (?:width|are|is|of))* {_NUMBER} ?{_LENGTH}(?: wide| in width)?",
            rf"{_NUMBER} ?{_LENGTH}[- ]wide {_STREET}",
        ) if (match := self._take(pattern))]  # fmt: skip
        streets = self._take(r"\b(\d+) ([a-z-]+ )?(avenue|boulevard|spoke|street|road)s?\b", keep=r", \2 \3 ,")
        limits = {name: match for name, pattern in _LIMITS.items() if (match := self._take(pattern))}
        for second in [name for name in limits if name != "least"][1:]:
            self.not_used.append(limits.pop(second)[0].strip())
        without = ""
        while match := self._take(r"\b(?:no|without(?: any)?)\s+((?:(?! (?:but|and|with) )[^.,;:()])+)"):
            without += f"{match[1]} "
        objects = self._objects()
        lacking = [match[0] for word in _words(WORDS["lacking"]) if (match := self._take(rf"(?:\b\d+ )?\b{word}s?\b"))]
        self.not_used += [phrase.strip() for phrase in lacking]
        pattern = next((name for name, words in WORDS["patterns"].items() if self._has(words)), None)
        kind = next((name for name, entry in WORDS["settlements"].items() if self._has(entry["words"])), None)
        buildings = self._buildings()
        implied = [WORDS["buildings"][one["name"]].get("implies") for one in buildings if one["count"] != 1]
        place = kind or next(filter(None, implied), "town")
        entry = WORDS["settlements"][place]
        self.plan |= {name: value for name, value in entry.items() if name in self.plan}
        choices = self._choices()
        for group, choice in choices.items():
            for name, factor in WORDS["groups"][group][choice].items():
                if name != "words":
                    self.plan[name] = _scaled(self.plan[name], factor)
        has_open = self._set_open_and_water(objects)
        for words in (entry["words"], WORDS["settlements"]["city"]["words"], WORDS["settlements"]["town"]["words"],
                      WORDS["patterns"].get(pattern, "")):  # fmt: skip
            self._take_words(words)
        if not (self.text != before or without):
            self._refuse()
        self.plan["pattern"] = pattern or entry["patterns"][seed % len(entry["patterns"])]
        self._set_buildings(buildings, entry, choices)
        if self.plan["only_these"] and not has_open:
            self.plan |= {"plazas": 0, "greens": 0}
        for name, low, high in (("blocks_along", 0.92, 1.08), ("block_m", 0.85, 1.2), ("gap_m", 0.92, 1.08)):
            self.plan[name] = _scaled(self.plan[name], rng_for(seed, "world", name).uniform(low, high))
        self._set_heights(limits, without)
        self._set_widths(widths)
        self._set_size(sizes, widths)
        if streets and self.plan["pattern"] == "radial":
            self.plan["spokes"] = self._within(f"number of {streets[3]}s", int(streets[1]), 3, 16)
        elif streets and streets[1] != "1":
            self.not_used.append(f"{streets[1]} {streets[3]}s")
        if re.search(r"\b(?:vehicles?|traffic)\b", without):
            self.plan["parked_share"] = 0.0
        self.not_used += self._left_over()
        for name, low, high in LIMITS:
            self.plan[name] = min(high, max(low, self.plan[name]))
        self.plan |= {"objects": [{"name": name, "count": count} for name, count in objects.items()]}
        plan = WorldPlan.model_validate(self.plan | {"not_used": self.not_used})
        trace = {
            "planner": "rules", "settlement": place, "settlement_is_named": bool(kind or any(implied)),
            "pattern": plan.pattern, "pattern_is_named": pattern is not None, "objects": objects, "without": without,
            **choices,
            "not_used": self.not_used, "not_respected": self.not_respected,
        }  # fmt: skip
        return plan, trace

    def _refuse(self) -> None:
        """Raise the error of a prompt of which nothing is read."""
        what = "the rule-based planner recognises no word of this prompt"
        expected = "an English description, such as 'a small village with a church'"
        fix = "name a kind of place, or use a language model with --planner URL"
        raise InputError(what, where="PROMPT", got=repr(self.prompt[:60]), expected=expected, fix=fix)

    def _has(self, words: str) -> bool:
        return any(re.search(rf"(?<![\w-]){re.escape(word)}s?(?![\w-])", self.text) for word in _words(words))

    def _objects(self) -> dict[str, int]:
        """Take the objects of the table, the longest names first; return their counts."""
        objects: dict[str, int] = {}
        names = {word: thing.name for thing in OBJECTS.values() for word in (thing.name, *thing.words)}
        for word in sorted(names, key=len, reverse=True):
            while found := self._take_counted(word):
                count = found[0] or (SEVERAL if found[1] else 1)
                objects[names[word]] = self._within(f"number of {names[word]}s", count, 1, 500)
        return dict(sorted(objects.items()))

    def _buildings(self) -> list[dict[str, Any]]:
        """Take the kinds of buildings; return them with their counts, null for a plural without a number."""
        names = {word: name for name, entry in WORDS["buildings"].items() for word in [*_words(entry["words"]), name]}
        found: dict[str, int | None] = {}
        for word in sorted(names, key=len, reverse=True):
            name = names[word]
            while counted := self._take_counted(word, needs_number=name == "building"):
                count = counted[0] or (0 if counted[1] else 1)
                if count := count + (found.get(name) or 0):
                    count = self._within(f"number of {name}s", count, 1, 1000)
                found[name] = count or None
        return [{"name": name, "count": count} for name, count in found.items()]

    def _choices(self) -> dict[str, str]:
        """Take the choice of the text in each group; words of size count only in phrases about the settlement."""
        chosen: dict[str, str] = {}
        ends = "with|of|and|around|in|by|on|at|along|near|between|to|from|for|over|through"
        phrases = re.split(rf"[.,;:()]|(?<![\w-])(?:{ends})(?![\w-])", self.text)
        sized = [
            phrase for phrase in phrases if re.search(rf"\b(?:{'|'.join(_words(WORDS['sized']))})\b|-scale", phrase)
        ]
        for group, entries in WORDS["groups"].items():
            text = " , ".join(sized if group == "size" else phrases)
            found = {
                choice: word for choice, entry in entries.items() for word in _words(entry["words"])
                if re.search(rf"(?<![\w-]){word}(?![\w-])", text)
            }  # fmt: skip
            if len(found) > 1:
                got = " and ".join(repr(word) for word in found.values())
                what = f"two words about {group} contradict each other"
                raise InputError(what, where="PROMPT", got=got, fix="use only one of these words")
            if found:
                chosen[group] = next(iter(found))
                self._take_words(entries[chosen[group]]["words"])
        return chosen

    def _set_open_and_water(self, objects: dict[str, int]) -> bool:
        """Take words of open blocks and of water; return whether there are some of the former."""
        before = self.text
        for word, (field, wide) in WORDS["water"].items():
            if self._has(word):
                self.plan[field] = wide
        for word, field in WORDS["open"].items():
            if counted := self._take_counted(word):
                most = 20 if field == "plazas" else 40
                number = counted[0] or (3 if counted[1] and word not in ("garden", "lawn") else 1)
                self.plan[field] = max(self.plan[field], self._within(f"number of {word}s", number, 1, most))
        has_open = self.text != before
        self._take_words(",".join(WORDS["water"]))
        if "bridge" in objects:
            self.plan["bridges"] = self._within("number of bridges", objects["bridge"], 1, 10)
            self.plan["river_m"] = self.plan["river_m"] or WORDS["water"]["river"][1]
        places = {OBJECTS[name].where for name in objects}
        if "quay" in places or ("water" in places and not self.plan["river_m"]):
            self.plan["shore_m"] = self.plan["shore_m"] or 90.0
        return has_open

    def _set_buildings(self, buildings: list[dict[str, Any]], entry: dict[str, Any], choices: dict[str, str]) -> None:
        """Set the kinds of buildings. Where one that the settlement consists of is counted, there are no others."""
        factor = WORDS["groups"]["height"].get(choices.get("height"), {}).get("heights_m", 1.0)
        for one in buildings:
            of = WORDS["buildings"][one["name"]]
            one["footprint_m"] = of.get("footprint_m", self.plan["footprint_m"])
            one["heights_m"] = _scaled(of["heights_m"], factor) if "heights_m" in of else self.plan["heights_m"]
            is_main = not of.get("landmark") or one["name"] in _words(entry.get("of", ""))
            if one["count"] is not None and is_main and (one["count"] > 1 or len(buildings) == 1):
                self.plan["only_these"] = True
        if any(one["count"] is None for one in buildings):
            self.plan["only_these"] = False
        self.plan["buildings"] = buildings

    def _set_heights(self, limits: dict[str, re.Match[str]], without: str) -> None:
        """Set the heights of all kinds of buildings to those of the prompt."""
        high: float | None = None
        low = 0.0
        for name, match in limits.items():
            number, unit = match.groups()[-2:]
            factor = 1.0 if unit.startswith("m") else STOREY_M
            value = float(number) * factor
            if name == "between":
                low = float(match[1]) * factor
            elif name == "exactly":
                low = value - 0.9 * factor
            low, high = (value, high) if name == "least" else (low, value)
        if high is None and re.search(r"\b(?:high|tall|towers?|skyscrapers?)", without):
            high = LOW_TOWN_M
        if high is not None and not 3.0 <= max(low, 3.0) <= high <= 450.0:
            got = " ".join(match[0].strip() for match in limits.values())
            expected = "a lowest height below the highest, both within 3 to 450 m"
            raise InputError("the range of building heights is impossible", where="PROMPT", got=got, expected=expected)
        kinds = [
            word for name, one in WORDS["buildings"].items() if name != "building" for word in _words(one["words"])
        ]
        before = rf"\b(?:{'|'.join(kinds)})(?:e?s)?(?: (?:of|with|are))? ?$"
        is_of_a_kind = any(re.search(before, match.string[: match.start()]) for match in limits.values())
        self.plan["highest_m"] = None if is_of_a_kind else high  # a lighthouse is none of "houses of up to 3 floors"
        for one in (self.plan, *self.plan["buildings"]):
            least, most = one["heights_m"]
            most = min(most if high is None or "between" not in limits else high, high or 450.0)
            least = max(low, min(least, 0.6 * most if high else least), 3.0)
            one["heights_m"] = (min(least, 450.0), max(most, 1.2 * least if low and high is None else least))
        if re.search(r"\b(?:towers|high-rises|skyscrapers) in the (?:cent|middle)", self.prompt.lower()):
            self.plan["high_center"] = True
            self.plan["heights_m"] = (min(self.plan["heights_m"][0], 8.0), self.plan["heights_m"][1])

    def _set_widths(self, widths: list[re.Match[str]]) -> None:
        """Set the widths of streets to those of the prompt."""
        for match in widths:
            street, number, unit = match.groups() if match[1].isalpha() else (match[3], match[1], match[2])
            field = "avenue_m" if street == "avenue" else "street_m"
            most = 60.0 if field == "avenue_m" else 40.0
            wide_m = self._within(f"{street} width, m", float(number) * _metres(unit), 5.0, most)
            if field == "street_m":
                wider = 1.0 if self.plan["pattern"] == "linear" else self.plan["avenue_m"] / self.plan["street_m"]
                self.plan["avenue_m"] = wide_m * wider
            self.plan[field] = wide_m

    def _set_size(self, sizes: dict[str, re.Match[str]], widths: list[re.Match[str]]) -> None:
        """Set the size of the town to that of the prompt."""
        pitch_m = self.plan["block_m"] + self.plan["street_m"]
        for name, match in sizes.items():
            if name == "sides":
                unit = _metres(match[4])
                sides = float(match[1]) * (_metres(match[2]) if match[2] else unit), float(match[3]) * unit
            elif name == "area":
                unit = 1e6 if re.search("k", match[2]) else 1e4 if match[2].startswith("h") else 1.0
                sides = (math.sqrt(float(match[1]) * unit),) * 2
            else:
                side = float(match[1]) * _metres(match[2])
                depth_m = max(100.0, DEEP * pitch_m) if self.plan["pattern"] == "linear" else 0.7 * side
                sides = (side, side if name == "square" else depth_m)
            self.plan["size_m"] = tuple(self._within("size of the town, m", side, 80.0, 2000.0) for side in sides)
            most = min(self.plan["size_m"]) / 4  # so that blocks remain
            self.plan["river_m"] = min(self.plan["river_m"], most / 2)
            for name in ("street_m", "avenue_m"):
                if self.plan[name] > most and widths:
                    self.not_respected.append(f"street width in so small a town: {most:g} m is possible")
                self.plan[name] = min(self.plan[name], most)

    def _within(self, what: str, value: Any, low: Any, high: Any) -> Any:
        """Return a value within what is possible; record one that is not."""
        possible = min(high, max(low, value))
        if possible != value:
            self.not_respected.append(f"{what}: {value:g} is said, {possible:g} is possible")
        return possible

    def _left_over(self) -> list[str]:
        """Return the phrases that are left in the text."""
        phrases = []
        for part in re.split(r"[.,;:()!?|'\"]", self.text):
            phrase = list[str]()
            for word in [*part.split(), "the"]:
                if word in STOPS or word in ORDINARY or word.removesuffix("s") in ORDINARY:
                    if phrase and phrase != ["1"]:
                        of = f" (of {word})" if word not in STOPS and phrase[-1].isdigit() else ""
                        phrases.append(" ".join(phrase) + of)
                    phrase = []
                elif word != "1" or phrase:
                    phrase.append(word)
        return phrases


def _metres(unit: str) -> float:
    return 1000.0 if unit.startswith("k") else 1.0


def _scaled(value: Any, factor: float) -> Any:
    return tuple(round(v * factor, 2) for v in value) if isinstance(value, tuple | list) else round(value * factor, 2)
