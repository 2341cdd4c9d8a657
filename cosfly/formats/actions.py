"""The closed set of decisions (tab:coc_actions of the paper): tokens, and their names in both languages.

How much of an action a motion shows is measured in caption/truth/actions.py.
"""

from __future__ import annotations

from typing import NamedTuple

from cosfly.runtime.errors import InputError


class Action(NamedTuple):
    """One action. group: the heading of tables. en: an infinitive."""

    group: str
    en: str
    zh: str


# In the order of prompts, schemas and tables.
ACTIONS = {
    "track_straight": Action("tracking", "keep tracking straight ahead", "保持直线跟踪"),
    "yaw_left_to_follow": Action("heading", "yaw left to follow", "向左偏航跟随"),
    "yaw_right_to_follow": Action("heading", "yaw right to follow", "向右偏航跟随"),
    "circle_left": Action("heading", "circle to the left", "向左环绕"),
    "circle_right": Action("heading", "circle to the right", "向右环绕"),
    "ascend": Action("vertical", "ascend", "上升"),
    "descend": Action("vertical", "descend", "下降"),
    "move_forward": Action("translation", "move forward", "前进"),
    "move_backward": Action("translation", "move backward", "后退"),
    "strafe_left": Action("translation", "strafe left", "向左平移"),
    "strafe_right": Action("translation", "strafe right", "向右平移"),
    "slow_down": Action("speed", "slow down", "减速"),
    "speed_up": Action("speed", "speed up", "加速"),
    "search_to_reacquire_target": Action("recovery", "search to reacquire the target", "搜索以重新捕获目标"),
    "hover": Action("recovery", "hover", "悬停"),
    "break_off": Action("recovery", "break off", "中止跟踪"),
    "return_to_home": Action("recovery", "return to home", "返航"),
}
TOKENS = tuple(ACTIONS)
ORDERS = ("break_off", "return_to_home")  # by a mission; geometry never implies them
BY_LETTERS = {token.replace("_", ""): token for token in TOKENS}

# Terms that a translation must have besides the names of the actions: English -> Chinese.
TERMS = {
    "target": "目标",
    "pedestrian": "行人",
    "drone": "无人机",
    "bounding box": "边界框",
    "image centre": "画面中心",
    "horizontal distance": "水平距离",
    "altitude": "高度",
    "yaw": "偏航",
    "speed": "速度",
    "current frame": "当前帧",
    "obstacle": "障碍物",
    "stable": "稳定",
}


def not_in_set(token: object, where: object) -> InputError:
    """Return the error of a decision that is not in the set."""
    what, expected = "not an action of the closed set", f"one of {', '.join(TOKENS)}"
    return InputError(what, where=str(where), got=str(token), expected=expected)
