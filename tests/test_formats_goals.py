"""Goals in words: true of the target alone, of nothing that is not seen, the same in both languages."""

from dataclasses import asdict
from itertools import chain, combinations

import numpy as np
import pytest

from cosfly.formats.frames import PERSON_ID
from cosfly.formats.kinds import KINDS
from cosfly.formats.people import COLORS, FIGURES, GARMENTS, GOAL_TERMS, Appearance, Goal, read_goal
from cosfly.geometry.goals import LANDMARKS, SIDES, SLOTS, SeenFrame, find_says, meant, words_of
from cosfly.render.person import draw_appearance, look_alike
from cosfly.runtime.errors import InputError

RELATIONS = {*SIDES, *LANDMARKS}
TREE_M, POST_M = 20, 40  # columns of the picture below, a metre each


def picture_of(columns: dict[int, int]) -> SeenFrame:
    """Look north from a height at people on a line, a metre to a pixel, 20 m away; trees and posts stand far above."""
    ids, kinds = np.zeros((40, 60), np.uint16), np.full((40, 60), KINDS["Roads"], np.uint8)
    for number, column in columns.items():
        ids[20, column], kinds[20, column] = number, KINDS["Pedestrians"]
    kinds[15, TREE_M], kinds[19, POST_M] = KINDS["Vegetation"], KINDS["Poles"]
    kinds[21, 30] = KINDS["Vegetation"]  # a lawn
    intrinsic = np.array([[20.0, 0.0, 30.0], [0.0, 20.0, 20.0], [0.0, 0.0, 1.0]])
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    return SeenFrame(kinds, ids, np.full((40, 60), 20.0, np.float32), intrinsic, rotation)


def crowd(rng: np.random.Generator) -> tuple[dict[int, Appearance], SeenFrame]:
    """Draw a target, look-alikes, strangers, and one that is out of view and looks just as the target."""
    target = draw_appearance(rng)
    others = [look_alike(target, rng) if rng.random() < 0.5 else draw_appearance(rng) for _ in range(rng.integers(12))]
    people = {PERSON_ID: target, 1: target} | {65533 - i: one for i, one in enumerate(others)}
    seen = [number for number in people if number != 1]
    return people, picture_of(dict(zip(seen, rng.permutation(np.arange(1, 59))[: len(seen)].tolist(), strict=True)))


def stands_apart(relation: str, picture: SeenFrame, number: int, rivals: list[int]) -> bool:
    where = {n: int(np.nonzero(picture.ids == n)[1][0]) for n in (number, *rivals)}
    if relation in ("left", "right"):
        sign = 1 if relation == "left" else -1
        return all(sign * where[number] < sign * where[n] for n in rivals)
    at = {"Vegetation": TREE_M, "Poles": POST_M}[relation]
    return abs(where[number] - at) <= 4.001 and all(abs(where[n] - at) > 4.001 for n in rivals)


def test_a_goal_is_true_of_the_target_alone_and_says_what_is_seen():
    rng = np.random.default_rng(3)
    relations = set()
    for _ in range(250):
        people, picture = crowd(rng)
        target, hidden = people[PERSON_ID], {slot for slot in ("figure", *SLOTS) if rng.random() < 0.4}
        says = find_says(people, picture, lambda slot, other, hidden=hidden: slot not in hidden)
        if says is None:
            continue
        assert [*says] == [one for one in GOAL_TERMS if one in says]
        assert not hidden & {*says}
        assert meant(says, target, people, picture) == {PERSON_ID}
        slots, relation = [s for s in says if s not in RELATIONS], [s for s in says if s in RELATIONS]
        rivals = [n for n in people if n not in (PERSON_ID, 1) and not {*slots} & {*target.differences(people[n])}]
        assert len(relation) == bool(rivals)  # a place is said where garments do not do
        assert all(stands_apart(relation[0], picture, PERSON_ID, rivals) for _ in relation)
        relations |= {*relation}
    assert {"left", "right", "Vegetation", "Poles"} <= relations


def test_what_the_picture_does_not_tell_apart_is_not_said_apart():
    red = Appearance("man", "jacket", "red", "shorts", "blue")
    shirt = Appearance("man", "t_shirt", "red", "shorts", "blue")
    people = {PERSON_ID: red, 5: shirt}

    def tells(slot, other):
        return other.top_color != "red" or slot != "top"

    assert find_says(people, picture_of({PERSON_ID: 20, 5: 21}), tells) is None
    assert find_says(people, picture_of({PERSON_ID: 20, 5: 30}), tells) == ("figure", "top", "left")
    assert find_says(people, picture_of({PERSON_ID: 20}), tells) == ("figure", "top")
    assert find_says(people, picture_of({PERSON_ID: 20}), lambda slot, other: False) is None


def test_both_languages_say_the_same_slots():
    looks = Appearance("woman", "jacket", "red", "skirt", "green", "cap", "white", "shoulder", "yellow")
    bare = Appearance("man", "coat", "red", "shorts", "green")
    words = {
        slot: GARMENTS[slot][getattr(looks, slot)] | {f"{k}_color": v for k, v in COLORS[color][0].items()}
        for slot in SLOTS if (color := getattr(looks, f"{slot}_color"))
    }  # fmt: skip
    for says in chain.from_iterable(combinations(("figure", *SLOTS, "left", "Poles"), n) for n in range(1, 8)):
        if not {*SLOTS} & {*says}:
            continue
        for language, text in words_of(says, looks).items():
            for slot, told in words.items():
                assert (told[language] in text) == (told[f"{language}_color"] in text) == (slot in says), text
            assert (FIGURES["woman"][language] in text) == ("figure" in says)
    assert words_of(("figure", "top", "bag", "hat", "Poles"), looks) == {
        "en": "the woman in the red jacket with the yellow shoulder bag and the white cap, by a post",
        "zh": "在杆子旁边、穿红色夹克、背黄色挎包、戴白色鸭舌帽的女子",
    }
    assert words_of(("legs", "bag", "hat", "right"), bare) == {
        "en": "the rightmost person in the green shorts with no bag and no hat",
        "zh": "最右边的穿绿色短裤、不带包、不戴帽子的行人",
    }


def test_a_goal_is_read_back_and_nothing_else_is():
    goal = Goal(3, "the man in the red coat", "穿红色长大衣的男子", ("figure", "top"))
    record = asdict(goal) | {"says": list(goal.says)}
    assert read_goal(record, 4, "here") == goal
    for broken in ({"frame": 4}, {"zh": None}, {"says": ["figure"]}, {"says": ["top", "figure"]}):
        with pytest.raises(InputError):
            read_goal(record | broken, 4, "here")
