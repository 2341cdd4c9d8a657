"""Effects of a camera: each changes colours as it says, and nothing else; off is off."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from test_cosfly_render import needs_gl
from test_renderers_contract import circling, write_inputs

from cosfly.geometry import intrinsic_matrix
from cosfly.products.flights import find_flights
from cosfly.products.frames import LEGIBLE_CONTRAST, Camera, TargetMeta, frame_name, read_meta
from cosfly.products.playback import read_flight
from cosfly.render.camera import contrast_of, legibility
from cosfly.render.effects import Effects, EffectsConfig, bent
from cosfly.render.perturbation import Poses
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import run
from cosfly.work.config import build

CAMERA = Camera(160, 90, intrinsic_matrix(160, 90, 75.0))
ALL = {"exposure_s": 0.02, "vibration_dps": 10, "noise": 3, "vignette": 0.3, "distortion_k1": 0.05, "jpeg_quality": 70}


def effects_of(**settings) -> Effects:
    trace = circling()
    poses = Poses(trace.positions_m, trace.rotations_deg, trace.targets_m, trace.clearances_m)
    return Effects(EffectsConfig(**settings), poses, trace.time_s, 3, "path_000/aug_001")


def street() -> tuple[np.ndarray, np.ndarray]:
    """A picture of blocks, and its depth."""
    blocks = np.random.default_rng(0).integers(60, 200, (9, 16, 3), dtype=np.uint8)
    rgb = cv2.GaussianBlur(np.kron(blocks, np.ones((10, 10, 1), np.uint8)), (5, 5), 1.0)
    return rgb, np.full((90, 160), 12.0, np.float32)


def changed(**settings) -> np.ndarray:
    rgb, depth = street()
    return effects_of(**settings).apply(rgb, depth, CAMERA, 2).astype(float) - rgb


def test_each_is_off_at_zero_and_grows():
    assert not EffectsConfig().is_on
    assert not changed().any()
    for name, weak, strong in (
        ("exposure_s", 0.02, 0.2), ("noise", 2, 9), ("vignette", 0.2, 0.6), ("distortion_k1", 0.02, 0.2),
        ("jpeg_quality", 90, 10),
    ):  # fmt: skip
        one, other = (np.abs(changed(**{name: value})).mean() for value in (weak, strong))
        assert 0 < one < other, name
        assert EffectsConfig(**{name: weak}).is_on


def test_chance_comes_from_seed_flight_and_frame():
    rgb, depth = street()
    effects = effects_of(**ALL)
    first = effects.apply(rgb, depth, CAMERA, 1)
    assert (first == effects_of(**ALL).apply(rgb, depth, CAMERA, 1)).all()
    for other in (replace(effects, seed=4), replace(effects, item="path_001/aug_001")):
        assert (first != other.apply(rgb, depth, CAMERA, 1)).any()
    assert (first != effects.apply(rgb, depth, CAMERA, 2)).any()


def test_blur_is_that_of_the_motion():
    """A drone that flies sideways at 5 m/s past a wall 12 m away: the picture moves by the parallax, in its middle by
    nothing; one that stands still blurs nothing."""
    rgb, depth = street()
    still, n = effects_of(exposure_s=0.1), 6
    place, turn = np.array([0.0, 0.0, 9.0]), np.zeros((n, 3))
    way = place + np.outer(0.5 * np.arange(n), [0.0, 5.0, 0.0])
    poses = Poses(np.tile(place, (n, 1)), turn, way, np.ones(n))
    assert (replace(still, planned=poses).apply(rgb, depth, CAMERA, 2) == rgb).all()
    moving = replace(still, planned=replace(poses, positions_m=way)).apply(rgb, depth, CAMERA, 2)
    length_px = 5.0 * 0.1 / 12.0 * CAMERA.focal_px
    at = np.linspace(-0.5, 0.5, int(np.ceil(length_px)) + 1) * length_px
    rows = [np.interp(np.arange(160) + shift, np.arange(160), rgb[45, :, 0]) for shift in at]
    assert np.abs(np.mean(rows, axis=0) - moving[45, :, 0])[10:-10].max() < 2.0


def test_noise_is_stronger_in_dark_pictures_and_the_corners_are_darker():
    grey, depth = np.full((90, 160, 3), 110, np.uint8), street()[1]
    noise = effects_of(noise=4.0)
    assert noise.apply(grey, depth, CAMERA, 0).std() == pytest.approx(4.0, rel=0.05)
    assert noise.apply(grey // 8, depth, CAMERA, 0).std() > 4.5
    shaded = effects_of(vignette=0.4).apply(grey, depth, CAMERA, 0)
    assert abs(int(shaded[0, 0, 0]) - 66) <= 1
    assert shaded[45, 80, 0] == 110


def test_a_bent_picture_is_straightened_by_the_model_on_record():
    rgb, _ = street()
    distortion = EffectsConfig(distortion_k1=0.1, distortion_k2=0.02).distortion
    assert distortion is not None
    middle = CAMERA.intrinsic - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # OpenCV's first pixel is at 0
    back = cv2.undistort(bent(rgb, CAMERA.intrinsic, distortion), middle, np.array(distortion))
    inner = np.abs(back.astype(int) - rgb)[20:-20, 30:-30]
    assert inner.mean() < 1.5 < np.abs(bent(rgb, CAMERA.intrinsic, distortion).astype(int) - rgb)[20:-20, 30:-30].mean()


@needs_gl
def test_labels_are_the_same_and_the_clean_track_is_as_drawn(tmp_path):
    boxes, simplified, traces = write_inputs(tmp_path, [circling(4)])
    size = {"width_px": 160, "height_px": 90, "first_timestamp": 1_700_000_000}
    cfg = build(RenderConfig, size | {"effects": ALL}, "test")
    plain, other = (
        run(one, boxes, simplified, traces, tmp_path / name)
        for name, one in (("plain", build(RenderConfig, size, "test")), ("effects", cfg))
    )
    assert "effects" in cfg.recorded()
    assert "effects" not in build(RenderConfig, size, "test").recorded()
    for folder in find_flights(plain):
        twin = other / folder.relative_to(plain)
        is_clean = folder.name == "ORI"
        for path in folder.rglob("frame_*/*"):
            same = path.read_bytes() == (twin / path.relative_to(folder)).read_bytes()
            assert same == (is_clean or path.name not in ("rgb.png", "meta.json")), path
        mine, theirs = read_flight(folder), read_flight(twin)
        assert (mine.target_bbox == theirs.target_bbox).all()
        assert theirs.distortion == ([0.0] * 5 if is_clean else [0.05, 0.0, 0.0, 0.0, 0.0])
        assert (read_meta(Path(twin) / frame_name(2)).camera.distortion is None) == is_clean


def test_contrast_is_of_the_person_against_what_is_around():
    rgb, is_person = np.full((90, 160, 3), 120, np.uint8), np.zeros((90, 160), bool)
    assert contrast_of(rgb, is_person) is None
    is_person[40:60, 70:78] = True
    assert contrast_of(rgb, is_person) == pytest.approx(0.0, abs=0.1)
    rgb[40:50, 70:78] = 30  # a dark jacket over trousers of the ground's colour
    dark = contrast_of(rgb, is_person)
    assert dark is not None
    assert dark > 30
    rgb[:, 120:] = 255  # far beside
    assert contrast_of(rgb, is_person) == dark
    fog = (0.95 * 150 + 0.05 * rgb.astype(float)).astype(np.uint8)
    assert (contrast_of(fog, is_person) or 0.0) < LEGIBLE_CONTRAST


@pytest.mark.parametrize(
    ("change", "is_legible"),
    [({}, True), ({"visible": False}, False), ({"visibility": 0.2}, False), ({"contrast": 3.0}, False),
     ({"contrast": None}, False), ({"bbox_2d": [0.0, 0.0, 6.0, 15.0]}, False), ({"bbox_2d": None}, False)],
)  # fmt: skip
def test_legible_is_what_the_bounds_say(change, is_legible):
    change = {"visible": True, "visibility": 0.9, "bbox_2d": [0.0, 0.0, 8.0, 20.0], "contrast": 20.0} | change
    target = TargetMeta.model_construct(**change)
    told = legibility(target, change["contrast"])
    assert told["legible"] == is_legible
    assert told["height_px"] == (0.0 if target.bbox_2d is None else target.bbox_2d[3])


@needs_gl
def test_legibility_is_of_the_picture_as_written(tmp_path):
    """In dense fog the person is visible, and nobody can make them out; a lens bends person and mask alike."""
    boxes, simplified, traces = write_inputs(tmp_path, [circling(3)])
    size = {"width_px": 320, "height_px": 180, "fovs_deg": [60], "tracks": ["clean"]}
    fog = {"thickest": {"cloudiness": 90.0, "precipitation": 0.0, "fog_density": 100.0, "fog_distance": 1.0}}
    (tmp_path / "fog.yaml").write_text(json.dumps({"presets": fog}))
    dim = {"weather_mode": "fixed", "weather_name": "thickest", "tod_name": "noon",
           "weather_pool": str(tmp_path / "fog.yaml")}  # fmt: skip
    bent_too = {"effects": {"distortion_k1": 0.2, "tracks": ["clean"]}}
    found = {}
    for name, more in (("plain", {}), ("bent", bent_too), ("fog", dim)):
        tree = run(build(RenderConfig, size | more, "test"), boxes, simplified, traces, tmp_path / name)
        (folder,) = find_flights(tree)
        flight = read_flight(folder)
        found[name] = flight.told_legibility(1)
        told = read_meta(folder / frame_name(1)).target
        assert found[name] == told.model_dump(include=set(found[name]))
        assert flight.target_visible.all()
    assert found["plain"]["legible"] is found["bent"]["legible"] is True
    assert found["bent"]["contrast"] == pytest.approx(found["plain"]["contrast"], rel=0.25)
    assert found["fog"]["legible"] is False
    assert float(found["fog"]["contrast"]) < LEGIBLE_CONTRAST
