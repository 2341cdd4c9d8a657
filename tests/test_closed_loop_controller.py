"""cosfly/closed_loop/controller.py: what a decision is flown as, held against the rules that decisions are judged by."""

import numpy as np
import pytest
from specimens_planning import town_of, walk_along
from tables import each

from caption.schema import FutureMotion
from caption.verification.actions import TABLE, Motion, Thresholds, measure
from cosfly.closed_loop.controller import Controller, read_controls
from cosfly.closed_loop.engines import EngineDecision
from cosfly.closed_loop.settings import CONTROLLER_FILE, Drone
from cosfly.closed_loop.stage import OpenEpisode
from cosfly.closed_loop.stepper import Airspace, ClosedLoopTrajectory
from cosfly.formats.captions import TOKENS
from cosfly.planners.contract import PlanConfig
from cosfly.planners.stage import plan_trajectory
from cosfly.render.settings import RenderConfig
from cosfly.runtime.errors import ConfigError

CONTROLS = read_controls(CONTROLLER_FILE, TOKENS)
HORIZON = 5  # decisions, 2.5 s, as labels look ahead


@pytest.fixture(scope="module")
def begin():
    town = town_of()
    airspace = Airspace(RenderConfig(width_px=320, height_px=180, fovs_deg=(90.0,)), town, town)
    walk = walk_along("path_00000", [(0, 0), (60, 0)])
    plan = plan_trajectory(walk, airspace.surroundings.obstacles, PlanConfig(), 0)

    def start(num_lead=40):
        flight = ClosedLoopTrajectory(airspace, plan, num_lead=num_lead)
        moment = flight.reset()[-1]
        return flight, Controller(CONTROLS, Drone(), moment), moment

    yield start
    airspace.renderer.close()


def flown(begin, *tokens) -> tuple[list, Motion, Controller]:
    flight, controller, moment = begin()
    before_mps = float(np.linalg.norm(moment.velocity_mps))
    moments = [moment]
    for token in tokens:
        moments.append(flight.step(controller.command(token, moments[-1])))
    future = FutureMotion(
        tuple(m.index for m in moments[1:]),
        *(np.array([getattr(m, name) for m in moments]) for name in ("time_s", "position_m")),
        np.array([m.rotation_deg[1] for m in moments]),
        np.array([m.target_m for m in moments]),
        np.array([m.target.visible for m in moments]),
        before_mps,
    )
    return moments, measure(future), controller


@pytest.mark.slow
@each("token", [t for t in TOKENS if t != "search_to_reacquire_target"])
def test_a_decision_that_is_flown_for_its_horizon_shows_what_its_own_rule_asks_for(begin, token):
    _, motion, _ = flown(begin, *[token] * HORIZON)
    if token in ("break_off", "return_to_home"):  # orders of a mission; who leaves without one leaves the person
        assert motion.approach_m <= -Thresholds().approach_m
        return
    shown, _ = TABLE.shown[token]
    assert shown(motion) >= 1.0, (token, shown(motion), motion)


@each("command", [(99.0, 0, 0, 0, 0), (0, 0, 0, float("nan"), 0), (0, 0)])
def test_a_command_that_cannot_be_flown_is_the_students_failure_and_the_drone_hovers(begin, command):
    flight, _, moment = begin()
    under_way = OpenEpisode("path_00000", flight, read_controls(CONTROLLER_FILE, TOKENS), 1)
    under_way.step(EngineDecision("ok", command=np.array(command)))
    frame = under_way.frames[-1]
    assert (frame.answer, frame.action, frame.command[:4]) == ("invalid", None, (0, 0, 0, 0))
    assert under_way.moments[-1].index == moment.index + 1


def test_a_table_without_a_row_or_with_a_wrong_word_is_refused_by_name(tmp_path):
    path, text = tmp_path / "own.yaml", CONTROLLER_FILE.read_text()
    path.write_text(text.replace("  hover:", "  hovering:"))
    with pytest.raises(ConfigError, match="hover"):
        read_controls(path, TOKENS)
    path.write_text(text.replace("turn: orbit", "turn: spin"))
    with pytest.raises(ConfigError, match="turn"):
        read_controls(path, TOKENS)
