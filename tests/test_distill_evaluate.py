"""distill/evaluation."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from specimens_distill import make_caption, write_set

from cosfly.formats.captions import TOKENS
from cosfly.formats.predictions import Prediction
from cosfly.geometry.trajectory_metrics import draw_pedestrians
from cosfly.inspection.blind_baseline import LEAST_WINDOWS
from cosfly.runtime.json_io import dump_json
from distill.evaluation.bertscore import BertScoreConfig, Scorer
from distill.evaluation.floors import Floors, coc_of, majority
from distill.evaluation.measure import STUDENT, measure, pair_up, read_report, text_of
from distill.evaluation.scores import VALUES, VERDICTS, ScoredAnswer, Scores, differences_of, figures_of, score_answers
from distill.evaluation.stage import EvaluateConfig, run
from distill.inference.outcome import failed_prediction, make_prediction
from distill.prepare.stage import PrepareConfig, make_sample
from distill.schema import Sample


def sample_of(frame: int, language: str = "en") -> Sample:
    return make_sample(make_caption("Town01", "trajectory_1", "ORI", frame), language, PrepareConfig())


# Frames 4..11 have the decisions slow_down, track, yaw_left, track, slow_down, track, yaw_left, track (see
# specimens_distill).
FRAMES = range(4, 12)
DECISIONS = ["slow_down", "track_straight", "yaw_left_to_follow", "track_straight"] * 2


def answer_with(sample: Sample, decision: str) -> str:
    return dump_json({**json.loads(sample.answer), "flight_decision": decision})


def predictions_of(samples: list[Sample]) -> list[Prediction]:
    """Right for four of eight: two wrong decisions, one answer cut short, one that is prose; one right one needs
    mending."""
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


def scores_of(samples, predictions=None, **more) -> Scores:
    pairs = pair_up(samples, predictions or predictions_of(samples))
    answers = [ScoredAnswer.of(prediction) for _, prediction in pairs]
    return score_answers([sample for sample, _ in pairs], answers, **more)


def figures(scores: Scores, resamples: int = 200, confidence: float = 0.95):
    draws = draw_pedestrians(len(set(scores.walk)), resamples, np.random.default_rng(0))
    return figures_of(scores, draws, confidence=confidence)


def test_measured_numbers_by_hand(samples):
    scores = scores_of(samples)
    found, by_decision = figures(scores)
    table = measure({STUDENT: scores}, [], resamples=100, confidence=0.9, seed=0).who[STUDENT].confusion
    assert table["track_straight"] == {"(unparsed)": 1, "slow_down": 1, "track_straight": 2}
    assert {name: figure.value for name, figure in found.items() if figure.value is not None} == pytest.approx(
        {
            "answered": 1.0,
            "parsed": 6 / 8,
            "parsed_unmended": 5 / 8,
            "accuracy": 4 / 8,
            "accuracy_parsed": 4 / 6,
            # slow_down: 1 hit of 2 references, 2 answers; track_straight: 2 of 4, 3; yaw_left_to_follow: 1 of 2, 1.
            "macro_f1": (2 * 1 / (2 + 2) + 2 * 2 / (4 + 3) + 2 * 1 / (2 + 1)) / 3,
            "accuracy_on_labels": 3 / 6,  # frames 4, 10, 11 of 4, 5, 7, 8, 10, 11, which are no multiples of 3
            "tokens": 9.0,
        }
    )
    assert (found["accuracy"].count, found["accuracy_parsed"].count) == (8, 6)
    assert (found["accuracy"].low, found["accuracy"].high) == (None, None)  # of one walk
    told = {name: (figure.value, figure.count) for name, figure in by_decision.items()}
    assert told == {"track_straight": (2 / 4, 4), "yaw_left_to_follow": (1 / 2, 2), "slow_down": (1 / 2, 2)}


def test_failures_are_no_wrong_answers(samples):
    predictions = predictions_of(samples)
    predictions[7] = failed_prediction(samples[7], "test", "damaged_picture")  # was right
    found, _ = figures(scores_of(samples, predictions))
    assert (found["answered"].value, found["answered"].count) == (7 / 8, 8)
    assert (found["accuracy"].value, found["accuracy"].count) == (3 / 7, 7)
    assert found["parsed"].value == 5 / 7
    report = measure({STUDENT: scores_of(samples, predictions)}, predictions, resamples=100, confidence=0.9, seed=0)
    assert report.failed == {"failed_damaged_picture": 1}
    assert report.unparsed == {"broken_json": 1, "no_json_object": 1}


def test_verdicts_are_those_of_the_true_future(samples):
    futures = [("slow_down", ()), ("hover", ()), (None, ("track_straight",)), (None, ()), ("hover", ("hover",))]
    futures += [(None, None)] * 3
    known = [
        sample.model_copy(update={"label": label, "contradicted": contradicted})
        for sample, (label, contradicted) in zip(samples, futures, strict=True)
    ]
    scores = scores_of(known, predictions_of(samples))
    # Answers: slow_down, slow_down, track_straight, then two that do not parse; of the last three nothing is known.
    words = [VERDICTS[number] if number >= 0 else None for number in scores.verdict]
    assert words == ["CONSISTENT", "SOFT_CONFLICT", "HARD_CONFLICT", *[None] * 5]
    found, _ = figures(scores)
    assert (found["consistent"].value, found["hard_conflict"].count) == (1 / 3, 3)


def made_up(num_walks: int, rng: np.random.Generator, *, size: int = 6, skill: float = 0.6) -> Scores:
    """Scores of walks of some size, in which right answers come in clumps."""
    sizes = rng.integers(2, 2 * size, num_walks)
    walk = np.repeat([f"walk_{i}" for i in range(num_walks)], sizes).astype(object)
    count = len(walk)
    right = rng.random(count) < np.repeat(rng.beta(2 * skill, 2 * (1 - skill), num_walks), sizes)
    reference = rng.integers(0, 3, count).astype(np.int8)
    texts = {name: np.full(count, "x", dtype=object) for name in ("language", "against")}
    texts |= {"key": np.array([f"{name}/{i}" for i, name in enumerate(walk)], dtype=object), "walk": walk}
    unknown = {name: np.full(count, np.nan) for name in ("precision", "recall", "f1", "drawn_ahead", *VALUES)}
    codes = {name: np.full(count, -1, dtype=np.int8) for name in ("label", "verdict")}
    flags = {name: np.ones(count, dtype=bool) for name in ("answered", "unmended")}
    answer, tokens = np.where(right, reference, 5).astype(np.int8), np.zeros(count, dtype=np.int64)
    known = {"reference": reference, "answer": answer, "num_tokens": tokens}
    return Scores(**known, **texts, **unknown, **codes, **flags)


def test_intervals_agree_with_the_bootstrap_of_scipy():
    from scipy.stats import bootstrap

    scores = made_up(60, np.random.default_rng(1))
    right = scores.answer == scores.reference
    walks = [right[scores.walk == name] for name in dict.fromkeys(scores.walk)]
    sums, counts = np.array([walk.sum() for walk in walks]), np.array([len(walk) for walk in walks])
    expected = bootstrap(
        (sums, counts), lambda s, n, axis: s.sum(axis=axis) / n.sum(axis=axis), paired=True, method="percentile",
        n_resamples=9999, confidence_level=0.9, rng=np.random.default_rng(2),
    ).confidence_interval  # fmt: skip
    found = figures(scores, 9999, 0.9)[0]["accuracy"]
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high), abs=4e-3)
    assert found.value == right.mean()


def test_paired_differences(samples):
    rng = np.random.default_rng(5)
    one = made_up(50, rng)
    worse = replace(one, answer=np.where(rng.random(len(one)) < 0.3, 7, one.answer).astype(np.int8))

    def compared(other: Scores, resamples: int = 2000) -> tuple:
        return differences_of(one, other, resamples=resamples, confidence=0.95, rng=np.random.default_rng(0))

    count, found = compared(worse)
    accuracy, right = found["accuracy"], [(each.answer == each.reference).mean() for each in (one, worse)]
    assert (count, accuracy.value) == (len(one), pytest.approx(right[0] - right[1]))
    assert (accuracy.low > 0, accuracy.p) == (True, 1 / 2000)
    # The same samples in another order, and a few of them: keys pair, not places.
    order = rng.permutation(len(one))
    assert compared(worse.at(order)) == (count, found)
    same = compared(one.at(order[:40]), 200)
    assert (same[0], same[1]["accuracy"].value, same[1]["accuracy"].p) == (40, 0.0, 1.0)
    assert compared(replace(one, key=one.key + "x"), 200)[0] == 0


def test_floors_by_hand(samples):
    train = [sample.model_copy(update={"decision": "hover"}) for sample in samples[:3]] + samples[3:5]
    answers = Floors(train, "en", 0).answers(samples, [coc_of(sample) for sample in samples])
    decisions = {name: [answer.coc.flight_decision for answer in own] for name, own in answers.items()}
    assert set(decisions["majority"]) == {"hover"}
    assert sorted(decisions["shuffled"]) == sorted(DECISIONS)
    assert len({answer.coc.reasoning_trace for answer in answers["constant"]}) == 1
    assert list(Floors([], "en", 0).answers(samples[:1], [coc_of(samples[0])])) == ["teacher"]
    assert majority(["slow_down", "track_straight"]) == "track_straight"  # a tie goes to the first of the action table


def test_a_rule_and_a_network_that_see_no_picture_beat_the_majority(samples):
    """What the past's numbers tell is no merit of a student: decisions by speed and distance, among numbers that mean
    nothing. Too few windows, or one without a past, give no such floor."""
    rng = np.random.default_rng(0)

    def told(count: int) -> list[Sample]:
        found = []
        for distance, speed in rng.uniform(0, 10, (count, 2)).round(2).tolist():
            decision = "slow_down" if speed <= 4 else "hover" if distance <= 3 else "track_straight"
            past = (float(rng.integers(99)), distance, speed, float(rng.integers(99)))
            found.append(samples[0].model_copy(update={"past": past, "decision": decision}))
        return found

    floors, asked = Floors(told(400), "en", 0), told(100)
    answers = floors.answers(asked, [coc_of(sample) for sample in asked])
    decisions = {name: np.array([answer.coc.flight_decision for answer in own]) for name, own in answers.items()}
    wanted = np.array([sample.decision for sample in asked])
    assert (decisions["rule"] == wanted).sum() >= 97
    assert (decisions["blind"] == wanted).sum() >= 90
    assert (decisions["majority"] == wanted).sum() < 60
    few, mixed = told(LEAST_WINDOWS - 1), [*told(400), samples[0]]
    for train, left_out in ((few, {"blind"}), (mixed, {"rule", "blind"}), (samples, {"rule", "blind"})):
        found = Floors(train, "en", 0).answers(asked, [coc_of(sample) for sample in asked])
        assert answers.keys() - found.keys() == left_out


def test_what_was_drawn_after_the_window_is_counted_apart(samples):
    ahead = [None, True, True, True, True, False, False, False]
    wrong = [sample.model_copy(update={"drawn_ahead": a}) for sample, a in zip(samples, ahead, strict=True)]
    answers = [ScoredAnswer(coc_of(sample)) for sample in wrong]
    other = next(token for token in TOKENS if token not in DECISIONS)
    for place in (1, 2, 3):
        answers[place] = ScoredAnswer(answers[place].coc.model_copy(update={"flight_decision": other}))
    figures, _ = figures_of(score_answers(wrong, answers), np.ones((1, 1)), confidence=0.9)
    assert (figures["drawn_ahead"].value, figures["drawn_ahead"].count) == (4 / 7, 7)
    assert (figures["accuracy_settled"].value, figures["accuracy_settled"].count) == (1.0, 3)
    figures, _ = figures_of(score_answers(samples, answers), np.ones((1, 1)), confidence=0.9)
    assert figures["drawn_ahead"].value is figures["accuracy_settled"].value is None


@pytest.fixture
def place(tmp_path, samples) -> Path:
    both = [*samples, *(sample_of(frame, "zh") for frame in FRAMES)]
    known = {"contradicted": ("ascend",)}
    both = [sample.model_copy(update={"walk": f"walk_{k % 2}", **known}) for k, sample in enumerate(both)]
    write_set(tmp_path / "set", {"train": both, "val": both, "test": both})
    write_predictions(tmp_path, predictions_of(both[:8]) + predictions_of(both[8:]))
    return tmp_path


def write_predictions(place: Path, records: list[Prediction]) -> None:
    lines = [dump_json(record.model_dump(mode="json")) for record in records]
    (place / "predictions.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")


CFG = EvaluateConfig()


def test_without_a_model_the_report_says_so_and_gives_no_number(place):
    path = run(CFG, place / "predictions.jsonl", place / "set", place / "out")
    report = read_report(path.parent)
    assert report.metrics == {"en": None, "zh": None}
    student, teacher = report.languages["zh"].who[STUDENT].figures, report.all.who["teacher"].figures
    assert (student["parsed"].value, student["bertscore_f1"].value) == (0.75, None)
    accuracy = {name: own.figures["accuracy"].value for name, own in report.all.who.items()}
    assert (accuracy.pop(STUDENT), accuracy.pop("majority"), accuracy.pop("teacher")) == (8 / 16, 8 / 16, 1)
    assert accuracy.keys() == {"shuffled", "constant"}  # no sample has a past
    assert (teacher["accuracy_on_labels"].value, teacher["bertscore_f1"].value) == (1, None)
    page = (place / "out" / "evaluation.md").read_text()
    assert "BERTScore of en: not computed, because no model folder" in page
    assert re.search(r"\| answers that parse \| 75\.00% \(.*to.*\) \| 100\.00% \|", page)
    assert len(report.examples) == 12
    again = run(CFG, place / "predictions.jsonl", place / "set", place / "again")
    for name in ("report.json", "evaluation.md", "evaluation.html", "scores.parquet"):
        assert (again.parent / name).read_bytes() == (path.parent / name).read_bytes()


def make_encoder(folder: Path) -> Path:
    """A tiny random RoBERTa with a byte-level tokenizer; its files hold no model_max_length, as some do."""
    torch = pytest.importorskip("torch", reason="needs the extra distill")
    pytest.importorskip("bert_score", reason="needs the extra distill")
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers, processors, trainers
    from transformers import PreTrainedTokenizerFast, RobertaConfig, RobertaModel

    tokenizer = Tokenizer(models.BPE())
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=True)
    tokenizer.decoder = decoders.ByteLevel()
    special, letters = ["<s>", "<pad>", "</s>", "<unk>", "<mask>"], sorted(pre_tokenizers.ByteLevel.alphabet())
    given: dict = {"special_tokens": special, "initial_alphabet": letters, "show_progress": False}
    trainer = trainers.BpeTrainer(vocab_size=400, **given)
    tokenizer.train_from_iterator([sample_of(frame).answer for frame in FRAMES], trainer)
    tokenizer.post_processor = processors.RobertaProcessing(("</s>", 2), ("<s>", 0))
    names = {"bos": "<s>", "eos": "</s>", "cls": "<s>", "sep": "</s>", "unk": "<unk>", "pad": "<pad>", "mask": "<mask>"}
    own = {f"{name}_token": token for name, token in names.items()}
    PreTrainedTokenizerFast(tokenizer_object=tokenizer, **own).save_pretrained(folder)
    sizes = {"hidden_size": 32, "num_hidden_layers": 3, "num_attention_heads": 4, "intermediate_size": 64}
    vocabulary = {"vocab_size": tokenizer.get_vocab_size(), "max_position_embeddings": 514, "pad_token_id": 1}
    config = RobertaConfig(**sizes, **vocabulary, initializer_range=0.3)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        RobertaModel(config).save_pretrained(folder)
    return folder


def test_scores_are_those_of_the_library(tmp_path_factory):
    encoder = make_encoder(tmp_path_factory.mktemp("bert") / "encoder")
    import bert_score

    texts = [text for frame in FRAMES for text in (text_of(coc_of(sample_of(frame))), sample_of(frame, "zh").answer)]
    texts += ["short one", "a " * 700, texts[0]]
    candidates = [*texts[1:], texts[0]]
    cfg = BertScoreConfig.model_validate({"en": {"layer": 2}})
    own = Scorer(cfg, "en", encoder, texts)
    plain = bert_score.BERTScorer(model_type=str(encoder), num_layers=2, device="cpu", nthreads=1)
    plain._tokenizer.model_max_length = 512
    expected = np.stack([part.numpy() for part in plain.score(candidates, texts)], axis=1)
    found = own.score(list(zip(candidates, texts, strict=True)))
    assert np.abs(found - expected).max() < 1e-5
    assert expected.std() > 0.01
    assert own.metric.cut == 1
    alone = own.score([(candidates[3], texts[3])])
    assert np.abs(alone - found[3]).max() < 1e-5
    assert own.score([("", texts[0]), (" ", "")]).tolist() == [[0, 0, 0], [0, 0, 0]]
