"""Opens a data set with LeRobot itself and prints as JSON what it sees; run where LeRobot is."""

import hashlib
import json
import os
import sys
from collections.abc import Iterator

os.environ["HF_HUB_OFFLINE"] = "1"

import av
import torch
from torch import library as operators

# The registry's torchvision is built for CUDA and misses these two beside a torch without.
if torch.version.cuda is None:
    library = operators.Library("torchvision", "DEF")
    for name in ("nms", "qnms"):
        library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")

import torchvision
from lerobot.datasets.lerobot_dataset import LeRobotDataset


def digest(values: torch.Tensor) -> str:
    return hashlib.sha256(values.contiguous().numpy().tobytes()).hexdigest()


def look(item: dict) -> dict:
    seen = {}
    for name, value in item.items():
        if not isinstance(value, torch.Tensor):
            seen[name] = value
        elif name.startswith("observation.images."):  # 0 to 1, channels first
            seen[name] = digest((value * 255).round().to(torch.uint8).permute(1, 2, 0))
        else:
            seen[name] = digest(value[0]) if name == "observation.depth" else value.tolist()
    return seen


class VideoReader:
    """The reader that LeRobot's backend `pyav` asks torchvision for, which newer versions of torchvision lack."""

    def __init__(self, path: str, stream: str) -> None:
        self.container = av.open(path)

    def seek(self, time_s: float, keyframes_only: bool) -> None:
        self.container.seek(int(time_s * av.time_base), any_frame=not keyframes_only)

    def __iter__(self) -> Iterator[dict]:
        for frame in self.container.decode(video=0):
            yield {"pts": frame.time, "data": torch.from_numpy(frame.to_ndarray(format="rgb24")).permute(2, 0, 1)}


torchvision.set_video_backend = lambda name: None
torchvision.io.VideoReader = VideoReader


def main(root: str, *indices: str) -> None:
    given = {"repo_id": "cosfly/flights", "root": root, "video_backend": "pyav"}
    data = LeRobotDataset(**given)
    stats = {name: {kind: values.tolist() for kind, values in one.items()} for name, one in data.meta.stats.items()}
    windows = LeRobotDataset(
        "cosfly/flights", root=root, video_backend="pyav", delta_timestamps={"observation.state": [-0.5, 0.0]}
    )
    batch = next(iter(torch.utils.data.DataLoader(data, batch_size=4, shuffle=False)))
    told = {
        "frames": len(data), "episodes": data.meta.total_episodes, "fps": data.meta.fps,
        "splits": data.meta.info["splits"],
        "items": {index: look(data[int(index)]) for index in indices},
        "before": windows[int(indices[-1])]["observation.state"].tolist(), "stats": stats,
        "batch": list(batch["observation.images.rgb"].shape),
    }  # fmt: skip
    print("LOOK " + json.dumps(told))


main(*sys.argv[1:])
