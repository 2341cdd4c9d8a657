"""The built-in rule teacher: deterministic, looks only at the facts measured on the observed frames.

It chooses a decision (rule_decisions.py) and writes English and Chinese templates, whose slots are filled as any other
teacher's are. `rule_sentences.yaml` has the sentences of each of the CONDITIONS. It is no model and sees no picture.
"""

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import islice, pairwise
from pathlib import Path

from caption.teachers.rule_decisions import LEAST_TURN_DEG, decide, expected_sizes, is_shaken, ranked
from caption.verification.facts import Facts, Series
from caption.verification.references import Fact, look_up, parse_reference
from cosfly.formats.segments import MISSION_KINDS
from cosfly.geometry.axes import wrap_deg
from cosfly.runtime.config import read_yaml

MODEL = "rules-17"  # its name in the records; counts changes of decisions and wording
SentencePair = tuple[str, str]  # English, Chinese
Condition = Callable[[Facts, int], bool]  # of the facts and the side of the decision: 1 left, -1 right, 0 neither

# The target. A perturbed track shakes the positions, so that smaller motion in it is not taken for a walk.
CLEAR_WALK_MPS = 0.9  # slower walks are not clear on a perturbed track
CLEAR_GAP_M = 4.0  # neither are smaller changes of the distance
HALTED_MPS = 0.05  # a slower pedestrian has stopped
STILL_MPS = 0.15  # a slower one stands
DAWDLING_MPS = 0.5  # a slower one moves slowly
BEND_DEG = 15.0  # a change of the target's heading that is worth a sentence
LITTLE_TURN_DEG = 40.0  # a smaller one hardly matters
# Angles between the walk and the line of sight, 0 straight away from the drone.
AWAY_DEG = 35.0
TOWARDS_DEG, TOWARDS_SHAKEN_DEG = 135.0, 150.0
CROSSING_DEG, CROSSING_SHAKEN_DEG = 35.0, 25.0  # from 90 degrees
# The target in the picture.
SMALL_SHARE, LARGE_SHARE = 0.04, 0.4  # its height as a share of the picture's
STEEP_DEG = 55.0  # of the line of sight below the horizon
LITTLE_DEG = 5.0  # a smaller bearing hardly matters
FAR_DEG = 15.0  # a target further from the axis calls for a turn
DRIFT_DEG = 1.5  # a smaller change of the bearing is not worth a sentence
ACROSS_SIGHT_DEG = 2.0  # a target further on the other side comes to the middle without a turn of the nose
CLOSE_M = 15.0  # a target that comes nearer than this leaves the drone little room
HIDDEN = ("occluded", "out_of_view")
SIDES = (("left", "right"), ("left",), ("right",))  # sides of the picture, by the side of the decision: 0, 1, -1
# The drone.
DRIFTING_MPS = 0.2  # a slower one keeps its place
SLOW_MPS = 0.3
OPENING_M = 0.5  # change of the distance within a window that is worth a sentence
SLIDING_MPS = 0.5  # motion to a side, and differences of speed, that are worth a sentence
CRAWLING_MPS = 0.7
CLIMBING_MPS = 0.15  # a slower climb is not worth a sentence
TURNING_DPS, SLIGHT_DPS = 1.0, 3.0  # slower turns are not worth a sentence, or are slight
# Bystanders.
CLOSING_M, STRIDE_M = 0.1, 3.0  # the least and the most that two people come nearer to each other between frames
NEAR_M, COMING_M = 3.0, 6.0  # from the target to a bystander at its side, to one on the way to it
MOST_DIFFERENCES = 1  # in appearance, of a person who is similar
# Topics of critical_components: what decisions rest on where the target is visible, hidden, and under an order.
TOPICS = ("heading", "height", "drone", "motion")
TOPICS_HIDDEN = ("view", "cover", "last", "drone", "height")
TOPICS_ORDERED = ("order", "view", "drone", "motion", "height")
STRIKING_TOPICS = ("view", "cover", "people", "place", "gap", "size")  # the first that holds is named as well


# --- conditions -------------------------------------------------------------------------------------------------------


def word_of(f: Facts, address: str) -> str | None:
    """Return the word that is true at an address, None if none is known."""
    reference = parse_reference(address)
    assert reference is not None
    fact = look_up(reference, f)
    return str(fact.value) if isinstance(fact, Fact) else None


def says(address: str, word: str, *conditions: Condition) -> Condition:
    """Return the condition that a word is true at an address and that other conditions hold."""

    def holds(f: Facts, side: int) -> bool:
        return word_of(f, address) == word and all(condition(f, side) for condition in conditions)

    return holds


def now(series: Series) -> float:
    """Return the value of a series at the current frame, 0 where it is not known."""
    return series[-1] or 0.0


def to_side(value: float, side: int) -> float:
    """Return how much of a value (positive to the left) is to a side; its size if there is no side."""
    return side * value if side else abs(value)


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
    return now(f.speed_mps) < CRAWLING_MPS


def walks_evenly(f: Facts, side: int) -> bool:
    """Return whether the target's mean speed is its speed now, so that a sentence may compare the drone with it."""
    return word_of(f, "trend:target_speed") not in ("increasing", "decreasing")


def gap_moves(f: Facts, side: int) -> bool:
    return word_of(f, "trend:distance") not in ("steady", "decreasing") and not comes(f, side)


def is_close(f: Facts) -> bool:
    return _or_far(f.distance_m[-1]) <= CLOSE_M


def is_slower(f: Facts) -> bool:
    """Return whether the drone is slower than the target."""
    return now(f.speed_mps) < now(f.target_speeds_mps)


def stands(f: Facts, side: int) -> bool:
    """Return whether the target stands, now and on the whole."""
    return is_walk_known(f, side) and fastest_walk_mps(f) < STILL_MPS


def fastest_walk_mps(f: Facts) -> float:
    """Return the speed of the target, the larger one of now and on the whole; 0 if it is not known."""
    return max(f.target_speed_mps or 0.0, now(f.target_speeds_mps))


def turns(f: Facts, side: int) -> bool:
    is_brisk = (f.target_speed_mps or 0.0) >= DAWDLING_MPS
    return is_brisk and walks(f, side) and not is_shaken(f) and to_side(f.target_turn_deg or 0.0, side) >= BEND_DEG


def _walk_deg(f: Facts) -> float | None:
    """Return the angle between the walk and the line of sight, 0 straight away from the drone; None if not clear."""
    course, bearing = f.target_headings_deg[-1], f.bearing_deg[-1]
    is_unclear = is_shaken(f) and (f.target_speed_mps or 0.0) < CLEAR_WALK_MPS
    if course is None or bearing is None or is_unclear or not walks(f, 0):
        return None
    return abs(wrap_deg(course - f.heading_deg[-1] - bearing))


def crosses(f: Facts, side: int) -> bool:
    walk_deg = _walk_deg(f)
    if walk_deg is None or f.target_velocity_mps is None:
        return False
    _, left_mps = f.target_velocity_mps
    is_square = abs(walk_deg - 90.0) < (CROSSING_SHAKEN_DEG if is_shaken(f) else CROSSING_DEG)
    return is_square and to_side(left_mps, side) >= SLIDING_MPS


def comes(f: Facts, side: int) -> bool:
    return (_walk_deg(f) or 0.0) > (TOWARDS_SHAKEN_DEG if is_shaken(f) else TOWARDS_DEG)


def walks_away(f: Facts, side: int) -> bool:
    walk_deg = _walk_deg(f)
    return walk_deg is not None and walk_deg < AWAY_DEG


def off_centre(f: Facts, side: int) -> bool:
    return is_legible(f, side) and word_of(f, "side:offset_x") in SIDES[side]


def is_turning(f: Facts, side: int) -> bool:
    return abs(now(f.yaw_rate_dps)) >= TURNING_DPS


def turn_ends(f: Facts, side: int) -> bool:
    """Return whether the nose is expected to turn the other way."""
    turn = expected_sizes(f)["yaw_left_to_follow"]
    return is_turning(f, side) and is_turn_slowing(f) and abs(turn) >= 1.0 and turn * now(f.yaw_rate_dps) < 0.0


def sight_swings(f: Facts, side: int) -> bool:
    return f.is_visible_now and to_side(expected_sizes(f)["yaw_left_to_follow"], side) >= 1.0


def sight_turns(f: Facts, side: int) -> bool:
    """Return whether the line of sight turns to a side on which the target is, or nearly."""
    is_across = side * now(f.bearing_deg) < -ACROSS_SIGHT_DEG
    return f.is_visible_now and not is_across and side * f.sight_rate_dps >= TURNING_DPS


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


def is_turn_slowing(f: Facts) -> bool:
    """Return whether the nose turned the same way in the last step as in the one before, and less."""
    last_step_deg = f.yaw_deg[-1] - f.yaw_deg[-2]
    step_before_deg = f.yaw_deg[-2] - f.yaw_deg[-3]
    return not is_shaken(f) and last_step_deg * step_before_deg > 0.0 and abs(last_step_deg) < abs(step_before_deg)


def slides(f: Facts, side: int) -> bool:
    ahead_mps, left_mps, _ = f.velocity_mps
    least_mps = CLEAR_WALK_MPS if is_shaken(f) else SLIDING_MPS
    return to_side(left_mps, side) >= max(least_mps, abs(ahead_mps))


def gap_scatters(f: Facts, side: int) -> bool:
    has_trend = gap_opens(f, 0) or gap_closes(f, 0) or word_of(f, "trend:distance") == "steady"
    return is_shaken(f) and f.is_visible_now and not has_trend


def bystander_closes(f: Facts, side: int) -> bool:
    """Return whether the nearest bystander comes nearer from frame to frame; a jump is another person."""
    steps_m = [0.0 if a is None or b is None else a - b for a, b in pairwise(f.other_distance_m[-3:])]
    is_near = f.is_visible_now and _or_far(f.other_distance_m[-1]) <= COMING_M
    return is_near and all(CLOSING_M < step_m < STRIDE_M for step_m in steps_m)


@dataclass(frozen=True)
class Family:
    """Decisions that are argued alike."""

    tokens: tuple[str, ...]  # one, or the same to the left and to the right
    consequences: str = "others"  # the part of the sentences about why the reason matters


FAMILIES = {
    "straight": Family(("track_straight",), "straight"),
    "yaw": Family(("yaw_left_to_follow", "yaw_right_to_follow"), "yaw"),
    "circle": Family(("circle_left", "circle_right")),
    "strafe": Family(("strafe_left", "strafe_right")),
    **{name: Family((name,)) for name in ("ascend", "descend", "speed_up", "slow_down")},
    "forward": Family(("move_forward",)),
    "backward": Family(("move_backward",)),
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
    speed_mps, walk_mps = now(f.speed_mps), now(f.target_speeds_mps)
    first_deg, last_deg = f.bearing_deg[0] or 0.0, now(f.bearing_deg)
    drift_deg = side * (last_deg - first_deg)
    first_m, last_m = f.distance_m[0], f.distance_m[-1]
    opens_m = 0.0 if first_m is None or last_m is None else last_m - first_m  # by how much the distance grows
    match name:
        case "straight":
            ahead_mps, left_mps, up_mps = f.velocity_mps
            target_leaves = abs(last_deg) - abs(first_deg) >= 2 * DRIFT_DEG and abs(last_deg) > LITTLE_DEG
            drone_turns_off = abs(now(f.yaw_rate_dps)) >= SLIGHT_DPS and not is_bearing_steady(f)
            drone_falls_back = opens_m >= OPENING_M and walk_mps > speed_mps + SLIDING_MPS
            pace_changes = (hurries(f, 0) or slows(f, 0)) and word_of(f, "trend:distance") != "steady"
            flies_aside = max(-ahead_mps, abs(left_mps), abs(up_mps)) > max(SLIDING_MPS, ahead_mps)
            is_off_course = drone_turns_off or flies_aside or ahead_mps < DRIFTING_MPS or abs(last_deg) > FAR_DEG
            return is_off_course or target_leaves or drone_falls_back or pace_changes
        case "yaw":
            drifts_away = side * last_deg < 1.0 and drift_deg <= -2 * DRIFT_DEG
            is_across = side * last_deg < -1.0 and drift_deg < 0.0
            return drifts_away or is_across
        case "slow_down":
            return walk_mps > max(0.0, speed_mps - SLIDING_MPS) or opens_m >= OPENING_M or hurries(f, 0)
        case "speed_up":
            return walk_mps < speed_mps or opens_m <= -OPENING_M
        case "strafe":
            is_left_behind = side * last_deg < -LITTLE_DEG and drift_deg < -2 * DRIFT_DEG
            return opens_m >= 1.0 or is_left_behind
        case "circle":
            return opens_m >= 1.0
        case "ascend" | "backward":
            is_small = not f.is_legible_now or now(f.box_height_px) < SMALL_SHARE * f.height_px
            return f.is_visible_now and is_small
        case "hover":
            return walk_mps >= DAWDLING_MPS
    return False


def overtakes(f: Facts, side: int) -> bool:
    """Return whether the drone flies forward faster than the target walks, now and on the whole."""
    is_walking = f.target_speed_mps and f.target_speeds_mps[-1]
    is_faster = bool(is_walking) and f.velocity_mps[0] > fastest_walk_mps(f)
    return is_faster and is_smooth(f, side) and walks_evenly(f, side)


def similar_near(f: Facts, side: int) -> bool:
    is_similar = f.alike_differences[-1] in range(MOST_DIFFERENCES + 1)  # None is not
    return f.is_visible_now and is_similar and _or_far(f.other_distance_m[-1]) <= COMING_M


def expects_slow_down(f: Facts, side: int) -> bool:
    return not gap_opens(f, side) and not is_slower(f) and expects(FAMILIES["slow_down"])(f, side)


# Conditions whose name in rule_sentences.yaml is that of their function.
NAMED = (
    stands, turns, crosses, comes, walks_away, off_centre, sight_turns, drifts, turn_ends, slides, strafes_on, overtakes,
    gap_scatters, bystander_closes, similar_near, expects_slow_down,
)  # fmt: skip
CONDITIONS: dict[str, Condition] = {
    "always": lambda f, side: True,
    **{condition.__name__: condition for condition in NAMED},
    # The walk of the target.
    "walks": walks,
    "sets_off": lambda f, side: hurries(f, side) and (f.target_speeds_mps[0] or 0.0) < STILL_MPS,
    "lingers": lambda f, side: is_walk_known(f, side) and now(f.target_speeds_mps) < DAWDLING_MPS,
    "slows": slows,
    "halts": lambda f, side: slows(f, side) and now(f.target_speeds_mps) < HALTED_MPS,
    "stops": lambda f, side: slows(f, side) and now(f.target_speeds_mps) < SLOW_MPS,
    "hurries": hurries,
    "slows_at_distance": says("trend:distance", "steady", slows),
    "hurries_at_distance": says("trend:distance", "steady", hurries),
    "turns_little": lambda f, side: turns(f, side) and abs(f.target_turn_deg or 0.0) <= LITTLE_TURN_DEG,
    "turns_sight": lambda f, side: turns(f, side) and sight_turns(f, side),
    "crosses_sight": lambda f, side: crosses(f, side) and sight_turns(f, side),
    "comes_near": lambda f, side: comes(f, side) and is_close(f) and not gap_opens(f, side),
    # Its place in the picture.
    "swings_through_jitter": lambda f, side: is_shaken(f) and sight_turns(f, side),
    "off_axis": lambda f, side: sight_swings(f, side) and side * now(f.bearing_deg) >= 1.0,
    "off_centre_little": lambda f, side: (
        off_centre(f, side) and abs(now(f.bearing_deg)) <= LITTLE_DEG and not is_turning(f, side)
    ),
    "off_centre_no_turn": lambda f, side: off_centre(f, side) and (side != 0 or not is_turning(f, side)),
    "on_axis": lambda f, side: centred(f, side) and not sight_swings(f, 0) and not is_turning(f, side),
    "on_its_side": lambda f, side: side * now(f.bearing_deg) >= 1.0,
    "bearing_steady": lambda f, side: is_bearing_steady(f),
    "steep": lambda f, side: now(f.depression_deg) >= STEEP_DEG,
    "small": lambda f, side: is_legible(f, side) and 0 < now(f.box_height_px) < SMALL_SHARE * f.height_px,
    "large": lambda f, side: is_legible(f, side) and now(f.box_height_px) > LARGE_SHARE * f.height_px,
    "hidden": says("visibility", "occluded"),
    "out_of_view": says("visibility", "out_of_view"),
    "faint": says("visibility", "illegible"),
    "partly_hidden": says("visibility", "partly_occluded"),
    "cover_closes": says("visibility@t0", "visible", says("visibility", "partly_occluded")),
    "reappeared": lambda f, side: f.is_legible_now and any(word in HIDDEN for word in f.visibility),
    "stays_hidden": lambda f, side: all(word in HIDDEN for word in f.visibility),
    "seen_at_first": lambda f, side: not f.is_visible_now and f.distance_m[0] is not None,
    # The distance, and the speeds of both.
    "gap_steady": says("trend:distance", "steady"),
    "gap_opens": gap_opens,
    "gap_closes": gap_closes,
    "gap_closes_near": lambda f, side: gap_closes(f, side) and is_close(f),
    "pace_matched": says("comparison:speed", "matching", is_smooth, walks, walks_evenly),
    "outrun": says("comparison:speed", "slower", is_smooth, walks, walks_evenly, gap_moves),
    # The drone.
    "turned": lambda f, side: is_smooth(f, side) and abs(f.yaw_deg[-1]) >= LEAST_TURN_DEG,
    "turning": lambda f, side: abs(now(f.yaw_rate_dps)) >= SLIGHT_DPS,
    "turns_slightly": is_turning,
    "turns_steadily": lambda f, side: abs(now(f.yaw_rate_dps)) >= SLIGHT_DPS and is_bearing_steady(f),
    "turn_goes_on": lambda f, side: side * now(f.yaw_rate_dps) >= TURNING_DPS,
    "turns_back": lambda f, side: side * now(f.yaw_rate_dps) <= -TURNING_DPS,
    "turns_with_sight": lambda f, side: side * now(f.yaw_rate_dps) >= TURNING_DPS and sight_turns(f, side),
    "nose_turns": lambda f, side: sight_turns(f, side) and side * f.yaw_deg[-1] >= LEAST_TURN_DEG,
    "hovers_on": lambda f, side: (f.target_speed_mps or 0.0) < DAWDLING_MPS and expects(FAMILIES["hover"])(f, side),
    "circles_on": lambda f, side: f.is_visible_now and expects(FAMILIES["circle"])(f, side),
    "strafes_to": lambda f, side: strafes_on(f, side) and side * now(f.bearing_deg) >= 1.0,
    "strafes_round": lambda f, side: strafes_on(f, side) and fastest_walk_mps(f) < SLOW_MPS,
    "drone_hovers": says("drone_motion", "hovering", lambda f, side: now(f.speed_mps) < SLOW_MPS),
    "drone_brakes": says("trend:speed", "decreasing", is_smooth, is_crawling),
    "drone_crawls": lambda f, side: is_smooth(f, side) and is_crawling(f, side),
    "drone_flies": lambda f, side: f.velocity_mps[0] >= 0.0,
    "retreats": lambda f, side: f.velocity_mps[0] <= -max(SLIDING_MPS, abs(f.velocity_mps[1])),
    "drone_lingers": lambda f, side: max(map(abs, f.velocity_mps[:2])) < DRIFTING_MPS,
    "drone_shifts": lambda f, side: abs(f.velocity_mps[1]) >= abs(f.velocity_mps[0]),
    "drone_drifts": lambda f, side: f.velocity_mps[0] >= 0.0 and abs(f.velocity_mps[1]) >= DRIFTING_MPS,
    "climbing": lambda f, side: f.velocity_mps[2] >= CLIMBING_MPS,
    "sinking": lambda f, side: f.velocity_mps[2] <= -CLIMBING_MPS,
    "drone_climbs": says("trend:altitude", "increasing", is_smooth),
    "drone_sinks": says("trend:altitude", "decreasing", is_smooth, is_legible),
    "goes_along": lambda f, side: slides(f, side) and crosses(f, side),
    "slides_past": lambda f, side: slides(f, -side) and sight_turns(f, side),
    # Bystanders, expected decisions and orders.
    "bystander_near": lambda f, side: f.is_visible_now and _or_far(f.other_distance_m[-1]) <= NEAR_M,
    **{f"expects_{name}": expects(family) for name, family in FAMILIES.items() if name != "slow_down"},
    **{kind: lambda f, side, kind=kind: f.mission == kind for kind in MISSION_KINDS},  # type: ignore[misc]
}


# --- writing ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Group:
    """The sentences of one condition."""

    name: str
    holds: Condition
    smooth: tuple[SentencePair, ...]  # for a track without perturbation
    shaken: tuple[SentencePair, ...]  # those of them for a perturbed track


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
    shaken = tuple([(en, zh) for en, zh in smooth if not _JITTERS.search(en)])
    return Group(name, CONDITIONS[name], smooth, shaken)


class Chooser:
    """Chooses by random bytes among sentences that are true of a window."""

    def __init__(self, facts: Facts, draws: bytes) -> None:
        self.facts = facts
        self._draws = iter(draws)
        self._is_shaken = is_shaken(facts)

    def below(self, count: int) -> int:
        """Return a random number from 0 to count - 1; each call takes a random byte."""
        return next(self._draws) % count

    def holding(self, groups: dict[str, Group], side: int) -> Iterator[Group]:
        """Yield the groups whose condition holds and that have a sentence for this track."""
        for group in groups.values():
            if (group.shaken or not self._is_shaken) and group.holds(self.facts, side):
                yield group

    def first(self, groups: dict[str, Group], side: int) -> list[Group]:
        """Return a list of the first group whose condition holds, empty if none does."""
        return list(islice(self.holding(groups, side), 1))

    def sentence(self, group: Group) -> SentencePair:
        pairs = group.shaken if self._is_shaken else group.smooth
        return pairs[self.below(len(pairs))]


def write_templates(
    facts: Facts, draws: bytes, decision: str | None = None
) -> tuple[dict[str, str], dict[str, str]] | None:
    """Write the English and the Chinese answer, with slots for the facts; None if the observed frames hold no reason.
    draws: At least 24 random bytes. decision: To justify (anchored); None takes the strongest one that has a reason."""
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
    texts = {
        "critical_components": _critical_components(choose, side),
        "reasoning_trace": _reasoning_trace(choose, name, side, reasons),
    }
    english = {name: " ".join([en for en, _ in pairs]) for name, pairs in texts.items()}
    chinese = {name: "".join([zh for _, zh in pairs]) for name, pairs in texts.items()}
    return english | {"flight_decision": token}, chinese | {"flight_decision": token}


def _critical_components(choose: Chooser, side: int) -> list[SentencePair]:
    """Return the facts on which a decision rests, in no fixed order. They hardly depend on the decision, so that a student
    that writes them has read what it needs before it decides."""
    topics = TOPICS if choose.facts.is_visible_now else TOPICS_HIDDEN
    if choose.facts.mission:
        topics = TOPICS_ORDERED
    parts = sentences()["facts"]
    groups = [group for topic in topics for group in choose.first(parts[topic], 0)]
    if topics is TOPICS:
        groups += islice((group for topic in STRIKING_TOPICS for group in choose.holding(parts[topic], side)), 1)
    pairs = []
    while groups:
        group = groups.pop(choose.below(len(groups)))
        pairs.append(choose.sentence(group))
    return pairs


def _reasoning_trace(choose: Chooser, name: str, side: int, reasons: list[Group]) -> list[SentencePair]:
    """Return the reason, often what follows from it, and the conclusion."""
    accounts = choose.first(sentences()["accounts"].get(name, {}), side)
    reason = reasons[choose.below(len(reasons) if name == "straight" else min(len(reasons), 2))]
    main = accounts[0] if accounts else reason  # what a reader would ask about is answered
    consequences = choose.first(sentences()["consequences"][FAMILIES[name].consequences], side)
    if choose.below(2) == 1:
        consequences = []
    (main_en, main_zh), *further = [choose.sentence(group) for group in (main, *consequences, _conclusions(name))]
    lead_en, lead_zh = next(choose.holding(sentences()["leads"][name], side)).smooth[0]
    return [(f"{lead_en} {main_en[0].lower()}{main_en[1:]}", lead_zh + main_zh), *further]


@cache
def _conclusions(name: str) -> Group:
    """Return the conclusions that fit a family of decisions: its own, and those that fit all."""
    parts = sentences()["conclusions"]
    pairs = tuple([pair for part in (name, "any") if part in parts for pair in parts[part]["always"].smooth])
    return Group(name, CONDITIONS["always"], pairs, pairs)
