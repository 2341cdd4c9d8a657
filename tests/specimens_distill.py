"""Captions over the specimen playback tree, in both languages, with every kind of record that prepare must sort."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from cosfly.formats.captions import PICTURES_MARK, Caption, Coc, Prompt, write_captions
from cosfly.formats.places import sample_id
from cosfly.formats.playback_file import read_track
from cosfly.formats.predictions import Split
from cosfly.formats.tracks import find_tracks
from cosfly.llm.student_chat import ChatFormat, FrameFormat, write_chat_format
from cosfly.runtime.json_io import write_model
from cosfly.runtime.run_dir import fingerprint
from distill.prepare import stage as prepare
from distill.prepare.stage import PrepareConfig, RunSource
from distill.schema import RECORD, RECORD_FORMAT, Sample, SourceTree, TrainingSet, write_splits

WINDOW = 5
DECISIONS = ("track_straight", "yaw_left_to_follow", "track_straight", "slow_down")
ENGLISH = {
    "track_straight": ("is centred in the view and walks on", "keeps its heading, so the drone tracks straight"),
    "yaw_left_to_follow": ("drifts to the left of the view", "turns left, so the drone yaws left to keep it in view"),
    "slow_down": ("stands still below the drone", "has stopped, so the drone slows down to keep its distance"),
}
CHINESE = {
    "track_straight": ("位于画面中央并继续前行", "保持方向，因此无人机直线跟踪"),
    "yaw_left_to_follow": ("向画面左侧偏移", "向左转弯，因此无人机左偏航跟随"),
    "slow_down": ("在无人机下方静止", "已经停下，因此无人机减速保持距离"),
}


def make_caption(town: str, trajectory: str, variant: str, frame: int, **changes: object) -> Caption:
    """Give an accepted caption of the window that ends at `frame`; its decision goes round DECISIONS."""
    decision = DECISIONS[(frame + len(variant)) % len(DECISIONS)]
    english, chinese = ENGLISH[decision], CHINESE[decision]
    fields = {
        "sample_id": sample_id(f"{trajectory}_{variant}", frame),
        "town": town, "trajectory": trajectory, "variant": variant, "frame_index": frame,
        "window": list(range(frame - WINDOW + 1, frame + 1)),
        "future": list(range(frame + 1, frame + 1 + WINDOW)),
        "prompt": {
            "en": Prompt(system="You fly the drone.", user=f"Five frames end at {frame}. {PICTURES_MARK} Answer."),
            "zh": Prompt(system="你驾驶无人机。", user=f"五帧，最后一帧为{frame}。{PICTURES_MARK}请回答。"),
        },
        "prompt_hash": "0" * 64, "picture_px": (64, 36),  # the size of the specimen tree
        "teacher": {"kind": "rules", "model": "rules", "settings": {"seed": 0}},
        "usage": {"prompt_tokens": 0, "completion_tokens": 0}, "attempts": 1, "status": "accepted",
        "label_from": "flight" if variant == "ORI" else "twin", "label": None if frame % 3 == 0 else decision,
        "verdict": "ABSTAIN" if frame % 3 == 0 else "CONSISTENT",  # as geometry cannot tell
    }  # fmt: skip
    for language, first, last in (
        ("en", f"The pedestrian {english[0]}, about {10 + frame} m ahead.", f"The pedestrian {english[1]}."),
        ("zh", f"行人{chinese[0]}，距离约{10 + frame}米。", f"行人{chinese[1]}。"),
    ):
        fields[language] = Coc(critical_components=first, reasoning_trace=last, flight_decision=decision)
    return Caption.model_validate({**fields, **changes})


def prepared(tree: Path, captions: Path, out: Path, *, seed: int = 0, **settings: Any) -> Path:
    cfg = PrepareConfig.model_validate(settings)
    return prepare.run(cfg, [RunSource(tree, captions)], out, seed=seed)


def write_set(out: Path, splits: Mapping[Split, Iterable[Sample]], trees: Iterable[Path] = ()) -> Path:
    """Write a training set of given samples; the trees are of the run that each stands in."""
    out.mkdir(parents=True, exist_ok=True)
    counts, _ = write_splits(out, Sample, splits)
    sources = [SourceTree(run=tree.parent.name, sha256=fingerprint(tree)) for tree in trees]
    write_model(out / RECORD, TrainingSet(split_by="walk", trees=sources, samples=counts), RECORD_FORMAT)
    return out


def make_captions(path: Path, tree: Path) -> list[Caption]:
    captions = []
    for folder in find_tracks(tree):
        flight = read_track(folder)
        names = (flight.town, flight.trajectory, flight.variant)
        captions += [make_caption(*names, frame) for frame in range(WINDOW - 1, len(flight))]
    write_captions(path, captions)
    return captions


ADAPTER_PIXELS = 64 * 64
TEACHING = ChatFormat.model_validate({
    "prompts": {"en": {"system": "You fly.", "user": "Five frames."}}, "num_frames": 5, "max_pixels": ADAPTER_PIXELS,
    "looks": [FrameFormat(views=("rgb",), size_px=(64, 36), depth_range_m=100.0)],
})  # fmt: skip


def make_adapter(base: Path, folder: Path, **changes) -> Path:
    """An adapter with random updates, as `distill train` leaves one."""
    import torch
    from peft import LoraConfig, get_peft_model

    from distill.student.model import load_student
    from distill.student.saving import ADAPTER_FACTS, ADAPTER_FORMAT, AdapterFacts, base_digests
    from distill.training.stage import target_modules

    student = load_student(base, device="cpu")
    lora = {"r": 4, "lora_alpha": 12, "init_lora_weights": False, "task_type": "CAUSAL_LM"}
    lora |= {"target_modules": target_modules(student)} | changes
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(7)
        student.model = get_peft_model(student.model, LoraConfig(**lora))
    with torch.no_grad():  # what training changes is small beside what was there
        for name, tensor in student.model.named_parameters():
            if "lora_B" in name:
                tensor.mul_(0.02)
    student.model.save_pretrained(folder)
    write_model(folder / ADAPTER_FACTS, AdapterFacts(base_sha256=base_digests(base)), ADAPTER_FORMAT)
    write_chat_format(folder, TEACHING)
    return folder
