"""Episodes of the benchmark: town, pedestrian trajectory and start, all computed in the process without files.

A town is a preset and a seed. The seeds of HELD_OUT are for tests only: no configuration and no training episode uses
them.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cosfly.closed_loop.stepper import Airspace, ClosedLoopTrajectory
from cosfly.formats.boxes import BoxMap
from cosfly.formats.bystanders import Bystander
from cosfly.formats.kinds import KINDS
from cosfly.formats.pedestrian_paths import walk_id
from cosfly.formats.traces import DroneTrace
from cosfly.geometry.axes import intrinsic_matrix, project, world_from_camera
from cosfly.geometry.kernels import BoxIndex, obstacle_index, visibility
from cosfly.maps.synthetic import PRESETS, SyntheticConfig, load
from cosfly.pedestrians.bystanders import bystanders_of
from cosfly.pedestrians.stage import make_pedestrian
from cosfly.pedestrians.walkable import PedestriansConfig, WalkableGround, walkable_ground
from cosfly.planners.contract import PlanConfig
from cosfly.planners.reference_trajectory import first_loss
from cosfly.planners.stage import plan_trajectory, screens_of
from cosfly.planners.styles import REACQUIRE
from cosfly.render.settings import RenderConfig
from cosfly.runtime.errors import InputError, NoPathError, nearest
from cosfly.runtime.io import sha256_bytes
from cosfly.runtime.json_io import FileFormat, Record, dump_json, read_model
from cosfly.runtime.seeding import rng_for
from cosfly.simplify.passes import SimplifyConfig, simplify

EPISODES_FILE = Path(__file__).with_name("episodes.json")
EPISODES_FORMAT = FileFormat("cosfly.episodes", "1.0", "episodes")
SIZE_PX = (640, 360)  # width and height of the pictures of the lists
FOV_DEG = 60.0
NUM_DECISIONS = 80  # 40 s
LEAD_FRAMES = 21  # of the plan, as in `fly.lead_frames`
AFTER_LOSS = 3  # frames without visibility before a policy takes over
EACH = 4  # every fourth start of an episode and every fourth of its frames is tried
TURNED_DEG = (60.0, 300.0)  # initial turn away from the target
TRIES = 40  # pedestrian trajectories until one can be an episode
PACE = {"walk": 0.4, "stop_and_look": 0.2, "hurry": 0.1, "fits_and_starts": 0.2, "turn_back": 0.1}
# Routes from cell to cell, as when the scores of docs/closed-loop.md were measured.
_ALONE = PedestriansConfig(ground="paved", road_cost=20, pace=PACE, hurry_speed_mps=2.0, route="cells")

# Environment -> pedestrians.
TASKS = {
    "cosfly/Follow-v0": _ALONE,
    "cosfly/Distracted-v0": _ALONE.model_copy(update={"others": 8, "look_alikes": 3}),
    "cosfly/Reacquire-v0": _ALONE,
}
REACQUIRES = "cosfly/Reacquire-v0"
UNSUITABLE = (
    "this pedestrian trajectory is not suitable for an episode: no drone trajectory, or only a short one, was found"
)


class BenchmarkTown(NamedTuple):
    """A generated town."""

    name: str
    preset: str
    seed: int


HELD_OUT = {
    f"HeldOut_{preset}": BenchmarkTown(f"HeldOut_{preset}", preset, 90_001 + k)
    for k, preset in enumerate(("grid", "old_town", "towers", "park", "river"))
}
TRAINING = tuple(
    BenchmarkTown(f"Training_{preset}_{seed}", preset, seed)
    for seed in range(7_001, 7_009) for preset in PRESETS if preset != "small_town"
)  # fmt: skip


class EpisodeLists(Record):
    """The file of lists: environment -> list -> episodes, each a town and the number of a trajectory."""

    lists: dict[str, dict[str, tuple[tuple[str, int], ...]]]


def read_list(name: str) -> tuple[str, tuple[tuple[str, int], ...], str]:
    """Return environment, episodes and digest of a list such as `cosfly/Follow-v0/test`; `test` is the default."""
    prefix, _, suffix = name.partition("-v0")
    env = f"{prefix}-v0"
    list_name = suffix.strip("/") or "test"
    lists = read_model(EPISODES_FILE, EpisodeLists, EPISODES_FORMAT).lists
    episodes = lists.get(env, {}).get(list_name)
    if episodes is None:
        problem = "the environment has no list of episodes with this name"
        if env not in lists:
            problem = f"there is no environment of this name{nearest(name, lists)}"
        raise InputError(problem, where="--env", got=name, expected=f"one of {', '.join(lists.get(env, lists))}")
    task = [
        env,
        TASKS[env].recorded(),
        [[HELD_OUT[town]._asdict(), number] for town, number in episodes],
        SIZE_PX,
        FOV_DEG,
        NUM_DECISIONS,
    ]
    return env, episodes, sha256_bytes(dump_json(task).encode())


def episode_id(town: str, number: int) -> str:
    """Return the id of an episode in records."""
    return f"{town}_{walk_id(number)}"


@dataclass(frozen=True, eq=False)
class BenchmarkWorld:
    """A town with all that its episodes need."""

    town: BenchmarkTown
    boxes: BoxMap  # that are drawn
    simplified: BoxMap
    ground: WalkableGround
    obstacles: BoxIndex
    screens: BoxIndex
    solids: BoxIndex  # that are drawn, without plants, whose foliage has gaps

    @property
    def sha256(self) -> str:
        """Digest of its boxes."""
        parts = (self.boxes.centers, self.boxes.half_extents, self.boxes.rotations_deg, self.boxes.kinds)
        return sha256_bytes(b"".join(np.ascontiguousarray(part).tobytes() for part in parts))

    def airspace(self, task: str, size_px: tuple[int, int] = SIZE_PX, like: Airspace | None = None) -> Airspace:
        """Open a renderer for a task; like: another town of this task and size, which shares its GL context."""
        num_others = TASKS[task].others
        cfg = RenderConfig(width_px=size_px[0], height_px=size_px[1], fovs_deg=(FOV_DEG,))
        return Airspace(
            cfg, self.boxes, self.simplified, map_sha256=self.sha256, seed=self.town.seed, num_others=num_others,
            like=like,
        )  # fmt: skip


@lru_cache(maxsize=len(HELD_OUT) + len(TRAINING))
def world_of(town: BenchmarkTown) -> BenchmarkWorld:
    """Build a town, once per process."""
    boxes = load(SyntheticConfig(name=town.name, preset=town.preset), town.seed)
    simplified = simplify(boxes, SimplifyConfig())
    return BenchmarkWorld(
        town=town, boxes=boxes, simplified=simplified, ground=walkable_ground(simplified, _ALONE, where=town.name),
        obstacles=obstacle_index(simplified), screens=screens_of(simplified),
        solids=obstacle_index(boxes.select(~boxes.is_any_of({KINDS["Vegetation"]}))),
    )  # fmt: skip


@dataclass(frozen=True)
class BenchmarkEpisode:
    """One episode: the plan of a drone trajectory, and the bystanders."""

    task: str
    world: BenchmarkWorld
    number: int
    plan: DroneTrace
    num_lead: int  # frames that follow the plan before a policy takes over
    others: tuple[Bystander, ...]

    def simulation(self, airspace: Airspace) -> ClosedLoopTrajectory:
        """Open the episode."""
        return ClosedLoopTrajectory(airspace, self.plan, number=self.number, num_lead=self.num_lead, others=self.others)


def hardest_begin(plan: DroneTrace, solids: BoxIndex) -> int:
    """Return the point of the plan where an episode begins.

    A drone that hovers after the lead frames sees the target in the fewest frames.
    """
    intrinsic = intrinsic_matrix(*SIZE_PX, FOV_DEG)
    hardest, least = 0, 1.0
    for begin in range(0, len(plan.time_s) - LEAD_FRAMES - NUM_DECISIONS + 1, EACH):
        now = begin + LEAD_FRAMES - 1
        frames = np.arange(now, now + NUM_DECISIONS + 1, EACH)
        camera_m = plan.positions_m[now]
        pixels, _ = project(plan.targets_m[frames], world_from_camera(camera_m, plan.rotations_deg[now]), intrinsic)
        targets_m = plan.targets_m[frames[((pixels >= 0) & (pixels < SIZE_PX)).all(axis=1)]]
        seen = visibility(solids, np.broadcast_to(camera_m, targets_m.shape), targets_m) > 0.0
        share = np.count_nonzero(seen) / len(frames)
        if plan.visibility[now] >= 0.5 and share < least:
            hardest, least = begin, share
    return hardest


def _takeover_after_loss(plan: DroneTrace) -> int | None:
    """Return the point where a policy takes over after the plan lost the target; None if there is none late enough."""
    if plan.instead_of:
        return None
    dt_s = float(plan.time_s[1])
    lost = first_loss(plan.visibility, dt_s, AFTER_LOSS * dt_s)
    return lost + AFTER_LOSS if lost is not None and lost + AFTER_LOSS > LEAD_FRAMES // 2 else None


@lru_cache(maxsize=256)
def episode_of(task: str, world: BenchmarkWorld, number: int) -> BenchmarkEpisode | None:
    """Return the episode of a town's trajectory; None if it or its plan is unsuitable. The last ones are cached."""
    cfg = TASKS[task]
    town = world.town
    name = walk_id(number)
    planning = PlanConfig(styles={REACQUIRE: 1.0}) if task == REACQUIRES else PlanConfig()
    try:
        target = make_pedestrian(name, world.ground, cfg, rng_for(town.seed, "pedestrians", name)).trajectory
        plan = plan_trajectory(target, world.obstacles, planning, town.seed, world.screens)
    except NoPathError:
        return None
    if plan.drop_reason is not None or len(plan.time_s) < LEAD_FRAMES + NUM_DECISIONS:
        return None
    begin = 0
    num_lead = LEAD_FRAMES
    rotations_deg = plan.rotations_deg.copy()
    if task != REACQUIRES:
        begin = hardest_begin(plan, world.solids)
    elif (takeover := _takeover_after_loss(plan)) is not None:
        num_lead = min(takeover, LEAD_FRAMES)
        begin = takeover - num_lead
    else:
        rotations_deg[:num_lead, 1] += float(rng_for(town.seed, "reacquire", name).uniform(*TURNED_DEG))
    end = begin + num_lead + NUM_DECISIONS
    if len(plan.time_s) < end:
        return None
    plan = replace(plan.part(number, begin, end), rotations_deg=rotations_deg[begin:end])
    plan = replace(plan, time_s=plan.time_s - plan.time_s[0])
    bystanders = tuple[Bystander, ...]()
    if cfg.others:
        rng = rng_for(town.seed, "pedestrians", f"{name}/others")
        positions_m = target.positions_m[begin:end]
        cut_target = replace(
            target, polyline_m=positions_m[:, :2], time_s=plan.time_s, positions_m=positions_m,
            speeds_mps=target.speeds_mps[begin:end],
        )  # fmt: skip
        bystanders = tuple(bystanders_of(cut_target, world.ground, cfg, rng).others)
    return BenchmarkEpisode(task, world, number, plan, num_lead, bystanders)
