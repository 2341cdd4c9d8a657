"""Everything that is read, in one folder of honest specimens, and how each is read: READERS."""

from __future__ import annotations

import contextlib
import gzip
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from fuzz import Reader
from safetensors.numpy import save_file
from specimens_captions import VOCABULARY, WAY
from specimens_distill import make_captions
from specimens_planning import walk_along
from test_products_pursuits import pursuit

from caption.run import stage as caption_stage
from caption.run.asking import read_quarantine
from caption.run.flights import named_flights
from caption.schema import CaptionConfig
from caption.teachers.foreign import read_foreign, read_student
from caption.teachers.prompt_files import export_prompts, own_prompts
from caption.truth.facts import Facts
from caption.truth.gold import GOLD, read_gold
from caption.truth.prose import judge_prose
from caption.truth.references import parse_reference
from cosfly.app import reproduce
from cosfly.app.settings import RunConfig
from cosfly.chat.answers import TOTALS, AnswerBook, journal_name
from cosfly.chat.protocol import error_words, read_body, read_completion, read_models
from cosfly.chat.refusals import kind_of
from cosfly.chat.student_chat import TAUGHT, read_taught, write_taught
from cosfly.chat.wire import Response, base_url, retry_after_s
from cosfly.cli.options import resolve
from cosfly.closed_loop.controller import read_controls
from cosfly.closed_loop.measures import score_pursuits
from cosfly.closed_loop.settings import CONTROLLER_FILE
from cosfly.inspection import stage as inspection
from cosfly.inspection.review import read_filled
from cosfly.inspection.settings import InspectConfig
from cosfly.look.gallery import contact_sheet, preview_gif
from cosfly.look.topview import png_bytes
from cosfly.maps import boxfile, cityjson, simworld
from cosfly.pedestrians import stage as pedestrians
from cosfly.pedestrians.walkable import PedestriansConfig
from cosfly.planners import benchmark, compare
from cosfly.planners.compare import text_tables
from cosfly.products import review
from cosfly.products.actions import (
    ACTIONS_FILE,
    ACTIONS_FORMAT,
    OWN_ACTIONS,
    actions_beside,
    read_actions,
    shipped_actions,
)
from cosfly.products.answer_text import Parsed, parse_answer
from cosfly.products.backdrop import Backdrop, WorldFrame, write_backdrop
from cosfly.products.boxes import BoxMap, MapHeader, make_box_map, read_boxes, write_boxes
from cosfly.products.captions import Coc, read_captions
from cosfly.products.flight_scores import SCORE, SCORE_FORMAT, read_score
from cosfly.products.flights import find_flights, read_twin
from cosfly.products.frames import DEPTH_PNG, read_depth, read_instance, read_meta, read_rgb
from cosfly.products.goals import Goal
from cosfly.products.inspection import read_inspection
from cosfly.products.kinds import KINDS
from cosfly.products.meshes import write_meshes
from cosfly.products.others import BUILDS, Company, Other, read_others, write_others
from cosfly.products.playback import TARGET_FILE, read_flight
from cosfly.products.png import parse_png
from cosfly.products.predictions import read_predictions
from cosfly.products.pursuits import read_pursuit, write_pursuit
from cosfly.products.roi import read_roi
from cosfly.products.town import IDS_FILE, IDS_FORMAT, read_instance_ids, read_town_map, write_town_map
from cosfly.products.traces import DroneTrace, read_traces, write_traces
from cosfly.products.walks import read_paths, write_paths
from cosfly.reading.documents import read_json
from cosfly.reading.files import read_bytes, sha256_file
from cosfly.reading.meshes import Mesh, read_meshes
from cosfly.render.settings import RenderConfig
from cosfly.render.weather import read_pools
from cosfly.simplify import stage as simplify
from cosfly.simplify.passes import SimplifyConfig
from cosfly.studies.depth import run as study_depth
from cosfly.work import provenance
from cosfly.work.config import apply_overrides, build
from cosfly.work.items import Item
from cosfly.work.journal import Journal
from cosfly.work.stage_events import EventLog, read_events
from cosfly.work.stage_folder import StageFolder, read_failures, read_manifest
from cosfly.work.store import CHECKSUMS, read_checksums, write_checksums, write_json, write_model
from cosfly.worlds.plan import NamedObject, WorldPlan
from cosfly.worlds.planner import plan_of
from distill.evaluation import stage as evaluate
from distill.evaluation.measure import read_report
from distill.evaluation.scores import read_scores
from distill.inference import merge
from distill.inference.outcome import make_prediction
from distill.prepare import dual_track
from distill.prepare import stage as prepare
from distill.prepare.dual_track import RECORD as TRACKS
from distill.prepare.dual_track import read_track_samples
from distill.prepare.sources import RunSource as Prepared
from distill.prepare.stage import PrepareConfig
from distill.schema import RECORD, open_split
from distill.student import checkpoint
from distill.student import model as student
from distill.training.stage import taught_by
from distill.windows import Windows
from release.export import stage as export
from release.export.captions import export as export_captions
from release.export.contract import ExportConfig
from release.export.stage import read_export
from release.package import stage as package
from release.package.sources import Source
from release.record import read_record
from release.stats import stats
from release.verify.verify import verify
from release.viewer import page as viewer
from release.viewer.content import ViewerConfig
from specimens import make_playback_tree, pack_depth

ANSWER = {
    "critical_components": "The pedestrian walks 12.4 m ahead, 3 px left of the centre; "
    "the drone flies 1.2 m/s at 8 m.",
    "reasoning_trace": "The pedestrian keeps its heading from t0 to t4, so the drone tracks straight.",
    "flight_decision": "track_straight",
}
PLAIN = {
    "critical_components": "The person can be made out on the road in front of the drone.",
    "reasoning_trace": "Nothing stands in the way, and this manoeuvre is as good as any other here.",
    "flight_decision": "hover",
}
REPLY = {
    "id": "1", "model": "m", "choices": [{"index": 0, "finish_reason": "stop",
    "message": {"role": "assistant", "content": json.dumps(ANSWER), "reasoning_content": "so"}}],
    "usage": {"prompt_tokens": 10, "completion_tokens": 20, "total_tokens": 30}, "error": None,
    "data": [{"id": "m", "max_model_len": 4096}],
}  # fmt: skip
CITY = {
    "type": "CityJSON", "version": "2.0",
    "metadata": {"referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/7415"},
    "transform": {"scale": [0.001] * 3, "translate": [1000.0, 0.0, 0.0]},
    "vertices": [[x, y, z] for z in (2000, 14_000) for x, y in ((0, 0), (9000, 0), (9000, 8000), (0, 8000))]
    + [[x, y, 2000] for x, y in ((-9000, -9000), (60_000, -9000), (60_000, -3000), (-9000, -3000))],
    "CityObjects": {
        "house": {"type": "Building", "attributes": {"fclass": "x"}, "children": ["part"]},
        "part": {"type": "BuildingPart", "parents": ["house"],
        "geometry": [{"type": "Solid", "lod": "1.2", "boundaries": [
            [[[3, 2, 1, 0]], [[4, 5, 6, 7]], [[0, 1, 5, 4]], [[1, 2, 6, 5]], [[2, 3, 7, 6]], [[3, 0, 4, 7]]]]}]},
        "road": {"type": "Road", "geometry": [{"type": "MultiSurface", "lod": "1", "boundaries": [[[8, 9, 10, 11]]]}]},
        "tree": {"type": "SolitaryVegetationObject", "geometry": [{"type": "GeometryInstance", "template": 0,
        "boundaries": [1],
            "transformationMatrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}]},
    },
    "geometry-templates": {"templates": [{"type": "MultiSurface", "lod": "1",
    "boundaries": [[[0, 1, 2]], [[0, 1, 3]]]}],
        "vertices-templates": [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 5.0]]},
}  # fmt: skip
FRAME = "frames_playback/frame_00006"
TREE = "render/Town01/trajectory_1776047127"
TEXTS = {
    "answer.json": json.dumps(ANSWER),
    "plan.json": json.dumps(WorldPlan(objects=[NamedObject(name="church")]).model_dump(mode="json")),
    "answer.txt": "<think>The {\"draft\": 1}</think>\nHere it is:\n"
    f"```json\n{json.dumps(ANSWER, indent=1)}\n``` // done",
    "answer_zh.txt": "｛“critical_components”：“行人位于前方12.4米”，“reasoning_trace”：“因此直线跟踪”，"
    "“flight_decision”：“track_straight”，｝",
    "prose.txt": f"{ANSWER['critical_components']} It turned 14.5 degrees to the left over the last three frames, "
    f"twice as far as before.\n{ANSWER['reasoning_trace']}",
    "prose_zh.txt": "行人位于前方12.4米，偏左3像素；无人机以1.2米每秒飞行，高度约为八米。\n最近三帧向左转了十四点五度，因此无人机左偏航跟随。",
    "slots.txt": "The pedestrian is {distance_m@t4} m ahead, {offset_x_px@t0..t4:trend}.\n"
    "It walks on, so the drone tracks straight {speed_mps@t3}.",
    "set.txt": "pedestrians.num_paths=3", "set_url.txt": "caption.teacher=https://host:8000/v1",
    "set_list.txt": "caption.endpoint={extra_body: {a: &a [x, 1.5e3], b: *a}}",
    "url.txt": "https://[::1]:8000/v1/chat/completions",
    "header.txt": "120",
    "reply.json": json.dumps(REPLY),
}  # fmt: skip


# --- the specimens ----------------------------------------------------------------------------------------------------


def make_specimens(root: Path) -> Path:
    """Write one of each file. Flights of 12 frames, pictures of 64 x 36."""
    _maps(root)
    tree = make_playback_tree(root / "render", 3, 12)
    write_town_map(tree / "Town01", MapHeader(name="Town01"))
    ids = {
        "person": 65535,
        "shared": 65534,
        "others": [65533],
        "num_shared": 0,
        "are_box_ids": True,
        "boxes": [[1, 1], [7, 7]],
    }
    write_json(tree / "Town01" / IDS_FILE, {**IDS_FORMAT.header, **ids})
    write_pursuit(root / "pursuit.json", pursuit())
    write_model(root / SCORE, score_pursuits([pursuit()]), SCORE_FORMAT)
    shutil.copy(CONTROLLER_FILE, root / "controller.yaml")
    pack_depth(root / TREE / "aug_001")
    shutil.copy(root / TREE / "ORI" / FRAME / "rgb.png", root / TREE / "ORI" / TARGET_FILE)
    for folder in find_flights(tree):
        write_checksums(
            folder, {name: digest for name, digest in provenance.folder_digests(folder).items() if name != CHECKSUMS}
        )
    captions = root / "captions.jsonl"
    made = make_captions(captions, tree)
    given = [{"sample_id": c.sample_id, "en": PLAIN, "therefore": None} for c in made[:4]]
    (root / "foreign.jsonl").write_text("".join(json.dumps(line) + "\n" for line in given))
    with gzip.open(GOLD, "rt", encoding="utf-8") as gold:
        (root / "gold.jsonl").write_text("".join(islice(gold, 4)), encoding="utf-8")
    inspection.run(InspectConfig(), None, None, tree, root / "inspect")
    flights = read_inspection(root / "inspect/inspect.json")
    kept = next(flight.folder for flight in flights.flights if flight.result != "rejected")
    choices = [{"folder": kept, "verdict": "rejected", "reason": "blurred"}]
    review.add_decisions(
        root / "inspect/inspect.json", [review.Choice.model_validate(choice) for choice in choices], "Ann"
    )
    about = {"schema": "cosfly.review", "schema_version": "1.0", "inspection": "0" * 64, "by": "Ann"}
    (root / "decisions.json").write_text(json.dumps(about | {"choices": choices}))
    accepted = [flight.model_copy(update={"result": "accepted", "issues": []}) for flight in flights.flights]
    counts = {"accepted": len(accepted), "review": 0, "rejected": 0, "reasons": {}}
    funnel = flights.funnel.model_copy(update={"flights": flights.funnel.flights.model_copy(update=counts)})
    inspection.write_inspection(
        root / "inspect.json", flights.model_copy(update={"flights": accepted, "funnel": funnel})
    )
    package.run(RELEASE, [Source("one", tree, captions, root / "inspect.json")], root / "release")
    for name in EXPORTED:
        export.run(build(ExportConfig, {"format": name}, "x"), root / "release", root / f"export/{name}")
    shutil.copy(_first_shard(root), root / "shard.parquet")
    _students(root, captions, tree)
    _records(root)
    for name, text in TEXTS.items():
        (root / name).write_text(text, encoding="utf-8")
    return root


METRICS = dict.fromkeys((*(name for name, *_ in compare.FIGURES), "collision_fraction"), 1.0)
RELEASE = package.ReleaseConfig(num_frames=6, shard_mb=1, row_group_mb=1, licence="cc-by-4.0", unbound="accept")


def _meshes(root: Path) -> None:
    corners = np.array([[(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 0, 1), (1, 0, 1), (0, 1, 2)]], dtype=float)
    write_meshes(
        root / "mesh.glb",
        {"a": Mesh(corners, np.array([[0.5, 0.25, 0.0], [np.nan] * 3])), "b": Mesh(corners, corners[:, 0])},
    )
    data = (root / "mesh.glb").read_bytes()
    size = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + size])
    document["buffers"][0]["uri"] = "mesh.bin"
    write_json(root / "mesh.gltf", document)
    (root / "mesh.bin").write_bytes(data[28 + size :])
    (root / "mesh.mtl").write_text("newmtl red\nKd 1 0 0\nnewmtl wood\nKd 1 1 1\nmap_Kd wood.png\n")
    (root / "mesh.obj").write_text(
        "mtllib mesh.mtl\no a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nusemtl red\nf 1 2 3\nf 1/1/1 -1 2 3\n"
    )


def _maps(root: Path) -> None:
    _meshes(root)
    write_boxes(root / "boxes_3d.json", _street())
    walk = walk_along("p0", [(-20, 0), (20, 0), (20, 2)])
    write_paths(root / "path.json", [walk], {"map": "hand", "seed": 0})
    n = len(walk.time_s)
    company = [Other(kind, walk.positions_m, np.zeros(n)) for kind in BUILDS]
    write_others(root / "others.json", [Company("p0", company)], {"map": "hand", "seed": 0, "dt_s": 0.5})
    up = walk.positions_m + np.array([0, 0, 10.0])
    ones = np.ones(n)
    traces = [
        DroneTrace(
            f"p{k}", "muco", walk.time_s, up, np.zeros((n, 3)), walk.positions_m, ones, ones * 5, METRICS, {"b": 2}
        )
        for k in range(2)
    ]
    write_traces(root / "drone_trace.json", traces, {"map": "hand", "seed": 0})
    ring = [[-30, -8], [30, -8], [30, 8], [-30, 8]]
    write_json(
        root / "roi.json",
        {
            "closed": True,
            "points_world": ring,
            "holes": [[[0, 0], [1, 0], [1, 1]]],
            "polygons": [{"points_world": ring, "holes": []}],
        },
    )
    around = [[*ring, ring[0]]]
    house = {
        "type": "Feature",
        "properties": {"type": "Buildings", "height": 9, "yaw": 0},
        "geometry": {"type": "Polygon", "coordinates": around},
    }
    tree = {
        "type": "Feature",
        "properties": {"type": "Vegetation", "height": 5, "length": 2, "width": 2},
        "geometry": {"type": "Point", "coordinates": [40, 9]},
    }
    png = png_bytes(np.zeros((4, 6, 3), np.uint8))
    write_backdrop(root / "above.png", png, WorldFrame(west_m=-3, north_m=2, metres_per_px=0.5))
    (root / "own.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [house, tree]}))
    (root / "roi.geojson").write_text(json.dumps({"type": "MultiPolygon", "coordinates": [around, around]}))
    (root / "own.csv").write_text(
        "id,type,x,y,z,length,width,height,yaw\n1,Buildings,0,0,4,9,9,8,30\n2,Roads,20,0,0,9,90,,0\n"
    )
    (root / "city.json").write_text(json.dumps(CITY))
    (root / "city.json.gz").write_bytes(gzip.compress(json.dumps(CITY).encode(), mtime=0))
    head = {k: v for k, v in CITY.items() if k != "geometry-templates"} | {"CityObjects": {}, "vertices": []}
    objects = {k: v for k, v in CITY["CityObjects"].items() if k != "tree"}
    feature = {"type": "CityJSONFeature", "id": "house", "CityObjects": objects, "vertices": CITY["vertices"]}
    (root / "city.jsonl").write_text(f"{json.dumps(head)}\n{json.dumps(feature)}\n")
    nodes = [_node("BP_Building_01_C", 5000, 3000, 30.0), _node("BP_Tree1_C", 100, 200), _node("BP_Can_C", 9, 9)]
    (root / "world.json").write_text(json.dumps({"base_map": "x", "nodes": nodes}))
    table = {"BP_Building_01_C": (2000, 1000, 3000), "BP_Tree1_C": (800, 600, 1200), "BP_Can_C": (256, 256, 256)}
    write_json(
        root / "Bbox.json",
        {"all": {name: {"bbox": dict(zip("xyz", size, strict=True))} for name, size in table.items()}},
    )


def _street() -> BoxMap:
    """A street of 80 m with a house, a wall and a tree."""
    rows = [
        ((0, 0, -0.5), (40, 20, 0.5), 0, "Ground"),
        ((0, 14, 8), (12, 5, 8), 0, "Buildings"),
        ((20, -9, 1), (4, 0.2, 1), 30, "Walls"),
        ((-20, -12, 4), (2, 2, 4), 0, "Vegetation"),
    ]
    kinds = [KINDS[kind] for *_, kind in rows]
    return make_box_map(
        [r[0] for r in rows], [r[1] for r in rows], [(0, r[2], 0) for r in rows], kinds, header=MapHeader(name="street")
    )


def _node(name: str, x: float, y: float, yaw: float = 0.0) -> dict[str, Any]:
    place = {
        "location": {"x": x, "y": y, "z": 0},
        "orientation": {"pitch": 0, "yaw": yaw, "roll": 0},
        "scale": {"x": 1, "y": 1, "z": 1},
    }
    return {"id": f"GEN_{name}", "instance_name": name, "properties": place}


def _prepare(captions: Path, tree: Path, out: Path) -> Path:
    return prepare.run(PrepareConfig(unbound="accept"), [Prepared.of_files(tree, captions)], out)


def _windows(tree: Path, out: Path) -> Path:
    return dual_track.run(dual_track.DualTrackConfig(too_few="fill"), [tree], out)


def _students(root: Path, captions: Path, tree: Path) -> None:
    _prepare(captions, tree, root / "train")
    _windows(tree, root / "tracks")
    samples = list(open_split(root / "train", "val"))
    lines = [
        make_prediction(sample, "val", sample.answer, 20, True, shipped_actions()).model_dump_json()
        for sample in samples
    ]
    (root / "predictions.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
    evaluate.run(
        evaluate.EvaluateConfig(resamples=100, examples=2),
        root / "predictions.jsonl",
        root / "train",
        root / "evaluation",
    )
    step = root / "checkpoints/step_000002"
    step.mkdir(parents=True)
    write_json(step / "state.json", {"schema": "cosfly.checkpoint", "schema_version": "2.0", "step": 2})
    write_checksums(step, {"state.json": provenance.fingerprint(step / "state.json")})
    (root / "log.jsonl").write_text("".join(f'{{"step": {k}, "loss": 0.5}}\n' for k in range(4)))
    model = root / "model"
    model.mkdir()
    write_json(model / "config.json", {"model_type": student.MODEL_TYPE})
    (model / "model.safetensors").write_bytes(b"weights")
    write_json(
        model / checkpoint.ADAPTER_FACTS,
        {
            "schema": "cosfly.adapter",
            "schema_version": "1.0",
            "base_sha256": checkpoint.base_digests(model),
            "max_pixels": 4,
        },
    )
    write_taught(model, taught_by(samples, 4))
    _student_files(root)


def _student_files(root: Path) -> None:
    """Write a model of two layers with an adapter of one."""
    base, adapter, rng = root / "base", root / "adapter", np.random.default_rng(0)
    for folder in (base, adapter):
        folder.mkdir()
    write_json(base / "config.json", {"model_type": student.MODEL_TYPE})
    layers = {f"layers.{k}.weight": rng.standard_normal((6, 4)).astype(np.float32) for k in range(2)}
    save_file(layers, base / "model-00001-of-00001.safetensors", {"format": "pt"})
    where = dict.fromkeys(layers, "model-00001-of-00001.safetensors")
    write_json(base / "model.safetensors.index.json", {"metadata": {"total_size": 192}, "weight_map": where})
    halves = {"A": np.ones((2, 4), np.float32), "B": np.ones((6, 2), np.float32)}
    update = {f"{merge.PREFIX}layers.1.lora_{part}.weight": values for part, values in halves.items()}
    save_file(update, adapter / "adapter_model.safetensors", {"format": "pt"})
    write_json(adapter / "adapter_config.json", {"peft_type": "LORA", "r": 2, "lora_alpha": 4, "bias": "none"})


def _merged(root: Path, scratch: Path) -> None:
    """Merge an adapter whose record names whatever base is there, so that changed weights are read."""
    adapter = scratch / "adapter"
    adapter.mkdir()
    for path in (root / "adapter").iterdir():
        (adapter / path.name).symlink_to(path)
    facts = {"schema": "cosfly.adapter", "schema_version": "1.0", "base_sha256": checkpoint.base_digests(root / "base")}
    write_json(adapter / checkpoint.ADAPTER_FACTS, facts | {"max_pixels": 4})
    merge.run(merge.MergeConfig(), root / "base", adapter, scratch / "merged")


def _records(root: Path) -> None:
    shutil.copy(ACTIONS_FILE, root / "actions.yaml")
    write_model(root / OWN_ACTIONS, shipped_actions(), ACTIONS_FORMAT)
    export_prompts(root / "prompts", VOCABULARY.prompts)
    (root / "sky.yaml").write_text(
        "presets:\n  sleet: {cloudiness: 90, precipitation: 40.5, fog_density: 20, fog_distance: 25}\n"
        "  haze: {cloudiness: 9, precipitation: 0, fog_density: 70, fog_distance: 12.5}\n"
    )
    (root / "run.yaml").write_text(
        "name: a\nseed: 3\npedestrians: {num_paths: 3}\n"
        "caption:\n  teacher: http://host/v1\n  window: {num_frames: 5}\n"
        "release: {licence: cc-by-4.0}\n"
    )
    write_json(
        root / "summary.json",
        {"stages": [{"stage": "maps", "counts": {"input": 1}, "seconds": 1.0}], "peak_memory_mb": 100.0},
    )
    (root / "failures.jsonl").write_text('{"id": "a", "code": "input", "message": "no"}\n')
    (root / "quarantine.jsonl").write_text('{"id": "a", "code": "no_answer", "message": "no"}\n')
    usage = {"prompt_tokens": 3, "completion_tokens": 4}
    with Journal(root / "answers" / journal_name("flight")) as journal:
        for k in range(3):
            journal.append(
                {
                    "key": f"k{k}",
                    "sample_id": "s",
                    "purpose": "en",
                    "model": "m",
                    "text": "{}",
                    "usage": usage,
                    "structured": "native",
                    "finish_reason": "stop",
                    "latency_s": 0.1,
                }
            )
    with Journal(root / "answers" / journal_name("closed")) as journal:
        journal.append({TOTALS: {"answers": 1, **usage}})
    log = EventLog(root)
    log._journal.append({"at_s": 1.0, "event": "probe", "worker": 1, "rss_mib": {"1": 2.0}, "disk_free_mib": 1.0})
    log.close()
    traces = read_traces(root / "drone_trace.json")
    (root / "compare").mkdir()
    (root / "simplify").mkdir()
    counted = {"passes": [{"counts": {"Vegetation": 3}}], "trunks": {"full": {"iou": 0.9}}, "grid": {"cells": [2, 2]}}
    write_json(root / "simplify/simplify_report.json", {"num_boxes": {"raw": 3}} | counted)
    names = list(compare.PLANNERS)[:2]
    timings = {name: {"mean_ms": 1.0, "max_ms": 1.0} for name in names}
    flown = compare.summarize(dict.fromkeys(names, traces), np.random.default_rng(0))
    write_json(root / "compare/compare.json", {"settings": {}} | flown)
    flights = dict.fromkeys(("track_astar", "muco"), traces[0].as_json())
    raw = benchmark.ScenarioRecord(id="a", flights=flights, infeasible={"prm": "no free way"})
    summary = benchmark.summarize([raw], ("track_astar", "muco", "prm"), np.random.default_rng(0))
    (root / "benchmark").mkdir()
    (root / "benchmark/scenarios.jsonl").write_text(raw.model_dump_json() + "\n", encoding="utf-8")
    header = {"map": "m", "num_boxes": 1, "seed": 0, "settings": {}}
    write_model(root / "benchmark/benchmark.json", benchmark.Benchmark(**header, **summary), benchmark.FORMAT)
    write_json(
        root / "compare/manifest.json",
        {
            "schema": "cosfly.manifest",
            "schema_version": "1.0",
            "stage": "x",
            "outputs": [],
            "counts": {},
            "seconds": 1.0,
            "timings": timings,
        },
    )


# --- how each is read -------------------------------------------------------------------------------------------------


def _bytes(path: Path) -> bytes:
    return path.read_bytes() if path.is_file() and path.stat().st_size < 1e9 else b""


def _facts() -> Facts:
    return next(read_gold()).facts


def _answer(root: Path, name: str, language: Any = "en") -> None:
    text = _bytes(root / name).decode("utf-8", "replace")
    more, finish_reason = ("claims",) if len(text) % 2 else (), "length" if len(text) % 3 == 0 else None
    parsed = parse_answer(text, shipped_actions(), language, more, finish_reason)
    assert (parsed.coc is None) == (parsed.reason is not None)


def _plan(root: Path) -> None:
    plan_of(_bytes(root / "plan.json").decode("utf-8", "replace"), "stop", "plan.json")


def _prose(root: Path, name: str, language: Any = "en") -> None:
    text = _bytes(root / name).decode("utf-8", "replace")[:20_000]
    components, _, trace = text.partition("\n")
    coc = Coc.model_construct(critical_components=components, reasoning_trace=trace, flight_decision="track_straight")
    judge_prose(coc, _facts(), language)


def _slots(root: Path) -> None:
    text = _bytes(root / "slots.txt").decode("utf-8", "replace")
    components, _, trace = text.partition("\n")
    coc = Coc.model_construct(critical_components=components, reasoning_trace=trace, flight_decision="track_straight")
    WAY.read(Parsed(coc, therefore="track_straight"), _facts())
    for word in components.split():
        parse_reference(word.strip("{}"))


def _reply(root: Path) -> None:
    data = _bytes(root / "reply.json")
    response = Response(200, data)
    read_completion(response, "plain")
    read_models(response)
    kind_of(400, data.decode("utf-8", "replace"))
    with contextlib.suppress(ValueError):  # what it says of a body that is no JSON
        error_words(read_body(data))


def _header(root: Path) -> None:
    wait_s = retry_after_s(_bytes(root / "header.txt").decode("latin-1"), 0.0)
    assert wait_s is None or 0.0 <= wait_s < float("inf")


def _setting(root: Path, name: str) -> None:
    build(RunConfig, apply_overrides({}, [_bytes(root / name).decode("utf-8", "replace")]), "--set")


def _url(root: Path) -> None:
    text = _bytes(root / "url.txt").decode("utf-8", "replace")
    base_url(text)
    build(RunConfig, {"caption": {"teacher": text, "judge": {"url": text}}}, "--teacher")


def _stage(run: Callable[..., object], folder: Path) -> None:
    """Do a stage; a bug in an item, which it records, counts as a traceback."""
    try:
        run()
    finally:
        path = folder / "failures.jsonl"
        bugs = [failure.message for failure in read_failures(path) if failure.code == "bug"] if path.exists() else []
        if bugs:
            raise AssertionError(f"recorded as a bug: {bugs[0]}")


def _inspected(root: Path, scratch: Path) -> None:
    work = inspection.make_worker(InspectConfig(), root / "boxes_3d.json", root / "drone_trace.json", root / "render")
    work(Item("a", f"{TREE.removeprefix('render/')}/ORI"))


def _captioned(root: Path, scratch: Path, **settings: Any) -> None:
    cfg = build(CaptionConfig, {"limit": 4, **settings}, "x")
    _stage(lambda: caption_stage.run(cfg, root / "render", scratch / "out"), scratch / "out")


def _targeted(root: Path, scratch: Path) -> None:
    """Take the picture of a target as a release does, and open it as its verification does."""
    goal = Goal(0, "the person in the red jacket", "穿红色夹克的行人", ("top",))
    shown = replace(read_flight(root / TREE / "ORI"), goal=goal).target_picture(0)
    if shown is not None:
        parse_png(shown["bytes"], TARGET_FILE).pixels()


def _resumed(root: Path, scratch: Path) -> None:
    inputs = {"data": root / "render"}
    record = provenance.read_stage_record(root / "inspect")
    stage = StageFolder(root / "inspect", record.stage, True)
    list(stage.items())
    provenance.checked_inputs(inputs | {"inspect": root / "inspect/inspect.json"})
    provenance.was_made_of(root / "inspect/inspect.json", "data")


def _checkpoint(root: Path, scratch: Path) -> None:
    newest = checkpoint.newest_checkpoint(root / "checkpoints")
    if newest is not None:
        checkpoint.read_progress(newest)


def _log(root: Path, scratch: Path) -> None:
    copy = scratch / "log.jsonl"
    copy.write_bytes(_bytes(root / "log.jsonl"))
    checkpoint.cut_log(copy, 2)


def _tree(root: Path, scratch: Path) -> None:
    named_flights(root / "render")
    contact_sheet(root / "render", scratch / "sheet.png")
    preview_gif(root / "render", scratch / "preview.gif")


def _tables(root: Path, scratch: Path) -> None:
    text_tables(root / "compare/compare.json")


def _reproduced(root: Path, scratch: Path) -> None:
    """Make every table of the paper for which there are files."""
    places = reproduce.Places([root], {})
    for label, printed in reproduce.read_paper().tables.items():
        with contextlib.suppress(reproduce.MissingFile):
            reproduce.part(label, printed, places, root)


def _simplified(root: Path, scratch: Path) -> None:
    simplify.run(SimplifyConfig(), root / "boxes_3d.json", scratch / "simplify")


def _walked(root: Path, scratch: Path) -> None:
    cfg = PedestriansConfig(num_paths=1, min_component_cells=20)
    _stage(
        lambda: pedestrians.run(cfg, root / "boxes_3d.json", scratch / "walks", roi=root / "roi.json"),
        scratch / "walks",
    )


def _evaluated(root: Path, scratch: Path) -> None:
    evaluate.run(evaluate.EvaluateConfig(), root / "predictions.jsonl", root / "train", scratch / "scores")


# Formats, and of the files of each those that a verification reads itself.
EXPORTED = {
    "webdataset": ("export.json", "train-00000.tar"),
    "lerobot": (
        "meta/info.json",
        "meta/tasks.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "data/chunk-000/file-000.parquet",
    ),
}


def _first_shard(root: Path) -> Path:
    return min((root / "release/dataset/data").iterdir())


def _verified(root: Path) -> None:
    """Verify the release with the changed shard in its place; it is called by its content, which no table can know."""
    _place_shard(root)
    verify(root / "release/dataset")


def _place_shard(root: Path) -> None:
    """Put the changed shard in its place, where it is a file."""
    if (root / "shard.parquet").is_file():
        shutil.copy(root / "shard.parquet", _first_shard(root))


def _counted(root: Path, scratch: Path) -> None:
    _place_shard(root)
    stats.run(root / "release/dataset", scratch / "stats", pixels=4)


def _viewed(root: Path, scratch: Path, folder: Path) -> None:
    _place_shard(root)
    captions = None if folder.name == "release" else root / "captions.jsonl"
    viewer.run(folder, scratch / "page.html", ViewerConfig(frames=2, picture_px=32), captions)


def _changed_release(root: Path, scratch: Path) -> Path:
    """A copy of the release with the changed shard in its place and its size on record, so that it is read."""
    dataset = shutil.copytree(root / "release/dataset", scratch / "dataset")
    shard, changed = min((dataset / "data").iterdir()), root / "shard.parquet"
    shard.unlink()
    if changed.is_file():  # a link to itself, a folder or nothing is a shard that is not there
        shutil.copy(changed, shard)
        record = read_json(dataset / "release.json")
        for entry in record["shards"]:
            if entry["path"] == f"data/{shard.name}":
                entry["bytes"] = shard.stat().st_size
        write_json(dataset / "release.json", record)
        digests = read_checksums(dataset) | {"release.json": sha256_file(dataset / "release.json")}
        write_checksums(dataset, digests)
    return dataset


def _looked_at(*source: Path) -> None:
    windows = Windows(*source)
    for number in range(0, len(windows), 5):
        windows[number]


def _exported(root: Path, scratch: Path, format: str) -> None:
    cfg, dataset = build(ExportConfig, {"format": format}, "x"), _changed_release(root, scratch)
    _stage(lambda: export.run(cfg, dataset, scratch / "export"), scratch / "export")


def _released(root: Path, scratch: Path) -> None:
    source = Source("one", root / "render", root / "captions.jsonl", root / "inspect.json")
    _stage(lambda: package.run(RELEASE, [source], scratch / "release"), scratch / "release")


def _one(name: str, read: Callable[[Path], object]) -> Reader:
    return Reader((name,), lambda root, scratch: read(root / name))


FLIGHT = (f"{TREE}/ORI/trajectory.json",)
PICTURES = tuple(f"{TREE}/ORI/{FRAME}/{name}" for name in ("rgb.png", "depth.npy", "instance.png"))
READERS: dict[str, Reader] = {
    "boxes": _one("boxes_3d.json", read_boxes),
    "meshes, glTF": _one("mesh.glb", lambda path: read_meshes(path, tree=path.parent)),
    "meshes, glTF as text": Reader(
        ("mesh.gltf", "mesh.bin"), lambda root, _: read_meshes(root / "mesh.gltf", tree=root)
    ),
    "meshes, OBJ": Reader(("mesh.obj", "mesh.mtl"), lambda root, _: read_meshes(root / "mesh.obj", tree=root)),
    "region of interest": _one("roi.json", read_roi),
    "picture from above": Reader(("above.png", "above.json"), lambda root, _: Backdrop.read(root / "above.png")),
    "region of interest, GeoJSON": _one("roi.geojson", read_roi),
    "table of boxes": _one("own.csv", lambda path: boxfile.load(boxfile.BoxesConfig(path=path))),
    "boxes, GeoJSON": _one("own.geojson", lambda path: boxfile.load(boxfile.BoxesConfig(path=path))),
    "walks": _one("path.json", read_paths),
    "others": _one("others.json", read_others),
    "traces": _one("drone_trace.json", read_traces),
    "pursuit": _one("pursuit.json", read_pursuit),
    "score": Reader((SCORE,), lambda root, _: read_score(root)),
    "controller": _one("controller.yaml", lambda path: read_controls(path, shipped_actions().tokens)),
    "city model": _one("city.json", lambda path: cityjson.load(cityjson.CityJsonConfig(path=path))),
    "city model, lines": _one("city.jsonl", lambda path: cityjson.load(cityjson.CityJsonConfig(path=path))),
    "city model, packed": _one("city.json.gz", lambda path: cityjson.load(cityjson.CityJsonConfig(path=path))),
    "SimWorld": Reader(
        ("world.json", "Bbox.json"), lambda root, _: simworld.load(simworld.SimWorldConfig(world=root / "world.json"))
    ),
    "simplify": Reader(("boxes_3d.json",), _simplified, share=0.2, hashes=True),
    "pedestrians": Reader(("boxes_3d.json", "roi.json"), _walked, share=0.1, hashes=True),
    "flight": Reader(FLIGHT, lambda root, _: read_flight(root / TREE / "ORI")),
    "flight, tolerant": Reader(FLIGHT, lambda root, _: read_flight(root / TREE / "ORI", strict=False)),
    "flight and its twin": Reader(
        FLIGHT, lambda root, _: read_twin(read_flight(root / TREE / "aug_001", strict=False))
    ),
    "annotation": _one(f"{TREE}/ORI/{FRAME}/meta.json", lambda path: read_meta(path.parent)),
    "rgb": _one(PICTURES[0], lambda path: read_rgb(path.parent)),
    "depth": _one(PICTURES[1], lambda path: read_depth(path.parent)),
    "depth, packed": _one(f"{TREE}/aug_001/{FRAME}/{DEPTH_PNG}", lambda path: read_depth(path.parent)),
    "instance": _one(PICTURES[2], lambda path: read_instance(path.parent)),
    "target's picture": Reader((f"{TREE}/ORI/{TARGET_FILE}",), _targeted),
    "PNG, by rows": Reader(
        PICTURES[::2],
        lambda root, _: [parse_png(read_bytes(root / name, what="picture"), name).pixels() for name in PICTURES[::2]],
    ),
    "instance_ids": _one(f"render/Town01/{IDS_FILE}", lambda path: read_instance_ids(path.parent)),
    "town": _one("render/Town01/map.json", lambda path: read_town_map(path.parent)),
    "flight's checksums": Reader(
        (f"{TREE}/ORI/{CHECKSUMS}",), lambda root, _: provenance.folder_digests(root / TREE / "ORI"), hashes=True
    ),
    "gallery": Reader((*FLIGHT, *PICTURES), _tree, share=0.1),
    "inspect": Reader(
        (
            *FLIGHT,
            *PICTURES,
            f"{TREE}/ORI/{FRAME}/meta.json",
            f"{TREE}/ORI/{CHECKSUMS}",
            "drone_trace.json",
            "boxes_3d.json",
        ),
        _inspected,
        share=0.2,
        hashes=True,
    ),
    "caption": Reader(FLIGHT, _captioned, share=0.1, hashes=True),
    "caption, of a file": Reader(
        ("foreign.jsonl",),
        lambda root, scratch: _captioned(
            root,
            scratch,
            teacher=f"file:{root}/foreign.jsonl",
            writing="prose",
            repair={"hard_conflict": "keep", "soft_conflict": "keep"},
        ),
        share=0.2,
        hashes=True,
    ),
    "captions": _one("captions.jsonl", lambda path: list(read_captions(path))),
    "foreign captions": _one("foreign.jsonl", read_foreign),
    "gold captions": _one("gold.jsonl", lambda path: [(gold.coc, gold.facts) for gold in read_gold(path)]),
    "predictions": _one("predictions.jsonl", read_predictions),
    "student's captions": _one("predictions.jsonl", read_student),
    "quarantine": _one("quarantine.jsonl", lambda path: read_quarantine(path.parent)),
    "answers kept": Reader(
        (f"answers/{journal_name('flight')}", f"answers/{journal_name('closed')}"),
        lambda root, _: AnswerBook(root / "answers").latency_s("flight", "s"),
    ),
    "evaluation's scores": _one("evaluation/scores.parquet", lambda path: read_scores(path, shipped_actions())),
    "evaluation": _one("evaluation/report.json", lambda path: read_report(path.parent)),
    "samples": Reader(
        (f"train/{RECORD}", "train/train.parquet"),
        lambda root, _: list(open_split(root / "train", "train")),
        hashes=True,
    ),
    "track_samples": Reader(
        (f"tracks/{TRACKS}", "tracks/train.parquet"),
        lambda root, _: list(read_track_samples(root / "tracks", "train")),
        hashes=True,
    ),
    "windows of a tree": Reader(
        ("captions.jsonl", *FLIGHT, *PICTURES),
        lambda root, _: _looked_at(root / "render", root / "captions.jsonl"),
        share=0.2,
    ),
    "windows, of a record": _one("release/dataset/release.json", lambda path: _looked_at(path.parent)),
    "windows of a release": Reader(
        ("shard.parquet",), lambda root, scratch: _looked_at(_changed_release(root, scratch)), share=0.3, hashes=True
    ),
    "prepare": Reader(
        ("captions.jsonl",),
        lambda root, scratch: _prepare(root / "captions.jsonl", root / "render", scratch / "train"),
        share=0.3,
        hashes=True,
    ),
    "evaluate": Reader(("predictions.jsonl", "train/val.parquet", "train/train.parquet"), _evaluated, hashes=True),
    "checkpoint": Reader(("checkpoints/step_000002/state.json", f"checkpoints/step_000002/{CHECKSUMS}"), _checkpoint),
    "training log": Reader(("log.jsonl",), _log),
    "adapter": _one(
        f"model/{checkpoint.ADAPTER_FACTS}", lambda path: checkpoint.read_adapter_facts(path.parent, path.parent)
    ),
    "merge": Reader(
        (
            "adapter/adapter_config.json",
            "adapter/adapter_model.safetensors",
            "base/config.json",
            "base/model-00001-of-00001.safetensors",
            "base/model.safetensors.index.json",
        ),
        _merged,
        share=0.5,
        hashes=True,
    ),
    "student's teaching": _one(f"model/{TAUGHT}", lambda path: read_taught(path.parent)),
    "student model": _one("model/config.json", lambda path: student.weight_files(path.parent)),
    "inspection": _one("inspect.json", read_inspection),
    "decisions": Reader(("inspect/review.jsonl",), lambda root, _: review.read_settled(root / "inspect/inspect.json")),
    "decisions, filled in": _one("decisions.json", read_filled),
    "depth study": Reader(
        PICTURES[:2], lambda root, scratch: study_depth(root / TREE / "ORI" / FRAME, scratch / "study"), share=0.2
    ),
    "release, build": Reader(
        ("inspect.json", "captions.jsonl", *FLIGHT, *PICTURES, "render/Town01/map.json"),
        _released,
        share=0.1,
        hashes=True,
    ),
    "release record": _one("release/dataset/release.json", read_record),
    "release, verify": Reader(
        (
            "shard.parquet",
            *(f"release/dataset/{name}" for name in ("release.json", "croissant.json", CHECKSUMS, "README.md")),
        ),
        lambda root, _: _verified(root),
        share=0.4,
        hashes=True,
    ),
    "release, stats": Reader(("shard.parquet", "release/dataset/release.json"), _counted, share=0.4, hashes=True),
    "release, viewer": Reader(
        ("shard.parquet", "release/dataset/release.json"),
        lambda root, scratch: _viewed(root, scratch, root / "release"),
        share=0.4,
        hashes=True,
    ),
    "tree, viewer": Reader(
        ("captions.jsonl", *FLIGHT, *PICTURES), lambda root, scratch: _viewed(root, scratch, root / "render"), share=0.2
    ),
    **{
        f"release, export to {name}": Reader(
            ("shard.parquet",), lambda root, scratch, name=name: _exported(root, scratch, name), share=0.1, hashes=True
        )
        for name in ("tree", "webdataset", "lerobot")
    },
    "release, captions": Reader(
        ("shard.parquet",),
        lambda root, scratch: export_captions(_changed_release(root, scratch), scratch / "c.csv", "csv"),
        share=0.2,
        hashes=True,
    ),
    "export record": _one("export/webdataset/webdataset/export.json", read_export),
    **{
        f"release, verify {name}": Reader(
            tuple(f"export/{name}/{name}/{file}" for file in files),
            lambda root, _, name=name: verify(root / f"export/{name}/{name}"),
            share=0.2,
            hashes=True,
        )
        for name, files in EXPORTED.items()
    },
    "shard": Reader(("shard.parquet",), lambda root, _: _shard(root)),
    "manifest": _one("inspect/manifest.json", lambda path: read_manifest(path.parent)),
    "stage record": Reader(
        ("inspect/stage.json", "inspect/manifest.json", "inspect/items.jsonl"), _resumed, share=0.4, hashes=True
    ),
    "verify": Reader(
        ("inspect/stage.json", "inspect/manifest.json", f"{TREE}/ORI/{CHECKSUMS}"),
        lambda root, _: provenance.verify([root / "inspect", root / "render"]),
        share=0.3,
        hashes=True,
    ),
    "failures": _one("failures.jsonl", read_failures),
    "events": _one("events.jsonl", lambda path: read_events(path.parent)),
    "summary": _one("summary.json", read_json),
    "scenarios of a benchmark": _one(
        "benchmark/scenarios.jsonl", lambda path: [record.traces() for record in benchmark.read_scenarios(path)]
    ),
    "benchmark": _one("benchmark/benchmark.json", lambda path: benchmark.text_tables(benchmark.read_benchmark(path))),
    "reproduction": Reader(("compare/compare.json", "simplify/simplify_report.json"), _reproduced),
    "comparison": Reader(("compare/compare.json", "compare/manifest.json"), _tables),
    "presets of weather": _one(
        "sky.yaml",
        lambda path: read_pools(
            build(RenderConfig, {"weather_mode": "random_per_path", "weather_pool": str(path)}, "x")
        ),
    ),
    "actions": _one("actions.yaml", read_actions),
    "actions beside captions": _one("actions.json", lambda path: actions_beside(path)),
    "prompts": Reader(("prompts/user_en.txt", "prompts/system_zh.txt"), lambda root, _: own_prompts(root / "prompts")),
    "settings": _one("run.yaml", lambda path: resolve(path, None)),
    "--set": Reader(("set.txt",), lambda root, _: _setting(root, "set.txt")),
    "--set, a URL": Reader(("set_url.txt",), lambda root, _: _setting(root, "set_url.txt")),
    "--set, a list": Reader(("set_list.txt",), lambda root, _: _setting(root, "set_list.txt")),
    "URL": Reader(("url.txt",), lambda root, _: _url(root)),
    "reply of a server": Reader(("reply.json",), lambda root, _: _reply(root)),
    "header of a server": Reader(("header.txt",), lambda root, _: _header(root)),
    "answer": Reader(("answer.json",), lambda root, _: _answer(root, "answer.json")),
    "answer with thoughts": Reader(("answer.txt",), lambda root, _: _answer(root, "answer.txt")),
    "answer in Chinese": Reader(("answer_zh.txt",), lambda root, _: _answer(root, "answer_zh.txt", "zh")),
    "plan of a world": Reader(("plan.json",), lambda root, _: _plan(root)),
    "prose": Reader(("prose.txt",), lambda root, _: _prose(root, "prose.txt")),
    "prose in Chinese": Reader(("prose_zh.txt",), lambda root, _: _prose(root, "prose_zh.txt", "zh")),
    "slots": Reader(("slots.txt",), lambda root, _: _slots(root)),
}


def _shard(root: Path) -> None:
    from cosfly.reading.tables import num_rows, rows_of

    path = root / "shard.parquet"
    num_rows(path)
    list(rows_of(path))
