"""Every command that writes, killed at every point: which commands, with which inputs, and the sweep over their points.

`python tests/crash_sweep.py` sweeps them all; names of commands after it, only these. --few: of each kind of point the
first and the last. --twice: killed again, at a random point, in the run that goes on. Exit code 1: something was wrong
after a kill, or nothing was killed.

It is a process of its own: what it kills are forks, and a fork of a process that has run others' threads may hang.
"""

import argparse
import importlib
import pkgutil
import shlex
import shutil
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from crashes import run, sweep

from cosfly.cli import app
from cosfly.planners.contract import PlanConfig
from cosfly.planners.stage import warm_up

TINY = (
    "maps.synthetic.size_m=110", "maps.synthetic.num_blocks=1", "pedestrians.num_paths=1",
    "pedestrians.min_distance_m=8", "pedestrians.max_distance_m=12", "pedestrians.route=cells", "render.width_px=160",
    "render.height_px=90", "'render.fovs_deg=[60]'", "inspect.legible_min=0", "caption.window.stride=4", "workers=1",
)  # fmt: skip


@dataclass
class Place:
    """Where a sweep works: `base` is a finished run, `students` what distillation begins with; servers end with the
    stack."""

    root: Path
    stack: ExitStack
    _made: dict[str, str] = field(default_factory=dict)

    def given(self, name: str) -> str:
        if name not in self._made:
            self._made[name] = str(INPUTS[name](self))
        return self._made[name]

    def do(self, name: str, out: Path, more: str = "") -> Path:
        first = COMMANDS[name][0]
        assert isinstance(first, str)
        words = words_of(f"{first} {more}", self, out)
        ended = run(lambda: command(words), out)
        assert ended.code == 0, ended.said
        return out


def command(words: list[str]) -> None:
    if code := app(["-q", *words], standalone_mode=False):
        raise SystemExit(code)


# Of runs the files that are swept, a pattern: steps in the folders of stages are those of the stages' own commands.
OWN = {"run": r"[^/]*", "run, more": r"[^/]*", "run, towns": r"((one|two)/)?\.?\w+\.\w+|one|two|\.lock|process"}


def load_all() -> None:
    for name in ("caption", "cosfly", "release"):
        for module in pkgutil.walk_packages(importlib.import_module(name).__path__, f"{name}."):
            if not module.name.endswith("__main__"):
                with suppress(ImportError):  # of an extra
                    importlib.import_module(module.name)
    warm_up(PlanConfig(planner="foresight"))


def _track(place: Place) -> Path:
    tree = Path(place.given("base")) / "render"
    return next(tree.glob("Town*/trajectory_*/*")).relative_to(tree)


def _students(place: Place) -> Path:
    import torch
    from specimens_students import make_place

    torch.set_num_threads(1)
    return make_place(place.root / "students")


def _chat_server(place: Place):
    from teacher_server import TeacherServer

    server = place.stack.enter_context(TeacherServer())
    server._server.handle_error = lambda *_: None  # type: ignore[method-assign]  # of one that asked and was killed
    return server


def _judge(place: Place) -> str:
    server = _chat_server(place)
    server.text = lambda body: '{"verdict": "REJECT_REGEN", "reason": "because"}'
    return server.url


def _simulator(protocol: str, place: Place) -> int:
    from simulator_serving import serving

    from cosfly.formats.boxes import read_boxes

    town = read_boxes(Path(place.given("base")) / "maps/boxes_3d.json")
    return place.stack.enter_context(serving(town, place.root / protocol, protocol=protocol))


INPUTS: dict[str, Callable[[Place], object]] = {
    "base": lambda place: place.do("run", place.root / "base"), "track": _track, "students": _students,
    "trained": lambda place: place.do("distill train", place.root / "trained"),
    "inferred": lambda place: place.do("distill infer", place.root / "inferred"),
    "flown": lambda place: place.do("fly", place.root / "flown"),
    "erred": lambda place: place.do("fly", place.root / "erred", "--student random"),
    "teacher": lambda place: _chat_server(place).url, "judge": _judge, "carla": partial(_simulator, "carla"),
    "unrealcv": partial(_simulator, "unrealcv"),
}  # fmt: skip

TRAINING = (
    "max_pixels=4096", "device=cpu", "max_steps=3", "samples_per_step=2", "batch_size=2", "save_every_steps=1",
    "data_workers=0", "lora_rank=4",
)  # fmt: skip
SHORT = {  # what commands have in common
    "tiny": " ".join(f"--set {setting}" for setting in TINY),
    "training": " ".join(f"--set distill.train.{setting}" for setting in TRAINING), "maps": "{base}/maps/boxes_3d.json",
    "simple": "{base}/simplify/step2_simplified.json", "walks": "{base}/pedestrians/path.json",
    "traces": "{base}/plan/drone_trace.json", "tree": "{base}/render", "release": "{base}/release/dataset",
    "towns": "--set 'towns={one: {}, two: {maps: {synthetic: {size_m: 120, num_blocks: 1}}}}'",
    "three": "--map {maps} --simplified {simple} --traces {traces} {tiny}",
    "asked": "--teacher {teacher} --set caption.endpoint.concurrency=1 --no-check {tiny}",
    "set": "--dataset {students}/set --data {students}/tree",
    "small": "--set distill.infer.max_new_tokens=4 --set distill.infer.device=cpu --set distill.infer.max_pixels=4096",
}  # fmt: skip


# Commands by name; {out} is what is watched, other braces are SHORT and INPUTS. Several: one after the other in the
# same folder; a function is what comes before.
COMMANDS: dict[str, list[str | Callable[[Place, Path], object]]] = {
    "maps": ["maps --out {out} {tiny}"],
    "maps carla": ["maps --source carla --set maps.carla.port={carla} --out {out}"],
    "maps unrealcv": ["maps --source unrealcv --set maps.unrealcv.port={unrealcv} --out {out}"],
    "world": ["world 'a small village with a well' --out {out}"],
    "simplify": ["simplify --map {maps} --out {out} {tiny}"],
    "pedestrians": ["pedestrians --map {simple} --out {out} {tiny}"],
    "plan": ["plan --map {simple} --paths {walks} --out {out} {tiny}"],
    "plan compare": ["plan compare {simple} {walks} --out {out} {tiny} --planner foresight --planner track_astar"],
    "render": [  # so narrow a view that the target is made out, and its picture written
        "render {three} --out {out} --set render.width_px=64 --set render.height_px=36 --set render.fovs_deg=[12]"
    ],
    "fly": [
        "fly --map {maps} --simplified {simple} --paths {walks} --out {out} {tiny} --set fly.most_decisions=4 "
        "--set fly.lead_frames=5 --set render.tracks=[clean]"
    ],
    "fly, relabelled": [
        "fly --map {maps} --simplified {simple} --relabel {erred} --out {out} {tiny} --set render.tracks=[clean] "
        "--set fly.relabel.stride=1 --set fly.relabel.future_frames=5"
    ],
    "leaderboard": ["leaderboard {flown} --out {out}"],
    "study weather": ["study weather --map {maps} --traces {traces} --out {out} {tiny}"],
    "study zoom": ["study zoom {three} --out {out} --every 10"],
    "view map": ["view {simple} --out {out}/scene.html --paths {walks} --traces {traces} --data {tree}"],
    "view run": ["view {base} --out {out}/viewer.html"],
    "view tree": ["view {tree} --out {out}/sheet.png"],
    "view frame": ["view {tree} --out {out}/sample.png --frame best --map {maps}"],
    "inspect": ["inspect --map {simple} --traces {traces} --data {tree} --out {out} {tiny}"],
    "inspect review": [
        lambda place, out: shutil.copytree(f"{place.given('base')}/inspect", out, dirs_exist_ok=True),
        "inspect review --inspect {out} --reject {track} --by somebody --reason 'too near'",
    ],
    "reproduce": ["reproduce {base} --out {out} --pedestrians 1 --workers 1"],
    "study depth": ["study depth --data {tree} --out {out}"],
    "caption": ["caption --data {tree} --out {out} {tiny}"],
    "caption, limited": [
        "caption --data {tree} --out {out} --limit 2 {tiny}",
        "caption --data {tree} --out {out} {tiny}",
    ],
    "caption, served": ["caption --data {tree} --out {out} {asked}"],
    "caption, judged": ["caption --data {tree} --out {out} {asked} --judge {judge} --set caption.judge.concurrency=1"],
    "caption prompts": ["caption prompts --export {out}/prompts"],
    "compare-strategies": [
        "caption compare-strategies --data {tree} --out {out} --teacher {teacher} --conflicts 2 {tiny}"
    ],
    "release build": ["release build {base} --out {out} --workers 1"],
    "release export tree": ["release export {release} --format tree --out {out}"],
    "release export webdataset": ["release export {release} --format webdataset --out {out}"],
    "release export lerobot": ["release export {release} --format lerobot --out {out}"],
    "release stats": ["release stats {release} --out {out}"],
    "release export chat": ["release export {base} --format chat --out {out}"],
    "release export coco": ["release export {base} --format coco --out {out}"],
    "distill prepare": [
        "distill prepare --captions {students}/captions.jsonl --data {students}/tree --out {out}"
    ],
    "distill dual-track": [
        "distill dual-track --data {students}/tree --out {out} "
        "--set distill.dual_track.observed=2 --set distill.dual_track.predicted=2"
    ],
    "distill train": ["distill train {set} --student {students}/student --out {out} {training}"],
    "distill infer": ["distill infer {set} --model {students}/student --out {out} {small}"],
    "distill merge": ["distill merge --model {students}/student --adapter {trained}/adapter --out {out}"],
    "distill evaluate": ["distill evaluate --dataset {students}/set --predictions {inferred} --out {out}"],
    "run": ["run quickstart --out {out} {tiny}"],
    "run, towns": ["run quickstart --out {out} {tiny} {towns}"],
    "run, towns, release": [  # the release alone is left to do
        "run quickstart --out {out} {tiny} {towns}", lambda _, out: shutil.rmtree(out / "release"), "run {out}"
    ],
}  # fmt: skip


def words_of(text: str, place: Place, out: Path) -> list[str]:
    while found := [name for name in SHORT if f"{{{name}}}" in text]:
        for name in found:
            text = text.replace(f"{{{name}}}", SHORT[name])
    for name in INPUTS:
        if f"{{{name}}}" in text:
            text = text.replace(f"{{{name}}}", place.given(name))
    return shlex.split(text.replace("{out}", str(out)))


def works(name: str, place: Place) -> list[Callable[[], object]]:
    out = place.root / "out"
    return [
        partial(given, place, out) if callable(given) else partial(command, words_of(given, place, out))
        for given in COMMANDS[name]
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="COMMAND")
    parser.add_argument("--few", action="store_true")
    parser.add_argument("--twice", action="store_true")
    options = vars(parser.parse_args())
    names = options.pop("names") or COMMANDS
    load_all()
    is_right = True
    with tempfile.TemporaryDirectory() as root, ExitStack() as stack:
        place = Place(Path(root), stack)
        for name in names:
            begin_s = time.monotonic()
            try:
                swept = sweep(works(name, place), place.root, only=OWN.get(name, ".*"), **options)
            except AssertionError as error:
                print(f"{name}: does not run undisturbed: {error}", flush=True)
                is_right = False
                continue
            seconds = f"{time.monotonic() - begin_s:.0f} s"
            counts = f"{swept.num_steps} steps, killed {swept.num_killed} times, {len(swept.wrong)} wrong"
            print(f"{name}: {counts}, {seconds}", flush=True)
            print("".join(f"  {line}\n" for line in swept.wrong), end="", flush=True)
            is_right &= not swept.wrong and swept.num_killed > 0
    if not is_right:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
