"""Do the frames of a flight show one world? What stands still is carried from each frame into the next (`cosfly/space/reprojection.py`), and what
comes out otherwise than the poses say is a jump: something vanished, another picture, a lamp that went out.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cosfly.geometry import world_from_camera
from cosfly.inspection.pixels import Picture
from cosfly.inspection.settings import InspectConfig
from cosfly.products.frames import frame_name, grid_rows
from cosfly.products.issues import Report
from cosfly.products.playback import Flight
from cosfly.space.reprojection import Agreement, View, compare_views, is_zoomed, usual_correlations

NEAR_FRAMES = 2  # farther apart, more is hidden behind other things than is seen twice
LEAST_SEEN, LEAST_AGREE = 150, 100  # points, for a share of them to mean something
TIMES_USUAL = 8.0
USUAL_AGREE, ROUGH_ERROR = 0.8, 1e-3  # of the points; of planes, as a share of the depth
USUAL_LEAST = 0.6  # correlation from frame to frame: pictures that agree less are no measure for each other


@dataclass
class Jumps:
    """Compares each frame with the one before; colours only where both were drawn in the same light and air (`air`) and as large."""

    flight: Flight
    _before: tuple[int, View, object] | None = None
    _frames: list[int] = field(default_factory=list)
    _found: list[Agreement] = field(default_factory=list)
    _same_air: list[bool] = field(default_factory=list)

    def see(self, i: int, picture: Picture, air: object) -> None:
        """Take the next frame, which has depth; air: what it was drawn in, anything that compares."""
        flight = self.flight
        pose = world_from_camera(flight.positions_m[i], flight.rotations_deg[i])
        rows = picture.colours[grid_rows(picture.colours.shape[0])]
        view = View(picture.depth, picture.instance, rows, np.ascontiguousarray(pose[:3, :3]), pose[:3, 3].copy())
        if self._before is not None and i - self._before[0] <= NEAR_FRAMES:
            k, before, air_before = self._before
            intrinsics = [flight.camera_at(j).intrinsic[[0, 1, 0, 1], [0, 1, 2, 2]] for j in (k, i)]
            self._frames.append(i)
            self._found.append(compare_views(before, view, *intrinsics))
            self._same_air.append(air == air_before and not is_zoomed(*intrinsics))
        self._before = (i, view, air)

    def judge(self, cfg: InspectConfig, report: Report) -> int:
        """Report the jumps; gives how many frames were judged: none where the depth of somebody else's flight is no world's."""
        if not self.flight.is_ours and not self._is_one_world():
            return 0
        colours = [pair.correlation if same else np.nan for pair, same in zip(self._found, self._same_air, strict=True)]
        shades = np.array(
            [abs(pair.shade) if same else np.nan for pair, same in zip(self._found, self._same_air, strict=True)]
        )
        known = shades[np.isfinite(shades)]
        # Pictures whose brightness is never the same have another cause than a jump.
        brightness_max = max(cfg.jump_brightness_max, TIMES_USUAL * float(np.median(known)) if len(known) else 0.0)
        focal_px = np.array([self.flight.camera_at(i).intrinsic[0, 0] for i in self._frames])
        usuals, drops = usual_correlations(np.array(colours), focal_px, cfg.jump_colour_drop)
        for i, pair, same_air, usual, drop in zip(
            self._frames, self._found, self._same_air, usuals, drops, strict=True
        ):
            if pair.seen < LEAST_SEEN:
                continue
            gone, agree, where = pair.through / pair.seen, pair.agree / pair.seen, frame_name(i)
            if gone > cfg.jump_gone_max:
                got = f"{gone:.1%} of what the frame before shows is gone"
                report.warn("temporal_jump", f"{where}/depth.npy", got, f"at most {cfg.jump_gone_max:.1%}")
            elif agree < cfg.jump_agree_min:
                got = f"{agree:.0%} of what the frame before shows is where the poses put it"
                report.warn("temporal_jump", f"{where}/depth.npy", got, f"at least {cfg.jump_agree_min:.0%}")
            elif not same_air or pair.agree < LEAST_AGREE:
                continue
            elif usual >= USUAL_LEAST and pair.correlation < usual - drop:
                got = f"colours that agree by {pair.correlation:.2f} with the frame before"
                report.warn(
                    "temporal_jump", f"{where}/rgb.png", got, f"at least {usual - drop:.2f}, by the other frames"
                )
            elif abs(pair.shade) > brightness_max:
                got = f"{pair.shade:+.0f} grey levels beside the frame before"
                report.warn("temporal_jump", f"{where}/rgb.png", got, f"at most {brightness_max:g}")
        return len(self._found)

    def _is_one_world(self) -> bool:
        """Tell whether most pairs of frames agree: rough depth agrees with nothing, and is equally rough everywhere."""
        pairs = [pair for pair in self._found if pair.seen >= LEAST_SEEN]
        agree = [pair.agree / pair.seen for pair in pairs]
        errors = [pair.error for pair in pairs if np.isfinite(pair.error)]
        is_near = bool(pairs) and float(np.median(agree)) >= USUAL_AGREE
        return is_near and (not errors or float(np.median(errors)) <= ROUGH_ERROR)
