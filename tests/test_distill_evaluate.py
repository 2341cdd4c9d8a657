"""distill/evaluation/stage.py: numbers that can be checked by hand, and BERTScore on a tiny local encoder."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from specimens_distill import make_caption, write_set

from cosfly.errors import ConfigError, InputError
from cosfly.products.predictions import Prediction
from cosfly.store import dump_json
from distill.evaluation.bertscore import others_of, score_texts
from distill.evaluation.stage import (
    NOT_COMPUTED,
    UNPARSED,
    EvaluateConfig,
    majority,
    measure,
    pair_up,
    run,
    wilson_interval,
)
from distill.inference.stage import make_prediction
from distill.prepare.samples import PrepareConfig, make_sample
from distill.schema import Sample


def sample_of(frame: int, language: str = "en") -> Sample:
    sample = make_sample(make_caption("Town01", "trajectory_1", "ORI", frame), language, PrepareConfig())  # type: ignore[arg-type]
    assert isinstance(sample, Sample)
    return sample


# Frames 4..11 have the decisions slow_down, track, yaw_left, track, slow_down, track, yaw_left, track (see specimens_distill).
FRAMES = range(4, 12)
DECISIONS = ["slow_down", "track_straight", "yaw_left_to_follow", "track_straight"] * 2


def answer_with(sample: Sample, decision: str) -> str:
    return dump_json({**json.loads(sample.answer), "flight_decision": decision})


def predictions_of(samples: list[Sample]) -> list[Prediction]:
    """Right for four of eight: two wrong decisions, one answer cut short, one that is prose; one right one needs mending."""
    texts = [sample.answer for sample in samples]
    texts[1] = answer_with(samples[1], "slow_down")
    texts[2] = answer_with(samples[2], "track_straight")
    texts[3] = texts[3][:40]
    texts[4] = "I would slow down."
    texts[5] = f"```json\n{texts[5]}\n```"
    return [make_prediction(sample, "test", text, 9, True) for sample, text in zip(samples, texts, strict=True)]


@pytest.fixture
def samples() -> list[Sample]:
    found = [sample_of(frame) for frame in FRAMES]
    assert [sample.decision for sample in found] == DECISIONS
    return found


def test_measured_numbers_by_hand(samples):
    found = measure(pair_up(samples, predictions_of(samples)), ["slow_down"] * 3 + ["hover"] * 2)
    assert found["samples"] == 8
    assert (found["parsed"]["right"], found["parsed"]["share"]) == (6, 0.75)
    assert found["parsed_without_mending"]["share"] == 5 / 8
    assert found["unparsed_reasons"] == {"broken_json": 1, "no_json_object": 1}
    assert (found["accuracy"]["right"], found["accuracy"]["share"]) == (4, 0.5)
    # Labels are there where the frame is no multiple of 3: frames 4 (right), 5, 7, 8 (wrong), 10, 11 (right).
    assert (found["accuracy_on_labels"]["right"], found["accuracy_on_labels"]["of"]) == (3, 6)
    assert found["floor_train_majority"]["decision"] == "slow_down"
    assert found["floor_train_majority"]["share"] == 2 / 8
    assert found["floor_split_majority"]["decision"] == "track_straight"
    assert found["floor_split_majority"]["share"] == 4 / 8
    assert {name: (share["right"], share["of"]) for name, share in found["by_decision"].items()} == {
        "track_straight": (2, 4),
        "yaw_left_to_follow": (1, 2),
        "slow_down": (1, 2),
    }
    assert found["confusion"] == {
        "track_straight": {"track_straight": 2, "slow_down": 1, UNPARSED: 1},
        "yaw_left_to_follow": {"yaw_left_to_follow": 1, "track_straight": 1},
        "slow_down": {"slow_down": 1, UNPARSED: 1},
    }


def test_wilson_interval_known_values():
    # 8 of 10 at 95 %: 0.4902 to 0.9433 (a textbook value)
    assert wilson_interval(8, 10) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert wilson_interval(0, 10) == pytest.approx((0.0, 0.2775), abs=1e-4)
    assert wilson_interval(0, 0) is None


@given(num_all=st.integers(1, 500), part=st.floats(0, 1))
def test_wilson_interval_holds_the_share_and_lies_in_the_unit_interval(num_all, part):
    num_right = round(part * num_all)
    low, high = wilson_interval(num_right, num_all)
    assert 0 <= low <= num_right / num_all + 1e-12
    assert num_right / num_all - 1e-12 <= high <= 1
    mirrored = wilson_interval(num_all - num_right, num_all)
    assert (1 - high, 1 - low) == pytest.approx(mirrored, abs=1e-9)


def test_majority_and_ties():
    assert majority(["hover", "slow_down", "hover"]) == "hover"
    assert majority(["slow_down", "track_straight"]) == "track_straight"  # the first of the action table
    assert majority([]) is None


def test_a_prediction_for_an_unknown_sample_is_refused(samples):
    with pytest.raises(InputError, match="does not have"):
        pair_up(samples[:-1], predictions_of(samples))


@given(st.integers(2, 40), st.integers(0, 10))
def test_shuffling_leaves_no_text_in_its_place(count, seed):
    texts = [str(i) for i in range(count)]
    shuffled = others_of(texts, np.random.default_rng(seed))
    assert sorted(shuffled) == sorted(texts)
    assert all(a != b for a, b in zip(texts, shuffled, strict=True))


def test_empty_texts_score_zero_and_are_not_asked():
    asked = []

    def scorer(candidates, references):
        asked.extend(candidates)
        return np.ones((len(candidates), 3))

    scores = score_texts(scorer, ["a", "", " ", "b"], ["x", "y", "z", ""])
    assert scores[:, 0].tolist() == [1, 0, 0, 0]
    assert asked == ["a"]


# --- run --------------------------------------------------------------------------------------------------------------


@pytest.fixture
def place(tmp_path, samples) -> Path:
    """A training set of two languages and the predictions of its test split."""
    both = [*samples, *(sample_of(frame, "zh") for frame in FRAMES)]
    write_set(tmp_path / "set", {"train": both, "val": both, "test": both})
    records = predictions_of(samples) + predictions_of(both[8:])
    lines = [dump_json(record.model_dump(mode="json")) for record in records]
    (tmp_path / "predictions.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return tmp_path


def test_without_a_model_the_report_says_so_and_gives_no_number(place):
    path = run(EvaluateConfig(), place / "predictions.jsonl", place / "set", place / "out")
    report = json.loads(path.read_text())
    assert report["bertscore"] == NOT_COMPUTED
    assert {measured["bertscore"] for measured in report["languages"].values()} == {NOT_COMPUTED}
    assert report["languages"]["zh"]["parsed"]["share"] == 0.75
    assert report["all"]["accuracy"] == {**report["all"]["accuracy"], "right": 8, "of": 16}
    page = (place / "out" / "evaluation.md").read_text()
    assert "| answers that parse | 75.00% (6/8;" in page
    assert "| BERTScore precision / recall / F1 | not computed: no model folder |" in page
    assert "always track_straight" in page
    again = run(EvaluateConfig(), place / "predictions.jsonl", place / "set", place / "again")
    assert again.read_bytes() == path.read_bytes()


def test_samples_that_were_not_asked_are_counted_apart(place):
    lines = (place / "predictions.jsonl").read_text(encoding="utf-8").splitlines(keepends=True)
    (place / "few.jsonl").write_text("".join(lines[:4]), encoding="utf-8")
    report = json.loads(run(EvaluateConfig(), place / "few.jsonl", place / "set", place / "out").read_text())
    assert report["not_asked"] == 12
    assert report["all"]["parsed"] == {**report["all"]["parsed"], "right": 3, "of": 4}  # three of the first four


@pytest.mark.parametrize("bad", ['{"sample_id": 1}\n', "no json\n", None])
def test_bad_predictions_name_file_and_line(place, bad):
    lines = (place / "predictions.jsonl").read_text(encoding="utf-8").splitlines(keepends=True)
    (place / "bad.jsonl").write_text(lines[0] + (bad or lines[0]), encoding="utf-8")
    with pytest.raises(InputError, match=r"bad\.jsonl:2"):
        run(EvaluateConfig(), place / "bad.jsonl", place / "set", place / "out")


# --- BERTScore --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def encoder(tmp_path_factory) -> Path:
    """A tiny random RoBERTa with a byte-level tokenizer; its files hold no model_max_length, as some do."""
    torch = pytest.importorskip("torch", reason="needs the extra distill")
    pytest.importorskip("bert_score", reason="needs the extra distill")
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers, processors, trainers
    from transformers import PreTrainedTokenizerFast, RobertaConfig, RobertaModel

    tokenizer = Tokenizer(models.BPE())
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=True)
    tokenizer.decoder = decoders.ByteLevel()
    special = ["<s>", "<pad>", "</s>", "<unk>", "<mask>"]
    trainer = trainers.BpeTrainer(
        vocab_size=400,
        special_tokens=special,
        initial_alphabet=sorted(pre_tokenizers.ByteLevel.alphabet()),
        show_progress=False,
    )
    tokenizer.train_from_iterator([sample_of(frame).answer for frame in FRAMES], trainer)
    tokenizer.post_processor = processors.RobertaProcessing(("</s>", 2), ("<s>", 0))
    folder = tmp_path_factory.mktemp("bert") / "encoder"
    PreTrainedTokenizerFast(
        tokenizer_object=tokenizer,
        bos_token="<s>",
        eos_token="</s>",
        cls_token="<s>",
        sep_token="</s>",
        unk_token="<unk>",
        pad_token="<pad>",
        mask_token="<mask>",
    ).save_pretrained(folder)
    config = RobertaConfig(
        vocab_size=tokenizer.get_vocab_size(),
        hidden_size=32,
        num_hidden_layers=3,
        num_attention_heads=4,
        intermediate_size=64,
        max_position_embeddings=514,
        pad_token_id=1,
        initializer_range=0.3,
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        RobertaModel(config).save_pretrained(folder)
    return folder


def evaluated(place: Path, encoder: Path, **settings: object) -> dict:
    cfg = EvaluateConfig.model_validate({"bertscore": {"layer": 2, "device": "cpu", **settings}})
    out = place / f"out_{len(list(place.iterdir()))}"
    return json.loads(run(cfg, place / "predictions.jsonl", place / "set", out, bertscore_model=encoder).read_text())


def test_identical_texts_score_one_shuffled_less_and_unparsed_zero(place, encoder):
    report = evaluated(place, encoder)
    for language in ("en", "zh"):
        scores = report["languages"][language]["bertscore"]
        # Four of the six parsed answers are the reference itself, the other two differ in the decision alone.
        assert 0.9 < scores["parsed_only"]["f1"] < 1.0
        assert scores["f1"] == pytest.approx(scores["parsed_only"]["f1"] * 6 / 8)
        assert scores["scored_zero"] == 2
        assert scores["shuffled_floor"]["f1"] < scores["f1"]
    facts = report["bertscore"]
    assert (facts["layer"], facts["idf"], facts["rescaled"]) == (2, False, False)
    assert set(facts["versions"]) == {"bert-score", "transformers", "torch"}


def test_perfect_predictions_score_one(place, encoder, samples):
    records = [make_prediction(sample, "test", sample.answer, 9, True) for sample in samples]
    lines = [dump_json(record.model_dump(mode="json")) for record in records]
    (place / "predictions.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
    for idf in (False, True):
        scores = evaluated(place, encoder, idf=idf)["languages"]["en"]["bertscore"]
        for name in ("precision", "recall", "f1"):
            assert scores[name] == pytest.approx(1.0, abs=1e-5)
            assert scores["shuffled_floor"][name] < 0.999


def test_languages_can_be_left_out(place, encoder):
    report = evaluated(place, encoder, languages=["en"])
    assert report["languages"]["zh"]["bertscore"] == "not computed: not in bertscore.languages"
    assert report["languages"]["en"]["bertscore"]["f1"] > 0


def test_rescaling_uses_the_baseline_file(place, encoder):
    (place / "baseline.tsv").write_text("LAYER,P,R,F\n0,0.1,0.1,0.1\n1,0.2,0.2,0.2\n2,0.5,0.5,0.5\n", encoding="utf-8")
    plain = evaluated(place, encoder)["languages"]["en"]["bertscore"]["parsed_only"]["f1"]
    scaled = evaluated(place, encoder, baseline=str(place / "baseline.tsv"))["languages"]["en"]["bertscore"][
        "parsed_only"
    ]["f1"]
    assert scaled == pytest.approx((plain - 0.5) / (1 - 0.5), abs=1e-5)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"layer": 17}, "fewer layers.*17.*<= 3"),
        ({"baseline": "nowhere.tsv"}, "no such baseline file"),
    ],
)
def test_settings_that_do_not_fit_the_encoder(place, encoder, settings, words):
    with pytest.raises(ConfigError, match=words):
        evaluated(place, encoder, **settings)


def test_a_folder_without_an_encoder_is_named(place, tmp_path):
    with pytest.raises(InputError, match="BERTScore model"):
        evaluated(place, tmp_path / "nothing")
