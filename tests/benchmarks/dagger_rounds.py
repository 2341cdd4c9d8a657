"""Does DAgger's data make a student better? A student is taught on the planner's flights, flies, is taught on what
`fly --relabel` made of its own flights too, and flies again, on walks of a town that it never saw.

    cosfly run TRAIN.yaml --out train --until caption --set caption.repair.soft_conflict=repair
    cosfly run TEST.yaml --out test --until plan
    python tests/benchmarks/dagger_rounds.py --train train --test test --out rounds --set render.width_px=320 \\
        --set render.height_px=180 --set 'render.fovs_deg=[60, 90]' --set fly.most_decisions=80 --set fly.tree=false

Both with `pedestrians: {ground: paved, min_distance_m: 60, max_distance_m: 120}` and pictures as the flights have them.
The student is a network of two hidden layers on the numbers of its prompt, behind a server that writes its decision
into an answer.
"""

import argparse
import json
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from teacher_server import TeacherServer

from cosfly.formats.captions import TOKENS, read_captions

TUPLE, FRAMES = re.compile(r"\(([-\d.,; ]+)\)"), 5
STEPS, RATE, WIDTH = 3000, 2e-3, 64


def features(prompt: str) -> np.ndarray:
    """What a prompt tells of drone and person in its frames, in the drone's last axes; zeros where it is silent."""
    found, poses, targets = np.zeros((FRAMES, 8)), *(_rows(prompt, word) for word in ("Drone pose", "Target position"))
    if len(poses) != FRAMES:
        return found.ravel()
    yaw = np.radians(poses[-1][4])
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    for k, pose in enumerate(poses):
        found[k, :2] = turn @ (pose[:2] - poses[-1][:2]) / 10.0
        found[k, 2:4] = (pose[2] - 20.0) / 10.0, ((pose[4] - poses[-1][4] + 180.0) % 360.0 - 180.0) / 20.0
        if len(targets) == FRAMES and np.isfinite(targets[k]).all():
            found[k, 4:6] = turn @ (targets[k][:2] - poses[-1][:2]) / 10.0
            found[k, 6:] = 1.0, pose[3] / 45.0
    return found.ravel()


def _rows(prompt: str, word: str) -> list[np.ndarray]:
    line = next((line for line in prompt.splitlines() if line.startswith(word)), "")
    return [np.array([float(n) for n in re.split("[,;]", row)]) for row in TUPLE.findall(line.partition(":")[2])]


def samples(captions: Path, most_flights: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Prompts in numbers (n, 40), and the decisions of accepted captions (n,), of the first flights or all."""
    accepted = [one for one in read_captions(captions) if one.status == "accepted"]
    flights = sorted({one.trajectory for one in accepted})[:most_flights]
    found = [
        (features(one.prompt["en"].user), TOKENS.index(one.en.flight_decision))
        for one in accepted
        if one.trajectory in flights
    ]
    return np.array([x for x, _ in found]), np.array([y for _, y in found])


def taught(x: np.ndarray, y: np.ndarray) -> torch.nn.Module:
    torch.manual_seed(0)
    torch.set_num_threads(1)
    net = torch.nn.Sequential(
        torch.nn.Linear(x.shape[1], WIDTH), torch.nn.Tanh(), torch.nn.Linear(WIDTH, WIDTH), torch.nn.Tanh(),
        torch.nn.Linear(WIDTH, len(TOKENS)),
    )  # fmt: skip
    inputs, labels = torch.tensor(x, dtype=torch.float32), torch.tensor(y)
    optimizer = torch.optim.AdamW(net.parameters(), RATE, weight_decay=1e-3)
    for _ in range(STEPS):
        batch = torch.randint(len(inputs), (512,))
        loss = torch.nn.functional.cross_entropy(net(inputs[batch]), labels[batch])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    right = float((net(inputs).argmax(1) == labels).float().mean())
    print(f"taught on {len(x)} windows: {right:.1%} of them right", flush=True)
    return net


def cosfly(*words: object) -> None:
    subprocess.run([sys.executable, "-m", "cosfly", *map(str, words)], check=True, stdout=subprocess.DEVNULL)


def places(run: Path) -> list[object]:
    return ["--map", run / "maps/boxes_3d.json", "--simplified", run / "simplify/step2_simplified.json"]


def fly(net: torch.nn.Module, run: Path, out: Path, settings: Sequence[str]) -> Path:
    def decision(body: dict) -> str:
        words = "\n".join(
            part["text"]
            for message in body["messages"]
            for part in ([{"text": message["content"]}] if isinstance(message["content"], str) else message["content"])
            if "text" in part
        )
        return TOKENS[int(net(torch.tensor(features(words), dtype=torch.float32)).argmax())]

    with TeacherServer(decision=decision) as server:
        walks = ["--paths", run / "pedestrians/path.json"]
        cosfly("fly", "--student", server.url, *places(run), *walks, "--out", out, *settings)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("train", "test", "out"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--first", type=int, help="flights of the planner that it is taught on first; all unless said")
    parser.add_argument("--set", action="append", default=[], help="settings of the flights")
    given = parser.parse_args()
    settings = [word for text in given.set for word in ("--set", text)]
    x, y = samples(given.train / "caption/captions.jsonl", given.first)
    net, told = taught(x, y), []
    told.append(fly(net, given.test, given.out / "r0", settings))
    for number in range(1, given.rounds + 1):
        own, made = given.out / f"own{number}", given.out / f"relabelled{number}"
        fly(net, given.train, own, settings)
        more = ["--set", f"fly.relabel.round={number}", "--set", "caption.repair.soft_conflict=repair"]
        cosfly("fly", "--relabel", own, *places(given.train), "--out", made, *settings, *more)
        new = samples(made / "caption/captions.jsonl")
        x, y = np.vstack([x, new[0]]), np.append(y, new[1])
        net = taught(x, y)
        told.append(fly(net, given.test, given.out / f"r{number}", settings))
    board = [f"{path.name}={path}" for path in told]
    cosfly("leaderboard", *board, "--rounds", "--out", given.out / "rounds")
    for path in sorted(given.out.glob("*/score.json")):
        figures = json.loads(path.read_text())["figures"]
        for name in ("success", "in_view"):
            print(path.parent.name, name, *(f"{figures[name][k]:.1%}" for k in ("value", "low", "high")), flush=True)


if __name__ == "__main__":
    main()
