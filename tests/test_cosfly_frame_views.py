"""Frames as pictures: one look for teachers, students and people."""

import base64
import io

import numpy as np
import pytest
from PIL import Image

from caption.schema import ImageConfig
from caption.teachers.images import FrameEncoder
from cosfly.errors import InputError
from cosfly.frame_views import VIEW_FILES, depth_colors, read_view, segmentation_colors, thumbnail
from cosfly.products.kinds import KINDS
from cosfly.products.playback import find_flights, read_flight
from distill.encoding import load_image
from specimens import PERSON_ID, make_playback_tree


@pytest.fixture(scope="module")
def frame(tmp_path_factory):
    tree = tmp_path_factory.mktemp("tree")
    make_playback_tree(tree, 1, 2, with_augmented=False)
    return read_flight(find_flights(tree)[0]).frame_folder(1)


def test_depth_colors_near_is_bright_and_sky_is_dark():
    depth = np.array([[0.5, 50.0, 99.9, 1000.0, 0.0]], dtype=np.float32)
    brightness = depth_colors(depth, 100.0).sum(axis=2)[0]
    assert brightness[0] > brightness[1] > brightness[2]
    assert brightness[3] == brightness[4] <= brightness[2]


def test_only_the_pedestrian_is_vivid():
    kinds = np.array([[KINDS["Buildings"], KINDS["Pedestrians"], KINDS["Sky"]]], dtype=np.uint8)
    ids = np.array([[3, PERSON_ID, 0]], dtype=np.uint16)
    colors = segmentation_colors(kinds, ids)[0].astype(int)
    spread = colors.max(axis=1) - colors.min(axis=1)
    assert spread[1] > 200
    assert max(spread[0], spread[2]) < 80


def test_depth_colors_mark_sky_and_invalid():
    colors = depth_colors(np.array([[1000.0, 0.0, 3.0, 90.0]], np.float32))
    dark = depth_colors(np.array([[100.0]], np.float32))[0, 0]
    assert (colors[0, :2] == dark).all()
    assert colors[0, 2].sum() > colors[0, 3].sum() > dark.sum()


@pytest.mark.parametrize("view", list(VIEW_FILES))
def test_a_student_sees_what_its_teacher_saw(frame, view):
    (image,) = FrameEncoder(ImageConfig(encoding="png")).encode(frame, (view,))
    seen = Image.open(io.BytesIO(base64.b64decode(image.url.partition(",")[2]))).convert("RGB")
    assert np.array_equal(np.asarray(seen), np.asarray(load_image(frame / VIEW_FILES[view])))
    assert np.array_equal(np.asarray(seen), read_view(frame, view))


def test_what_is_no_picture_is_refused(frame):
    with pytest.raises(InputError, match=r"not a picture.*rgb\.png"):
        load_image(frame / "meta.json")


def test_a_thumbnail_is_a_small_jpeg_or_nothing(frame, tmp_path):
    small = Image.open(io.BytesIO(base64.b64decode(thumbnail(frame, 20))))
    assert (small.format, small.width) == ("JPEG", 20)
    assert thumbnail(tmp_path, 20) is None
