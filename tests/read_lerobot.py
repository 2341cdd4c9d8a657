"""Opens a data set with LeRobot itself, gives ACT a batch, and prints as JSON what it sees; run where LeRobot is."""

import hashlib
import json
import os
import sys
import types
from collections.abc import Iterator
from pathlib import Path

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
from lerobot.datasets import lerobot_dataset, utils
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils import import_utils


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


def act_loss(root: str) -> float:
    """Return the loss of a small random ACT on a batch of pictures, states and the next four actions."""
    import_utils._transformers_available = False  # the one of the tests is for another huggingface_hub
    policies = types.ModuleType("lerobot.policies")  # the package itself imports what other policies need
    policies.__path__ = [str(Path(import_utils.__file__).parents[1] / "policies")]
    sys.modules["lerobot.policies"] = policies
    from lerobot.configs.types import FeatureType
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy

    meta = LeRobotDataset("cosfly/flights", root=root).meta
    features = utils.dataset_to_policy_features(meta.features)
    outputs = {name: one for name, one in features.items() if one.type is FeatureType.ACTION}
    seen = (FeatureType.VISUAL, FeatureType.STATE)
    inputs = {name: one for name, one in features.items() if one.type in seen and name.startswith("observation.")}
    cfg = ACTConfig(
        input_features=inputs, output_features=outputs, chunk_size=4, n_action_steps=4, dim_model=32, n_heads=2,
        dim_feedforward=32, n_encoder_layers=1, pretrained_backbone_weights=None, device="cpu",
    )  # fmt: skip
    steps = {"action": [k / meta.fps for k in range(4)]}
    data = LeRobotDataset("cosfly/flights", root=root, delta_timestamps=steps, video_backend="pyav")
    loss, _ = ACTPolicy(cfg).forward(next(iter(torch.utils.data.DataLoader(data, batch_size=2))))
    return loss.item()


def main(root: str, *indices: str) -> None:
    if not indices:
        constants = {"version": lerobot_dataset.CODEBASE_VERSION, "chunk": utils.DEFAULT_CHUNK_SIZE}
        constants |= {"data": utils.DEFAULT_DATA_PATH, "episodes": utils.DEFAULT_EPISODES_PATH}
        constants |= {"video": utils.DEFAULT_VIDEO_PATH, "defaults": sorted(utils.DEFAULT_FEATURES)}
        print("LOOK " + json.dumps(constants | {"loss": act_loss(root)}))
        return
    data = LeRobotDataset("cosfly/flights", root=root)
    stats = {name: {kind: values.tolist() for kind, values in one.items()} for name, one in data.meta.stats.items()}
    windows = LeRobotDataset("cosfly/flights", root=root, delta_timestamps={"observation.state": [-0.5, 0.0]})
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
