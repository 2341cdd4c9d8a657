"""Captions for tools of others: what a spreadsheet, LLaMA-Factory and LLaVA would make of them."""

import csv
import json
from collections import Counter
from pathlib import Path

import pytest
from commands import invoke
from specimens_release import CFG, build, make_caption, make_inspection

from cosfly.formats.captions import Coc, read_captions, write_captions
from cosfly.formats.inspection import write_inspection
from cosfly.formats.playback import read_track
from cosfly.formats.tracks import find_tracks
from cosfly.runtime.errors import InputError, StorageError
from release.export.captions import FORMULA, export
from specimens import make_playback_tree

NUM_POINTS = 9
ANSWER = {"critical_components": "=HYPERLINK(1) ahead", "reasoning_trace": 'A, B\nC "D"', "flight_decision": "hover"}


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A run folder: render/, caption/captions.jsonl (one dropped in each flight), and release/dataset/ of it."""
    root = tmp_path_factory.mktemp("one") / "run"
    make_playback_tree(root / "render", 2, NUM_POINTS)
    (root / "tree").symlink_to("render")
    captions = []
    for number, flight in enumerate(map(read_track, find_tracks(root / "render"))):
        for i in range(4, NUM_POINTS - 1):
            caption = make_caption(flight, i)
            if i == NUM_POINTS - 2:
                caption = caption.model_copy(update={"status": "dropped", "drop_reason": "hard_conflict"})
            elif number == 0 and i == 4:
                decision = caption.en.flight_decision
                caption = caption.model_copy(update={"en": Coc(**ANSWER | {"flight_decision": decision})})
            captions.append(caption)
    (root / "caption").mkdir()
    write_captions(root / "caption/captions.jsonl", captions)
    write_captions(root / "captions.jsonl", captions)
    write_inspection(root / "inspect.json", make_inspection(root / "render", {}))
    build(root, root / "release", CFG.model_copy(update={"selection": "all"}))
    return root


def accepted(run: Path) -> list:
    return [caption for caption in read_captions(run / "caption/captions.jsonl") if caption.status == "accepted"]


def test_a_table_keeps_every_text_and_holds_no_formula(run, tmp_path):
    told = export(run, tmp_path / "c.csv", "csv")
    assert told.written == len(accepted(run))
    assert told.left_out == {"dropped_hard_conflict": 4}
    with open(tmp_path / "c.csv", encoding="utf-8-sig", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["sample_id"] for row in rows] == [caption.sample_id for caption in accepted(run)]
    assert rows[0]["critical_components_en"] == "'" + ANSWER["critical_components"]
    assert rows[0]["reasoning_trace_en"] == ANSWER["reasoning_trace"]
    for row, caption in zip(rows[1:], accepted(run)[1:], strict=True):
        assert row["reasoning_trace_en"] == caption.en.reasoning_trace
        assert row["reasoning_trace_zh"] == caption.zh.reasoning_trace
        assert json.loads(row["window"]) == caption.window
        assert not any(value.startswith(FORMULA) for value in row.values())


def test_json_lines_open_with_datasets(run, tmp_path, monkeypatch):
    datasets = pytest.importorskip("datasets")
    export(run, tmp_path / "c.jsonl", "jsonl")
    found = datasets.load_dataset(
        "json", data_files=str(tmp_path / "c.jsonl"), split="train", cache_dir=str(tmp_path / "cache")
    )
    assert found["reasoning_trace_zh"] == [caption.zh.reasoning_trace for caption in accepted(run)]
    assert all("<pictures>" not in prompt for prompt in found["prompt_en"])


def check_loader_takes(samples: list[dict], tree: Path, images: str) -> None:
    """What both families of loaders ask for: turns human, gpt; as many marks as pictures; pictures below one folder."""
    for sample in samples:
        assert [turn["from"] for turn in sample["conversations"]] == ["human", "gpt"]
        named = [sample[images]] if isinstance(sample[images], str) else sample[images]
        assert sum(turn["value"].count("<image>") for turn in sample["conversations"]) == len(named)
        assert all((tree / name).is_file() for name in named)
        assert set(json.loads(sample["conversations"][1]["value"])) == set(ANSWER)
    assert max(Counter(sample["id"] for sample in samples).values()) == 1


@pytest.mark.parametrize(("format", "images"), [("sharegpt", "images"), ("llava", "image")])
@pytest.mark.parametrize("shown", ["all", "last"])
def test_conversations_are_what_their_loaders_ask_for(run, tmp_path, format, images, shown):
    told = export(run, tmp_path / "c.json", format, shown=shown)
    samples = json.loads((tmp_path / "c.json").read_text(encoding="utf-8"))
    assert told.written == len(samples) == 2 * len(accepted(run))
    check_loader_takes(samples, run / "render", images)
    first, caption = samples[0], accepted(run)[0]
    asked = first["conversations"][0]["value"]
    assert asked.startswith("<image>" if shown == "last" else "t0: <image>\n")
    assert ("One picture is given" in asked) == (shown == "last")
    assert caption.prompt["en"].system in (first.get("system", ""), *asked.splitlines())
    assert (format, shown) != ("llava", "last") or isinstance(first["image"], str)


def test_conversations_of_a_release_are_of_one_split(dataset, tmp_path):
    with pytest.raises(InputError, match=r"the captions are of several splits; got train, validation; .*--split"):
        export(dataset, tmp_path / "c.json", "llava")
    assert not (tmp_path / "c.json").exists()
    export(dataset, tmp_path / "all.jsonl", "jsonl")
    lines = [json.loads(line) for line in (tmp_path / "all.jsonl").read_text(encoding="utf-8").splitlines()]
    for split in ("train", "validation"):
        to = ["--split", split, "--out", tmp_path / f"{split}.json"]
        done = invoke("release export", dataset, "--format sharegpt --language en", to)
        assert done.exit_code == 0, done.output
        found = [sample["id"] for sample in json.loads((tmp_path / f"{split}.json").read_text(encoding="utf-8"))]
        assert found == [f"{line['sample_id']}_en" for line in lines if line["split"] == split] != []


def test_a_file_that_is_there_stays_unless_it_may_go(run, tmp_path):
    (tmp_path / "c.csv").write_text("mine")
    with pytest.raises(StorageError, match=r"c\.csv: the output file already exists; pass --overwrite"):
        export(run, tmp_path / "c.csv", "csv")
    assert (tmp_path / "c.csv").read_text() == "mine"
    told = invoke("release export", run, "--format csv --overwrite --out", tmp_path / "c.csv")
    assert told.exit_code == 0
    assert (tmp_path / "c.csv").read_text(encoding="utf-8-sig").startswith("sample_id,")
