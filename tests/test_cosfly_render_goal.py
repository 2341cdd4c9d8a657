"""Goals of drawn flights: nothing is said that the picture does not show, and of all in it they mean the target alone."""

from dataclasses import replace

import numpy as np
import pytest
from test_cosfly_render import needs_gl
from test_renderers_contract import circling, pose_towards, write_inputs

from cosfly.formats.boxes import make_box_map
from cosfly.formats.bystanders import Bystander, Bystanders, write_bystanders
from cosfly.formats.kinds import KINDS
from cosfly.formats.people import Appearance, People
from cosfly.geometry.axes import intrinsic_matrix
from cosfly.geometry.goals import LANDMARKS, SIDES, target_picture
from cosfly.render.contract import Frame, PosedBystander, PosedPerson, other_id
from cosfly.render.person import choose_clothes
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import open_renderer, run
from cosfly.render.track import find_goal
from cosfly.runtime.config import build

LOOKS = Appearance("man", "jacket", "blue", "trousers", "red")


@needs_gl
@pytest.mark.parametrize(("y_m", "says_legs"), [(8.0, True), (-8.0, False)])
def test_what_a_wall_hides_is_not_said(y_m, says_legs):
    """Two men whose trousers alone differ; to the south of them is a wall as high as their hips."""
    people = People(LOOKS, {other_id(0): replace(LOOKS, legs_color="yellow")})
    clothes = choose_clothes(np.random.default_rng(0), LOOKS)
    wall = make_box_map([[0.0, -1.5, 0.5]], [[9.0, 0.1, 0.5]], [[0.0] * 3], [KINDS["Walls"]])
    intrinsic, renderer = intrinsic_matrix(320, 180, 60.0), open_renderer("gl", wall, 320, 180, num_others=1)
    hips_m, (low_m, high_m) = np.array([[0.0, 0.0, 0.9], [1.5, 0.0, 0.9]]), np.array([[-30.0] * 3, [30.0] * 3])
    renderer.prepare(low_m, high_m)
    pose = pose_towards([0.2, y_m, 1.3], hips_m[0])

    def draw(looks: Appearance) -> Frame:
        dressed = [replace(clothes, looks=one) for one in (looks, people.others[other_id(0)])]
        bodies = [PosedPerson(hip_m, 0.0, 0.5, 1.0, one) for hip_m, one in zip(hips_m, dressed, strict=True)]
        return renderer.render(pose, intrinsic, bodies[0], [PosedBystander(other_id(0), bodies[1])])

    goal = find_goal(people, 3, draw, intrinsic, pose[:3, :3])
    renderer.close()
    assert goal is not None
    assert (goal.frame, "legs" in goal.says) == (3, says_legs)
    assert bool({*goal.says} & {*SIDES, *LANDMARKS}) != says_legs  # where they are hidden, a place is said


@pytest.fixture(scope="session")
def crowded_tree(built_once):
    """Two walks, both tracks, each among eight bystanders of whom four look alike the target but for one thing."""
    return built_once("crowd", make_crowded_tree) / "out"


def make_crowded_tree(folder):
    traces = [circling(3, f"path_{k:03d}") for k in range(2)]
    places_m = [[x, y, -0.9] for x in (-4.0, -1.5, 1.0, 3.5) for y in (-2.0, 2.0)]
    crowd = [
        Bystander("Pedestrians", trace.targets_m + place_m, np.zeros(3), k < 4)
        for trace in traces for k, place_m in enumerate(places_m)
    ]  # fmt: skip
    write_bystanders(
        folder / "others.json", [Bystanders(t.path_id, crowd[i * 8 :][:8]) for i, t in enumerate(traces)], {}
    )
    cfg = build(RenderConfig, {"width_px": 320, "height_px": 180, "fovs_deg": [60.0]}, "test")
    run(cfg, *write_inputs(folder / "in", traces), folder / "out", seed=2, others=folder / "others.json")


def test_a_target_picture_holds_the_person_and_stays_inside():
    rgb = np.zeros((90, 160, 3), np.uint8)
    rgb[40:60, 0:10] = 255
    assert target_picture(rgb, [0.0, 40.0, 10.0, 60.0]).max() == 255
    assert max(target_picture(rgb, [0.0, 40.0, 10.0, 60.0]).shape) == 160
    assert target_picture(np.zeros((900, 900, 3), np.uint8), [300.0, 300.0, 400.0, 600.0]).shape == (450, 450, 3)
