"""References: the fact at an address, worked out by hand for one window."""

import dataclasses

from specimens_captions import GAP
from tables import each

from caption.verification.references import Fact, look_up, parse_reference

FACTS = dataclasses.replace(GAP, yaw_deg=(0.0, 1.0, 3.0, 6.0, 10.0))


@each(("address", "fact"), [
    ("distance", Fact(18.0, "m", 1)),
    ("distance@t0", Fact(20.0, "m", 1)),
    ("distance@t3", "unknown_fact"),
    ("distance@t5", "unobserved_frame"),
    ("change:distance", Fact(-2.0, "m", 1)),
    ("change:distance@t0-t2", Fact(-1.0, "m", 1)),
    ("change:distance@t3-t4", "unknown_fact"),
    ("growth:box_height", Fact(20.0, "percent", 0)),
    ("rate:altitude@t3-t4", Fact(2.0, "mps", 1)),
    ("rate:yaw@t2-t4", Fact(7.0, "dps", 1)),
    ("climb_rate@t2", Fact(1.0, "mps", 2)),
    ("mean:speed", Fact(2.75, "mps", 2)),
    ("mean:speed@t2-t4", Fact(3.17, "mps", 2)),
    ("max:speed", Fact(4.0, "mps", 2)),
    ("min:speed@t2-t4", Fact(2.5, "mps", 2)),
    ("speed@t0", Fact(2.0, "mps", 2)),
    ("mean:target_speed", Fact(1.6, "mps", 2)),
    ("change:target_heading", "unknown_fact"),
    ("side:yaw", Fact("left")),
    ("side:offset_x", Fact("left")),
    ("side:offset_x@t1", Fact("centred")),
    ("side:offset_y", Fact("below")),
    ("trend:speed", Fact("increasing")),
    ("trend:pitch", Fact("steady")),
    ("trend:distance", Fact("decreasing")),
    ("comparison:speed", Fact("faster")),
    ("visibility@t3", Fact("occluded")),
    ("target_motion", Fact("walking")),
    ("drone_motion", Fact("moving")),
    ("bearing", "unknown_fact"),
    ("sideways_speed", Fact(0.0, "mps", 2)),
    ("forward_speed@t3", "unknown_fact"),
])  # fmt: skip
def test_the_fact_at_an_address(address, fact):
    reference = parse_reference(address)
    assert reference is not None
    assert look_up(reference, FACTS) == fact
    assert parse_reference(str(reference)) == reference


@each("address", [
    "", "colour", "distance@now", "distance@t0-t4", "trend:visibility", "side:distance", "sum:distance", "change:",
    "x" * 9,
])  # fmt: skip
def test_what_names_nothing(address):
    assert parse_reference(address) is None


def test_a_series_that_ends_where_it_began_has_no_trend():
    for distance_m in ((20.5, 20.8, 20.5, 19.3, 20.5), (20.0, 22.0, 18.0, 21.0, 20.2)):
        facts = dataclasses.replace(FACTS, distance_m=distance_m)
        assert look_up(parse_reference("trend:distance"), facts) == Fact("mixed")
