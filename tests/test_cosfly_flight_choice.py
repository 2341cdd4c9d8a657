"""Trees of somebody else: some flights, one track, flights behind links, several trees; to captions and a release."""

from pathlib import Path

import pytest
from specimens_foreign import write_foreign_tree

from cosfly.formats.places import TrackChoice
from cosfly.formats.tracks import find_tracks
from cosfly.runtime.errors import InputError

TOWNS, NAMES = ("Town01", "Town02_Opt"), ("trajectory_1777083733", "trajectory_1777090000")


@pytest.fixture(scope="module")
def tree(tmp_path_factory) -> Path:
    return write_foreign_tree(
        tmp_path_factory.mktemp("public") / "tree", towns=TOWNS, trajectories=NAMES, num_points=14
    )


def names(tree: Path, **choice) -> list[str]:
    return [folder.relative_to(tree).as_posix() for folder in find_tracks(tree, TrackChoice(**choice))]


def test_patterns_are_of_folders_and_those_above_them(tree):
    for choice, count in (
        ({}, 8), ({"match": ("Town01",)}, 4), ({"match": ("Town0[12]*/trajectory_177708*",)}, 4),
        ({"match": ("*/ORI",)}, 4),
        ({"match": ("Town01/trajectory_1777083733/ORI", "Town02_Opt/trajectory_1777090000/")}, 3),
        ({"tracks": ("clean",)}, 4), ({"match": ("Town02*",), "tracks": ("perturbed",)}, 2),
    ):  # fmt: skip
        found = names(tree, **choice)
        assert len(found) == count
        assert set(found) <= set(names(tree))
    words = r"no track folder in this directory matches the patterns of --flights; got Town9; .*Town01/trajectory_1777083733/ORI"
    with pytest.raises(InputError, match=words):
        names(tree, match=("Town9",))
    with pytest.raises(InputError, match="this directory has no perturbed track among those that match --flights"):
        names(tree, match=("*/ORI",), tracks=("perturbed",))
