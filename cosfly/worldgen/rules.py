"""The built-in planner: reads an English prompt by tables of words, without a model.

The reader takes each phrase that it understands out of the text. So no later phase reads it again, and what remains are
the words that were not used. The order of the phases is the grammar; `_Reader.read` gives the reason for each.

Source: an alternative to the language model of app:simworld:step1 where no endpoint is given.
"""

import math
import re
from collections import defaultdict
from typing import Any

from cosfly.runtime.errors import InputError
from cosfly.runtime.seeding import rng_for
from cosfly.worldgen.phrases import (
    ADJECTIVES,
    NOUNS,
    ORDINARY,
    POSITIONS,
    SETTLEMENT_NOUNS,
    SETTLEMENTS,
    STOPS,
    WORDS,
    Phrase,
    holds,
    longest_first,
    nearby_noun,
    noun_before,
    phrases_of,
    words_of,
)  # fmt: skip
from cosfly.worldgen.plan import LEAST_FOOTPRINT_M, OBJECTS, PATH_M, WorldPlan

FIELD_BOUNDS = {
    "gap_m": (0.05, 40.0), "street_m": (5.0, 40.0), "avenue_m": (5.0, 60.0), "parked_share": (0.0, 0.9),
    "blocks_along": (1.0, 9.0), "block_m": (20.0, 180.0),
}  # fmt: skip
SEVERAL, SEVERAL_OPEN = 4, 3  # objects, and open blocks, of a plural without a number
FEW = 5  # fewer buildings than that are not a whole town, but stand among others
STOREY_M = 3.0
VARIED = {"blocks_along": (0.92, 1.08), "block_m": (0.85, 1.2), "gap_m": (0.92, 1.08)}  # range of random factors
LOWEST_M, HIGHEST_M = 3.0, 450.0  # buildings of a plan
LOW_TOWN_M = 16.0  # highest building of a town without high-rises
LINEAR_DEPTH = 2.4  # depth of a linear town of a given length, in blocks

# Patterns of the text, which is in lower case with numbers in digits, each with an example.
_NUMBER = r"(\d+(?:\.\d+)?)"
_LENGTH = r"(km|kilomet(?:er|re)s?|m|metres?|meters?)\b"
_HEIGHT = (  # "12 m", "3-storey", but not the "12 m" of "12 m deep"
    rf"(?P<number>{_NUMBER})[ -]?(?P<unit>m|metres?|meters?|floors?|storeys?|stor(?:y|ies)|levels?)\b"
    r"(?! (?:x|by|apart|away|deep|thick|from|in diameter)\b)(?: high| tall| in height)?"
)
_HEIGHTS = {
    # "no building is higher than 20 m", "up to 3 floors"
    "at_most": r"(?:(?:no|none|not|nothing)(?: (?P<what>\w+?)s?)?(?: is| are)? (?:higher|taller|more|over|above)"
               rf"(?: than)?|under|below|at most|up to|max(?:imum)?\.?(?: height)?(?: of)?|limited to) {_HEIGHT}",
    "or_less": rf"{_HEIGHT},? (?:at most|or less|or lower|maximum|at the most)",  # "20 m high or less"
    # "4 to 6 m", "between 10 m and 5 floors"
    "between": rf"(?:\b(?:between|from) )?\b(?P<low>{_NUMBER}) ?(?:m|metres?|meters?)? ?(?:and|to|or|-) {_HEIGHT}",
    "at_least": rf"(?:at least|more than|over|above|minimum) {_HEIGHT}",  # "over 40 m tall"
    "exactly": _HEIGHT,  # "3-storey"
}  # fmt: skip
_OF_SOME = re.compile(r"\b(?:some|one|a few|\d+) of (?:them|which)(?: are| is)? $")  # "some of them 10 floors high"
_SIZES = {
    "sides": rf"{_NUMBER} ?(?:{_LENGTH})? ?(?:x|×|by|times) ?{_NUMBER} ?{_LENGTH}",  # "600 x 400 m"
    "square": rf"{_NUMBER} ?{_LENGTH} (?:square\b|across|on (?:a|each) side)",  # "500 m across"
    # "2.5 sq km"
    "area": rf"{_NUMBER} ?(km2|km²|square kilomet(?:er|re)s?|sq\.? ?km|hectares?|ha|m2|m²|square met(?:er|re)s)(?!\w)",
    "length": rf"{_NUMBER} ?{_LENGTH} long\b",  # "800 m long"
    "width": rf"(?P<number>\d+(?:\.\d+)?) ?{_LENGTH}(?:[ -]wide| in width)\b",  # "8 m wide", also of streets and water
}
_CARS = r"\b\d+ (?:[a-z-]+ )?cars(?: parked)?\b"  # a number, which is not used: "20 parked cars"
_ABSENT = r"\b(?:no|without(?: any)?)\s+((?:(?! (?:but|and|with) )[^.,;:()])+)"  # "without any towers"
_STOPS = "|".join(longest_first(STOPS))
# What can be absent. Nothing is done about other words after "no", such as "no balconies" or "no houses".
_BUILDINGS = [
    f"{name}, {row['words']}" for name, row in WORDS["buildings"].items() if name not in ("house", "building")
]
_CAN_BE_ABSENT = [
    *("high", "tall", "building", "vehicle", "traffic", "tree", "vegetation", "car", "cars"),
    *WORDS["open"], *WORDS["water"], *OBJECTS, *(word for obj in OBJECTS.values() for word in obj.words),
    *(word for words in _BUILDINGS for word in words_of(words)),
]  # fmt: skip
_HAS_EFFECT = re.compile(rf"\b(?:{'|'.join(longest_first(_CAN_BE_ABSENT))})(?:e?s|er|est)?\b")

# Fields that an adjective changes, by target: what its noun stands for.
FIELDS: dict[str, set[str]] = defaultdict(
    lambda: {"footprint_m", "heights_m"},  # kinds of buildings
    town={"blocks_along", "block_m", "gap_m", "heights_m", "street_m", "avenue_m", "trees_per_ha", "parked_share"},
    street={"street_m", "avenue_m", "trees_per_ha", "parked_share"},
    avenue={"avenue_m", "trees_per_ha", "parked_share"},
    water={"river_m"},
    other=set(),
)
OF_ANY = ("vegetation", "cars")  # groups of adjectives that describe the town, unless a noun follows
# Widths: target -> field, and the possible range, m.
WIDTHS = {"street": ("street_m", 5.0, 40.0), "avenue": ("avenue_m", 5.0, 60.0), "water": ("river_m", 4.0, 100.0)}


def _noun_of_measure(phrases: list[Phrase], number: int, name: str, match: re.Match[str]) -> str:
    """Return the noun of a measure in a phrase: of the phrase, or in a phrase without one, the noun before it."""
    phrase = phrases[number]
    if name == "at_most" and match[0].startswith(("no", "none", "nothing")):
        return match["what"] if match["what"] in NOUNS else ""  # "no house is higher than 8 m"
    if phrase.head:
        return phrase.head
    is_of_town = "." in phrase.ends or (name in _SIZES and "of" not in phrase.ends and "each" not in phrase.words)
    return "" if is_of_town else noun_before(phrases, number) or nearby_noun(phrases, number)


def _target(group: str, noun: str) -> str:
    """Return whose fields an adjective of a group changes with a noun."""
    target = NOUNS.get(noun, "other") if noun else "town"
    is_of_town = group == "density" and target in WORDS["buildings"]  # dense houses
    return "town" if is_of_town else target


def plan_by_rules(prompt: str, seed: int) -> tuple[WorldPlan, dict[str, Any]]:
    """Read a prompt; return the plan, and the trace: what was read as what, and what was not respected.

    The seed chooses the street pattern and sizes that the prompt does not name.
    """
    return _Reader(prompt).read(seed)


def _normalized(prompt: str) -> str:
    """Return a prompt in lower case with numbers in digits, and with one word for phrases such as "few trees"."""
    text = prompt.lower().replace("’", "'").replace("#", " ")  # "#" marks measures
    for words in longest_first(WORDS["amounts"]):
        amount = WORDS["amounts"][words]  # "hardly any greenery" becomes the word "few-trees" of the choices
        text = re.sub(rf"\b{words} (?:trees|vegetation|greenery)\b", f"{amount}-trees", text)
        text = re.sub(rf"\b{words} (?:parked )?cars\b", f"{amount}-cars", text)
    for word in longest_first(WORDS["numbers"]):
        text = re.sub(rf"\b{word}\b", str(WORDS["numbers"][word]), text)
    for plain, pattern in (
        # "a church whose tower": a part of it, which is not used
        (r"\1 steeple", r"\b((?:church|chapel|cathedral|castle)(?: (?!and\b)[\w-]+){1,4})(?<!clock)(?<!bell) tower\b"),
        ("lakeside", r"\b(?:shores?|banks?|edge) of (?:a|the) (?:\w+ )?lake\b|\blake ?(?:shore|front)\b"),
        ("industrial", r"\bindustrial (?:park|estate)\b"), (r"\1-park", r"\b(business|logistics) park\b"),
        (r"\1public park", r"^((?:an? |the )?(?:[\w-]+ ){0,2})(?<!car )park\b"),  # not the one of "a city with a park"
        ("1-stor", r"\bsingle[- ]stor"), ("hotel-buildings", r"\bhotels\b"),
        (r"apartment block\1", r"\bblock(s?) of flats\b"), ("apartments", r"\bflats\b"),
        (r"\1s of at most", r"\bthe (?:tallest|highest) (house|building)s? (?:is|are|has)\b"),
        # "no building except the church is higher than 12 m"
        (r"\1 is", r"\b((?:no|none|nothing)(?: \w+)?),? (?:but|except|other than|apart from)(?: \w+){1,4},? is\b"),
    ):  # fmt: skip
        text = re.sub(pattern, plain, text)
    text = re.sub(r"\b([2-9]0)-([1-9])\b", lambda match: str(int(match[1]) + int(match[2])), text)  # "20-5": 25
    text = re.sub(r"\b(\d+) ?[-–] ?(\d+)\b", r"\1 to \2", text)  # "15-20 m"
    return f" {text} "


class _Reader:
    """Reads one prompt."""

    def __init__(self, prompt: str) -> None:
        if re.search(r"[\u4e00-\u9fff]", prompt):
            what = "内置规则只读英文描述"
            expected = "英文描述, 例如 'a small village with a church'"
            fix = "用英文写这段描述, 或用 --planner URL 指定语言模型"
            raise InputError(what, where="PROMPT", got=repr(prompt[:60]), expected=expected, fix=fix)
        self.prompt = prompt
        self.normalized = _normalized(prompt)
        self.text = self.normalized  # what is not read yet
        self.plan: dict[str, Any] = WorldPlan().model_dump()  # its fields so far
        self.used: list[str] = []
        self.not_used: list[str] = []
        self.not_respected: list[str] = []
        # What is read by `_take_phrases`.
        self.measures = list[tuple[str, re.Match[str]]]()  # with their names in _SIZES and _HEIGHTS
        self.sizes: dict[str, re.Match[str]] = {}  # of the town, by name in _SIZES
        # By name in _HEIGHTS, of each target: heights of all buildings ("town") or one kind, widths of the others.
        self.limits: dict[str, dict[str, re.Match[str]]] = {}
        self.absent = ""  # what there is not, such as "towers, "
        self.objects: dict[str, int] = {}  # counts
        self.buildings: dict[str, int | None] = {}  # counts by kind; None for a plural without a number
        self.pattern: str | None = None  # of streets, if it is named
        self.named: str | None = None  # the settlement, if it is named
        self.choices: dict[str, dict[str, str]] = {}  # of adjectives: target -> group -> choice

    def read(self, seed: int) -> tuple[WorldPlan, dict[str, Any]]:
        """Return the plan and the trace."""
        whole_text = self.text
        self._take_phrases()
        implied = [WORDS["buildings"][name].get("implies") for name, count in self.buildings.items() if count != 1]
        place = self.named or next(filter(None, implied), "town")
        settlement = WORDS["settlements"][place]
        self.plan |= {name: value for name, value in settlement.items() if name in self.plan}
        for target in ("town", "street", "avenue", "building"):
            self._apply_choices(target, self.plan)
        has_open = self._take_open_and_water()
        towns = [WORDS["settlements"][name]["words"] for name in (place, "city", "town")]
        for words in (*towns, WORDS["patterns"].get(self.pattern, "")):
            self._take_words(words)
        if self.text == whole_text and not self.absent:
            what = "the rule-based planner recognises no word of this prompt"
            expected = "an English description, such as 'a small village with a church'"
            fix = "name a kind of place, or use a language model with --planner URL"
            raise InputError(what, where="PROMPT", got=repr(self.prompt[:60]), expected=expected, fix=fix)
        self.plan["pattern"] = self.pattern or settlement["patterns"][seed % len(settlement["patterns"])]
        self._set_buildings(has_open)
        # The seed varies what settlement and choices set; then comes what the prompt measures, which does not vary.
        for name, factors in VARIED.items():
            self.plan[name] = _scaled(self.plan[name], rng_for(seed, "world", name).uniform(*factors))
        self._set_heights()
        self._set_widths()
        self._set_size()
        if re.search(r"\bbuildings?\b", self.absent) and not self.buildings:
            self.plan["only_these"] = True
        if re.search(r"\b(?:vehicles?|traffic)\b", self.absent):
            self.plan["parked_share"] = 0.0
        for name, (low, high) in FIELD_BOUNDS.items():
            self.plan[name] = min(high, max(low, self.plan[name]))
        self.plan["objects"] = [{"name": name, "count": count} for name, count in self.objects.items()]
        in_the_south = {"south (position)", "southern (position)"} if self.plan["is_shore"] else set()  # as all shores
        self.plan["not_used"] = [
            words for words in dict.fromkeys([*self.not_used, *self._left_over()]) if words not in in_the_south
        ]
        plan = WorldPlan.model_validate(self.plan)
        trace = {
            "planner": "rules", "settlement": place, "settlement_is_named": bool(self.named or any(implied)),
            "pattern": plan.pattern, "pattern_is_named": self.pattern is not None,
            "objects": self.objects, "without": self.absent, "choices": self.choices,
            "used": [words for words in self.used if words not in self.not_used],
            "not_used": plan.not_used, "not_respected": self.not_respected,
        }  # fmt: skip
        return plan, trace

    # --- phrases of the text ---

    def _has(self, words: str) -> bool:
        return any(holds(self.text, word) for word in words_of(words))

    def _take(self, pattern: str, keep: str = ",") -> re.Match[str] | None:
        """Return the first match of a pattern, and put `keep` in its place."""
        if match := re.search(pattern, self.text):
            self.text = f"{self.text[: match.start()]} {match.expand(keep)} {self.text[match.end() :]}"
            if keep == ",":
                self.used.append(match[0].strip())
        return match

    def _take_words(self, words: str, meaning: str = "") -> None:
        """Take all of some words, singular or plural; meaning: what they were used for, if that is not plain."""
        for word in longest_first(words_of(words)):
            while match := self._take(rf"(?<![\w-]){re.escape(word)}s?(?![\w-])"):
                if meaning:
                    self.used[-1] = f"{match[0].strip()} ({meaning})"

    def _take_counted(self, word: str, plural_count: int, name: str = "", *, needs_number: bool = False) -> int | None:
        """Take a noun, not its adjectives; return its number, or None if the text does not hold it.

        A noun without a number counts 1, or `plural_count` in the plural.
        """
        plural = f"{word[:-1]}ies" if re.search("[^aeiou]y$", word) else f"{word}(?:e?s)?"
        adjectives = rf"(?:(?!(?:{_STOPS}) )[a-z-]+ ){{0,3}}?"
        number = rf"(?:\b(\d+) ({adjectives})){'' if needs_number else '?'}"
        # "3 tall brick towers": number "3", adjectives "tall brick ", noun "towers"
        match = self._take(rf"{number}\b({word}|{plural})\b(?!-)", keep=r", \2 ,")
        if match is None:
            return None
        meaning = "" if name in match[3] else f" ({name})"
        self.used.append(f"{match[1] or ''} {match[3]}{meaning}".strip().replace("hotel-building", "hotel"))
        return int(match[1] or 0) or (1 if match[3] == word else plural_count)

    def _take_phrases(self) -> None:
        """Take measures and nouns. Each is taken before those that would misread it."""
        for name, pattern in (_SIZES | _HEIGHTS).items():  # before nouns, which their numbers do not count
            while match := self._take(pattern, keep=f"#{len(self.measures)}#"):
                self.measures.append((name, match))
        while match := self._take(_CARS):  # before the words of cars: "5 parked cars" are not many
            self.not_used.append(match[0].strip())
        while match := self._take(_ABSENT):  # before the nouns: "without towers" names no tower
            self.absent += f"{match[1].strip()}, "
            if not _HAS_EFFECT.search(match[1]):
                self.not_used.append(match[0].strip())
        self._attach_words()
        self.objects = self._take_objects()  # before buildings: a clock tower is no tower
        for word in words_of(WORDS["lacking"]):  # before buildings: a control tower is none either
            if match := self._take(rf"(?:\b\d+ )?\b{word}s?\b"):
                self.not_used.append(match[0].strip())
        # The words of settlements and patterns stay in the text until all else is read, because other tables have them
        # too: a harbour has water.
        self.buildings = self._take_buildings()

    def _take_objects(self) -> dict[str, int]:
        """Take the objects of the table; return their counts."""
        counts: dict[str, int] = {}
        names = {word: obj.name for obj in OBJECTS.values() for word in (obj.name, *obj.words)}
        for word in longest_first(names):
            name = names[word]
            while (count := self._take_counted(word, SEVERAL, name)) is not None:
                counts[name] = self._within(f"number of {name}s", count, 1, 500)
        return dict(sorted(counts.items()))

    def _take_buildings(self) -> dict[str, int | None]:
        """Take the kinds of buildings; return their counts, None for a plural without a number."""
        names = {word: name for name, row in WORDS["buildings"].items() for word in [*words_of(row["words"]), name]}
        counts: dict[str, int | None] = {}
        for word in longest_first(names):
            name = names[word]
            while (count := self._take_counted(word, 0, name, needs_number=name == "building")) is not None:
                count += counts.get(name) or 0
                counts[name] = self._within(f"number of {name}s", count, 1, 1000) if count else None
        return counts

    def _attach_words(self) -> None:
        """Find the named settlement, and take the measures and adjectives for what their nouns stand for."""
        phrases = phrases_of(self.text)
        # "Winding streets" name a pattern, a round pond does not.
        of_streets = ",".join(phrase.text for phrase in phrases if NOUNS.get(phrase.head, "town") in (*WIDTHS, "town"))
        for name, patterns in WORDS["patterns"].items():
            is_named = any(holds(self.text if " " in word else of_streets, word) for word in words_of(patterns))
            self.pattern = self.pattern or (name if is_named else None)
        for number, phrase in enumerate(phrases):
            if not self.named and phrase.head in SETTLEMENT_NOUNS:
                self.named = next((name for name, words in SETTLEMENTS.items() if words & {*phrase.nouns}), None)
            for name, match in (self.measures[k] for k in phrase.measures):
                self._attach_measure(name, match, _noun_of_measure(phrases, number, name, match))
        taken = list[tuple[int, int]]()
        for number, phrase in enumerate(phrases):
            for start, word in phrase.adjectives:
                group, choice = ADJECTIVES[word]
                noun = phrase.head or ("" if group in OF_ANY else nearby_noun(phrases, number))
                target = _target(group, noun)
                chosen = self.choices.setdefault(target, {})
                if FIELDS[target].isdisjoint(WORDS["groups"][group][choice]) or chosen.get(group, choice) != choice:
                    continue  # it stays in the text, and so among the words that are not used
                chosen[group] = choice
                self.used.append(f"{word} ({group if target == 'town' else noun})")
                taken.append((start, start + len(word)))
        for start, end in reversed(taken):
            self.text = self.text[:start] + self.text[end:].removeprefix(" ")  # "30 small houses" are 30 houses
        self.text = re.sub(r" *#\d+# *", " ", self.text)

    def _attach_measure(self, name: str, match: re.Match[str], noun: str) -> None:
        """Take a measure as the size of the town, as a limit of heights, or as the width of streets or water."""
        target = NOUNS.get(noun, "other") if noun else "town"
        is_width = target in WIDTHS
        if name in _SIZES and not (name == "width" and is_width):
            is_used = target == "town" or (name == "length" and is_width)
            chosen = self.sizes
        else:
            target = "town" if target == "building" else target
            is_used = target != "other" and (name == "width" or not is_width or match["unit"].startswith("m"))
            is_used = is_used and not _OF_SOME.search(match.string[: match.start()])
            chosen = self.limits.setdefault(target, {}) if is_used else {}
            if name != "at_least" and chosen.keys() - {"at_least"}:  # only the first limits the highest building
                is_used = False
        if is_used and name not in chosen:
            chosen[name] = match
            self.used.append(f"{match[0].strip()} ({'size' if chosen is self.sizes else noun or 'all buildings'})")
        else:
            self.not_used.append(match[0].strip() + (f" (of {noun})" if noun in NOUNS else ""))

    def _take_open_and_water(self) -> bool:
        """Take words of open blocks and of water, and set both; return whether open blocks are named."""
        named = set[str]()
        has_river = bool({"bridge", "footbridge"} & {*self.objects}) or self._has(WORDS["rivers"])
        for word, width_m in WORDS["water"].items():
            if self._has(word):
                self.plan["river_m"] = width_m
        self._apply_choices("water", self.plan)
        for word, field in WORDS["open"].items():
            if re.search(rf"(?:^|, ){word}s?, ", self.absent):
                self.plan[field] = 0
        for word, field in WORDS["open"].items():
            # "Houses with gardens" means no several blocks.
            count = self._take_counted(word, plural_count=1 if word in ("garden", "lawn") else SEVERAL_OPEN)
            if count is not None:
                named.add(field)
                most = 20 if field == "plazas" else 40  # as in WorldPlan
                self.plan[field] = max(self.plan[field], self._within(f"number of {word}s", count, 1, most))
        has_open = bool(named)
        if has_open:  # what the settlement has without being asked
            self.plan |= dict.fromkeys({"plazas", "greens"} - named, 0)
        self._take_words(WORDS["rivers"])
        self._take_words(",".join(WORDS["water"]), "shore")
        num_bridges = self.objects.get("bridge", 0) + self.objects.get("footbridge", 0)
        if re.search(r"\bbridges?\b", self.absent):
            self.plan["bridges"] = 0
        if num_bridges:
            self.plan["bridges"] = self._within("number of bridges", num_bridges, 1, 10)
            self.plan["bridge_m"] = PATH_M if "footbridge" in self.objects else None
            self.plan["river_m"] = self.plan["river_m"] or WORDS["water"]["river"]
        if any(OBJECTS[name].where in ("water", "bank") for name in self.objects):
            self.plan["river_m"] = self.plan["river_m"] or WORDS["water"]["harbour"]
        self.plan["is_shore"] = bool(self.plan["river_m"]) and not has_river
        return has_open

    def _left_over(self) -> list[str]:
        """Return the phrases that are left in the text: words between stops and ordinary words."""
        phrases = list[str]()
        positions = list[str]()
        for part in re.split(r"[.,;:()!?|'\"]", self.text):
            phrase = list[str]()
            for word in [*part.split(), "the"]:  # a stop, which ends the last phrase
                if word in POSITIONS:
                    positions.append(word)
                if word in STOPS or word in ORDINARY or word.removesuffix("s") in ORDINARY:
                    if phrase:  # "40 cars" leaves "40 (of cars)"
                        noun = f" (of {word})" if word not in STOPS and phrase[-1].isdigit() else ""
                        phrases.append(" ".join(phrase) + noun)
                    phrase = []
                elif word != "1" or phrase:  # the number of "one avenue" says nothing
                    phrase.append(word)
        return [*phrases, *(f"{word} (position)" for word in dict.fromkeys(positions))]

    # --- fields of the plan ---

    def _apply_choices(self, target: str, fields: dict[str, Any]) -> None:
        """Multiply the fields of a target by the factors of its adjectives."""
        for group, choice in self.choices.get(target, {}).items():
            for name, factor in WORDS["groups"][group][choice].items():
                if name in FIELDS[target] and name in fields:
                    fields[name] = _scaled(fields[name], factor)
        if target != "town" and "footprint_m" in fields:
            fields["footprint_m"] = tuple(max(side_m, LEAST_FOOTPRINT_M) for side_m in fields["footprint_m"])

    def _set_buildings(self, has_open: bool) -> None:
        """Set the kinds of buildings, and whether there are no others."""
        counts = [count for count in self.buildings.values() if count is not None]
        is_of_them = any(re.search(rf" of {count} (?!m\b|met|floor|stor|level)", self.normalized) for count in counts)
        for name, count in self.buildings.items():
            row = WORDS["buildings"][name]
            footprint_m = row.get("footprint_m", self.plan["footprint_m"])
            group = {"name": name, "count": count, "footprint_m": footprint_m, "heights_m": self.plan["heights_m"]}
            if "heights_m" in row:
                group["heights_m"] = row["heights_m"]
                self._apply_choices("town", group)
            if name != "building":  # whose adjectives are those of all buildings
                self._apply_choices(name, group)
            if count is None and "gap_m" in row:
                self.plan["gap_m"] = row["gap_m"]
            self.plan["buildings"].append(group)
            is_main = not row.get("landmark") and sum(counts) >= FEW
            if None not in self.buildings.values() and (is_of_them or is_main):
                self.plan["only_these"] = True
        if self.plan["only_these"] and not has_open:
            self.plan |= {"plazas": 0, "greens": 0}

    def _set_heights(self) -> None:
        """Limit the heights of all buildings, and of the kinds that have limits of their own."""
        of_all = self.limits.get("town", {})
        if not of_all and re.search(r"\b(?:high|tall|towers?|skyscrapers?)", self.absent):
            for group in (self.plan, *self.plan["buildings"]):
                group["heights_m"] = _limited(group["heights_m"], 0.0, LOW_TOWN_M, is_replaced=False)
        for name, group in [("", self.plan), *((group["name"], group) for group in self.plan["buildings"])]:
            limits = self.limits.get(name) or of_all
            low_m, high_m = _range_of(limits)
            if not max(low_m, LOWEST_M) <= (HIGHEST_M if high_m is None else high_m) <= HIGHEST_M:
                got = " ".join(match[0].strip() for match in limits.values())
                what, expected = "the range of heights is impossible", "a lowest below the highest, within 3 to 450 m"
                raise InputError(what, where="PROMPT", got=got, expected=expected)
            is_replaced = bool({"between", "exactly"} & limits.keys())
            group["heights_m"] = _limited(group["heights_m"], low_m, high_m, is_replaced=is_replaced)

    def _set_widths(self) -> None:
        """Set the widths of streets and of the water to those of the prompt."""
        for target, (field, low_m, high_m) in WIDTHS.items():
            for name, match in self.limits.get(target, {}).items():
                width_m = float(match["number"]) * (_metres(match[2]) if name == "width" else 1.0)
                if name == "between":
                    width_m = (float(match["low"]) + width_m) / 2
                if name == "at_least":
                    width_m = max(width_m, self.plan[field])
                if name in ("at_most", "or_less"):
                    width_m = min(width_m, self.plan[field])
                self.plan[field] = self._within(f"width of a {target}, m", width_m, low_m, high_m)
        self.plan["avenue_m"] = max(self.plan["avenue_m"], self.plan["street_m"])

    def _set_size(self) -> None:
        """Set the size of the town to that of the prompt."""
        pitch_m = self.plan["block_m"] + self.plan["street_m"]
        for name, match in self.sizes.items():
            if name == "sides":  # in "600 x 400 m" the unit is that of both
                width_m = float(match[1]) * _metres(match[2] or match[4])
                sides_m = (width_m, float(match[3]) * _metres(match[4]))
            elif name == "area":
                unit_m2 = 1e6 if "k" in match[2] else 1e4 if match[2].startswith("h") else 1.0
                sides_m = (math.sqrt(float(match[1]) * unit_m2),) * 2
            else:
                side_m = float(match[1]) * _metres(match[2])
                depth_m = max(100.0, LINEAR_DEPTH * pitch_m) if self.plan["pattern"] == "linear" else 0.7 * side_m
                sides_m = (side_m, side_m if name == "square" else depth_m)
            self.plan["size_m"] = tuple(self._within("size of the town, m", side_m, 80.0, 2000.0) for side_m in sides_m)
            most_m = min(self.plan["size_m"]) / 4  # so that blocks remain
            self.plan["river_m"] = min(self.plan["river_m"], most_m / 2)
            self.plan |= {field: min(self.plan[field], most_m) for field in ("street_m", "avenue_m")}

    def _within(self, what: str, value: Any, low: Any, high: Any) -> Any:
        """Return a value within what is possible; record one that is not."""
        possible = min(high, max(low, value))
        if possible != value:
            self.not_respected.append(f"{what}: {value:g} is said, {possible:g} is possible")
        return possible


def _range_of(limits: dict[str, re.Match[str]]) -> tuple[float, float | None]:
    """Return the lowest height of limits, and the highest, m; 0 and None where there is none."""
    low_m: float = 0.0
    high_m: float | None = None
    for name, match in limits.items():
        unit_m = _metres(match["unit"])
        height_m = float(match["number"]) * unit_m
        if name == "at_least":
            low_m = height_m
            continue
        high_m = height_m
        if name == "between":
            low_m = float(match["low"]) * unit_m
        elif name == "exactly":
            low_m = height_m
    return low_m, high_m


def _limited(heights_m: Any, low_m: float, high_m: float | None, *, is_replaced: bool) -> tuple[float, float]:
    """Return a range of heights within limits; `is_replaced`: up to the highest also where buildings are lower."""
    least_m, most_m = heights_m
    if high_m is None:
        least_m = max(low_m, least_m, LOWEST_M)
        # Above a lower limit buildings still differ, by a fifth.
        most_m = max(most_m, 1.2 * least_m if low_m else least_m)
    else:
        most_m = high_m if is_replaced else min(most_m, high_m)
        least_m = max(low_m, min(least_m, 0.6 * most_m), LOWEST_M)  # 0.6: they differ below an upper limit too
        most_m = max(most_m, least_m)
    return round(min(least_m, HIGHEST_M), 2), round(min(most_m, HIGHEST_M), 2)


def _metres(unit: str) -> float:
    """Return the metres in a unit: kilometres, metres, or storeys under any name."""
    return {"k": 1000.0, "m": 1.0}.get(unit[0], STOREY_M)


def _scaled(value: Any, factor: float) -> Any:
    """Return a number, or each number of a range, times a factor."""
    return tuple(round(v * factor, 2) for v in value) if isinstance(value, tuple | list) else round(value * factor, 2)
