"""The embedded rule teacher: deterministic, looks only at the facts measured on the observed frames.

It chooses a decision (rule_decisions.py) and writes English and Chinese templates, whose slots are filled as any other
teacher's are. A sentence is used only where its condition holds: CONDITIONS names them,
`rule_sentences.yaml` has the sentences of each. Records say `kind: rules`: it is no model and sees no picture.
"""

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import islice, pairwise
from pathlib import Path

from caption.teachers.rule_decisions import LEAST_TURN_DEG, decide, expected_sizes, is_shaken, ranked, sight_rate_dps
from caption.verification.facts import Facts
from caption.verification.references import Fact, look_up, parse_reference
from cosfly.formats.segments import MISSION_KINDS
from cosfly.geometry.axes import wrap_deg
from cosfly.runtime.config import read_yaml

MODEL = "rules-17"  # its name in the records; counts changes of decisions and wording
Both = tuple[str, str]  # English, Chinese
Condition = Callable[[Facts, int], bool]  # of the facts and the side of the decision: 1 left, -1 right, 0 neither

CLEAR_WALK_MPS, CLEAR_GAP_M = 0.9, 4.0  # less is taken for shaking on a perturbed track
BEND_DEG = 15.0  # a change of the target's heading that is worth a sentence
SMALL_SHARE, LARGE_SHARE = 0.04, 0.4  # of the picture's height
STEEP_DEG = 55.0
STRIDE_M = 3.0  # the most that two people come nearer to each other between frames
NEAR_M, COMING_M = 3.0, 6.0  # from the target to a bystander at its side, to one on the way to it
MOST_DIFFERENCES = 1  # in appearance, of a person who is similar
SLOW_MPS, SLIDING_MPS, CRAWLING_MPS, DRIFTING_MPS = 0.3, 0.5, 0.7, 0.2
HALTED_MPS, STILL_MPS, DAWDLING_MPS = 0.05, 0.15, 0.5  # a slower pedestrian has stopped; stands; moves slowly
TURNING_DPS, SLIGHT_DPS, CLIMBING_MPS = 1.0, 3.0, 0.15  # slower turns and climbs are not worth a sentence; are slight
SIDES = (("left", "right"), ("left",), ("right",))  # by the side of the decision
HIDDEN = ("occluded", "out_of_view")
CLOSE_M = 15.0  # a target that comes nearer than this leaves the drone little room
LITTLE_DEG, LITTLE_TURN_DEG = 5.0, 40.0  # bearings and turns of the target that hardly matter
FAR_DEG = 15.0  # a target further from the axis calls for a turn
DRIFT_DEG = 1.5  # a smaller change of the bearing is not worth a sentence
ACROSS_SIGHT_DEG = 2.0  # a target further on the other side comes to the middle without a turn of the nose
# Topics of critical_components: what decisions rest on where the target is visible, hidden, and under an order.
TOPICS = ("heading", "height", "drone", "motion")
TOPICS_HIDDEN = ("view", "cover", "last", "drone", "height")
TOPICS_ORDERED = ("order", "view", "drone", "motion", "height")
STRIKING_TOPICS = ("view", "cover", "people", "place", "gap", "size")  # the first that holds is named as well


# --- conditions -------------------------------------------------------------------------------------------------------


def word_of(f: Facts, address: str) -> str | None:
    """Return the word that is true at an address, None where none is known."""
    key = ("word", address)
    if key not in f.found:
        reference = parse_reference(address)
        assert reference is not None
        fact = look_up(reference, f)
        f.found[key] = str(fact.value) if isinstance(fact, Fact) else None
    return f.found[key]  # type: ignore[no-any-return]


def says(address: str, word: str, *conditions: Condition) -> Condition:
    """Return the condition that a word is true at an address and that other conditions hold."""

    def holds(f: Facts, side: int) -> bool:
        if word_of(f, address) != word:
            return False
        return not [None for condition in conditions if not condition(f, side)]

    return holds


def is_smooth(f: Facts, side: int) -> bool:
    return not is_shaken(f)


def is_legible(f: Facts, side: int) -> bool:
    """Return whether the picture shows the target, so that its place and size in it may be stated."""
    return f.is_legible_now


def is_walk_known(f: Facts, side: int) -> bool:
    return f.is_visible_now and f.target_speeds_mps[-1] is not None


def is_walk_known_at_first(f: Facts, side: int) -> bool:
    return is_walk_known(f, side) and f.target_speeds_mps[0] is not None and not is_shaken(f)


def is_gap_clear(f: Facts, side: int) -> bool:
    first, last = f.distance_m[0], f.distance_m[-1]
    return first is not None and last is not None and (not is_shaken(f) or abs(last - first) >= CLEAR_GAP_M)


walks = says("target_motion", "walking", is_walk_known)
slows = says("trend:target_speed", "decreasing", is_walk_known_at_first)
hurries = says("trend:target_speed", "increasing", is_walk_known_at_first)
centred = says("side:offset_x", "centred", is_legible)
gap_opens = says("trend:distance", "increasing", is_gap_clear)
gap_closes = says("trend:distance", "decreasing", is_gap_clear)


def _or_far(distance_m: float | None) -> float:
    """Return a distance, infinite where it is not known."""
    return math.inf if distance_m is None else distance_m


def is_crawling(f: Facts, side: int) -> bool:
    return (f.speed_mps[-1] or 0.0) < CRAWLING_MPS


def walks_evenly(f: Facts, side: int) -> bool:
    """Return whether the target's mean speed is its speed now, so that a sentence may compare the drone with it."""
    return word_of(f, "trend:target_speed") not in ("increasing", "decreasing")


def gap_moves(f: Facts, side: int) -> bool:
    return word_of(f, "trend:distance") not in ("steady", "decreasing") and not comes(f, side)


def is_close(f: Facts) -> bool:
    return _or_far(f.distance_m[-1]) <= CLOSE_M


def is_slower(f: Facts) -> bool:
    """Return whether the drone is slower than the target."""
    return (f.speed_mps[-1] or 0.0) < (f.target_speeds_mps[-1] or 0.0)


def sets_off(f: Facts, side: int) -> bool:
    return hurries(f, side) and (f.target_speeds_mps[0] or 0.0) < STILL_MPS


def stands(f: Facts, side: int) -> bool:
    """Return whether the target stands, now and on the whole."""
    return is_walk_known(f, side) and max(f.target_speed_mps or 0.0, f.target_speeds_mps[-1] or 0.0) < STILL_MPS


def turns(f: Facts, side: int) -> bool:
    turn_deg, is_brisk = f.target_turn_deg or 0.0, (f.target_speed_mps or 0.0) >= DAWDLING_MPS
    return is_brisk and walks(f, side) and not is_shaken(f) and (side * turn_deg if side else abs(turn_deg)) >= BEND_DEG


def _walk_deg(f: Facts) -> float | None:
    """Return the angle between the walk and the line of sight, None where it is not clear."""
    course, bearing = f.target_headings_deg[-1], f.bearing_deg[-1]
    is_unclear = is_shaken(f) and (f.target_speed_mps or 0.0) < CLEAR_WALK_MPS
    if course is None or bearing is None or is_unclear or not walks(f, 0):
        return None
    return abs(wrap_deg(course - f.heading_deg[-1] - bearing))


def crosses(f: Facts, side: int) -> bool:
    off_deg, walk = _walk_deg(f), f.target_velocity_mps
    if off_deg is None or walk is None or side * walk[1] < 0.0 or abs(walk[1]) < SLIDING_MPS:
        return False
    return abs(off_deg - 90.0) < (25.0 if is_shaken(f) else 35.0)


def comes(f: Facts, side: int) -> bool:
    return (_walk_deg(f) or 0.0) > (150.0 if is_shaken(f) else 135.0)


def walks_away(f: Facts, side: int) -> bool:
    off_deg = _walk_deg(f)
    return off_deg is not None and off_deg < 35.0


def off_centre(f: Facts, side: int) -> bool:
    return is_legible(f, side) and word_of(f, "side:offset_x") in SIDES[side]


def is_turning(f: Facts, side: int) -> bool:
    return abs(f.yaw_rate_dps[-1] or 0.0) >= TURNING_DPS


def turn_ends(f: Facts, side: int) -> bool:
    """Return whether the nose is expected to turn the other way."""
    turn = expected_sizes(f)["yaw_left_to_follow"]
    return is_turning(f, side) and is_slowing(f) and abs(turn) >= 1.0 and turn * (f.yaw_rate_dps[-1] or 0.0) < 0.0


def sight_swings(f: Facts, side: int) -> bool:
    turn = expected_sizes(f)["yaw_left_to_follow"]
    return f.is_visible_now and (side * turn if side else abs(turn)) >= 1.0


def sight_turns(f: Facts, side: int) -> bool:
    """Return whether the line of sight turns to a side on which the target is, or nearly."""
    is_across = side * (f.bearing_deg[-1] or 0.0) < -ACROSS_SIGHT_DEG
    return f.is_visible_now and not is_across and side * sight_rate_dps(f) >= TURNING_DPS


def drifts(f: Facts, side: int) -> bool:
    """Return whether the target moves to a side in the picture, and is there now."""
    first_deg, last_deg = f.bearing_deg[0], f.bearing_deg[-1]
    if first_deg is None or last_deg is None or is_shaken(f) or not f.is_legible_now:
        return False
    return side * (last_deg - first_deg) >= DRIFT_DEG and side * last_deg >= 1.0


def is_bearing_steady(f: Facts) -> bool:
    first_deg, last_deg = f.bearing_deg[0], f.bearing_deg[-1]
    return first_deg is not None and last_deg is not None and abs(last_deg - first_deg) < 2 * DRIFT_DEG


def strafes_on(f: Facts, side: int) -> bool:
    """Return whether a strafe goes on, and the target neither leaves nor drifts out of the picture on the other side."""
    first_deg, last_deg = f.bearing_deg[0], f.bearing_deg[-1]
    if first_deg is None or last_deg is None or gap_opens(f, side) or not expects(FAMILIES["strafe"])(f, side):
        return False
    return side * last_deg >= -LITTLE_DEG and (is_shaken(f) or side * (last_deg - first_deg) >= -2 * DRIFT_DEG)


def circles_on(f: Facts, side: int) -> bool:
    return f.is_visible_now and expects(FAMILIES["circle"])(f, side)


def nose_turns(f: Facts, side: int) -> bool:
    return sight_turns(f, side) and side * f.yaw_deg[-1] >= LEAST_TURN_DEG


def is_slowing(f: Facts) -> bool:
    """Return whether the nose turned the same way in the last step as in the one before, and less."""
    last_deg, before_deg = f.yaw_deg[-1] - f.yaw_deg[-2], f.yaw_deg[-2] - f.yaw_deg[-3]
    return not is_shaken(f) and last_deg * before_deg > 0.0 and abs(last_deg) < abs(before_deg)


def slides(f: Facts, side: int) -> bool:
    ahead_mps, left_mps, _ = f.velocity_mps
    least_mps = CLEAR_WALK_MPS if is_shaken(f) else SLIDING_MPS
    return (side * left_mps if side else abs(left_mps)) >= max(least_mps, abs(ahead_mps))


def gap_scatters(f: Facts, side: int) -> bool:
    has_trend = gap_opens(f, 0) or gap_closes(f, 0) or word_of(f, "trend:distance") == "steady"
    return is_shaken(f) and f.is_visible_now and not has_trend


def bystander_closes(f: Facts, side: int) -> bool:
    """Return whether the nearest bystander comes nearer from frame to frame; a jump is another person."""
    steps_m = [0.0 if a is None or b is None else a - b for a, b in pairwise(f.other_distance_m[-3:])]
    is_near = f.is_visible_now and _or_far(f.other_distance_m[-1]) <= COMING_M
    return is_near and all(0.1 < step_m < STRIDE_M for step_m in steps_m)


@dataclass(frozen=True)
class Family:
    """Decisions that are argued alike. tokens: one, or the same to the left and to the right. why: its consequences."""

    tokens: tuple[str, ...]
    why: str = "others"


FAMILIES = {
    "straight": Family(("track_straight",), "straight"),
    "yaw": Family(("yaw_left_to_follow", "yaw_right_to_follow"), "yaw"),
    "circle": Family(("circle_left", "circle_right")),
    "strafe": Family(("strafe_left", "strafe_right")),
    "ascend": Family(("ascend",)),
    "descend": Family(("descend",)),
    "forward": Family(("move_forward",)),
    "backward": Family(("move_backward",)),
    "speed_up": Family(("speed_up",)),
    "slow_down": Family(("slow_down",)),
    "hover": Family(("hover",), "hover"),
    "search": Family(("search_to_reacquire_target",), "lost"),
    "break_off": Family(("break_off",), "order"),
    "home": Family(("return_to_home",), "order"),
}
FAMILY_OF = {token: name for name, family in FAMILIES.items() for token in family.tokens}


def expects(family: Family) -> Condition:
    """Return the condition that the observed frames themselves lead to a decision of a family, on its side."""

    def holds(f: Facts, side: int) -> bool:
        token = family.tokens[side < 0]
        return token in ranked(f) and (token != "track_straight" or token == decide(f))

    return holds


def is_opposed(f: Facts, name: str, side: int) -> bool:
    """Return whether the measured state speaks against a decision of a family, so that no reason would support it."""
    ahead_mps, left_mps, up_mps = f.velocity_mps
    speed_mps, walk_mps = f.speed_mps[-1] or 0.0, f.target_speeds_mps[-1] or 0.0
    first_deg, last_deg = f.bearing_deg[0] or 0.0, f.bearing_deg[-1] or 0.0
    first_m, last_m = f.distance_m[0], f.distance_m[-1]
    opens_m = 0.0 if first_m is None or last_m is None else last_m - first_m
    match name:
        case "straight":
            leaves = abs(last_deg) - abs(first_deg) >= 2 * DRIFT_DEG and abs(last_deg) > LITTLE_DEG
            turns_off = abs(f.yaw_rate_dps[-1] or 0.0) >= SLIGHT_DPS and not is_bearing_steady(f)
            falls_back = opens_m >= SLIDING_MPS and walk_mps > speed_mps + SLIDING_MPS
            changes = (hurries(f, 0) or slows(f, 0)) and word_of(f, "trend:distance") != "steady"
            is_aside = max(-ahead_mps, abs(left_mps), abs(up_mps)) > max(SLIDING_MPS, ahead_mps)
            is_still = ahead_mps < DRIFTING_MPS
            return leaves or turns_off or falls_back or changes or abs(last_deg) > FAR_DEG or is_aside or is_still
        case "yaw":
            drift_deg = side * (last_deg - first_deg)
            return (side * last_deg < 1.0 and drift_deg <= -2 * DRIFT_DEG) or (
                side * last_deg < -1.0 and drift_deg < 0.0
            )
        case "slow_down":
            return walk_mps > max(0.0, speed_mps - SLIDING_MPS) or opens_m >= SLIDING_MPS or hurries(f, 0)
        case "speed_up":
            return walk_mps < speed_mps or opens_m <= -SLIDING_MPS
        case "strafe":
            is_left_behind = side * last_deg < -LITTLE_DEG and side * (last_deg - first_deg) < -2 * DRIFT_DEG
            return opens_m >= 1.0 or is_left_behind
        case "circle":
            return opens_m >= 1.0
        case "ascend" | "backward":
            return f.is_visible_now and not (
                f.is_legible_now and (f.box_height_px[-1] or 0) >= SMALL_SHARE * f.height_px
            )
        case "hover":
            return walk_mps >= DAWDLING_MPS
    return False


def is_ordered(kind: str) -> Condition:
    return lambda f, side: f.mission == kind


# The names by which rule_sentences.yaml refers to conditions.
CONDITIONS: dict[str, Condition] = {
    "always": lambda f, side: True,
    "stands": stands,
    "lingers": lambda f, side: is_walk_known(f, side) and (f.target_speeds_mps[-1] or 0.0) < DAWDLING_MPS,
    "sets_off": sets_off, "turns": turns, "crosses": crosses, "comes": comes, "walks_away": walks_away, "walks": walks,
    "slows_at_distance": says("trend:distance", "steady", slows), "hurries_at_distance": says("trend:distance", "steady", hurries),
    "slows": slows, "halts": lambda f, side: slows(f, side) and (f.target_speeds_mps[-1] or 0.0) < HALTED_MPS, "stops": lambda f, side: slows(f, side) and (f.target_speeds_mps[-1] or 0.0) < SLOW_MPS,
    "hurries": hurries, "off_centre": off_centre, "sight_turns": sight_turns, "swings_through_jitter": lambda f, side: is_shaken(f) and sight_turns(f, side),
    "crosses_sight": lambda f, side: crosses(f, side) and sight_turns(f, side),
    "off_axis": lambda f, side: sight_swings(f, side) and side * (f.bearing_deg[-1] or 0.0) >= 1.0,
    "off_centre_little": lambda f, side: off_centre(f, side) and abs(f.bearing_deg[-1] or 0.0) <= LITTLE_DEG
    and not is_turning(f, side),
    "turns_little": lambda f, side: turns(f, side) and abs(f.target_turn_deg or 0.0) <= LITTLE_TURN_DEG,
    "turn_goes_on": lambda f, side: side * (f.yaw_rate_dps[-1] or 0.0) >= TURNING_DPS,
    "turns_sight": lambda f, side: turns(f, side) and sight_turns(f, side),
    "turns_steadily": lambda f, side: abs(f.yaw_rate_dps[-1] or 0.0) >= SLIGHT_DPS and is_bearing_steady(f),
    "hovers_on": lambda f, side: (f.target_speed_mps or 0.0) < DAWDLING_MPS and expects(FAMILIES["hover"])(f, side),
    "turns_with_sight": lambda f, side: side * (f.yaw_rate_dps[-1] or 0.0) >= TURNING_DPS
    and f.is_visible_now and side * sight_rate_dps(f) >= TURNING_DPS
    and side * (f.bearing_deg[-1] or 0.0) >= -ACROSS_SIGHT_DEG,
    "on_its_side": lambda f, side: side * (f.bearing_deg[-1] or 0.0) >= 1.0,
    "strafes_to": lambda f, side: strafes_on(f, side) and side * (f.bearing_deg[-1] or 0.0) >= 1.0,
    "strafes_round": lambda f, side: strafes_on(f, side)
    and max(f.target_speed_mps or 0.0, f.target_speeds_mps[-1] or 0.0) < SLOW_MPS,
    "strafes_on": strafes_on, "circles_on": circles_on, "bearing_steady": lambda f, side: is_bearing_steady(f),
    "drifts": drifts,
    "turned": lambda f, side: is_smooth(f, side) and abs(f.yaw_deg[-1]) >= LEAST_TURN_DEG,
    "off_centre_no_turn": lambda f, side: off_centre(f, side) and (side != 0 or not is_turning(f, side)),
    "on_axis": lambda f, side: centred(f, side) and not sight_swings(f, 0) and not is_turning(f, side),
    "gap_steady": says("trend:distance", "steady"),
    "gap_opens": gap_opens, "gap_closes": gap_closes, "gap_scatters": gap_scatters,
    "pace_matched": says("comparison:speed", "matching", is_smooth, walks, walks_evenly),
    "outrun": says("comparison:speed", "slower", is_smooth, walks, walks_evenly, gap_moves),
    "overtakes": lambda f, side: is_smooth(f, side) and walks_evenly(f, side)
    and f.velocity_mps[0] > max(f.target_speed_mps or math.inf, f.target_speeds_mps[-1] or math.inf),
    "nose_turns": nose_turns,
    "drone_hovers": says("drone_motion", "hovering", lambda f, side: (f.speed_mps[-1] or 0.0) < SLOW_MPS),
    "drone_brakes": says("trend:speed", "decreasing", is_smooth, is_crawling),
    "drone_crawls": lambda f, side: is_smooth(f, side) and is_crawling(f, side),
    "drone_flies": lambda f, side: f.velocity_mps[0] >= 0.0,
    "slides": slides, "retreats": lambda f, side: f.velocity_mps[0] <= -max(SLIDING_MPS, abs(f.velocity_mps[1])),
    "turn_ends": turn_ends, "turns_slightly": is_turning,
    "turning": lambda f, side: abs(f.yaw_rate_dps[-1] or 0.0) >= SLIGHT_DPS,
    "turns_back": lambda f, side: side * (f.yaw_rate_dps[-1] or 0.0) <= -TURNING_DPS,
    "drone_lingers": lambda f, side: max(map(abs, f.velocity_mps[:2])) < DRIFTING_MPS,
    "drone_shifts": lambda f, side: abs(f.velocity_mps[1]) >= abs(f.velocity_mps[0]),
    "climbing": lambda f, side: f.velocity_mps[2] >= CLIMBING_MPS,
    "sinking": lambda f, side: f.velocity_mps[2] <= -CLIMBING_MPS,
    "drone_drifts": lambda f, side: f.velocity_mps[0] >= 0.0 and abs(f.velocity_mps[1]) >= DRIFTING_MPS,
    "comes_near": lambda f, side: comes(f, side) and is_close(f) and not gap_opens(f, side),
    "gap_closes_near": lambda f, side: gap_closes(f, side) and is_close(f),
    "goes_along": lambda f, side: slides(f, side) and crosses(f, side),
    "slides_past": lambda f, side: slides(f, -side) and sight_turns(f, side),
    "drone_climbs": says("trend:altitude", "increasing", is_smooth),
    "drone_sinks": says("trend:altitude", "decreasing", is_smooth, is_legible),
    "steep": lambda f, side: (f.depression_deg[-1] or 0.0) >= STEEP_DEG,
    "small": lambda f, side: is_legible(f, side) and 0 < (f.box_height_px[-1] or 0) < SMALL_SHARE * f.height_px,
    "large": lambda f, side: is_legible(f, side) and (f.box_height_px[-1] or 0) > LARGE_SHARE * f.height_px,
    "hidden": says("visibility", "occluded"), "out_of_view": says("visibility", "out_of_view"), "faint": says("visibility", "illegible"),
    "partly_hidden": says("visibility", "partly_occluded"),
    "cover_closes": says("visibility@t0", "visible", says("visibility", "partly_occluded")),
    "reappeared": lambda f, side: f.is_legible_now and any(word in HIDDEN for word in f.visibility),
    "stays_hidden": lambda f, side: all(word in HIDDEN for word in f.visibility),
    "seen_at_first": lambda f, side: not f.is_visible_now and f.distance_m[0] is not None,
    "bystander_near": lambda f, side: f.is_visible_now and _or_far(f.other_distance_m[-1]) <= NEAR_M,
    "bystander_closes": bystander_closes,
    "similar_near": lambda f, side: f.is_visible_now and f.alike_differences[-1] in range(MOST_DIFFERENCES + 1)
    and _or_far(f.other_distance_m[-1]) <= COMING_M,
    **{f"expects_{name}": expects(family) for name, family in FAMILIES.items()},
    "expects_slow_down": lambda f, side: not gap_opens(f, side) and not is_slower(f)
    and expects(FAMILIES["slow_down"])(f, side),
    **{kind: is_ordered(kind) for kind in MISSION_KINDS},
}  # fmt: skip


# --- writing ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Group:
    """The sentences of one condition. shaken: those of them for a perturbed track."""

    name: str
    holds: Condition
    smooth: tuple[Both, ...]
    shaken: tuple[Both, ...]


# Numbers that the shaking of a perturbed track changes more than the motion does.
_JITTERS = re.compile(r"\{(?:change:|yaw\}|mean:speed|mean:target|target_|(?:altitude|distance|box_height)@)")


@cache
def sentences() -> dict[str, dict[str, dict[str, Group]]]:
    """Read the sentences: section -> topic or family -> name of a condition -> its sentences."""
    table = read_yaml(Path(__file__).with_name("rule_sentences.yaml"))
    return {
        section: {part: {name: _group(name, pairs) for name, pairs in groups.items()} for part, groups in parts.items()}
        for section, parts in table.items()
    }


def _group(name: str, pairs: Sequence[Sequence[str]]) -> Group:
    smooth = tuple([(en, zh) for en, zh in pairs])
    return Group(name, CONDITIONS[name], smooth, tuple([pair for pair in smooth if not _JITTERS.search(pair[0])]))


class Chooser:
    """Chooses by random bytes among sentences that are true of a window."""

    def __init__(self, facts: Facts, draws: bytes) -> None:
        self.facts, self._draws, self._is_shaken = facts, iter(draws), is_shaken(facts)

    def below(self, count: int) -> int:
        return next(self._draws) % count

    def holding(self, groups: dict[str, Group], side: int) -> Iterator[Group]:
        """Yield the groups whose condition holds and that have a sentence for this track."""
        for group in groups.values():
            if (group.shaken or not self._is_shaken) and group.holds(self.facts, side):
                yield group

    def sentence(self, group: Group) -> Both:
        pairs = group.shaken if self._is_shaken else group.smooth
        return pairs[self.below(len(pairs))]


def write_templates(
    facts: Facts, draws: bytes, decision: str | None = None
) -> tuple[dict[str, str], dict[str, str]] | None:
    """Write the English and the Chinese answer, with slots for the facts.

    Args:
        draws: random bytes, at least 24.
        decision: the decision to justify (anchored); None takes the strongest one that has a reason.

    Returns:
        None where the observed frames hold no reason.
    """
    choose = Chooser(facts, draws)
    for token in [decision] if decision else ranked(facts):
        side = ("left" in token) - ("right" in token)
        name = FAMILY_OF[token]
        if is_opposed(facts, name, side):
            continue
        if reasons := list(choose.holding(sentences()["reasons"][name], side)):
            break
    else:
        return None
    components, trace = _critical_components(choose, side), _reasoning_trace(choose, name, side, reasons)
    texts = [(" ".join([en for en, _ in both]), "".join([zh for _, zh in both])) for both in (components, trace)]
    english, chinese = [
        {"critical_components": critical, "reasoning_trace": reasoning, "flight_decision": token}
        for critical, reasoning in zip(*texts, strict=True)
    ]
    return english, chinese


def _critical_components(choose: Chooser, side: int) -> list[Both]:
    """Return the facts on which a decision rests, in no fixed order.

    They hardly depend on the decision: what tells one manoeuvre from another is how the nose turns, how the drone
    climbs and moves, and how the target moves. A student that writes them has read what it needs before it decides.
    """
    topics = TOPICS_ORDERED if choose.facts.mission else TOPICS if choose.facts.is_visible_now else TOPICS_HIDDEN
    found = [group for topic in topics for group in islice(choose.holding(sentences()["facts"][topic], 0), 1)]
    if topics is TOPICS:
        striking = (group for topic in STRIKING_TOPICS for group in choose.holding(sentences()["facts"][topic], side))
        found += islice(striking, 1)
    return [choose.sentence(found.pop(choose.below(len(found)))) for _ in tuple(found)]


def _reasoning_trace(choose: Chooser, name: str, side: int, reasons: list[Group]) -> list[Both]:
    """Return the reason, often what follows from it, and the conclusion."""
    accounts = list(choose.holding(sentences()["accounts"].get(name, {}), side))
    number = choose.below(len(reasons) if name == "straight" else min(len(reasons), 2))
    main = accounts.pop(0) if accounts else reasons.pop(number)  # what a reader would ask about is answered
    consequences = list(islice(choose.holding(sentences()["consequences"][FAMILIES[name].why], side), 1))
    second = (consequences, [])[choose.below(2)]
    first, *others = [choose.sentence(group) for group in (main, *second, _conclusions(name))]
    lead = next(choose.holding(sentences()["leads"][name], side)).smooth[0]
    return [(f"{lead[0]} {first[0][0].lower()}{first[0][1:]}", lead[1] + first[1]), *others]


@cache
def _conclusions(name: str) -> Group:
    """Return the conclusions that fit a family of decisions: its own, and those that fit all."""
    parts = sentences()["conclusions"]
    pairs = tuple([pair for part in (name, "any") if part in parts for pair in parts[part]["always"].smooth])
    return Group(name, CONDITIONS["always"], pairs, pairs)
