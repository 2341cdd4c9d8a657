"""distill/evaluation."""

import html
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from specimens_distill import make_caption, write_set
from specimens_families import make_tokenizer

from cosfly.formats.captions import TOKENS, ValueCounts, write_captions
from cosfly.formats.predictions import Prediction
from cosfly.inspection.blind_baseline import LEAST_WINDOWS
from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import dump_json, read_model
from distill.evaluation import figures
from distill.evaluation.figures import Answers, coc_of, measure, text_of
from distill.evaluation.report import REPORT_FORMAT, Evaluation, notes_of, summary_tables, tables_of
from distill.evaluation.stage import Scorer, asked_samples, floors_of, majority, run
from distill.inference.samples import make_prediction
from distill.prepare.stage import PrepareConfig, make_sample
from distill.schema import Sample, open_split


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


def measured(samples, predictions=None, values=None):
    predictions = predictions or predictions_of(samples)
    answers = Answers.of_student(predictions, values or [None] * len(samples))
    return measure(samples, {"student": answers}, ["student"], np.random.default_rng(0)).who["student"]


def test_measured_numbers_by_hand(samples):
    counts = [ValueCounts(values_matched=3, values_contradicted=1), ValueCounts(values_matched=2), *[None] * 6]
    found = measured(samples, values=counts)
    assert found.confusion["track_straight"] == {"(unparsed)": 1, "slow_down": 1, "track_straight": 2}
    assert {name: figure.value for name, figure in found.figures.items() if figure.value is not None} == pytest.approx(
        {
            "answered": 1.0,
            "parsed": 6 / 8,
            "parsed_unchanged": 5 / 8,
            "accuracy": 4 / 8,
            "accuracy_parsed": 4 / 6,
            # slow_down: 1 hit of 2 references, 2 answers; track_straight: 2 of 4, 3; yaw_left_to_follow: 1 of 2, 1.
            "macro_f1": (2 * 1 / (2 + 2) + 2 * 2 / (4 + 3) + 2 * 1 / (2 + 1)) / 3,
            "accuracy_on_labels": 3 / 6,  # frames 4, 10, 11 of 4, 5, 7, 8, 10, 11, which are no multiples of 3
            "values_matched": 5 / 6,
            "values_contradicted": 1 / 6,
            "tokens": 9.0,
        }
    )
    accuracy = found.figures["accuracy"]
    assert (accuracy.count, found.figures["accuracy_parsed"].count) == (8, 6)
    assert (accuracy.low, accuracy.high) == (None, None)  # of one walk
    told = {name: (figure.value, figure.count) for name, figure in found.by_decision.items()}
    assert told == {"track_straight": (2 / 4, 4), "yaw_left_to_follow": (1 / 2, 2), "slow_down": (1 / 2, 2)}


def test_failures_are_no_wrong_answers(samples):
    predictions = predictions_of(samples)
    predictions[7] = make_prediction(samples[7], "test", failure="damaged_picture")  # was right
    found = measured(samples, predictions).figures
    assert (found["answered"].value, found["answered"].count) == (7 / 8, 8)
    assert (found["accuracy"].value, found["accuracy"].count) == (3 / 7, 7)
    assert found["parsed"].value == 5 / 7


def test_verdicts_are_those_of_the_true_future(samples):
    futures = [("slow_down", ()), ("hover", ()), (None, ("track_straight",)), (None, ()), ("hover", ("hover",))]
    futures += [("track_straight", ()), ("hover", ("yaw_left_to_follow",)), (None, None)]
    known = [
        sample.model_copy(update={"label": label, "contradicted": contradicted})
        for sample, (label, contradicted) in zip(samples, futures, strict=True)
    ]
    found = measured(known, predictions_of(samples)).figures
    # Answers: slow_down, slow_down, track_straight, two that do not parse, track_straight, yaw_left_to_follow; of the
    # future of the last nothing is known.
    values = {name: found[name].value for name in ("consistent", "soft_conflict", "hard_conflict", "abstain")}
    assert values == {"consistent": 2 / 5, "soft_conflict": 1 / 5, "hard_conflict": 2 / 5, "abstain": 0}
    assert found["hard_conflict"].count == 5


def made_up(num_walks: int, rng: np.random.Generator) -> tuple[list[Sample], np.ndarray]:
    """Samples of walks of some size, and decisions of a student whose right answers come in clumps."""
    sizes = rng.integers(2, 12, num_walks)
    right = rng.random(sizes.sum()) < np.repeat(rng.beta(1.2, 0.8, num_walks), sizes)
    reference = rng.integers(0, 3, sizes.sum())
    base = sample_of(4)
    walks = np.repeat([f"walk_{i}" for i in range(num_walks)], sizes).tolist()
    found = [
        base.model_copy(update={"walk": walk, "sample_id": f"{walk}/{i}", "decision": TOKENS[number]})
        for i, (walk, number) in enumerate(zip(walks, reference.tolist(), strict=True))
    ]
    return found, np.where(right, reference, 5)


def test_intervals_agree_with_the_bootstrap_of_scipy(monkeypatch):
    from scipy.stats import bootstrap

    samples, decisions = made_up(60, np.random.default_rng(1))
    right = np.array([TOKENS.index(sample.decision) for sample in samples]) == decisions
    walk = np.array([sample.walk for sample in samples])
    walks = [right[walk == name] for name in dict.fromkeys(walk)]
    sums, counts = np.array([own.sum() for own in walks]), np.array([len(own) for own in walks])
    expected = bootstrap(
        (sums, counts), lambda s, n, axis: s.sum(axis=axis) / n.sum(axis=axis), paired=True, method="percentile",
        n_resamples=9999, rng=np.random.default_rng(2),
    ).confidence_interval  # fmt: skip
    monkeypatch.setattr(figures, "RESAMPLES", 9999)
    everyone = {"student": Answers.of(decisions)}
    found = measure(samples, everyone, ["student"], np.random.default_rng(0)).who["student"].figures["accuracy"]
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high), abs=4e-3)
    assert found.value == right.mean()


def test_paired_differences():
    rng = np.random.default_rng(5)
    samples, decisions = made_up(50, rng)
    worse = np.where(rng.random(len(samples)) < 0.3, 7, decisions)
    everyone = {"one": Answers.of(decisions), "worse": Answers.of(worse), "same": Answers.of(decisions)}
    found = measure(samples, everyone, [*everyone], np.random.default_rng(0))
    pairs = {(pairing.first, pairing.second): pairing.differences["accuracy"] for pairing in found.pairings}
    assert [*pairs] == [("one", "worse"), ("one", "same"), ("worse", "same")]
    one, other = (found.who[name].figures["accuracy"] for name in ("one", "worse"))
    difference = pairs["one", "worse"]
    assert difference.value == pytest.approx(one.value - other.value)
    # On the same draws a difference is known better than from the two intervals.
    assert 0 < difference.low < difference.high < one.high - other.low
    assert (pairs["one", "same"].value, pairs["one", "same"].low, pairs["one", "same"].high) == (0, 0, 0)


def test_students_are_measured_on_the_samples_of_all(samples):
    found = {"a": {p.key: p for p in predictions_of(samples)}, "b": {p.key: p for p in predictions_of(samples)[2:]}}
    assert asked_samples(samples, found) == samples[2:]
    with pytest.raises(InputError, match="does not contain this sample"):
        asked_samples(samples[1:], found)


def decisions_of(answers: Answers) -> list[str]:
    return [TOKENS[number] for number in answers.decision]


def test_floors_by_hand(samples):
    train = [sample.model_copy(update={"decision": "hover"}) for sample in samples[:3]] + samples[3:5]
    answers = floors_of(train, samples, "en", 0)
    assert set(decisions_of(answers["majority"])) == {"hover"}
    assert len(set(answers["majority"].texts)) == 1
    assert answers["majority"].texts[0] in {text_of(coc_of(sample)) for sample in samples[:3]}
    assert decisions_of(answers["teacher"]) == DECISIONS
    assert list(floors_of([], samples[:1], "en", 0)) == ["teacher"]
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

    train, asked = told(400), told(100)
    answers = floors_of(train, asked, "en", 0)
    wanted = np.array([sample.decision for sample in asked])
    right = {name: (np.array(decisions_of(own)) == wanted).sum() for name, own in answers.items()}
    assert right["rule"] >= 97
    assert right["blind"] >= 90
    assert right["majority"] < 60
    few, mixed = told(LEAST_WINDOWS - 1), [*told(400), samples[0]]
    for train, left_out in ((few, {"blind"}), (mixed, {"rule", "blind"}), (samples, {"rule", "blind"})):
        assert answers.keys() - floors_of(train, asked, "en", 0).keys() == left_out


@pytest.fixture
def place(tmp_path, samples) -> Path:
    """set/ in both languages, of three walks; predictions of the students `one` and `other`."""
    both = [*samples, *(sample_of(frame, "zh") for frame in FRAMES)]
    both = [one.model_copy(update={"walk": f"walk_{k % 3}", "contradicted": ("ascend",)}) for k, one in enumerate(both)]
    write_set(tmp_path / "set", {"train": both, "val": both, "test": both})
    write_predictions(tmp_path / "one", predictions_of(both[:8]) + predictions_of(both[8:]))
    right = [make_prediction(sample, "test", sample.answer, 9, True) for sample in both]
    write_predictions(tmp_path / "other", right)
    return tmp_path


def write_predictions(place: Path, records: list[Prediction]) -> None:
    place.mkdir()
    lines = [dump_json(record.model_dump(mode="json")) for record in records]
    (place / "predictions.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_report(folder: Path) -> Evaluation:
    return read_model(folder / "report.json", Evaluation, REPORT_FORMAT, tree=folder)


def test_without_an_encoder_the_report_says_so_and_gives_no_number(place):
    path = run([place / "one/predictions.jsonl"], place / "set", place / "out")
    report = read_report(path.parent)
    assert report.metrics == {"en": None, "zh": None}
    student, teacher = (report.languages["zh"].who[name].figures for name in ("one", "teacher"))
    assert (student["parsed"].value, student["bertscore_f1"].value) == (0.75, None)
    accuracy = {name: own.figures["accuracy"].value for name, own in report.languages["en"].who.items()}
    assert accuracy == {"one": 4 / 8, "majority": 4 / 8, "teacher": 1}  # no rule: no sample has a past
    assert (teacher["accuracy_on_labels"].value, teacher["bertscore_f1"].value) == (1, None)
    assert report.students["one"].without_decision == {"broken_json": 2, "no_json_object": 2}
    assert "BERTScore of en was not computed, because no encoder was passed." in notes_of(report)
    rows = {row[0]: row[1:] for row in list(summary_tables(path))[1].rows}
    assert rows["one"][0].startswith("75.0%")
    assert rows["one"][-1] == "-"
    assert len(report.examples) == 12
    again = run([place / "one"], place / "set", place / "again")
    for name in ("report.json", "evaluation.html"):
        assert (again.parent / name).read_bytes() == (path.parent / name).read_bytes()


def test_a_student_is_not_named_like_another_column(place):
    for name in ("teacher", "rule"):
        shutil.copytree(place / "one", place / name)
        with pytest.raises(InputError, match="same name"):
            run([place / name], place / "set", place / "out")
    with pytest.raises(InputError, match="same name"):
        run([place / "one", place / "one/predictions.jsonl"], place / "set", place / "out")


def test_the_table_has_everybody_side_by_side(place):
    """Students, teacher, baselines and the paper, in one row of a figure; and the differences of students."""
    out = run([place / "one", place / "other"], place / "set", place / "out").parent
    main, _, pair = tables_of(read_report(out), "en")
    columns = ["one", "other", "teacher", "baseline: majority", "paper: Qwen3.5-2B + LoRA", "paper: Qwen3.5-4B + LoRA"]
    assert main.columns[1:] == columns
    table = {row[0]: [cell.split(" ")[0] for cell in row[1:]] for row in main.rows}
    assert table["answers that parse"] == ["75.0%", "100.0%", "100.0%", "100.0%", "100.0%", "100.0%"]
    assert table["decision is the teacher's, parsed answers"][-2:] == ["68.7%", "70.1%"]
    assert table["verdict: hard conflict"] == ["0.0%"] * 4 + ["-"] * 2
    agreement = next(row for row in main.rows if row[0] == "decision is the teacher's, all answers")
    assert re.fullmatch(r"50\.0% \([\d.]+% to [\d.]+%\)", agreement[1])
    assert agreement[2] == "100.0%"
    assert pair.title == "one minus other"
    difference = next(row for row in pair.rows if row[0] == "decision is the teacher's, all answers")
    assert re.fullmatch(r"-50\.0% \(-[\d.]+% to -[\d.]+%\)", difference[1])
    page = html.unescape((out / "evaluation.html").read_text(encoding="utf-8"))
    assert all(cell in page for cell in (*columns, pair.title, *agreement[1].split(" ("), *difference[1].split(" (")))


def test_values_of_a_students_texts_come_from_the_captions_made_of_them(place, tmp_path):
    texts = json.loads(sample_of(11).answer)
    checks = {"values": {"en": {"values_matched": 3, "values_contradicted": 1}}}
    kept = make_caption("Town01", "trajectory_1", "ORI", 11, en=texts, checks=checks)
    other = make_caption("Town01", "trajectory_1", "ORI", 10, checks=checks)
    # The student answered this window too, but not with this text.
    other.en = other.en.model_copy(update={"reasoning_trace": "Something else."})
    write_captions(tmp_path / "captions.jsonl", [kept, other])
    out = run([place / "one"], place / "set", place / "out", judged=[tmp_path / "captions.jsonl"]).parent
    found = read_report(out).languages["en"].who["one"].figures
    assert (found["values_matched"].value, found["values_matched"].count) == (3 / 4, 4)


def make_encoder(folder: Path) -> Path:
    """A tiny random RoBERTa with a byte-level tokenizer; its files hold no model_max_length, as some do."""
    torch = pytest.importorskip("torch", reason="needs the extra distill")
    pytest.importorskip("bert_score", reason="needs the extra distill")
    from tokenizers import processors
    from transformers import RobertaConfig, RobertaModel

    tokenizer = make_tokenizer(["<pad>", "<s>", "</s>", "<unk>", "<mask>"], "", "</s>")
    names = {"bos": "<s>", "cls": "<s>", "sep": "</s>", "unk": "<unk>", "mask": "<mask>"}
    tokenizer.add_special_tokens({f"{name}_token": token for name, token in names.items()})
    tokenizer.backend_tokenizer.post_processor = processors.RobertaProcessing(("</s>", 2), ("<s>", 1))
    tokenizer.save_pretrained(folder)
    sizes = {"hidden_size": 32, "num_hidden_layers": 3, "num_attention_heads": 4, "intermediate_size": 64}
    vocabulary = {"vocab_size": len(tokenizer), "max_position_embeddings": 514, "pad_token_id": 0}
    config = RobertaConfig(**sizes, **vocabulary, initializer_range=0.3)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        RobertaModel(config).save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def encoder(tmp_path_factory) -> Path:
    return make_encoder(tmp_path_factory.mktemp("bert") / "encoder")


def test_scores_are_those_of_the_library(encoder):
    import bert_score

    texts = [text for frame in FRAMES for text in (text_of(coc_of(sample_of(frame))), sample_of(frame, "zh").answer)]
    texts += ["short one", "a " * 700, texts[0]]
    candidates = [*texts[1:], texts[0]]
    own = Scorer(encoder, texts)
    plain = bert_score.BERTScorer(model_type=str(encoder), num_layers=3, device="cpu", nthreads=1)
    plain._tokenizer.model_max_length = 512
    expected = np.stack([part.numpy() for part in plain.score(candidates, texts)], axis=1)
    found = own.score({"student": candidates, "silent": [""] * len(texts)}, texts)
    assert np.abs(found["student"] - expected).max() < 1e-6
    assert not found["silent"].any()
    assert expected.std() > 0.01
    assert own.metric.cut == 1
    assert own.metric.layer == 3  # the last: the library does not know the folder's name
    known = shutil.copytree(encoder, encoder.with_name("distilroberta-base"))
    config = json.loads((known / "config.json").read_text())
    (known / "config.json").write_text(json.dumps(config | {"num_hidden_layers": 6}))
    assert Scorer(known, texts).metric.layer == 5  # the library's choice for this name


def test_an_evaluation_with_an_encoder_names_it(place, encoder):
    """A student whose answers do not parse scores 0."""
    silent = [make_prediction(sample, "test", "Well.", 2, True) for sample in open_split(place / "set", "test")]
    write_predictions(place / "silent", silent)
    students = [place / "one", place / "silent"]
    out = run(students, place / "set", place / "out", encoders={"en": encoder, "zh": encoder}).parent
    report = read_report(out)
    f1 = {name: own.figures["bertscore_f1"].value for name, own in report.languages["en"].who.items()}
    assert 0 < f1["one"] < 1
    assert 0 < f1["majority"] < 1
    assert f1["silent"] == 0
    assert f1["teacher"] is None
    assert report.languages["en"].who["majority"].figures["values_matched"].value is None
    rows = [row[0] for row in tables_of(report, "en")[0].rows]
    assert f"BERTScore F1 ({encoder.parent.name}/encoder layer 3)" in rows
