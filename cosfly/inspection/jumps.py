"""Do the frames of a flight show one world? What stands still is carried from each frame into the next (`cosfly/space/reprojection.py`), and what
comes out otherwise than the poses say is a jump: something vanished, or another place.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cosfly.geometry import world_from_camera
from cosfly.inspection.pixels import Picture
from cosfly.inspection.settings import InspectConfig
from cosfly.products.frames import frame_name
from cosfly.products.issues import Report
from cosfly.products.playback import Flight
from cosfly.space.reprojection import Agreement, View, compare_views

NEAR_FRAMES = 2  # farther apart, more is hidden behind other things than is seen twice
LEAST_SEEN = 150  # points, for a share of them to mean something
USUAL_AGREE, ROUGH_ERROR = 0.8, 1e-3  # of the points; of planes, as a share of the depth


@dataclass
class Jumps:
    """Compares depth and ids of each frame with the one before, through their poses. Colours say nothing: light, rain and zoom change them."""

    flight: Flight
    _before: tuple[int, View] | None = None
    _frames: list[int] = field(default_factory=list)
    _found: list[Agreement] = field(default_factory=list)

    def see(self, i: int, picture: Picture) -> None:
        """Take the next frame, which has depth."""
        flight = self.flight
        pose = world_from_camera(flight.positions_m[i], flight.rotations_deg[i])
        view = View(picture.depth, picture.instance, np.ascontiguousarray(pose[:3, :3]), pose[:3, 3].copy())
        if self._before is not None and i - self._before[0] <= NEAR_FRAMES:
            k, before = self._before
            intrinsics = [flight.camera_at(j).intrinsic[[0, 1, 0, 1], [0, 1, 2, 2]] for j in (k, i)]
            self._frames.append(i)
            self._found.append(compare_views(before, view, *intrinsics))
        self._before = (i, view)

    def judge(self, cfg: InspectConfig, report: Report) -> int:
        """Report the jumps; gives how many frames were judged: none where the depth of somebody else's flight is no world's."""
        if not self.flight.is_ours and not self._is_one_world():
            return 0
        for i, pair in zip(self._frames, self._found, strict=True):
            if pair.seen < LEAST_SEEN:
                continue
            gone, agree, where = pair.through / pair.seen, pair.agree / pair.seen, f"{frame_name(i)}/depth.npy"
            if gone > cfg.jump_gone_max:
                got = f"{gone:.1%} of what the frame before shows is gone"
                report.warn("temporal_jump", where, got, f"at most {cfg.jump_gone_max:.1%}")
            elif agree < cfg.jump_agree_min:
                got = f"{agree:.0%} of what the frame before shows is where the poses put it"
                report.warn("temporal_jump", where, got, f"at least {cfg.jump_agree_min:.0%}")
        return len(self._found)

    def _is_one_world(self) -> bool:
        """Tell whether most pairs of frames agree: rough depth agrees with nothing, and is equally rough everywhere."""
        pairs = [pair for pair in self._found if pair.seen >= LEAST_SEEN]
        agree = [pair.agree / pair.seen for pair in pairs]
        errors = [pair.error for pair in pairs if np.isfinite(pair.error)]
        is_near = bool(pairs) and float(np.median(agree)) >= USUAL_AGREE
        return is_near and (not errors or float(np.median(errors)) <= ROUGH_ERROR)
