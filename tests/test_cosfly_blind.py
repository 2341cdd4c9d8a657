"""What decisions can be told from without a picture."""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from cosfly.geometry.axes import rotation_matrices
from cosfly.inspection.blind_baseline import past_of
from specimens import make_flight

NUM = 12


def flight_of(walked_m, **changes):
    """A flight 20 m behind and 10 m above a walker at places (n, 2)."""
    flight, _ = make_flight(len(walked_m))
    targets = np.column_stack([walked_m, np.full(len(walked_m), 0.9)])
    still = replace(flight.perturbation, target_m=np.zeros_like(targets))
    positions = targets + np.array([-20.0, 3.0, 10.0])
    return replace(flight, targets_m=targets, positions_m=positions, perturbation=still, is_original=True, **changes)


def straight(steps_m):
    return np.column_stack([np.cumsum(steps_m), np.zeros(len(steps_m))])


EVEN = straight(np.full(NUM, 0.6))


@given(st.integers(0, 2**31))
@settings(max_examples=25, deadline=None)
def test_a_past_is_the_same_wherever_and_whenever_it_was(seed):
    rng = np.random.default_rng(seed)
    flight = flight_of(rng.normal(size=(NUM, 2)).cumsum(axis=0), time_s=0.5 * np.arange(NUM))
    flight = replace(flight, rotations_deg=rng.uniform(-60, 60, (NUM, 3)))
    yaw_deg, moved_m = float(rng.uniform(-180, 180)), rng.uniform(-1e3, 1e3, 3)
    turn = rotation_matrices(np.radians(np.array([[0.0, yaw_deg, 0.0]])))[0]
    there = replace(
        flight, positions_m=flight.positions_m @ turn.T + moved_m, targets_m=flight.targets_m @ turn.T + moved_m,
        rotations_deg=flight.rotations_deg + np.array([0.0, yaw_deg, 0.0]), time_s=flight.time_s + 77.0,
    )  # fmt: skip
    here = past_of(flight, range(5), False)
    np.testing.assert_allclose(past_of(there, range(5), False), here, atol=1e-6)
    later = flight.positions_m.copy()
    later[5:] += 9.0
    assert np.array_equal(past_of(replace(flight, positions_m=later), range(5), False), here)  # nothing of the future
    assert not np.array_equal(past_of(flight, range(5), True), here)


def test_a_past_holds_what_a_prompt_may_tell():
    """Poses as they were drawn, with their perturbation, and no place of a target that nobody sees."""
    clean = flight_of(EVEN)
    shifted_m = np.zeros((NUM, 3))
    shifted_m[3] = 0.5, -0.5, 0.2
    noisy = replace(
        clean, is_original=False, positions_m=clean.positions_m + shifted_m,
        perturbation=replace(clean.perturbation, drone_m=shifted_m, rotation_deg=np.zeros((NUM, 3))),
    )  # fmt: skip
    np.testing.assert_allclose(noisy.planned[0][:, :3], clean.positions_m, atol=1e-9)
    assert np.abs(past_of(noisy, range(5), False) - past_of(clean, range(5), False)).max() > 0.4
    hidden = replace(clean, target=replace(clean.target, visible=np.zeros(NUM, dtype=bool)))
    moved = replace(hidden, targets_m=hidden.targets_m + np.random.default_rng(0).normal(size=(NUM, 3)))
    assert np.array_equal(past_of(moved, range(5), False), past_of(hidden, range(5), False))
