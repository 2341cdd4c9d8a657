"""Does open-loop accuracy foretell closed-loop success? Over "checkpoints" of a known accuracy: the rule teacher whose
decision is replaced with probability p by one drawn from the set, or of which some decisions are replaced by
`track_straight`. They are no trained students.

    python tests/benchmarks/checkpoints.py --out DIR --map MAPS --simplified SIMPLIFIED --paths PATHS [--walks 6]

Writes DIR/NAME/, as `cosfly fly` does, for each checkpoint and prints `NAME=accuracy`: the share of windows of planned
flights (those of the planner, captioned by the rules) whose label it answers. For one map; give all to `leaderboard`.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from cosfly.closed_loop import stage
from cosfly.closed_loop.engines import EngineDecision, Observation, open_engine
from cosfly.closed_loop.measures import score_episodes
from cosfly.formats.captions import TOKENS, read_captions
from cosfly.formats.episodes import EPISODES, SCORE, SCORE_FORMAT, read_episode
from cosfly.formats.traces import read_traces
from cosfly.pipeline.settings import RunConfig
from cosfly.planners import stage as planning
from cosfly.runtime.json_io import write_model
from cosfly.runtime.seeding import rng_for
from cosfly.runtime.worker import Item

TURNS = ("yaw_left_to_follow", "yaw_right_to_follow")
NOISE = (0.0, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0)


def replaced(action: str, item: str, noise: float, without: tuple[str, ...]) -> str:
    rng = rng_for(0, "checkpoint", f"{noise}/{item}")
    if rng.random() < noise:
        return str(rng.choice(TOKENS))
    return "track_straight" if action in without else action


class Checkpoint:
    """A pilot whose decisions are replaced."""

    def __init__(self, pilot: Any, noise: float, without: tuple[str, ...]) -> None:
        self.name, self.num_frames = pilot.name, pilot.num_frames
        self._engine, self._noise, self._without = pilot, noise, without

    def decide(self, observations: Sequence[Observation]) -> list[EngineDecision]:
        answers = self._engine.decide(observations)
        items = [f"{observation.episode}/{observation.moments[-1].index}" for observation in observations]
        given = (self._noise, self._without)
        return [replace(a, action=replaced(a.action, item, *given)) for a, item in zip(answers, items, strict=True)]


def main() -> None:
    parser = argparse.ArgumentParser()
    for name in ("map", "simplified", "paths", "out", "captions"):
        parser.add_argument(f"--{name}", type=Path, required=name != "captions")
    parser.add_argument("--walks", type=int, default=6)
    given = parser.parse_args()
    run = RunConfig.model_validate({"render": {"width_px": 320, "height_px": 180}})
    whole = stage.ClosedLoopConfig(
        fly=run.fly, plan=run.plan, render=run.render, caption=run.caption, infer=run.distill.infer
    )
    plans = planning.run(run.plan, given.simplified, given.paths, given.out / "plan", workers=1)
    numbers = [n for n, trace in enumerate(read_traces(plans)) if trace.drop_reason is None][: given.walks]
    checkpoints = {f"noise-{p:g}": (p, ()) for p in NOISE}
    checkpoints |= {"no-turns": (0.0, TURNS), "no-left": (0.0, TURNS[:1]), "no-speed": (0.0, ("speed_up", "slow_down"))}
    windows = [c for c in read_captions(given.captions) if c.label and c.en] if given.captions else []
    for name, (noise, without) in checkpoints.items():
        told = [(c.label, replaced(c.en.flight_decision, c.sample_id, noise, without)) for c in windows]
        if told:
            print(f"{name}={sum(a == b for a, b in told) / len(told):.4f}", flush=True)
        out = given.out / name
        if (out / SCORE).is_file():
            continue
        (out / EPISODES).mkdir(parents=True, exist_ok=True)
        stage.open_engine = lambda *args, how=(noise, without): Checkpoint(open_engine(*args), *how)
        stage.make_worker(whole, (given.map, given.simplified, plans, None), out, 0, 1)(Item("all", numbers))
        flown = [
            read_episode(path).model_copy(update={"student": name}) for path in sorted((out / EPISODES).glob("*.json"))
        ]
        write_model(out / SCORE, score_episodes(flown), SCORE_FORMAT)


if __name__ == "__main__":
    main()
