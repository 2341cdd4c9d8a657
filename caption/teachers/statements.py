"""Statements about a window in both languages: the critical components of the rule teacher.

Each statement is a choice of wordings, each wording an English and a Chinese text of the same facts.
"""

from __future__ import annotations

from caption.truth.facts import Facts

Both = tuple[str, str]  # English, Chinese

CENTERED_SHARE = 0.02  # of the image width: nearer than this to the middle counts as centred

_SEEN: dict[str, tuple[Both, ...]] = {
    "visible": (
        ("the target pedestrian is visible", "目标行人可见"),
        ("the pedestrian is visible in the current frame", "行人在当前帧中可见"),
    ),
    "partly_occluded": (
        ("the target pedestrian is visible but partly occluded", "目标行人可见但被部分遮挡"),
        ("the pedestrian is partly occluded yet still visible", "行人被部分遮挡但仍可见"),
    ),
    "occluded": (
        ("the target pedestrian is occluded in the current frame", "目标行人在当前帧中被遮挡"),
        ("the pedestrian is currently occluded", "行人当前被遮挡"),
    ),
    "out_of_view": (
        ("the target pedestrian is out of view", "目标行人在视野外"),
        ("the pedestrian is out of view in the current frame", "行人在当前帧中处于视野外"),
    ),
}


def describe(f: Facts) -> list[tuple[Both, ...]]:
    """Give the statements about a window, each as a tuple of wordings of equal meaning."""
    parts = [_SEEN[f.visibility[-1]]]
    if f.is_visible_now:
        parts += [part for part in (_box(f), _position(f)) if part]
    parts += [part for part in (_walk(f), _distance(f), _speed(f), _altitude(f), _yaw(f)) if part]
    return parts


def _walk(f: Facts) -> tuple[Both, ...] | None:
    if f.target_speed_mps is None:
        return None
    speed = f"{f.target_speed_mps:.2f}"
    if f.target_speed_mps < 0.2:
        return ((f"the target stands almost still ({speed} m/s)", f"目标几乎静止（{speed} 米/秒）"),)
    if f.target_turn_deg is not None and abs(f.target_turn_deg) >= 15.0:
        en, zh = ("left", "左") if f.target_turn_deg > 0 else ("right", "右")
        return (
            (f"the target walks at {speed} m/s and bends to the {en}", f"目标以 {speed} 米/秒行走并向{zh}转弯"),
            (f"the target moves at {speed} m/s, bending to the {en}", f"目标以 {speed} 米/秒移动，并向{zh}转弯"),
        )
    return (
        (f"the target walks at {speed} m/s", f"目标以 {speed} 米/秒行走"),
        (f"the target moves at {speed} m/s", f"目标以 {speed} 米/秒移动"),
    )


def _box(f: Facts) -> tuple[Both, ...] | None:
    w0, h0, w1, h1 = f.box_width_px[0], f.box_height_px[0], f.box_width_px[-1], f.box_height_px[-1]
    if w1 is None or h1 is None:
        return None
    if w0 is None or h0 is None or abs(h1 - h0) < max(2.0, 0.08 * h0):
        return (
            (f"the bounding box measures about {w1} x {h1} px", f"边界框约为 {w1} × {h1} 像素"),
            (f"its bounding box is about {w1} x {h1} px", f"边界框大小约 {w1} × {h1} 像素"),
        )
    en, zh = ("grows", "增大") if h1 > h0 else ("shrinks", "缩小")
    english = f"the bounding box {en} from {w0} x {h0} px to {w1} x {h1} px"
    return ((english, f"边界框从 {w0} × {h0} 像素{zh}到 {w1} × {h1} 像素"),)


def _position(f: Facts) -> tuple[Both, ...] | None:
    dx = f.offset_x_px[-1]
    if dx is None:
        return None
    if abs(dx) < max(2.0, CENTERED_SHARE * f.width_px):
        return (
            ("it stays close to the image centre", "目标位置接近画面中心"),
            ("it lies near the image centre", "目标位于画面中心附近"),
        )
    en, zh = ("right", "右") if dx > 0 else ("left", "左")
    n = abs(dx)
    return (
        (f"it lies {n} px to the {en} of the image centre", f"目标位于画面中心{zh}侧 {n} 像素处"),
        (f"it sits {n} px {en} of the image centre", f"目标在画面中心偏{zh} {n} 像素处"),
    )


def _distance(f: Facts) -> tuple[Both, ...] | None:
    first, last = f.distance_m[0], f.distance_m[-1]
    if first is None or last is None:
        return None
    if abs(last - first) < 0.5:
        return (
            (f"the horizontal distance stays near {last:.1f} m", f"水平距离保持在约 {last:.1f} 米"),
            (f"the horizontal distance is about {last:.1f} m", f"水平距离约为 {last:.1f} 米"),
        )
    en, zh = ("increases", "增加") if last > first else ("decreases", "减小")
    old, new = f"{first:.1f}", f"{last:.1f}"
    return ((f"the horizontal distance {en} from {old} m to {new} m", f"水平距离从 {old} 米{zh}到 {new} 米"),)


def _speed(f: Facts) -> tuple[Both, ...]:
    first, last = f.speed_mps[1], f.speed_mps[-1]
    assert first is not None
    assert last is not None
    if abs(last - first) < 0.4:
        return (
            (f"the drone speed is {last:.2f} m/s", f"无人机速度为 {last:.2f} 米/秒"),
            (f"the drone flies at {last:.2f} m/s", f"无人机以 {last:.2f} 米/秒飞行"),
        )
    en, zh = ("increases", "增加") if last > first else ("decreases", "减小")
    old, new = f"{first:.2f}", f"{last:.2f}"
    return ((f"the drone speed {en} from {old} m/s to {new} m/s", f"无人机速度从 {old} 米/秒{zh}到 {new} 米/秒"),)


def _altitude(f: Facts) -> tuple[Both, ...]:
    first, last = f.altitude_m[0], f.altitude_m[-1]
    if abs(last - first) < 0.5:
        return (
            (f"the altitude is about {last:.1f} m", f"高度约为 {last:.1f} 米"),
            (f"the altitude holds near {last:.1f} m", f"高度维持在约 {last:.1f} 米"),
        )
    en, zh = ("climbs", "爬升") if last > first else ("descends", "下降")
    old, new = f"{first:.1f}", f"{last:.1f}"
    return ((f"the drone {en} in altitude from {old} m to {new} m", f"无人机高度从 {old} 米{zh}到 {new} 米"),)


def _yaw(f: Facts) -> tuple[Both, ...]:
    total = f.yaw_deg[-1]
    if abs(total) < 1.0 and max(f.yaw_deg) - min(f.yaw_deg) >= 2.0:
        return (("the yaw wavers around its first value", "偏航角在初始值附近摆动"),)
    if abs(total) < 1.0:
        return (("the yaw is steady", "偏航角平稳"), ("the yaw hardly changes", "偏航角几乎不变"))
    en, zh = ("left", "左") if total > 0 else ("right", "右")
    return ((f"the yaw has turned {abs(total):.1f} deg to the {en}", f"偏航角已向{zh}转动 {abs(total):.1f} 度"),)
