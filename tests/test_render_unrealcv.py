"""Frames of an UnrealCV server: through the real client from a server of ours, against the embedded renderer's."""

import json
import time
from pathlib import Path

import numpy as np
import pytest
from simulator_serving import serving
from simulators.scene import clothes_of
from simulators.unrealcv_server import UnrealCvServer
from test_cosfly_maps_unrealcv import beside
from test_render_carla import FRAMES, files_of, flown, same_but_for_pictures, schema_of
from test_renderers_contract import street
from typer.testing import CliRunner

from cosfly.cli import app
from cosfly.formats.boxes import BoxMap, write_boxes
from cosfly.formats.kinds import KINDS
from cosfly.formats.tracks import find_tracks
from cosfly.geometry.axes import intrinsic_matrix, world_from_camera
from cosfly.maps import unrealcv_export
from cosfly.maps.unrealcv_export import UnrealCvMapConfig
from cosfly.render.contract import PERSON_ID, PosedBystander, PosedCar, PosedPerson, other_id
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import open_renderer, run
from cosfly.render.unrealcv_backend import UnrealCvRenderConfig
from cosfly.runtime.config import build
from cosfly.runtime.errors import EnvironmentMissing, RenderError
from cosfly.simulators.unrealcv_client import UnrealCvConfig, connect

pytest.importorskip("unrealcv")
CLEAN = {**FRAMES, "tracks": ["clean"]}
QUICK = {"timeout_s": 60.0, "settle_delay_s": 0.02}


def exported() -> BoxMap:
    with beside(street()) as port:
        return unrealcv_export.load(UnrealCvMapConfig(port=port), 0)


def inputs(folder: Path, num_flights: int = 1, num_frames: int = 3) -> list[Path]:
    boxes, simplified, traces = flown(folder, num_flights, num_frames)
    for path in (boxes, simplified):
        write_boxes(path, exported())
    return [boxes, simplified, traces]


def config(port: int, settings: dict = CLEAN, **own) -> RenderConfig:
    return build(RenderConfig, {**settings, "backend": "unrealcv", "unrealcv": {"port": port, **QUICK, **own}}, "test")


def opened(port: int, box_map: BoxMap, **own):
    settings = build(UnrealCvRenderConfig, {"port": port, **QUICK, **own}, "test")
    return open_renderer("unrealcv", box_map, 160, 90, settings=settings, num_others=4)


@pytest.mark.slow
def test_a_tree_is_the_embedded_renderers_by_recursive_diff(tmp_path):
    """Step 6's contract: the same folders, files, schemas and frames; poses byte for byte; other pixels of people."""
    given = inputs(tmp_path / "in", 2, 4)
    reference = run(build(RenderConfig, FRAMES, "test"), *given, tmp_path / "gl", seed=5, workers=1)
    with serving(street(), tmp_path / "town", protocol="unrealcv") as port:
        tree = run(config(port, FRAMES), *given, tmp_path / "unrealcv", seed=5, workers=1)
        objects, until_s = "COSFLY", time.monotonic() + 60.0
        while "COSFLY" in str(objects) and time.monotonic() < until_s:  # a guard takes them away when a worker is gone
            time.sleep(1.0)
            connection = connect(UnrealCvConfig(port=port), port)
            objects, pose, size = connection.ask("vget /objects", "vget /camera/0/pose", "vget /camera/0/size")
            connection.close()
        assert "COSFLY" not in str(objects), "nobody is left"
        assert (str(pose).split()[0], size) == ("0.000000", "640 480"), "the camera is where it was"
    for ours, theirs in same_but_for_pictures(tree, reference):
        _, name, rgb, depth, kinds, ids, meta = ours
        _, _, their_rgb, their_depth, their_kinds, their_ids, their_meta = theirs
        rest = (ids != PERSON_ID) & (their_ids != PERSON_ID)
        is_sky = their_depth >= 650.0
        apart = np.abs(depth - their_depth) > np.maximum(their_depth * 2.0**-11, 1e-3) * 1.01
        assert (apart & rest & ~is_sky).sum() <= 8, name
        assert (depth[is_sky & rest] == 1000.0).all(), "half precision ends at 655 m"
        assert ((ids != their_ids) & rest & ~is_sky).sum() <= 8, name
        assert ((kinds != their_kinds) & rest & ~is_sky).sum() <= 8, name
        assert np.abs(rgb[rest].astype(int) - their_rgb[rest]).mean() < 10.0, "houses are painted by other ids"
        assert ((ids == PERSON_ID) == (kinds == KINDS["Pedestrians"])).all()
        assert meta.target.num_pixels == pytest.approx(their_meta.target.num_pixels, rel=0.5)
        assert (meta.drone_pose == their_meta.drone_pose).all()
        assert schema_of(meta.model_dump()) == schema_of(their_meta.model_dump())


def test_people_and_cars_stand_where_they_are_and_the_lens_changes():
    clothes = clothes_of("Base_User_Agent_C")
    pose = world_from_camera(np.array([-1.0, -9.5, 5.5]), np.array([-32.5, 60.0, 0.0]))
    person = PosedPerson(np.array([4.0, -3.0, 0.90625]), 0.0, 0.0, 1.0, clothes)
    car = PosedBystander(other_id(0), PosedCar(np.array([1.0, -4.0, 0.75]), 1.0, (2.25, 0.9, 0.75), 0.3))
    frames = []
    with beside(street()) as port:
        ours = opened(port, exported())
        theirs = open_renderer("gl", exported(), 160, 90, num_others=4)
        for renderer in (ours, theirs):
            frames.append(renderer.render(pose, intrinsic_matrix(160, 90, 60.0), person, [car]))
        near = ours.render(pose, intrinsic_matrix(160, 90, 30.0), person)
        with pytest.raises(RenderError, match=r"cannot render with this intrinsic matrix.*square pixels"):
            ours.render(pose, intrinsic_matrix(160, 90, 60.0) + np.eye(3)[0], None)
        ours.close()
        theirs.close()
    for number in (PERSON_ID, other_id(0)):
        masks = [frame.ids == number for frame in frames]
        assert masks[0].sum() > 30
        assert np.argwhere(masks[0]).mean(axis=0) == pytest.approx(np.argwhere(masks[1]).mean(axis=0), abs=1.5)
    assert (near.ids == PERSON_ID).sum() > 2.5 * (frames[0].ids == PERSON_ID).sum()
    assert not (near.ids == other_id(0)).any(), "who is gone is taken away"


def test_a_camera_that_falls_is_found(monkeypatch):
    done = UnrealCvServer._done

    def fallen(server, command: str) -> bytes:
        if command.startswith("vset /camera/0/pose"):
            words = command.split()
            words[4] = "60.0"  # a pawn that gravity takes down
            command = " ".join(words)
        return done(server, command)

    monkeypatch.setattr(UnrealCvServer, "_done", fallen)
    with beside(street()) as port:
        renderer = opened(port, exported())
        pose = world_from_camera(np.array([-1.0, -9.5, 12.5]), np.array([-32.5, 60.0, 0.0]))
        told = rf"127\.0\.0\.1:{port}, street: the camera is not at the requested.*0\.6 m over the ground.*12\.5 m over"
        with pytest.raises(RenderError, match=told):
            renderer.render(pose, intrinsic_matrix(160, 90, 60.0), None)
        renderer.close()


@pytest.mark.slow
def test_lost_late_double_and_broken_pictures_are_asked_again(tmp_path):
    given = inputs(tmp_path / "in", 1, 5)
    trees = []
    faults = ("drop:depth@2", "duplicate:lit@4", "malformed:object_mask@6", "malformed:depth@8", "delay:lit@10=4")
    for name, planted in {"plain": (), "faulty": faults}.items():
        with serving(street(), tmp_path / name, *planted, protocol="unrealcv") as port:
            cfg = config(port, timeout_s=3.0, animate=False)
            trees.append(run(cfg, *given, tmp_path / f"tree_{name}", workers=1))
    assert files_of(trees[0]) == files_of(trees[1])


@pytest.mark.slow
@pytest.mark.parametrize(("fault", "told"), [("die@6", "refused"), ("hang@6", "no answer in 8 s")])
def test_a_server_that_ends_is_named_and_the_run_goes_on_with_the_next(fault, told, tmp_path):
    given = inputs(tmp_path / "in", 2, 4)
    with (
        serving(street(), tmp_path / "town", fault, protocol="unrealcv") as port,
        pytest.raises(EnvironmentMissing, match=rf"127\.0\.0\.1:{port} \(UnrealCV.*{told}"),
    ):
        run(config(port, timeout_s=8.0), *given, tmp_path / "tree", workers=1)
    assert len(find_tracks(tmp_path / "tree")) == 1
    kept = files_of(tmp_path / "tree")
    with serving(street(), tmp_path / "town", protocol="unrealcv") as port:
        files = files_of(run(config(port), *given, tmp_path / "tree", workers=1))
    assert len(find_tracks(tmp_path / "tree")) == 2
    assert {name: files[name] for name in kept} == kept


@pytest.mark.slow
def test_the_papers_options(tmp_path):
    boxes, simplified, traces = inputs(tmp_path / "in", 2, 3)
    with serving(street(), tmp_path / "town", protocol="unrealcv") as port:
        words = [
            *("render", "--backend", "unrealcv", "--cvip", "127.0.0.1", "--cvport", str(port), "--path-index", "1"),
            *("--no-require-depth", "--require-rgb", "--settle-delay", "0.02", "--coord-scale", "100.0"),
            *("--coord-z-offset", "0.0", "--gif", "--gif-fps", "8", "--gif-name", "look.gif", "--workers", "1"),
            *("--map", str(boxes), "--simplified", str(simplified), "--traces", str(traces)),
            *("--out", str(tmp_path / "render"), "--set", "render.width_px=160", "--set", "render.height_px=90"),
        ]
        done = CliRunner().invoke(app, words, catch_exceptions=False)
    words[words.index("--path-index") + 1], words[words.index("--out") + 1] = "7", str(tmp_path / "other")
    other = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    flights = find_tracks(tmp_path / "render")
    assert {json.loads((f / "trajectory.json").read_text())["source"]["path_index"] for f in flights} == {1}
    names = {p.name for p in (tmp_path / "render").rglob("frame_00000/*")}
    assert "rgb.png" in names
    assert not any(name.startswith("depth") for name in names)
    from PIL import Image

    with Image.open(tmp_path / "render/look.gif") as gif:
        assert (gif.n_frames, gif.info["duration"]) == (3, 120)
    words = "render.path_index: the input has no drone trajectory with this index; got 7; expected an index from 0 to 1"
    assert words in str(other.exception)
    assert not (tmp_path / "other").exists()
