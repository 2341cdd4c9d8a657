"""What a run covers: counted in bins, added up, and told beside the plain run."""

import itertools

import numpy as np
import pytest

from cosfly.formats.playback import read_track
from cosfly.formats.tracks import find_tracks
from cosfly.geometry.coverage import AXES, Coverage, azimuths_deg
from cosfly.inspection.track import coverage_of
from cosfly.viz.coverage_page import coverage_html, ranges, shares
from specimens import make_playback_tree


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    tree = make_playback_tree(tmp_path_factory.mktemp("tree"), 2, 12, width_px=64, height_px=36)
    return [read_track(folder) for folder in find_tracks(tree)]


def test_azimuths_count_from_the_walkers_heading_to_the_left():
    offsets = {(10, 0): 0, (0, 10): 90, (-10, 0.001): 180, (0, -10): -90, (7, 7): 45}
    for heading, ((x, y), azimuth) in itertools.product((0.0, 90.0, -135.0), offsets.items()):
        turn = np.radians(heading)
        turned = [x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn), 20.0]
        found = azimuths_deg(np.array([turned]), np.array([heading]))[0]
        assert (found - azimuth + 180) % 360 - 180 == pytest.approx(0, abs=0.1)


def test_flights_add_up(flights):
    parts = [coverage_of(flight) for flight in flights]
    total = Coverage.total(parts)
    assert total.frames == sum(len(flight) for flight in flights)
    assert sum(total.styles.values()) == sum(total.paces.values()) == total.frames
    heights = np.concatenate([f.positions_m[:, 2] - f.targets_m[:, 2] for f in flights]) + 0.9
    low, high = total.range_of("height_m")
    assert low == pytest.approx(np.quantile(heights, 0.05), abs=2.0)
    assert high == pytest.approx(np.quantile(heights, 0.95), abs=2.0)
    assert all(sum(total.bins[name]) == total.frames for name in ("height_m", "distance_m"))
    assert Coverage.total([]).frames == 0


def test_each_is_told_beside_the_plain_run(flights):
    total = Coverage.total([coverage_of(flight) for flight in flights])
    page = coverage_html(total)
    assert (page.count("<svg"), page.count("<polyline")) == (len(AXES), len(AXES))
    assert {row[0] for row in shares(total, "styles")} == {"follow"}
    assert shares(total, "labels") == []  # nobody captioned them
    assert all(plain != "-" for _, _, plain in ranges(total))
