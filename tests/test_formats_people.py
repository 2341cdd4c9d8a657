"""The wardrobe: drawn, written, read, told apart."""

from dataclasses import asdict

import numpy as np
import pytest
from tables import each

from cosfly.formats.people import COLORS, HAIR, Appearance, People
from cosfly.render.person import draw_appearance, look_alike
from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import validated


def test_a_drawn_person_is_read_back_as_written():
    rng = np.random.default_rng(1)
    for _ in range(200):
        person = draw_appearance(rng)
        assert validated(Appearance, asdict(person), "here") == person
        assert person.hat_color not in HAIR


def test_a_look_alike_differs_in_one_thing():
    rng = np.random.default_rng(2)
    for _ in range(200):
        person = draw_appearance(rng)
        other = look_alike(person, rng)
        assert len(person.differences(other)) == 1
        assert person.is_all_seen
        assert other.is_all_seen


def test_the_most_alike_differs_least_the_greatest_id_of_several():
    target = Appearance("man", "jacket", "red", "shorts", "blue")
    one, two = (Appearance("man", "jacket", color, "shorts", color) for color in ("red", "green"))
    people = People(
        target, {9: two, 8: one, 7: one, 6: Appearance("woman", "coat", "pink", "trousers", "pink", "cap", "red")}
    )
    assert people.most_alike([9, 8, 7, 6]) == (8, 1)
    assert people.most_alike([6, 9]) == (9, 2)
    assert people.most_alike([6]) == (6, 4)
    assert people.most_alike([]) == (None, None)


@each(("field", "value"), [("top", "toga"), ("hat_color", "red"), ("figure", 3), ("bag", None)])
def test_what_the_wardrobe_lacks_is_refused(field, value):
    bare = asdict(Appearance("man", "jacket", "red", "shorts", "blue"))
    with pytest.raises(InputError, match=field):
        validated(Appearance, bare | {field: value}, "here")


def test_colours_are_far_apart():
    srgb = np.array([color for _, color in COLORS.values()]) ** (1 / 2.2)
    apart = np.linalg.norm(srgb[:, None] - srgb[None], axis=2)[np.triu_indices(len(srgb), 1)]
    assert apart.min() > 0.2
